"""Cameras from pictures: COLMAP's incremental mapping, in a process of its own.

A process of its own, because pycolmap may abort instead of raising (an exception inside
one of its OpenMP loops), and because its libraries do not mix well with others.
"""

import dataclasses
import json
import pathlib
import shutil
import subprocess
import sys

from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.colmap_library import library
from nerfies_jax.capture.frames import SUFFIXES
from nerfies_jax.capture.json_files import AnyPath, new_folder

EXHAUSTIVE_UP_TO = 40  # pictures; above, matching every pair takes most of the time


@dataclasses.dataclass(frozen=True)
class MappingSpec:
    """How the cameras are looked for. All pictures share one lens."""

    # OPENCV keeps the vertical focal length apart, as Nerfies' camera does.
    camera_model: str = "OPENCV"
    # 2000 at octave 0 take a seventh of the time of COLMAP's 8192 at octave -1, for
    # twice the error (0.0006 against 0.0003 of a 2.4 long path).
    features: int = 4000
    first_octave: int = 0
    overlap: int = 10  # neighbours to match in a film
    in_order: bool = True  # names follow the film
    threads: int = 4
    at_least: float = 0.5  # share of the pictures that must find their place
    seconds: float = 3600.0  # then it is given up

    def __post_init__(self):
        if self.features < 100:
            raise ValueError(
                f"features={self.features} finds nothing; use at least 100"
            )
        if not 0 <= self.at_least <= 1:
            raise ValueError(f"at_least={self.at_least}; it is a share from 0 to 1")


def run_sfm(
    images: AnyPath,
    out: AnyPath,
    masks: AnyPath | None = None,
    spec: MappingSpec = MappingSpec(),
) -> pathlib.Path:
    """Reconstruct the pictures in a folder; `out` becomes a folder with sparse/0.

    `masks` holds `<picture name>.png` with black where features are to be ignored: on
    whatever moves by itself. Measured with a mover on 15 % of the picture: without
    masks all pictures register and the reprojection error is low, but the path is 250
    times further off. The pictures are copied to `out/images`, so `out` can be loaded.
    """
    images, out = pathlib.Path(images), pathlib.Path(out)
    if not images.is_dir():
        raise CaptureError(f"{images}: no such folder; pass a folder with pictures")
    names = sorted(file.name for file in images.iterdir() if file.suffix in SUFFIXES)
    if len(names) < 2:
        raise CaptureError(
            f"{images}: {len(names)} pictures; a reconstruction needs at least 2"
        )
    if masks is not None:
        masks = pathlib.Path(masks)
        absent = [name for name in names if not (masks / f"{name}.png").is_file()]
        if absent:
            raise CaptureError(
                f"{masks}: no mask {absent[0]}.png ({len(absent)} such); name each "
                "after "
                "its picture"
            )
    with new_folder(out) as folder:
        shutil.copytree(images, folder / "images")
        if masks is not None:
            shutil.copytree(masks, folder / "masks")
        counts = _in_own_process(folder, masks is not None, spec)
        if counts["registered"] < max(2, spec.at_least * len(names)):
            raise CaptureError(
                f"{images}: only {counts['registered']} of {len(names)} pictures found "
                "their place; film more slowly and with more texture, or mask what "
                "moves"
            )
    return out


def _in_own_process(folder, masked, spec):
    request = json.dumps(
        {"folder": str(folder), "masked": masked, "spec": dataclasses.asdict(spec)}
    )
    command = [sys.executable, "-m", "nerfies_jax.capture.structure_from_motion"]
    root = pathlib.Path(__file__).resolve().parents[2]
    try:
        done = subprocess.run(
            command,
            input=request,
            capture_output=True,
            text=True,
            timeout=spec.seconds,
            cwd=root,
        )
    except subprocess.TimeoutExpired:
        raise CaptureError(
            f"{folder.name}: no cameras after {spec.seconds:g} s; use fewer pictures"
        ) from None
    last = done.stdout.strip().splitlines()[-1:] or [""]
    if done.returncode != 0 or not last[0].startswith("{"):
        last_words = [
            line for line in done.stderr.strip().splitlines() if line.strip()
        ][-1:]
        raise CaptureError(
            f"{folder.name}: COLMAP ended with code {done.returncode} "
            f"({' '.join(last_words)[:200]}); try fewer features or smaller pictures"
        )
    return json.loads(last[0])


def _reconstruct(folder: pathlib.Path, masked: bool, spec: MappingSpec) -> int:
    """In the child: fill folder/sparse/0; the number of registered pictures."""
    pycolmap = library()
    database, images = folder / "database.db", folder / "images"
    reading = pycolmap.ImageReaderOptions()
    reading.camera_model = spec.camera_model
    if masked:
        reading.mask_path = str(folder / "masks")
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = spec.threads
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
    matching.num_threads = spec.threads
    count = sum(1 for _ in images.iterdir())
    if spec.in_order and count > EXHAUSTIVE_UP_TO:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = spec.overlap
        pycolmap.match_sequential(
            database,
            matching_options=matching,
            pairing_options=pairing,
            device=pycolmap.Device.cpu,
        )
    else:
        pycolmap.match_exhaustive(
            database, matching_options=matching, device=pycolmap.Device.cpu
        )
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = spec.threads
    models = pycolmap.incremental_mapping(database, images, folder / "models", options)
    # No model is an empty dict and a line in the log, not an exception.
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if best is not None:
        target = folder / "sparse" / "0"
        target.mkdir(parents=True)
        best.write(str(target))
    shutil.rmtree(folder / "models", ignore_errors=True)
    database.unlink(missing_ok=True)
    return 0 if best is None else best.num_reg_images()


if __name__ == "__main__":
    job = json.load(sys.stdin)
    registered = _reconstruct(
        pathlib.Path(job["folder"]), job["masked"], MappingSpec(**job["spec"])
    )
    print(json.dumps({"registered": registered}))
