"""Convert an archive of arrays, a video or images to a capture.

nerfies prepare npz FILE OUT       images, poses, times, focal in one .npz
nerfies prepare video FILE OUT     sharp frames, cameras by COLMAP
nerfies prepare images DIR OUT     cameras by COLMAP

Without npz, video or images, the source itself says which it is.
"""

import dataclasses
import pathlib
import shlex
from typing import Annotated

import tyro

from experiments import cli
from nerfies_jax.runs.config import Preparation
from nerfies_jax.runtime import console

KINDS = ("npz", "video", "images")
How = Annotated[Preparation, tyro.conf.OmitArgPrefixes]


@dataclasses.dataclass(frozen=True)
class Npz:
    """Arrays `images`, `poses` (OpenGL camera to world), `focal` and `times`.

    If consecutive rows share one pose, they are a validation sweep and held out. The
    rows before them are training frames, and the rows after them are left out.
    """

    file: cli.Positional[pathlib.Path]
    """The archive."""
    out: cli.Positional[pathlib.Path]
    """Folder to write. It must be empty or missing."""
    heldout: str | None = None
    """Rows to score on, as first:last+1."""
    train: str | None = None
    """Training frames as first:last+1 (default: all others)."""


@dataclasses.dataclass(frozen=True)
class Video:
    """Convert a video: its sharpest frames, with cameras from COLMAP."""

    file: cli.Positional[pathlib.Path]
    """The video."""
    out: cli.Positional[pathlib.Path]
    """Folder to write. It must be empty or missing."""
    how: How = Preparation()


@dataclasses.dataclass(frozen=True)
class Images:
    """Convert a folder of images, with cameras from COLMAP."""

    file: cli.Positional[pathlib.Path]
    """Folder of images, in the order of their names."""
    out: cli.Positional[pathlib.Path]
    """Folder to write. It must be empty or missing."""
    how: How = Preparation()


def with_kind(words: list[str]) -> list[str]:
    """Name the kind of a source that a command line begins with.

    Args:
      words: The command line, with or without a kind.

    Returns:
      The command line with a kind, unless it begins with another word or an option.
    """
    if not words or words[0] in KINDS or words[0].startswith("-"):
        return words
    from nerfies_jax.capture.formats import VIDEOS  # loads JAX

    source = pathlib.Path(words[0])
    suffix = source.suffix.lower()
    if source.is_dir():
        return ["images", *words]
    if suffix == ".npz" or suffix in VIDEOS:
        return ["npz" if suffix == ".npz" else "video", *words]
    return words


@cli.command(Npz | Video | Images, with_kind)
def main(args):
    """Convert. Wrong input ends with exit code 2."""
    record = None  # arrays come with cameras
    with cli.user_errors():
        if isinstance(args, Npz):
            from nerfies_jax.capture import npz_archive

            for line in npz_archive.convert(**vars(args)):
                console.say(line)
        else:
            from nerfies_jax.runs import preparation

            preparation.prepare(args.file, args.out, args.how, console.say)
            record = cli.stored(args.out / preparation.RECORD)
    console.say(f"next: nerfies reconstruct {shlex.quote(str(args.out))}")
    return {"folder": str(args.out), "prepared": record}


if __name__ == "__main__":
    main()
