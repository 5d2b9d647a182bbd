"""Structure from motion with COLMAP's incremental mapping, in a separate process.

The process is separate because pycolmap may abort instead of raising (an exception
inside one of its OpenMP loops), and because its libraries conflict with others.
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

EXHAUSTIVE_UP_TO = 40  # pictures; above, matching every pair takes most of the time
SEED = 0  # of RANSAC: by the clock, 24 to 26 of the same 30 pictures found a place
MOST_JUDGED = 5000  # points
# Cameras are doubtful beyond these. Real clips of 87 and 86 pictures came out at 0.4 px
# and 6 and 9 degrees.
MOST_ERROR_PX, LEAST_ANGLE_DEG, LEAST_PLACED = 1.5, 1.5, 0.9


@dataclasses.dataclass(frozen=True)
class MappingSpec:
    """Settings of structure from motion. All images share one lens."""

    # OPENCV keeps the vertical focal length apart, as Nerfies' camera does.
    camera_model: str = "OPENCV"
    # First guess of the focal length, in longest sides of the picture; COLMAP's own.
    focal: float = 1.2
    # 2000 at octave 0 take a seventh of the time of COLMAP's 8192 at octave -1, for
    # twice the error (0.0006 against 0.0003 of a 2.4 long path).
    features: int = 4000
    # Octave -1 for 0: all of 30 pictures for 27 of a hand before books (512x384), 973
    # points for 456; of films of 86 and 87 pictures 2.0 and 2.9 times the points, 0.42
    # and 0.31 px off for 0.73 and 0.60, in 8 and 10 s for 4 and 6.
    first_octave: int = -1
    # "auto" matches neighbors where names follow a film of more than 40 pictures.
    matcher: Literal["auto", "sequential", "exhaustive"] = "auto"
    overlap: int = 10  # neighbors to match in a film
    in_order: bool = True  # names follow the film
    threads: int | None = None  # as many as there are cores
    at_least: float = 0.5  # share of the pictures that must find their place
    seconds: float = 3600.0  # then it is given up

    def __post_init__(self):
        if self.features < 100:
            raise ValueError(
                f"features={self.features} finds nothing; use at least 100"
            )
        if not 0 <= self.at_least <= 1:
            raise ValueError(f"at_least={self.at_least}; it is a share from 0 to 1")
        if not self.focal > 0:
            raise ValueError(f"focal={self.focal}; it is a positive share of a side")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads={self.threads}; use at least 1")


MASK = "mask moving regions in black"


class FewPlaced(CaptureError):
    """Too few of the images were registered."""


class Poses(NamedTuple):
    """Registered cameras, and quality measures of the static points."""

    folder: pathlib.Path  # with images and sparse/0
    pictures: int
    placed: int  # of the pictures
    points: int  # seen in three pictures and more
    error_px: float  # median over the points, of the mean over their pictures
    angle_deg: float  # median between the two outer lines of sight to a point

    def lines(self) -> list[str]:
        """Describe the result and any doubts about it.

        Returns:
          Lines of text.
        """
        lines = [
            f"cameras: {self.placed} of {self.pictures} pictures found their place; "
            f"{self.points:,} points at rest, {self.error_px:.2f} px off, seen under "
            f"{self.angle_deg:.1f} degrees"
        ]
        if self.error_px > MOST_ERROR_PX:
            lines.append(
                f"doubtful: points at rest are {self.error_px:.2f} px off, more than "
                f"{MOST_ERROR_PX:g}; {MASK}, or film anew without blur"
            )
        if self.angle_deg < LEAST_ANGLE_DEG:
            lines.append(
                f"doubtful: points are seen under {self.angle_deg:.1f} degrees, less "
                f"than {LEAST_ANGLE_DEG:g}; their depth is a guess: walk while filming"
            )
        if self.placed < LEAST_PLACED * self.pictures:
            lines.append(
                f"doubtful: {self.pictures - self.placed} pictures found no place and "
                f"are left out; {_more(self.pictures)}"
            )
        return lines


def _more(pictures):
    return (
        f"take more images, closer together (of a video {2 * pictures} frames), move "
        f"the camera more slowly and past more texture, or {MASK}"
    )


def run_sfm(
    images: AnyPath,
    out: AnyPath,
    masks: AnyPath | None = None,
    spec: MappingSpec = MappingSpec(),
) -> Poses:
    """Reconstruct cameras from the images in a folder.

    Progress is emitted as events. With something moving on 15 % of the image and no
    masks, all images registered with a low reprojection error, but the path was 250
    times further off.

    Args:
      images: Folder of images.
      out: Folder to write, with `sparse/0` and a copy of the images in `images`, so
        that it can be loaded as a capture.
      masks: Folder with `<image name>.png`, black where features are to be ignored
        because something moves there.
      spec: Settings.

    Returns:
      The registered cameras.

    Raises:
      CaptureError: If there are too few images, a mask is missing, or mapping fails.
      FewPlaced: If too few images were registered.
      MissingExtra: If pycolmap is not installed.
    """
    extras.check("pycolmap", "sfm")  # here, not in the child, whose last line is told
    # The child runs elsewhere.
    images, out = pathlib.Path(images).resolve(), pathlib.Path(out).resolve()
    if not images.is_dir():
        raise CaptureError(f"{images}: no such folder; pass a folder with pictures")
    names = [file.name for file in frames.pictures_in(images)]
    if len(names) < MIN_TRACK:
        raise CaptureError(
            f"{images}: {len(names)} pictures; a reconstruction needs at least "
            f"{MIN_TRACK}"
        )
    if masks is not None:
        masks = pathlib.Path(masks)
        absent = [name for name in names if not (masks / f"{name}.png").is_file()]
        if absent:
            raise CaptureError(
                f"{masks}: no mask {absent[0]}.png ({len(absent)} such); name each "
                "after its picture"
            )
    with new_folder(out) as folder:
        shutil.copytree(images, folder / "images")
        if masks is not None:
            shutil.copytree(masks, folder / "masks")
        judged = _in_own_process(folder, masks is not None, spec, len(names))
        poses = Poses(out, len(names), **judged)
        if poses.placed < max(2, spec.at_least * len(names)):
            raise FewPlaced(
                f"{images}: only {poses.placed} of {len(names)} pictures found "
                f"their place; {_more(len(names))}"
            )
    return poses


@events.stage("structure from motion")
def _in_own_process(folder, masked, spec, images):
    request = json.dumps(
        {"folder": str(folder), "masked": masked, "spec": dataclasses.asdict(spec)}
    )
    command = [sys.executable, "-m", "nerfies_jax.capture.structure_from_motion"]
    root = pathlib.Path(__file__).resolve().parents[2]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    # A log may hold any bytes, and must be read on, or its pipe fills.
    words = {"text": True, "errors": "replace"}
    with children.start(command, cwd=root, **words, **pipes) as child:
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
        except BrokenPipeError:  # it ended before it read; its code says more
            answer = ""
        finally:
            late = not timer.is_alive()
            timer.cancel()
            child.kill()
            child.wait()
            reader.join()
    last = answer.strip().splitlines()[-1:] or [""]
    if late:
        raise CaptureError(
            f"{folder.name}: no cameras after {spec.seconds:g} s; use fewer or smaller "
            "pictures"
        )
    if child.returncode != 0 or not last[0].startswith("{"):
        probe(folder)  # COLMAP says nothing of a full disk
        raise CaptureError(
            f"{folder.name}: COLMAP ended with code {child.returncode} "
            f"({' '.join(list(log)[-1:])[:200]}); try fewer or smaller pictures"
        )
    return json.loads(last[0])


# Patterns of progress in COLMAP's log, and the stage that they belong to.
STAGES = (
    (re.compile(r"Processed file \[(\d+)/(\d+)\]"), "extracting features"),
    (re.compile(r"Processing image \[(\d+)/(\d+)\]"), "matching features"),
    (re.compile(r"Processing block \[(\d+)/(\d+)"), "matching features"),
    (re.compile(r"Registering image.*num_reg_frames=(\d+)"), "placing cameras"),
)


def _follow(lines, log, images):
    """Keep the last lines of the child's log, and follow its stages by them."""
    name, stage = "", None
    with contextlib.ExitStack() as opened:
        for line in filter(None, map(str.strip, lines)):
            log.append(line)
            for pattern, begun in STAGES:
                where = pattern.search(line)
                if not where:
                    continue
                if begun != name:
                    opened.close()
                    name = begun
                    stage = opened.enter_context(events.stage(name))
                done, total = (*map(int, where.groups()), images)[:2]
                stage.reach(done, total)


def _reconstruct(folder: pathlib.Path, masked: bool, spec: MappingSpec) -> dict:
    """Fill folder/sparse/0 in the child process, and return fields of `Poses`."""
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
    follows = spec.in_order and count > EXHAUSTIVE_UP_TO
    if spec.matcher == "sequential" or (spec.matcher == "auto" and follows):
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
    # No model is an empty dict and a line in the log, not an exception.
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if best is not None:
        target = folder / "sparse" / "0"
        target.mkdir(parents=True)
        best.write(str(target))
    shutil.rmtree(folder / "models", ignore_errors=True)
    database.unlink(missing_ok=True)
    if best is None:
        return {"placed": 0, "points": 0, "error_px": 0.0, "angle_deg": 0.0}
    return {"placed": best.num_reg_images(), **_judged(best)}


def _judged(model) -> dict:
    """Reprojection errors of static points, and their triangulation angles."""
    points = [p for p in model.points3D.values() if p.track.length() >= MIN_TRACK]
    if not points:
        return {"points": 0, "error_px": 0.0, "angle_deg": 0.0}
    center = {
        number: image.projection_center()
        for number, image in model.images.items()
        if image.has_pose
    }
    few = points[:: -(-len(points) // MOST_JUDGED)]
    angles = []
    for point in few:
        sights = np.array([center[each.image_id] for each in point.track.elements])
        sights = point.xyz - sights
        sights /= np.linalg.norm(sights, axis=1, keepdims=True)
        angles.append(np.degrees(np.arccos(np.clip(sights @ sights.T, -1, 1).min())))
    return {
        "points": len(points),
        "error_px": float(np.median([point.error for point in few])),
        "angle_deg": float(np.median(angles)),
    }


if __name__ == "__main__":
    children.end_with_parent()
    job = json.load(sys.stdin)
    spec = MappingSpec(**job["spec"])
    judged = _reconstruct(pathlib.Path(job["folder"]), job["masked"], spec)
    console.say(json.dumps(judged))
