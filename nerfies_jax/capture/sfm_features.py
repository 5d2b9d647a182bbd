"""Features and matches of images, kept in a COLMAP database for several mappings.

Functions run in the child process of `structure_from_motion`. Features and matches are
computed once. Each mapping gets a database of its own, with other camera models,
without the features of moving objects, or without fine features.
"""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import PIL.Image

from nerfies_jax.capture.colmap_library import library

# Seed of RANSAC.
SEED = 0
# Smallest scale of features at octave 0, in pixels. Those of octave -1 begin at 0.88.
COARSE_PX = 1.7


class CameraGroup(NamedTuple):
    """Images that share one camera."""

    names: tuple[str, ...]
    focal: float  # initial focal length as a multiple of the longest side


def extract(database: pathlib.Path, images: pathlib.Path, spec, threads: int):
    """Extract and match features of all images.

    The result does not depend on the number of threads.

    Args:
      database: The database to create.
      images: Folder of images.
      spec: A `MappingSpec`.
      threads: Number of threads.
    """
    pycolmap = library()
    names = sorted(file.name for file in images.iterdir())
    _create(database, images, [CameraGroup(tuple(names), 1.2)], "SIMPLE_PINHOLE")
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    extraction.sift.max_num_features = spec.features
    extraction.sift.first_octave = spec.first_octave
    pycolmap.extract_features(
        database,
        images,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.skip_geometric_verification = True  # `derive` verifies
    if spec.is_sequential(len(names)):
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


def _create(database, images, groups, model):
    """Create a database of images without features.

    Their ids follow the order of the names. If the images are left to the extraction
    of features, ids follow the order in which its threads finish, and with the ids the
    first image pair, the order of registration and the result change from run to run.
    """
    pycolmap = library()
    database.unlink(missing_ok=True)
    pycolmap.Database.open(database).close()
    for group in groups:
        reading = pycolmap.ImageReaderOptions()
        reading.camera_model = model
        reading.default_focal_length_factor = group.focal
        pycolmap.import_images(
            database,
            images,
            camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=sorted(group.names),
            options=reading,
        )


def derive(
    source: pathlib.Path,
    target: pathlib.Path,
    images: pathlib.Path,
    groups: Sequence[CameraGroup],
    model: str,
    masks: pathlib.Path | None = None,
    least_scale: float = 0.0,
    threads: int = 1,
):
    """Write a database with other cameras and with a part of the features.

    Args:
      source: Database of `extract`.
      target: Database to create.
      images: Folder of images.
      groups: Images by camera.
      model: Camera model.
      masks: Folder with `<image name>.png`, black where features are left out.
      least_scale: Smallest scale of the features to keep, in pixels.
      threads: Number of threads.
    """
    pycolmap = library()
    _create(target, images, groups, model)
    old, new = pycolmap.Database.open(source), pycolmap.Database.open(target)
    try:
        id_of = {image.name: image.image_id for image in new.read_all_images()}
        new_id, new_row = {}, {}
        for image in old.read_all_images():
            points = np.asarray(old.read_keypoints(image.image_id))
            keep = _scales(points) >= least_scale
            if masks is not None:
                keep &= _is_unmasked(points, masks / f"{image.name}.png")
            new_id[image.image_id] = id_of[image.name]
            new_row[image.image_id] = np.where(keep, np.cumsum(keep) - 1, -1)
            new.write_keypoints(
                id_of[image.name], np.ascontiguousarray(points[keep], np.float32)
            )
        for pair, matches in zip(*old.read_all_matches(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            rows = np.asarray(matches).reshape(-1, 2)
            rows = np.stack(
                [new_row[first][rows[:, 0]], new_row[second][rows[:, 1]]], axis=-1
            )
            rows = rows[(rows >= 0).all(-1)]
            if len(rows):
                new.write_matches(new_id[first], new_id[second], rows.astype(np.uint32))
    finally:
        old.close()
        new.close()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = threads
    pycolmap.geometric_verification(
        target, verifier_options=verifier, two_view_geometry_options=verification
    )


def _scales(points):
    """Scales of keypoints, whose affine shape is in columns 2 to 5 if there are six."""
    if points.shape[1] == 4:  # x, y, scale, orientation
        return points[:, 2]
    return np.hypot(points[:, 2], points[:, 4])


def _is_unmasked(points, file):
    with PIL.Image.open(file) as image:
        mask = np.asarray(image.convert("L"))
    last = np.array(mask.shape[::-1]) - 1
    x, y = np.clip(points[:, :2].astype(int), 0, last).T
    return mask[y, x] > 0
