"""Structure from motion with COLMAP's incremental mapping, in a separate process.

A separate process is needed because pycolmap may abort instead of raising an exception
(inside its OpenMP loops), and because its libraries conflict with others.
"""

import collections
import contextlib
import dataclasses
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Sequence
from typing import Literal, NamedTuple

from nerfies_jax.capture import (
    extras,
    frames,
    sfm_features,
    sfm_ladder,
    sfm_mapping,
)
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.colmap_library import MIN_TRACK
from nerfies_jax.capture.json_files import AnyPath, new_folder, probe
from nerfies_jax.capture.sfm_features import CameraGroup
from nerfies_jax.capture.sfm_ladder import (
    DOUBTED_ANGLE_DEG,
    LEAST_PLACED,
    MOST_ERROR_PX,
)
from nerfies_jax.runtime import children, console, events, stopping

# Images. With more, exhaustive matching would take most of the time.
EXHAUSTIVE_UP_TO = 40


@dataclasses.dataclass(frozen=True)
class MappingSpec:
    """Settings of structure from motion."""

    # Tried first. OPENCV has separate horizontal and vertical focal lengths, as the
    # cameras of Nerfies have.
    camera_model: str = "OPENCV"
    # Initial focal length as a multiple of the longest image side, COLMAP's default.
    focal: float = 1.2
    # Largest number of SIFT features per image. 2000 at octave 0 take a seventh of the
    # time of COLMAP's default (8192 at octave -1), for twice the error (0.0006 instead
    # of 0.0003 on a path of length 2.4).
    features: int = 4000
    # Octave -1 compared with 0: of 30 images of a hand in front of books (512x384), 30
    # instead of 27 register, with 973 points instead of 456. Videos of 86 and 87 frames
    # get 2.0 and 2.9 times the points, with errors of 0.42 and 0.31 px instead of 0.73
    # and 0.60, in 8 and 10 s instead of 4 and 6.
    first_octave: int = -1
    # Smallest scale of the features to use, in pixels. `sfm_features.COARSE_PX` leaves
    # those of octave 0.
    least_scale: float = 0.0
    # "one" camera for all images, or for each group of images. "each": a camera for
    # each image. "auto" gives each image a camera if no common camera succeeds.
    cameras: Literal["auto", "one", "each"] = "auto"
    # "auto" matches sequentially if there are more than `EXHAUSTIVE_UP_TO` images and
    # their names are in order of time.
    matcher: Literal["auto", "sequential", "exhaustive"] = "auto"
    overlap: int = 10  # following images to match in sequential matching
    in_order: bool = True  # names are in order of time, as those of video frames
    threads: int | None = None  # None for all cores
    # Smallest share of the images that must register. With 0, the largest piece of the
    # video that can be reconstructed is the result.
    at_least: float = 0.5
    seconds: float = 3600.0  # time limit

    def __post_init__(self):
        if self.features < 100:
            raise ValueError(f"features={self.features} is too few; use at least 100")
        if not 0 <= self.at_least <= 1:
            raise ValueError(f"at_least={self.at_least}; expected a share from 0 to 1")
        if not self.focal > 0:
            raise ValueError(
                f"focal={self.focal}; expected a positive multiple of the longest side"
            )
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads={self.threads}; use at least 1")

    def is_sequential(self, count: int) -> bool:
        """Decide whether only neighboring images are matched.

        Args:
          count: Number of images.

        Returns:
          False to match all pairs.
        """
        if self.matcher == "auto":
            return self.in_order and count > EXHAUSTIVE_UP_TO
        return self.matcher == "sequential"


MASK = "mask moving regions (black)"


class FewPlaced(CaptureError):
    """Too few of the images were registered.

    Attributes:
      placed: Number of images that were.
    """

    def __init__(self, message: str, placed: int = 0):
        super().__init__(message)
        self.placed = placed


class Poses(NamedTuple):
    """Registered cameras, and quality measures of the static points."""

    folder: pathlib.Path  # with images and sparse/0
    images: int  # number of images
    placed: int  # number of registered images
    points: int  # observed in at least `MIN_TRACK` images
    error_px: float  # median over the points of their mean reprojection errors
    angle_deg: float  # median over the points of their largest triangulation angles
    # Text about the choice of the camera model, and doubts about it.
    notes: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Describe the result and how far it can be trusted.

        Returns:
          Lines of text.
        """
        lines = [
            f"cameras: {self.placed} of {self.images} images registered; "
            f"{self.points:,} static points, reprojection error {self.error_px:.2f} "
            f"px, triangulation angle {self.angle_deg:.1f} degrees",
            *self.notes,
        ]
        if self.error_px > MOST_ERROR_PX:
            lines.append(
                f"doubtful: the reprojection error of {self.error_px:.2f} px is above "
                f"{MOST_ERROR_PX:g}; {MASK}, or record again without motion blur"
            )
        if self.angle_deg < DOUBTED_ANGLE_DEG:
            lines.append(
                f"doubtful: the triangulation angle of {self.angle_deg:.1f} degrees is "
                f"below {DOUBTED_ANGLE_DEG:g}, so depth is unreliable; walk while "
                "recording"
            )
        if self.placed < LEAST_PLACED * self.images:
            lines.append(
                f"doubtful: {self.images - self.placed} images could not be "
                f"registered and are left out; {_more_overlap(self.images)}"
            )
        return lines


def _more_overlap(images):
    return (
        f"take more images, closer together (of a video {2 * images} frames), move "
        f"the camera more slowly and past more texture, or {MASK}"
    )


def run_sfm(
    images: AnyPath,
    out: AnyPath,
    masks: AnyPath | None = None,
    spec: MappingSpec = MappingSpec(),
    *,
    groups: Sequence[CameraGroup] | None = None,
    features: AnyPath | None = None,
) -> Poses:
    """Reconstruct cameras from the images in a folder.

    The same images and settings give the same cameras, with any number of threads.
    Several camera models are tried until one is plausible. Progress is emitted as
    events. Moving regions need masks: with 15 % of the image
    moving and no masks, all images registered with a low reprojection error, but the
    error of the camera path was 250 times larger.

    Args:
      images: Folder of images.
      out: Folder to write, with `sparse/0` and a copy of the images in `images`, so
        that it can be loaded as a capture.
      masks: Folder with `<image name>.png`, black where something moves. No features
        are used there.
      spec: Settings.
      groups: Images by camera, each image once. None for one camera.
      features: File that keeps the features and matches of all images. If it exists,
        they are read from it, otherwise it is written.

    Returns:
      The registered cameras.

    Raises:
      CaptureError: If there are too few images, a mask is missing, or mapping fails.
      FewPlaced: If too few images were registered.
      MissingExtra: If pycolmap is not installed.
    """
    # Checked here, since of an error in the child only the last line is reported.
    extras.check("pycolmap", "sfm")
    # The child has another working directory.
    images, out = pathlib.Path(images).resolve(), pathlib.Path(out).resolve()
    if not images.is_dir():
        raise CaptureError(f"{images}: no such folder; pass a folder with images")
    names = [file.name for file in frames.images_in(images)]
    if len(names) < MIN_TRACK:
        raise CaptureError(
            f"{images}: {len(names)} images; a reconstruction needs at least "
            f"{MIN_TRACK}"
        )
    if masks is not None:
        masks = pathlib.Path(masks)
        absent = [name for name in names if not (masks / f"{name}.png").is_file()]
        if absent:
            raise CaptureError(
                f"{masks}: no mask {absent[0]}.png ({len(absent)} missing); name each "
                "after its image"
            )
    if groups is None:
        groups = [CameraGroup(tuple(names), spec.focal)]
    if sorted(name for group in groups for name in group.names) != sorted(names):
        raise ValueError("groups must contain each image of the folder once")
    request = {
        "features": None if features is None else str(pathlib.Path(features).resolve()),
        "masked": masks is not None,
        "groups": [(group.names, group.focal) for group in groups],
        "spec": dataclasses.asdict(spec),
    }
    with new_folder(out) as folder:
        shutil.copytree(images, folder / "images")
        if masks is not None:
            shutil.copytree(masks, folder / "masks")
        measures = _run_child(folder, request, spec, len(names))
        span = measures.pop("span", None)
        poses = Poses(out, len(names), **measures)
        if poses.placed < max(MIN_TRACK, spec.at_least * len(names)):
            piece = ""
            if poses.placed >= MIN_TRACK:
                piece = f" ({span[0]} to {span[1]}; use them alone with piece=True)"
            raise FewPlaced(
                f"{images}: only {poses.placed} of {len(names)} images could be "
                f"registered{piece}; {_more_overlap(len(names))}",
                poses.placed,
            )
    return poses


@events.stage("structure from motion")
def _run_child(folder, request, spec, images):
    request = json.dumps({"folder": str(folder), **request})
    command = [sys.executable, "-m", "nerfies_jax.capture.structure_from_motion"]
    root = pathlib.Path(__file__).resolve().parents[2]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    # The log may hold any bytes, and must be read until its end, or its pipe fills up.
    text = {"text": True, "errors": "replace"}
    with children.start(command, cwd=root, **text, **pipes) as child:
        log = collections.deque(maxlen=20)
        reader = threading.Thread(target=_follow, args=(child.stderr, log, images))
        reader.start()
        timer = threading.Timer(spec.seconds, child.kill)
        timer.start()
        try:
            with child.stdin:
                child.stdin.write(request)
            answer = child.stdout.read()
            child.wait()
        except BrokenPipeError:  # it ended before it read; its exit code is reported
            answer = ""
        finally:
            timed_out = not timer.is_alive()
            timer.cancel()
            child.kill()
            child.wait()
            reader.join()
    last_line = (answer.strip().splitlines() or [""])[-1]
    if timed_out:
        raise CaptureError(
            f"{folder.name}: no cameras after {spec.seconds:g} s; use fewer or smaller "
            "images"
        )
    if child.returncode != 0 or not last_line.startswith("{"):
        stopping.check()  # a signal to the process group ended the child as well
        probe(folder)  # raises if the disk is full, which COLMAP does not report
        raise CaptureError(
            f"{folder.name}: COLMAP ended with code {child.returncode} "
            f"({' '.join(list(log)[-1:])[:200]}); try fewer or smaller images"
        )
    measures = json.loads(last_line)
    return {**measures, "notes": tuple(measures.get("notes", ()))}


# The child begins an attempt with another camera model.
ATTEMPT = re.compile(r"camera model \d+: ")
# Progress in COLMAP's log, and the names of the stages.
STAGES = (
    (re.compile(r"Processed file \[(\d+)/(\d+)\]"), "extracting features"),
    (re.compile(r"Processing image \[(\d+)/(\d+)\]"), "matching features"),
    (re.compile(r"Processing block \[(\d+)/(\d+)"), "matching features"),
    (re.compile(r"Registering image.*num_reg_frames=(\d+)"), "placing cameras"),
)


def _follow(lines, log, images):
    """Keep the last lines of the child's log, and emit its progress as events."""
    current, stage = "", None
    with contextlib.ExitStack() as stack:
        for line in filter(None, map(str.strip, lines)):
            log.append(line)
            if ATTEMPT.match(line):  # its images are counted from zero again
                stack.close()
                current = ""
            for pattern, name in STAGES:
                match = pattern.search(line)
                if not match:
                    continue
                if name != current:
                    stack.close()
                    current = name
                    stage = stack.enter_context(events.stage(name))
                count, total = (*map(int, match.groups()), images)[:2]
                stage.reach(count, total)


def _reconstruct(
    folder: pathlib.Path, features: str | None, has_masks: bool, groups, spec
):
    """Write folder/sparse/0 in the child process, and return fields of `Poses`."""
    threads = spec.threads or os.cpu_count() or 1
    images = folder / "images"
    database = folder / "features.db" if features is None else pathlib.Path(features)
    if not database.is_file():
        partial = folder / "extracted.db"
        sfm_features.extract(partial, images, spec, threads)
        partial.replace(database)
    groups = [CameraGroup(tuple(names), focal) for names, focal in groups]
    mapping = sfm_mapping.climb(
        database, images, folder, groups, spec, folder / "masks" if has_masks else None
    )
    (folder / "features.db").unlink(missing_ok=True)
    if mapping is None:
        return {"placed": 0, "points": 0, "error_px": 0.0, "angle_deg": 0.0}
    target = folder / "sparse" / "0"
    target.mkdir(parents=True)
    mapping.model.write(str(target))
    best = mapping.summary
    names = sorted(
        mapping.model.image(number).name for number in mapping.model.reg_image_ids()
    )
    return {
        "placed": best.placed,
        "points": best.points,
        "error_px": best.error_px,
        "angle_deg": best.angle_deg,
        "notes": sfm_ladder.notes(best, mapping.tried, mapping.pieces),
        "span": [names[0], names[-1]],
    }


if __name__ == "__main__":
    children.end_with_parent()
    job = json.load(sys.stdin)
    measures = _reconstruct(
        pathlib.Path(job["folder"]),
        job["features"],
        job["masked"],
        job["groups"],
        MappingSpec(**job["spec"]),
    )
    console.say(json.dumps(measures))
