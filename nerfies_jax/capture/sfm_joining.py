"""Joining of COLMAP models that share images, in the child process."""

from typing import Any

import numpy as np

from nerfies_jax.capture.colmap_library import library
from nerfies_jax.capture.sfm_features import SEED

# Pairs of points, observed at the same features of shared images, that must agree on
# one similarity transform, and their smallest share.
LEAST_PAIRS, LEAST_AGREEING = 20, 0.5
# Largest distance of a pair that agrees, as a share of the median distance of the
# points from their center.
PAIR_ERROR = 0.02
# Points that an image of a joined model must observe to stay.
LEAST_OBSERVATIONS = 15


def join(models: list[Any], database, images, folder, options) -> tuple[Any, list[int]]:
    """Join the models that share images with the largest.

    Args:
      models: Models of one database, the largest first. Those joined are changed.
      database: The database.
      images: Folder of images.
      folder: Existing folder for temporary files.
      options: `IncrementalPipelineOptions` for points of the joined model.

    Returns:
      The joined model, or the largest if no other fits, and the numbers of images of
      the models that remain, its own first.
    """
    pycolmap = library()
    base, others = models[0], models[1:]
    while True:
        separate = [other for other in others if not _append(base, other)]
        if len(separate) == len(others):
            return base, [each.num_reg_images() for each in (base, *others)]
        others = separate
        target = folder / "joined"
        target.mkdir(exist_ok=True)
        base = pycolmap.triangulate_points(
            base, database, images, target, True, options
        )
        adjust(base, options)
        _drop_unsupported(base)


def adjust(model, options, distortion: bool | None = None):
    """Bundle-adjust a model on one thread, whose result is reproducible.

    Args:
      model: The model, which is changed.
      options: `IncrementalPipelineOptions` with the intrinsics to refine.
      distortion: Refine the focal length, and the distortion if True, whatever the
        options say. None to follow the options.
    """
    pycolmap = library()
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.ceres.solver_options.num_threads = 1
    adjustment.refine_focal_length = options.ba_refine_focal_length
    adjustment.refine_extra_params = options.ba_refine_extra_params
    if distortion is not None:
        adjustment.refine_focal_length = True
        adjustment.refine_extra_params = distortion
    pycolmap.bundle_adjustment(model, adjustment)
    model.update_point_3d_errors()


def _append(base, other):
    """Add the images of a model that only it has, if the two fit; return True if so."""
    pycolmap = library()
    pairs = _common_points(base, other)
    new = [i for i in sorted(other.reg_image_ids()) if not base.exists_image(i)]
    if len(pairs) < LEAST_PAIRS or not new:
        return False
    source = np.array([other.point3D(number).xyz for number, _ in pairs])
    target = np.array([base.point3D(number).xyz for _, number in pairs])
    spread = np.median(np.linalg.norm(target - np.median(target, axis=0), axis=1))
    options = pycolmap.RANSACOptions()
    options.random_seed = SEED
    options.max_error = PAIR_ERROR * float(spread)
    estimate = pycolmap.estimate_sim3d_robust(source, target, options)
    if estimate is None or estimate["num_inliers"] < LEAST_AGREEING * len(pairs):
        return False
    other.transform(estimate["tgt_from_src"])
    for number in new:
        image = other.image(number)
        if not base.exists_camera(image.camera_id):
            base.add_camera_with_trivial_rig(other.camera(image.camera_id))
        copy = pycolmap.Image(
            name=image.name,
            keypoints=np.array([point.xy for point in image.points2D]).reshape(-1, 2),
            camera_id=image.camera_id,
            image_id=number,
        )
        base.add_image_with_trivial_frame(copy, image.cam_from_world())
    return True


def _common_points(base, other):
    """Pairs of ids of points (of `other`, of `base`) at the same features."""
    pairs = set()
    for number, _ in base.find_common_reg_image_ids(other):
        features = zip(
            base.image(number).points2D, other.image(number).points2D, strict=True
        )
        pairs.update(
            (second.point3D_id, first.point3D_id)
            for first, second in features
            if first.has_point3D() and second.has_point3D()
        )
    return sorted(pairs)


def _drop_unsupported(model):
    """Remove images that observe too few points after joining."""
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        if sum(point.has_point3D() for point in image.points2D) < LEAST_OBSERVATIONS:
            model.deregister_frame(image.frame_id)
