"""List the commands, or run one: `nerfies NAME ...`.

`python -m experiments NAME ...` is the same.
"""

import functools
import importlib
import importlib.metadata
import operator
import platform
import sys
from typing import Annotated, Any

import tyro

from experiments import names, options
from experiments.names import HERE, STUDY, commands
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.runtime import console
from nerfies_jax.runtime.version import __version__

USAGE = f"""\
usage: nerfies NAME ...

{{commands}}

nerfies NAME --help    options of a command
nerfies {STUDY}          benchmarks and checks of this project
nerfies --version      versions, for reports of bugs"""
STUDIES = f"""\
usage: nerfies {STUDY} NAME ...

{{commands}}

nerfies {STUDY} NAME --help    options of a study"""


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
    by_name = commands()
    studies = names.studies()
    if words[:1] == [STUDY]:
        if words[1:2] in ([], ["-h"], ["--help"]):
            console.say(STUDIES.format(commands=_table(studies)))
            return
        _run(words[1:], by_name, STUDY, studies)
        return
    for_users = {name: text for name, text in by_name.items() if name not in studies}
    if not words or words[0] in ("-h", "--help"):
        console.say(USAGE.format(commands=_table(for_users)))
        return
    if words[0] == "--version":
        console.say(version())
        return
    if words[0].startswith(options.COMPLETION):
        print_completion(words)
        return
    _run(words, by_name, "command", [*for_users, STUDY])


def _run(words, names, kind, offered_names):
    name, *arguments = words
    if name not in names:
        console.error(f"no {kind} {name!r}; {known_names(name, offered_names)}")
        raise SystemExit(2)
    main_of(name)(arguments)


def _table(summaries):
    width = max(map(len, summaries))
    return "\n".join(f"{name:{width}}  {line}" for name, line in summaries.items())


def version() -> str:
    """Name the versions that matter in a report of a bug.

    Returns:
      One line, with the versions of this package, JAX and Python, and the platform.
    """
    parts = [f"nerfies-jax {__version__}"]
    parts += [
        f"{name} {importlib.metadata.version(name)}" for name in ("jax", "jaxlib")
    ]
    parts += [f"Python {platform.python_version()}"]
    return ", ".join([*parts, f"{platform.system()} {platform.machine()}"])


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
    kinds = {
        name: Annotated[
            options.completion_type(main_of(name).settings), tyro.conf.subcommand(name)
        ]
        for name in commands()
    }
    studies = [kinds.pop(name) for name in names.studies()]
    within = options.several(studies)
    union: Any = functools.reduce(
        operator.or_, [*kinds.values(), Annotated[within, tyro.conf.subcommand(STUDY)]]
    )
    tyro.cli(union, prog="nerfies", args=words, config=options.READ_BY)


if __name__ == "__main__":
    main()
