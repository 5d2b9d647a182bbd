"""Pages of the documentation site that other files of this repository hold.

A hook of mkdocs (mkdocs.yml). README is the first page, notebooks and the API reference
are made into pages, and links out of docs lead to their copies on the site. With
PLAYERS=FOLDER, the player.html files there (NAME.html) are in the gallery. With
REPOSITORY=https://github.com/OWNER/NAME, pages of notebooks link to Colab.
"""

import ast
import importlib.util
import os
import pathlib
import re
import shutil

import jupytext
from mkdocs.structure.files import File

ROOT = pathlib.Path(__file__).resolve().parents[1]
_SPEC = importlib.util.spec_from_file_location("notebooks", ROOT / ".ci/notebooks.py")
colab = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(colab)
# Files beside docs that pages link, with their place on the site.
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changes.md",
    "SECURITY.md": "security.md",
    "CODE_OF_CONDUCT.md": "code_of_conduct.md",
}
COPIES = {"CITATION.cff": "CITATION.cff", "Dockerfile": "Dockerfile.txt"}
FACES = {"nj": "nerfies_jax", "gj": "gaussians_jax", "runs": "nerfies_jax.runs"}
# Topics of the API by where a public name is defined, the first that fits.
TOPICS = {
    "Rasterization and rendering": ("gaussians_jax.splatting",),
    "Gaussians: scenes, files, tracks": (
        *("gaussians_jax.core", "gaussians_jax.scene", "gaussians_jax.io"),
        "gaussians_jax.runs",
    ),
    "Gaussians: protocols": (
        *("gaussians_jax.motion", "gaussians_jax.strategy", "gaussians_jax.losses"),
    ),
    "Radiance fields": ("nerfies_jax.fields", "nerfies_jax.scene"),
    "Geometry": ("nerfies_jax.geometry",),
    "Networks and encodings": ("nerfies_jax.nn",),
    "Captures and runs": ("nerfies_jax.runs",),
    "Training and evaluation": ("nerfies_jax.training", "nerfies_jax.evaluation"),
    "Metrics": ("nerfies_jax.metrics",),
    "Checks of arguments": ("nerfies_jax.runtime",),
}


def on_files(files, config):
    """Add the pages that are not in docs."""
    texts = {new: linked((ROOT / old).read_text(), old) for old, new in PAGES.items()}
    for path in sorted((ROOT / "docs/notebooks").glob("*.py")):
        texts[f"notebooks/{path.stem}.md"] = notebook(path)
        files.remove(files.get_file_from_path(f"notebooks/{path.name}"))
    for topic, entries in api().items():
        texts[f"api/{file_name(topic)}.md"] = api_page(topic, entries)
    texts["gallery.md"] = gallery(players())
    for name, text in texts.items():
        files.append(File.generated(config, name, content=text))
    for old, new in COPIES.items():
        text = (ROOT / old).read_text()
        files.append(File.generated(config, new, content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Let links to files beside docs lead to their copies."""
    above = "../" * page.file.src_uri.count("/")
    for old, new in (PAGES | COPIES).items():
        markdown = re.sub(
            rf"\]\((?:\.\./)+{re.escape(old)}", f"]({above}{new}", markdown
        )
    if page.file.src_uri == "notebooks/README.md":
        markdown = re.sub(r"\]\((\w+)\.py\)", r"](\1.md)", markdown)
    return markdown


def on_post_build(config):
    """Copy the players."""
    for path in players():
        target = pathlib.Path(config["site_dir"], "players", path.name)
        target.parent.mkdir(exist_ok=True)
        shutil.copy(path, target)


def linked(text, name):
    """Return a page of the root folder with links as on the site."""
    for old, new in (PAGES | COPIES).items():
        text = text.replace(f"]({old}", f"]({new}")
    text = text.replace("](docs/", "](")
    if name == "CONTRIBUTING.md":
        return text.replace("](../", "](")
    return text


def notebook(path):
    """Return a notebook as a page."""
    repository = os.environ.get("REPOSITORY")
    parts = []
    if repository:
        target = colab.address(repository, path.stem)
        parts.append(f"[![Open in Colab]({colab.BADGE})]({target})")
    for cell in jupytext.read(path).cells:
        code = cell.cell_type == "code"
        parts.append(f"```python\n{cell.source}\n```" if code else cell.source)
    return "\n\n".join(parts) + "\n"


def players():
    """List the players that the site shows."""
    folder = os.environ.get("PLAYERS")
    return sorted(pathlib.Path(folder).glob("*.html")) if folder else []


def gallery(paths):
    """Return the page of players."""
    parts = ["# Gallery", "Reconstructions of built-in scenes. Drag to look around."]
    if not paths:
        parts[1] = "![A reconstruction in the player](images/player.jpg)"
        parts.append(
            "This copy of the site was built without players. The published one has "
            "a live player of each built-in scene."
        )
    for path in paths:
        parts.append(f"## {path.stem}")
        parts.append(
            f'<iframe src="../players/{path.name}" title="{path.stem}" loading="lazy" '
            'style="width:100%;aspect-ratio:4/3;border:0"></iframe>'
        )
    return "\n\n".join(parts) + "\n"


def api():
    """List by topic the public names with the objects that they are."""
    topics = {topic: [] for topic in TOPICS}
    for short, package in FACES.items():
        for name, where in names_of(package):
            fits = (t for t, places in TOPICS.items() if where.startswith(places))
            topics[next(fits)].append((f"{short}.{name}", where))
    return topics


def names_of(package):
    """Yield the names of a stub, and where each is defined."""
    folder = ROOT.joinpath(*package.split("."))
    for node in ast.parse((folder / "__init__.pyi").read_text()).body:
        if not isinstance(node, ast.ImportFrom):
            continue
        base = package if node.level else ""
        base = ".".join(filter(None, [base, node.module]))
        for alias in node.names:
            yield alias.asname, f"{base}.{alias.name}"


def file_name(topic):
    """Return the name of the page of a topic."""
    return "_".join(re.findall("[a-z]+", topic.lower()))


def api_page(topic, entries):
    """Return the page of a topic, which mkdocstrings fills."""
    parts = [f"# {topic}"]
    for name, where in entries:
        parts.append(f"## `{name}`")
        parts.append(f"::: {where}\n    options:\n      heading_level: 3")
    return "\n\n".join(parts) + "\n"
