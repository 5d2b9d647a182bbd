"""Names of the commands: those for users first, then the studies of this project.

`nerfies NAME` runs a command, and `nerfies study NAME` a study.
"""

import ast
import pathlib

HERE = pathlib.Path(__file__).resolve().parent
STUDY = "study"
# In the order of work on a scene. Every other command is a study.
FOR_USERS = (
    "reconstruct",
    "download",
    "prepare",
    "inspect_scene",
    "preprocess",
    "view",
    "render",
    "export",
    "compare",
    "batch",
    "settings",
    "make_scene",
)


def commands() -> dict[str, str]:
    """Read the first docstring line of each module with a `main`, without importing it.

    Returns:
      Lines by name of the command, those for users first.
    """
    files = {path.stem: path for path in HERE.glob("*.py") if path.stem != "__main__"}
    files |= {path.parent.name: path for path in HERE.glob("*/__main__.py")}
    summaries = {}
    for name in (*FOR_USERS, *sorted(files.keys() - {*FOR_USERS})):
        module = ast.parse(files[name].read_text())
        if any(getattr(node, "name", None) == "main" for node in module.body):
            text = ast.get_docstring(module) or ""
            summaries[name] = text.partition("\n")[0]
    return summaries


def studies() -> dict[str, str]:
    """Return the first docstring line of each study by its name."""
    return {name: text for name, text in commands().items() if name not in FOR_USERS}


def line(name: str) -> str:
    """Return the words that call a command, such as "nerfies render".

    Args:
      name: Name of a command, of which each that is not for users is a study.

    Returns:
      The words.
    """
    return f"nerfies {name}" if name in FOR_USERS else f"nerfies {STUDY} {name}"
