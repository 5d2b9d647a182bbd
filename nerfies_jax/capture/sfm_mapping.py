"""Incremental mapping with the camera models of a ladder, in the child process."""

import copy
import math
import pathlib
import shutil
from typing import Any, NamedTuple

import numpy as np

from nerfies_jax.capture import sfm_features, sfm_joining, sfm_ladder
from nerfies_jax.capture.colmap_library import MIN_TRACK, library
from nerfies_jax.capture.sfm_features import SEED, CameraGroup
from nerfies_jax.capture.sfm_ladder import Rung, Summary
from nerfies_jax.runtime import console

MOST_JUDGED = 5000  # points of which the quality is measured
# Images of which single focal lengths are fitted, and their smallest number of points.
MOST_FITTED, LEAST_FITTED = 40, 30
# Smallest triangulation angle of points in degrees. COLMAP's default of 1.5 leaves
# images of a camera that mostly turns without points: 42 of 60 register instead of 60.
LEAST_ANGLE_DEG = 0.5


class Mapped(NamedTuple):
    """The best reconstruction of several attempts."""

    model: Any  # pycolmap.Reconstruction
    summary: Summary
    tried: tuple[Summary, ...]
    pieces: list[int]  # numbers of images of the models that could not be joined


def climb(
    features: pathlib.Path,
    images: pathlib.Path,
    work: pathlib.Path,
    groups: list[CameraGroup],
    spec,
    masks: pathlib.Path | None,
) -> Mapped | None:
    """Reconstruct cameras with one camera model after the other until one is plausible.

    Args:
      features: Database of `sfm_features.extract`.
      images: Folder of images.
      work: Existing folder for temporary files.
      groups: Images by camera, for models with common cameras.
      spec: A `MappingSpec`.
      masks: Folder with `<image name>.png`, black where features are left out.

    Returns:
      The best reconstruction, or None if no attempt registered two images.
    """
    results: list[tuple] = []
    while True:
        rung = sfm_ladder.next_rung([each[1] for each in results], spec.cameras)
        if rung is None:
            break
        # Read by the parent process, which reports the progress.
        console.note(f"camera model {len(results) + 1}: {rung.text}")
        results.append(_attempt(rung, features, images, work, groups, spec, masks))
    summaries = [each[1] for each in results]
    model, summary, pieces = results[sfm_ladder.best(summaries)]
    if model is None:
        return None
    return Mapped(model, summary, tuple(summaries), pieces)


def _attempt(rung: Rung, features, images, work, groups, spec, masks):
    """Return a model or None, its summary, and the sizes of all models."""
    pycolmap = library()
    count = sum(len(group.names) for group in groups)
    if rung.each:
        groups = [
            CameraGroup((name,), group.focal)
            for group in groups
            for name in group.names
        ]
    folder = work / "mapping"
    folder.mkdir()
    try:
        database = folder / "database.db"
        sfm_features.derive(
            features,
            database,
            images,
            groups,
            _model(rung, spec),
            masks,
            spec.least_scale,
            spec.threads or -1,
        )
        options = _options(rung)
        (folder / "models").mkdir()
        models = pycolmap.incremental_mapping(
            database, images, folder / "models", options
        )
        models = sorted(models.values(), key=lambda one: -one.num_reg_images())
        model, pieces = None, list[int]()
        if models:
            model, pieces = sfm_joining.join(models, database, images, folder, options)
            if rung.hold:
                model = _refine(model, options)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return model, _summarize(model, rung, count), pieces


def _model(rung, spec):
    """COLMAP camera model, without distortion if the requested one has none."""
    if rung.model is None:
        return spec.camera_model
    return "SIMPLE_PINHOLE" if "PINHOLE" in spec.camera_model else rung.model


def _options(rung):
    options = library().IncrementalPipelineOptions()
    # With several threads, sums of bundle adjustment have no fixed order.
    options.num_threads = 1
    options.random_seed = SEED
    options.mapper.filter_min_tri_angle = LEAST_ANGLE_DEG
    options.triangulation.min_angle = LEAST_ANGLE_DEG
    if rung.hold:
        options.ba_refine_focal_length = False
        options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
    return options


def _refine(model, options):
    """Refine cameras that were held: the focal length, and then the distortion as well.

    A step that makes the intrinsics implausible is undone.
    """
    for distortion in (False, True):
        candidate = copy.deepcopy(model)
        sfm_joining.adjust(candidate, options, distortion)
        lens = _summarize(candidate, sfm_ladder.HELD, candidate.num_reg_images())
        if sfm_ladder.implausible_lens(lens):
            break
        model = candidate
    return model


def _summarize(model, rung: Rung, images: int) -> Summary:
    """Measure the quality of a reconstruction and of its intrinsics."""
    if model is None:
        return Summary(rung, images, 0, 0, 0.0, 0.0, (1.0, 1.0), 1.0, folds=False)
    camera_ids = {model.image(number).camera_id for number in model.reg_image_ids()}
    lenses = [_lens(model.camera(number)) for number in sorted(camera_ids)]
    focals = [focal for focal, _, _ in lenses]
    points, error_px, angle_deg = _quality(model)
    return Summary(
        rung,
        images,
        model.num_reg_images(),
        points,
        error_px,
        angle_deg,
        (min(focals, default=math.nan), max(focals, default=math.nan)),
        max((aspect for _, aspect, _ in lenses), default=1.0),
        any(folds for _, _, folds in lenses),
        0.0 if rung.each else _focal_spread(model),
    )


def _lens(camera):
    """Focal length in image sides, ratio between the axes, and if the lens folds."""
    x, y = camera.focal_length_x, camera.focal_length_y
    side = max(camera.width, camera.height)
    corner = math.hypot(
        max(camera.principal_point_x, camera.width - camera.principal_point_x) / x,
        max(camera.principal_point_y, camera.height - camera.principal_point_y) / y,
    )
    # k1, k2 of all models that can be requested. Others of OPENCV are tangential.
    radial = [camera.params[i] for i in camera.extra_params_idxs()][:2]
    focal, aspect = math.sqrt(abs(x * y)) / side, max(x / y, y / x)
    return focal, aspect, sfm_ladder.folds_inside(radial, corner)


def _focal_spread(model):
    """Relative spread of the focal lengths that fit single images best.

    The points are fixed. Images of a zoom fit best with different focal lengths even if
    the reconstruction has a common one. For groups of cameras, the spread is relative
    to the focal length of each.
    """
    pycolmap = library()
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.refine_focal_length, options.refine_extra_params = True, False
    numbers = sorted(model.reg_image_ids())
    ratios = []
    for number in numbers[:: -(-len(numbers) // MOST_FITTED)]:
        image = model.image(number)
        observations = [point for point in image.points2D if point.has_point3D()]
        if len(observations) < LEAST_FITTED:
            continue
        camera = copy.deepcopy(model.camera(image.camera_id))
        before = camera.mean_focal_length()
        solution = pycolmap.refine_absolute_pose(
            image.cam_from_world(),
            np.array([point.xy for point in observations]),
            np.array([model.point3D(point.point3D_id).xyz for point in observations]),
            np.ones(len(observations), bool),
            camera,
            options,
        )
        if solution is not None:
            ratios.append(camera.mean_focal_length() / before)
    if len(ratios) < MIN_TRACK:
        return 0.0
    low, high = np.percentile(ratios, (10, 90))
    return float(high / low - 1) if low > 0 else math.inf


def _quality(model):
    """Number of reliable points, and medians of their errors and largest angles."""
    points = [p for p in model.points3D.values() if p.track.length() >= MIN_TRACK]
    if not points:
        return 0, 0.0, 0.0
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
    error = float(np.median([point.error for point in sample]))
    return len(points), error, float(np.median(angles))
