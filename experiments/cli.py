"""The command line: settings read by tyro, wrong input told in one line.

JAX is not imported here, so `--help` is quick and `--device` can still choose the
platform.
"""

import contextlib
import dataclasses
import pathlib
import sys
from typing import Annotated, Any, Literal

import tyro

from nerfies_jax.capture.given import GivenFiles
from nerfies_jax.runs.config import CaptureSource, MoreMetrics

Positional = tyro.conf.Positional


@dataclasses.dataclass(frozen=True)
class NamedSource(CaptureSource):
    """Which pictures, the folder named without an option."""

    capture: Positional[pathlib.Path | None] = None
    """Folder in Nerfies, HyperNeRF, Blender, D-NeRF, COLMAP or LLFF layout."""
    scene: str | None = None
    """Which built-in scene, where no capture is given (default: default)."""
    missing: Literal["refuse", "skip"] | None = None
    """What to do with frames whose picture is missing (default: refuse)."""
    files: Annotated[GivenFiles, tyro.conf.arg(name="")] = GivenFiles()


# Their fields stand among the other options of a command.
Source = Annotated[NamedSource, tyro.conf.arg(name="")]
More = Annotated[MoreMetrics, tyro.conf.arg(name="")]
SourceOptions = Annotated[CaptureSource, tyro.conf.arg(name="")]


def plain(source: CaptureSource) -> CaptureSource:
    """The same source as a run keeps it, however its folder was named."""
    return CaptureSource(**given(source))


def given(source: CaptureSource) -> dict[str, Any]:
    """What the command line says of the source, by field."""
    unsaid = (None, GivenFiles())
    return {name: value for name, value in vars(source).items() if value not in unsaid}


def parse(settings_class, arguments=None):
    """A frozen dataclass from the command line; its docstrings are the help text."""
    return tyro.cli(settings_class, args=arguments)


def formerly(option):
    """For `Annotated`: the option is understood by its earlier name as well."""
    return tyro.conf.arg(aliases=[option])


RATE = 24.0  # frames per second of films and camera paths
VIEW_PORT = 8080
# Those of `nerfies_jax.capture.camera_paths`, which loads JAX.
PATHS = ("sway", "orbit", "lemniscate", "stabilised", "captured")


def check_frames(frames: int | None, path: str) -> None:
    """Raise for a number of pictures that a camera path cannot have."""
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
    """Raise for a number that is no port anybody may listen at."""
    if not 1024 <= port <= 65535:
        raise ValueError(f"--port {port}: choose one from 1024 to 65535")


def sized(size: tuple[int, int], max_side: int | None) -> tuple[int, int]:
    """A width and height as they are, or with `max_side` as the longer one."""
    if max_side is None:
        return size
    factor = max_side / max(size)
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


@contextlib.contextmanager
def user_errors(kinds: tuple[type[Exception], ...] = (ValueError, OSError)):
    """Wrong input in one line and exit code 2; our own bugs keep their traceback.

    Wraps the stages that read what the user gave (captures, settings, run folders),
    which raise `ValueError` or `OSError` naming the value, the bound and the mend.
    """
    try:
        yield
    except kinds as error:
        print("error: " + " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)
