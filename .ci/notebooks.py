"""Make notebooks that Colab opens, which reads .ipynb files of GitHub only.

    python .ci/notebooks.py https://github.com/OWNER/NAME FOLDER

The first cell of each installs the package from that repository. The docs workflow
publishes the folder as the branch `colab`, to which the pages of the site link.
"""

import pathlib
import re
import sys

import jupytext

ROOT = pathlib.Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "docs/notebooks"
BRANCH = "colab"
BADGE = "https://colab.research.google.com/assets/colab-badge.svg"


def converted(path, repository):
    """Read a notebook whose first code cell installs from a repository."""
    notebook = jupytext.read(path)
    first = next(cell for cell in notebook.cells if cell.cell_type == "code")
    first.source, count = re.subn(
        r'"(nerfies-jax\[[\w,]+\])"', rf'"\1 @ git+{repository}"', first.source
    )
    if not (count and first.source.startswith("%pip install ")):
        raise SystemExit(f"{path}: its first cell must install the package")
    return notebook


def address(repository, name):
    """Return the address at which Colab opens a notebook."""
    owner_and_name = repository.rstrip("/").split("/", 3)[3]
    site = "https://colab.research.google.com/github"
    return f"{site}/{owner_and_name}/blob/{BRANCH}/{name}.ipynb"


def main(repository, folder):
    """Write all notebooks into a folder."""
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted(NOTEBOOKS.glob("*.py")):
        notebook = converted(path, repository.rstrip("/"))
        jupytext.write(notebook, folder / f"{path.stem}.ipynb")


if __name__ == "__main__":
    main(*sys.argv[1:])
