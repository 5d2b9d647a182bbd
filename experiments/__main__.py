"""List all commands; `python -m experiments NAME ...` runs one.

`nerfies NAME ...` is the same.
"""

import ast
import functools
import importlib
import operator
import pathlib
import sys
from typing import Annotated, Any

import tyro

from experiments import options
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.runtime import console

HERE = pathlib.Path(__file__).resolve().parent


def commands() -> dict[str, str]:
    """Read the first docstring line of each module with a `main`, without importing it.

    Returns:
      Lines by command name.
    """
    files = {path.stem: path for path in HERE.glob("*.py") if path.stem != "__main__"}
    files |= {path.parent.name: path for path in HERE.glob("*/__main__.py")}
    summaries = {}
    for name in sorted(files):
        module = ast.parse(files[name].read_text())
        if any(getattr(node, "name", None) == "main" for node in module.body):
            text = ast.get_docstring(module) or ""
            summaries[name] = text.partition("\n")[0]
    return summaries


def main(arguments: list[str] | None = None) -> None:
    """List the commands, or run the one named first.

    Args:
      arguments: Words of the command line. None reads `sys.argv`. An unknown command
        ends with exit code 2.
    """
    with console.session():
        _main(arguments)


def _main(arguments):
    words = sys.argv[1:] if arguments is None else arguments
    known = commands()
    if not words or words[0] in ("-h", "--help"):
        width = max(map(len, known))
        console.say("usage: nerfies NAME ...   or   python -m experiments.NAME ...\n")
        console.say(
            "\n".join(f"{name:{width}}  {line}" for name, line in known.items())
        )
        return
    if words[0].startswith(options.COMPLETION):
        print_completion(words)
        return
    name, *rest = words
    if name not in known:
        meant = known_names(name, known)
        console.error(f"no command {name!r}; {meant}")
        raise SystemExit(2)
    main_of(name)(rest)


def main_of(name: str) -> options.Command:
    """Import the function that runs a command.

    Args:
      name: Name of the command.

    Returns:
      The function, whose `settings` is its dataclass of options.
    """
    package = (HERE / name).is_dir()
    module = f"experiments.{name}.__main__" if package else f"experiments.{name}"
    return importlib.import_module(module).main


def print_completion(words: list[str]) -> None:
    """Print the shell completion of all commands, their options and choices.

    Args:
      words: The option, and the name of the shell.
    """
    kinds = [
        Annotated[options.offered(main_of(name).settings), tyro.conf.subcommand(name)]
        for name in commands()
    ]
    union: Any = functools.reduce(operator.or_, kinds)
    tyro.cli(union, prog="nerfies", args=words, config=options.READ_BY)


if __name__ == "__main__":
    main()
