"""Conversion of a video, or of images without cameras, to a capture that is kept.

Cameras are estimated in two passes, the second of which masks what moves, as found by
the first, and uses finer features. On two real clips with known cameras, the second
pass alone and after the first gave: for 87 frames of 184x240, reprojection errors of
static points of 0.31 and 0.26 px and position errors of 0.86 and 0.67 % of the extent
after the best similarity (medians), and for 86 frames of 512x384, 0.42 and 0.35 px,
0.34 and 0.34 %. They took some 30 to 60 s each on two busy cores.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import pathlib
import re
import shutil
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from nerfies_jax.capture import colmap, footage, formats, nerfies_format
from nerfies_jax.capture.capture import Capture, CaptureError, describe
from nerfies_jax.capture.footage import Taken
from nerfies_jax.capture.images import write_png
from nerfies_jax.capture.json_files import AnyPath, scratch_folder, write_json
from nerfies_jax.capture.structure_from_motion import (
    FewPlaced,
    MappingSpec,
    Poses,
    run_sfm,
)
from nerfies_jax.preprocessing import masks_without_cameras
from nerfies_jax.runs import movers, run_folder
from nerfies_jax.runs.config import Preparation
from nerfies_jax.runs.run_folder import PREPARED as RECORD
from nerfies_jax.runtime import console, events
from nerfies_jax.training import specs

# Masks are of a pinhole and features lie beside edges: this share of the longer side
# is masked around what moves as well.
RIM = 0.01
# Cameras of the second pass are kept where they place so many of the first's images.
AS_MANY = 0.9

Tell = Callable[[str], None]


class Solved(NamedTuple):
    """Cameras, and the masks that they were estimated with."""

    poses: Poses
    masked: bool
    lines: tuple[str, ...]  # what to say of how they were found


def prepare(
    source: AnyPath,
    out: AnyPath,
    how: Preparation = Preparation(),
    tell: Tell = lambda line: None,
) -> Capture:
    """Convert a video or a folder of images to a Nerfies directory with cameras.

    The directory is written completely or not at all. Its `colmap` is the COLMAP model,
    `masks_found` the masks of what was found to move, in white, and `prepared.json` a
    record of the conversion.

    Args:
      source: The video or folder.
      out: The directory to write.
      how: Settings.
      tell: Called with lines of text about the progress.

    Returns:
      The capture.

    Raises:
      ValueError: If the cameras cannot be estimated, with the remedy.
    """
    source, out = pathlib.Path(source), pathlib.Path(out)
    if not source.exists():
        raise CaptureError(f"{source}: no such film or folder; check the path")
    run_folder.refuse_run(source)
    kind = footage.kind_of(source)
    if kind is None:
        raise CaptureError(
            f"{source}: neither a film ({', '.join(formats.VIDEOS)}) nor a folder with "
            f"two or more pictures ({', '.join((*footage.PLAIN, *footage.HEIC))})"
        )
    if kind == "pictures" and (how.frames or how.fps):
        raise ValueError("frames and fps choose from a film; a folder is taken whole")
    _check_masks(how)
    with scratch_folder(out) as scratch, _named(scratch, source, out):
        if kind == "film":
            tell(f"looking for sharp frames in {source}")
        taken = _taken(kind, source, scratch, how)
        for line in taken.notes:
            tell(line)
        solved = _solve(scratch, taken, how, tell)
        for line in solved.lines:
            tell(line)
        capture = colmap.read(solved.poses.folder)
        rate = None
        if taken.seconds:
            rate = (len(taken.names) - 1) / taken.seconds
        if how.masks is None:  # what was found is no truth to be scored by
            capture = dataclasses.replace(capture, moving=None)
        capture = dataclasses.replace(
            capture, name=out.resolve().name, path=None, frames_per_second=rate
        )
        written = scratch / "capture"
        with events.stage("writing the capture"):
            nerfies_format.write(capture, written)
        shutil.copytree(solved.poses.folder / "sparse", written / "colmap" / "sparse")
        if solved.masked and how.masks is None:
            (scratch / "found").rename(written / "masks_found")
        write_json(written / RECORD, _record(source, how, solved))
        os.replace(written, out.resolve())
    for line in describe(capture):
        tell(line)
    return capture


def _check_masks(how):
    if how.masks is not None and not pathlib.Path(how.masks).is_dir():
        raise CaptureError(f"{how.masks}: no such folder of masks")


@contextlib.contextmanager
def _named(scratch, source, out):
    """Errors about the scratch folder, which goes, name the source or the result."""
    try:
        yield
    except CaptureError as error:
        hidden = re.escape(str(scratch.resolve()))
        # Its images by name, whatever else as the whole.
        inside = f"{hidden}{re.escape(os.sep)}(images|[^:]*)"
        named = out if "cannot be written" in str(error) else source
        said = re.sub(inside, lambda _: str(named), str(error))
        raise CaptureError(said) from error


def _taken(kind, source, scratch, how) -> Taken:
    if kind == "film":
        return footage.from_film(
            source, scratch, how.frames, how.fps, how.max_side, how.masks
        )
    return footage.from_pictures(source, scratch, how.max_side, how.masks)


def _solve(scratch, taken, how, tell) -> Solved:
    """Estimate the cameras of the images in `scratch/images`, in one pass or two."""
    spec = MappingSpec(
        camera_model=how.camera_model, matcher=how.matcher, threads=how.threads
    )
    if taken.focal is not None:
        spec = dataclasses.replace(spec, focal=taken.focal)
    pictures, given = scratch / "images", scratch / "masks"
    if how.masks is not None:
        poses = run_sfm(pictures, scratch / "only", given, spec)
        return Solved(poses, True, tuple(poses.lines()))
    # Coarse first: what moves has most of the fine features of some images.
    coarse = spec if how.passes == 1 else dataclasses.replace(spec, first_octave=0)
    try:
        first = run_sfm(pictures, scratch / "first", None, coarse)
    except FewPlaced as error:
        if how.passes == 1:
            raise
        return _solve_without_movers(scratch, spec, error, tell)
    if how.passes == 1:
        return Solved(first, False, tuple(first.lines()))
    tell(f"{first.lines()[0]}; looking for what moves")
    capture = colmap.read(first.folder)
    moving = movers.masks_of(capture)
    masks = None
    if moving is None:
        tell("nothing was found to move; the cameras again from finer features")
    else:
        row_of = {f"{name}.png": row for row, name in enumerate(capture.ids)}
        still = np.zeros(moving.shape[1:], bool)  # of what found no place
        moves = {n: moving[row_of[n]] if n in row_of else still for n in taken.names}
        masks = _write_masks(scratch, moves)
        share = f"{moving.mean():.1%} of the pixels move"
        tell(f"{share}; the cameras again without them")
    try:
        second = run_sfm(pictures, scratch / "second", masks, spec)
    except CaptureError as error:
        reason = str(error).partition(": ")[2]
        kept = f"once more, {reason}; the first cameras are kept"
        return Solved(first, False, (kept, *first.lines()))
    if second.placed < AS_MANY * first.placed:
        kept = f"once more only {second.placed} are placed; the first are kept"
        return Solved(first, False, (kept, *first.lines()))
    return Solved(second, masks is not None, tuple(second.lines()))


def _solve_without_movers(scratch, spec, error, tell):
    """The cameras without what seems to move, where with it too few were placed."""
    tell(f"{str(error).partition(': ')[2]}; looking for what moves")
    try:
        moves = masks_without_cameras.moving_in(scratch / "images")
    except ValueError as reason:
        raise error from reason
    share = np.mean([one.mean() for one in moves.values()])
    if share == 0:
        raise error
    masks = _write_masks(scratch, moves)
    tell(f"{share:.1%} of the pixels seem to move; the cameras again without them")
    poses = run_sfm(scratch / "images", scratch / "second", masks, spec)
    return Solved(poses, True, tuple(poses.lines()))


def _write_masks(scratch, moving):
    """Write masks: white for users, and black with a margin for COLMAP.

    Returns the folder of the latter.
    """
    (scratch / "found").mkdir()
    (scratch / "black").mkdir()
    for name, moves in moving.items():
        rim = 2 * round(RIM * max(moves.shape)) + 1
        wide = cv2.dilate(moves.astype(np.uint8), np.ones((rim, rim), np.uint8)) > 0
        write_png(scratch / "found" / name, moves)
        write_png(scratch / "black" / f"{name}.png", ~wide)
    return scratch / "black"


def _record(source, how, solved):
    poses = solved.poses._asdict()
    del poses["folder"]
    return {**_made_of(source, how), "masked": solved.masked, "poses": poses}


def _made_of(source, how):
    """Identity of a capture: its source, its contents, masks and settings."""
    _check_masks(how)
    masks = None if how.masks is None else _checksum(pathlib.Path(how.masks))
    # Threads change how long it takes.
    how = {name: one for name, one in specs.as_json(how).items() if name != "threads"}
    return {
        "source": str(source.resolve()),
        "content": _checksum(source),
        "masks": masks,
        "how": how,
    }


def _checksum(path):
    """Checksum of the names and contents of a video or of the images of a folder.

    Files that file managers leave there (.DS_Store, Thumbs.db) do not count.
    """
    files = [path] if path.is_file() else sorted(footage.pictures_in(path))
    checksum = hashlib.blake2b(digest_size=12)
    for each in files:
        checksum.update(each.name.encode(errors="surrogateescape"))
        with each.open("rb") as file:
            checksum.update(hashlib.file_digest(file, "blake2b").digest())
    return checksum.hexdigest()


def needed(path: AnyPath) -> bool:
    """Test if a path names a video or images without cameras, and no capture.

    Args:
      path: File or folder.

    Returns:
      True if it must be converted with `prepare`.
    """
    path = pathlib.Path(path)
    if footage.kind_of(path) is None:
        return False
    return path.is_file() or not any(each.recognize(path) for each in formats.FORMATS)


def prepared(
    source: AnyPath,
    out: AnyPath,
    how: Preparation = Preparation(),
    tell: Tell = console.say,
) -> pathlib.Path:
    """Return the folder of a capture made from a source, and make it if needed.

    Args:
      source: The video or folder of images.
      out: The folder of the capture.
      how: Settings.
      tell: Called with lines of text about the progress.

    Returns:
      `out`.

    Raises:
      ValueError: If `out` was made from other files or with other settings.
    """
    source, out = pathlib.Path(source), pathlib.Path(out)
    if not (out / RECORD).is_file():
        tell(f"preparing {source} as {out}, which is kept")
        prepare(source, out, how, tell)
        return out
    try:
        made_of = dict(json.loads((out / RECORD).read_bytes()))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        # The folder may hold the user's own work by now: it is not made again unasked.
        raise ValueError(
            f"{out / RECORD}: damaged, so nothing tells what {out} was made of "
            f"({error}); remove the folder, or choose another one with out=..."
        ) from error
    wanted = json.loads(json.dumps(_made_of(source, how)))
    differ = [name for name, value in wanted.items() if made_of.get(name) != value]
    if differ:
        raise ValueError(
            f"{out}: a capture prepared otherwise ({', '.join(differ)} differ); remove "
            "it, or choose another folder with out=..."
        )
    tell(f"{source} was prepared before: {out}")
    return out
