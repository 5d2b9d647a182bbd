"""Command lines: settings parsed by tyro, wrong input reported in one line.

JAX is not imported here, so `--help` is quick and `--device` can still choose the
platform.
"""

import contextlib
import dataclasses
import functools
import importlib.util
import json
import os
import pathlib
import re
import shlex
import sys
import typing
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any, Literal, NamedTuple

import tyro
from tyro.conf import Positional

from experiments import names, options
from nerfies_jax.capture.external import ExternalFiles
from nerfies_jax.capture.extras import MissingExtra
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.runs import platform, representations, trust
from nerfies_jax.runs.config import (
    CaptureNotFound,
    CaptureSource,
    MoreMetrics,
    check_budget,
)
from nerfies_jax.runs.representations import PRESETS
from nerfies_jax.runtime import console, stopping
from nerfies_jax.training.specs import OverrideError

# Those of `nerfies_jax.capture.synthetic`, which loads JAX.
Scene = Literal[
    "default",
    "static",
    "rigid",
    "fast",
    "non-rigid",
    "articulated",
    "exposure",
    "transient",
    "specular",
    "topology",
    "pose-error",
    "barrel",
    "fisheye",
    "rig",
    "collection",
    "collection-masked",
    "static-20",
    "static-50",
    "pan",
    "zoom",
]
SCENES: tuple[str, ...] = typing.get_args(Scene)
# Arguments of the library that have an option of the same name; "..." is any value.
ARGUMENTS = (
    *(
        "checkpoint_every",
        "coordinator",
        "device",
        "devices",
        "evaluate_at",
        "evaluate_every",
        "factor",
        "frame_memory",
        "heldout",
        "max_side",
    ),
    *("missing", "out", "overwrite", "scene", "seconds", "train"),
    *("depths", "depth_model", "masks", "segmentation_model"),
)
_ARGUMENT = re.compile(
    rf"\b(?P<name>{'|'.join(ARGUMENTS)})=(?P<value>\"[^\"]*\"|\.\.\.|[^\s;,)]*[^\s;:,.)])"
)
_RESUME = re.compile(r"runs\.resume(?:\('([^']*)'\))?")
Preset = Annotated[str | None, options.Known(PRESETS), tyro.conf.arg(metavar="NAME")]
Overrides = Annotated[tuple[str, ...], tyro.conf.arg(metavar="FIELD=VALUE ...")]
Code = Annotated[tuple[str, ...], tyro.conf.arg(metavar="MODULE:NAME ...")]


@dataclasses.dataclass(frozen=True)
class NamedSource(CaptureSource):
    """The capture as a positional argument."""

    capture: Positional[pathlib.Path | None] = None
    """Folder in Nerfies, HyperNeRF, Blender, D-NeRF, COLMAP or LLFF layout."""
    # None in these two is what the command line leaves to the class below.
    scene: Annotated[str | None, options.Known(SCENES)] = None  # type: ignore[assignment]
    """Built-in scene to use if no capture is given (default: default)."""
    missing: Literal["refuse", "skip"] | None = None  # type: ignore[assignment]
    """Handling of frames whose image is missing (default: refuse)."""
    files: Annotated[ExternalFiles, tyro.conf.arg(name="")] = ExternalFiles()

    def __post_init__(self):
        if None not in (self.capture, self.scene):
            raise ValueError(
                f"{self.capture} and --scene {self.scene}: name a folder or a built-in "
                "scene, not both"
            )
        check_budget(self.preprocessing)


def _heading(name: str) -> tuple:
    """For `Annotated`: fields of settings by their own names, under a heading."""
    return tyro.conf.OmitArgPrefixes, tyro.conf.arg(name=name)


Source = Annotated[(NamedSource, *_heading("capture"))]
More = Annotated[(MoreMetrics, *_heading("scoring"))]


def plain(source: CaptureSource) -> CaptureSource:
    """Return the source as a run stores it, however its folder was named."""
    return CaptureSource(**set_options(source))


def set_options(source: CaptureSource) -> dict[str, Any]:
    """Collect the options of the source that the command line sets.

    Args:
      source: The source.

    Returns:
      Values by field.
    """
    unsaid = (None, ExternalFiles())
    return {name: value for name, value in vars(source).items() if value not in unsaid}


def check_out_file(path: pathlib.Path | None, option: str) -> None:
    """Refuse, before anything is measured, what cannot become a new file.

    Args:
      path: The file, if one was named.
      option: The option that named it.

    Raises:
      ValueError: The path is a folder, lies in none, or would be written over.
    """
    if path is None:
        return
    if path.is_dir():
        example = path / "x.json"
        raise ValueError(f"{option} {path}: a folder; name a file, as {example}")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"{option} {path}: no folder {path.parent}; make it first")
    if path.exists():
        raise ValueError(
            f"{option} {path}: already there; name another file, or move it away"
        )


def check_out_folder(path: pathlib.Path | None) -> None:
    """Raise ValueError where --out is a file or holds results that would be lost."""
    if path is None or not path.exists():
        return
    if not path.is_dir():
        raise ValueError(f"--out {path}: a file; name a folder")
    if any(path.iterdir()):
        raise ValueError(
            f"--out {path}: not empty; name another folder, or move it away"
        )


def check_presets(names: Iterable[str]) -> None:
    """Raise ValueError, with the known presets, if --presets names another."""
    for name in names:
        if name not in PRESETS:
            raise ValueError(
                f"--presets {name}: no such preset; {known_names(name, PRESETS)}"
            )


def find_code(names: Iterable[str]) -> None:
    """Let modules of the current folder be found, if options name any of them.

    The folder comes last on the path: a stranger's run folder may hold a `jax.py`.
    """
    for name in names:
        module = name.partition(":")[0].partition(".")[0]
        is_importable = module in sys.modules or not module.isidentifier()
        if is_importable or importlib.util.find_spec(module) is not None:
            continue
        folder = pathlib.Path.cwd()
        if (folder / f"{module}.py").is_file() or (folder / module).is_dir():
            sys.path.append(str(folder))
            return


def start_for_run(args: Any) -> None:
    """Start JAX for the run of a command, and let the code that it trusts be found.

    Args:
      args: Settings with `device`, `run` and `trust`.
    """
    find_code(args.trust)
    threads = representations.cores_of_run(args.run).threads
    platform.start_jax(args.device, threads, wide=not args.trust)


class Ended(NamedTuple):
    """The result of a command that says itself with which exit code it ends."""

    result: Any
    code: int


def command(
    settings: Any, complete: Callable[[list[str]], list[str]] = list
) -> Callable[[Callable], options.Command]:
    """Make `main(arguments)` of a function of settings that returns the result as JSON.

    With `--json` the result is printed as one document, and all other output, also of
    child processes, goes to standard error. Wrong settings end with exit code 2. A
    closed pipe on stdout changes nothing. If other output is lost, a command that
    succeeds exits with code 1.

    Args:
      settings: Dataclass of options.
      complete: Function that adds words which users may omit to the command line.

    Returns:
      A decorator.
    """

    def decorate(run):
        @functools.wraps(run)
        def main(arguments=None):
            with console.session() as session:
                return _ran(session, arguments)

        def _ran(session, arguments):
            words = sys.argv[1:] if arguments is None else list(arguments)
            as_json = options.JSON in words
            words = [word for word in words if word != options.JSON]
            with user_errors():
                args = parse(settings, complete(words), _command_name(run))
            aside = _words_aside() if as_json else contextlib.nullcontext()
            with aside, user_errors((MissingExtra,)):
                result = _interruptible(run, args)
            end = result if isinstance(result, Ended) else None
            result = result if end is None else end.result
            if as_json:
                document = json.dumps(result, indent=1, allow_nan=False, default=str)
                session.deliver(document)
            if end is not None:
                raise SystemExit(end.code)
            return result

        main.settings = settings
        return main

    return decorate


def _interruptible(run, args):
    """Run a command. Signals end it with exit code 128 + signal, Ctrl-C in a line.

    Child processes and files that are half written go with it.
    """
    try:
        with stopping.exits(), _stopped_first():
            stopping.check()
            result = run(args)
            stopping.check()
            return result
    except KeyboardInterrupt:
        console.note("interrupted")
        raise SystemExit(130) from None
    except stopping.Stopped as stop:
        for line in stopping.ending(stop.name):
            console.note(line)
        raise


@contextlib.contextmanager
def _stopped_first() -> Iterator[None]:
    """Take an error that follows a signal for its consequence.

    Ctrl-C reaches child processes too, and what they leave undone is an error here.
    """
    try:
        yield
    except Exception:
        stopping.check()
        raise


def parse(settings: Any, arguments: list[str] | None = None, prog: str = "") -> Any:
    """Parse the command line into a frozen dataclass, whose docstrings are the help.

    Args:
      settings: The dataclass.
      arguments: Words of the command line. None reads `sys.argv`.
      prog: Name of the command in the help.

    Returns:
      The settings.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    return options.parse(settings, words, prog or "nerfies")


def _command_name(run):
    """Return the name that a user calls the command by."""
    name = run.__module__
    if name != "__main__":
        name = name.removesuffix(".__main__").removeprefix("experiments.")
        return names.line(name)
    spec = sys.modules[name].__spec__
    name = pathlib.Path(sys.argv[0]).stem if spec is None else spec.name
    return f"python -m {name.removesuffix('.__main__')}"


@contextlib.contextmanager
def _words_aside() -> Iterator[None]:
    """Standard output is standard error, for this process and those it starts."""
    sys.stdout.flush()
    stdout = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(stdout, 1)
        os.close(stdout)


def stored(path: pathlib.Path) -> Any:
    """Read a JSON file.

    Args:
      path: The file.

    Returns:
      Its contents, None if it does not exist.
    """
    return json.loads(path.read_text()) if path.is_file() else None


def formerly(option):
    """Mark an option, for `Annotated`, as having an earlier name."""
    return tyro.conf.arg(aliases=[option])


RATE = 24.0  # frames per second of videos and camera paths
VIEW_PORT = 8080
# Those of `nerfies_jax.capture.camera_paths`, which loads JAX.
PATHS = ("sway", "orbit", "lemniscate", "stabilized", "captured")


def check_frames(frames: int | None, path: str) -> None:
    """Raise ValueError for a number of images that a camera path cannot have."""
    if frames is None:
        return
    if frames < 1:
        raise ValueError(f"--frames {frames}: render at least one")
    if path not in PATHS:
        raise ValueError(
            f"--frames {frames}: --path {path} has its own number of frames; it is for "
            + ", ".join(PATHS)
        )


def check_port(port: int) -> None:
    """Raise ValueError for a port below 1024 or above 65535."""
    if not 1024 <= port <= 65535:
        raise ValueError(f"--port {port}: choose one from 1024 to 65535")


def check_max_side(max_side: int | None) -> None:
    """Raise ValueError for a longest side below one pixel."""
    if max_side is not None and max_side < 1:
        raise ValueError(f"--max-side {max_side}: draw at least one pixel")


def scale_size(size: tuple[int, int], max_side: int | None) -> tuple[int, int]:
    """Return a width and height, scaled to a longer side of `max_side` if given."""
    if max_side is None:
        return size
    factor = max_side / max(size)
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


@contextlib.contextmanager
def user_errors(kinds: tuple[type[Exception], ...] = (ValueError, OSError)):
    """Report wrong input in one line with exit code 2. Bugs keep their traceback.

    It wraps the stages that read user input (captures, settings, run folders), which
    raise errors that name the value, the bound and the remedy.

    Args:
      kinds: Types of errors that are the user's.
    """
    try:
        with _stopped_first():
            yield
    except kinds as error:
        console.error(as_options(" ".join(str(error).split()), error))
        sys.exit(2)


def as_options(text: str, error: Exception) -> str:
    """Name options in an error of the library, which knows arguments only.

    Args:
      text: The message, in one line.
      error: The error that it is of.

    Returns:
      The message with options in place of arguments such as `max_side=640`, and with
      the options that give a way out of some kinds of errors.
    """

    def option(match):
        value = match["value"].strip("'\"")
        text = "" if value in ("...", "True") else f" {value}"
        return f"--{match['name'].replace('_', '-')}{text}"

    text = _ARGUMENT.sub(option, text)
    text = _RESUME.sub(
        lambda match: f"--out {match[1]} --resume" if match[1] else "--resume", text
    )
    for each in (error, error.__cause__):
        if isinstance(each, OverrideError):
            return f"--set {text}"
        if isinstance(each, trust.UntrustedCode):
            return f"{text}, with --trust {shlex.join(each.names)}"
        if isinstance(each, CaptureNotFound):
            words = ("--out", str(each.folder), "--resume")
            command = f"nerfies reconstruct CAPTURE {shlex.join(words)}"
            return f"{text}: {command}"
    return text
