"""All commands with a line each; `python -m experiments NAME ...` runs one.

`nerfies NAME ...` is the same.
"""

import ast
import importlib
import pathlib
import sys

HERE = pathlib.Path(__file__).resolve().parent
NOT_COMMANDS = ("__init__", "__main__", "cli", "markdown")


def commands() -> dict[str, str]:
    """By name, the first line of what its module says; nothing is imported."""
    files = {path.stem: path for path in HERE.glob("*.py")}
    files |= {path.parent.name: path for path in HERE.glob("*/__main__.py")}
    summaries = {}
    for name in sorted(files.keys() - {*NOT_COMMANDS}):
        text = ast.get_docstring(ast.parse(files[name].read_text())) or ""
        summaries[name] = text.partition("\n")[0]
    return summaries


def main(arguments: list[str] | None = None) -> None:
    """List the commands, or run the one named first; exit code 2 for an unknown one."""
    words = sys.argv[1:] if arguments is None else arguments
    known = commands()
    if not words or words[0] in ("-h", "--help"):
        width = max(map(len, known))
        print("usage: nerfies NAME ...   or   python -m experiments.NAME ...\n")
        print("\n".join(f"{name:{width}}  {line}" for name, line in known.items()))
        return
    name, *rest = words
    if name not in known:
        print(
            f"error: no command {name!r}; there are {', '.join(known)}", file=sys.stderr
        )
        raise SystemExit(2)
    package = (HERE / name).is_dir()
    module = f"experiments.{name}.__main__" if package else f"experiments.{name}"
    sys.argv[0] = f"nerfies {name}"  # as --help shows it
    if "" not in sys.path:  # as python -m does: --effect finds what lies here
        sys.path.insert(0, "")
    importlib.import_module(module).main(rest)


if __name__ == "__main__":
    main()
