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
from typing import Literal, NamedTuple

import numpy as np

from nerfies_jax.capture import extras, frames
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.colmap_library import MIN_TRACK, library
from nerfies_jax.capture.json_files import AnyPath, new_folder, probe
from nerfies_jax.runtime import children, console, events

# Images. With more, exhaustive matching would take most of the time.
EXHAUSTIVE_UP_TO = 40
# Seed of RANSAC. With random seeds, between 24 and 26 of the same 30 images registered.
SEED = 0
MOST_JUDGED = 5000  # points of which the quality is measured
# Limits of reliable results. Real videos of 87 and 86 frames have errors of 0.4 px and
# triangulation angles of 6 and 9 degrees.
MOST_ERROR_PX, LEAST_ANGLE_DEG, LEAST_PLACED = 1.5, 1.5, 0.9


@dataclasses.dataclass(frozen=True)
class MappingSpec:
    """Settings of structure from motion. All images share one lens."""

    # OPENCV has separate horizontal and vertical focal lengths, as Nerfies' camera has.
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
    # "auto" matches sequentially if there are more than `EXHAUSTIVE_UP_TO` images and
    # their names are in order of time.
    matcher: Literal["auto", "sequential", "exhaustive"] = "auto"
    overlap: int = 10  # following images to match in sequential matching
    in_order: bool = True  # names are in order of time, as those of video frames
    threads: int | None = None  # None for all cores
    at_least: float = 0.5  # smallest share of the images that must register
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


MASK = "mask moving regions (black)"


class FewPlaced(CaptureError):
    """Too few of the images were registered."""


class Poses(NamedTuple):
    """Registered cameras, and quality measures of the static points."""

    folder: pathlib.Path  # with images and sparse/0
    pictures: int  # number of images
    placed: int  # number of registered images
    points: int  # observed in at least `MIN_TRACK` images
    error_px: float  # median over the points of their mean reprojection errors
    angle_deg: float  # median over the points of their largest triangulation angles

    def lines(self) -> list[str]:
        """Describe the result and how far it can be trusted.

        Returns:
          Lines of text.
        """
        lines = [
            f"cameras: {self.placed} of {self.pictures} images registered; "
            f"{self.points:,} static points, reprojection error {self.error_px:.2f} "
            f"px, triangulation angle {self.angle_deg:.1f} degrees"
        ]
        if self.error_px > MOST_ERROR_PX:
            lines.append(
                f"doubtful: the reprojection error of {self.error_px:.2f} px is above "
                f"{MOST_ERROR_PX:g}; {MASK}, or record again without motion blur"
            )
        if self.angle_deg < LEAST_ANGLE_DEG:
            lines.append(
                f"doubtful: the triangulation angle of {self.angle_deg:.1f} degrees is "
                f"below {LEAST_ANGLE_DEG:g}, so depth is unreliable; walk while "
                "recording"
            )
        if self.placed < LEAST_PLACED * self.pictures:
            lines.append(
                f"doubtful: {self.pictures - self.placed} images could not be "
                f"registered and are left out; {_more_overlap(self.pictures)}"
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
) -> Poses:
    """Reconstruct cameras from the images in a folder.

    Progress is emitted as events. Moving regions need masks: with 15 % of the image
    moving and no masks, all images registered with a low reprojection error, but the
    error of the camera path was 250 times larger.

    Args:
      images: Folder of images.
      out: Folder to write, with `sparse/0` and a copy of the images in `images`, so
        that it can be loaded as a capture.
      masks: Folder with `<image name>.png`, black where something moves. No features
        are extracted there.
      spec: Settings.

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
    names = [file.name for file in frames.pictures_in(images)]
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
    with new_folder(out) as folder:
        shutil.copytree(images, folder / "images")
        if masks is not None:
            shutil.copytree(masks, folder / "masks")
        measures = _run_child(folder, masks is not None, spec, len(names))
        poses = Poses(out, len(names), **measures)
        if poses.placed < max(2, spec.at_least * len(names)):
            raise FewPlaced(
                f"{images}: only {poses.placed} of {len(names)} images could be "
                f"registered; {_more_overlap(len(names))}"
            )
    return poses


@events.stage("structure from motion")
def _run_child(folder, masked, spec, images):
    request = json.dumps(
        {"folder": str(folder), "masked": masked, "spec": dataclasses.asdict(spec)}
    )
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
        probe(folder)  # raises if the disk is full, which COLMAP does not report
        raise CaptureError(
            f"{folder.name}: COLMAP ended with code {child.returncode} "
            f"({' '.join(list(log)[-1:])[:200]}); try fewer or smaller images"
        )
    return json.loads(last_line)


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
            for pattern, name in STAGES:
                match = pattern.search(line)
                if not match:
                    continue
                if name != current:
                    stack.close()
                    current = name
                    stage = stack.enter_context(events.stage(name))
                done, total = (*map(int, match.groups()), images)[:2]
                stage.reach(done, total)


def _reconstruct(folder: pathlib.Path, masked: bool, spec: MappingSpec) -> dict:
    """Write folder/sparse/0 in the child process, and return fields of `Poses`."""
    pycolmap = library()
    threads = spec.threads or os.cpu_count() or 1
    database, images = folder / "database.db", folder / "images"
    reading = pycolmap.ImageReaderOptions()
    reading.camera_model = spec.camera_model
    reading.default_focal_length_factor = spec.focal
    if masked:
        reading.mask_path = str(folder / "masks")
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    extraction.sift.max_num_features = spec.features
    extraction.sift.first_octave = spec.first_octave
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reading,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    count = sum(1 for _ in images.iterdir())
    is_long_video = spec.in_order and count > EXHAUSTIVE_UP_TO
    if spec.matcher == "sequential" or (spec.matcher == "auto" and is_long_video):
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = spec.overlap
        pycolmap.match_sequential(
            database,
            matching_options=matching,
            verification_options=verification,
            pairing_options=pairing,
            device=pycolmap.Device.cpu,
        )
    else:
        pycolmap.match_exhaustive(
            database,
            matching_options=matching,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = threads
    options.random_seed = SEED
    models = pycolmap.incremental_mapping(database, images, folder / "models", options)
    # If mapping fails, the dict is empty.
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if best is not None:
        target = folder / "sparse" / "0"
        target.mkdir(parents=True)
        best.write(str(target))
    shutil.rmtree(folder / "models", ignore_errors=True)
    database.unlink(missing_ok=True)
    if best is None:
        return {"placed": 0, "points": 0, "error_px": 0.0, "angle_deg": 0.0}
    return {"placed": best.num_reg_images(), **_quality(best)}


def _quality(model) -> dict:
    """Reprojection errors and triangulation angles of reliable points."""
    points = [p for p in model.points3D.values() if p.track.length() >= MIN_TRACK]
    if not points:
        return {"points": 0, "error_px": 0.0, "angle_deg": 0.0}
    center = {
        number: image.projection_center()
        for number, image in model.images.items()
        if image.has_pose
    }
    sample = points[:: -(-len(points) // MOST_JUDGED)]
    angles = []
    for point in sample:
        rays = np.array([center[each.image_id] for each in point.track.elements])
        rays = point.xyz - rays
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angles.append(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1).min())))
    return {
        "points": len(points),
        "error_px": float(np.median([point.error for point in sample])),
        "angle_deg": float(np.median(angles)),
    }


if __name__ == "__main__":
    children.end_with_parent()
    job = json.load(sys.stdin)
    spec = MappingSpec(**job["spec"])
    measures = _reconstruct(pathlib.Path(job["folder"]), job["masked"], spec)
    console.say(json.dumps(measures))
