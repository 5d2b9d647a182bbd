"""Metrics of depth, optical flow, point tracks and camera paths.

Metrics of depth, flow and tracks are pure JAX, in float32 or float64. Camera paths are
compared on the host in float64. Their alignment depends on a numerical rank and cannot
be differentiated.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry.precision import widened

DELTA = 1.25  # ratio of depths that is accepted as correct, Eigen et al. 2014
# In KITTI 2015, the flow of a pixel is an outlier if its error exceeds 3 px and 5 % of
# the true length.
OUTLIER_PX = 3.0
OUTLIER_SHARE = 0.05
# Directions in which the spread of points is smaller than this share of the largest
# spread are due to rounding: float32 positions have a relative error of 6e-8.
FLAT_BELOW = 1e-6


class DepthErrors(NamedTuple):
    """Errors over the pixels where both depths are known, NaN if there are none."""

    abs_rel: Float[Array, ""]  # mean |d - truth| / truth
    rmse: Float[Array, ""]  # scene units
    within_delta: Float[Array, ""]  # share with max(d/truth, truth/d) < 1.25
    pixels: Float[Array, ""]  # number of compared pixels


class Line(NamedTuple):
    """Alignment `scale * depth + shift`."""

    scale: Float[Array, ""]  # 0 if it is not determined
    shift: Float[Array, ""]
    determined: Bool[Array, ""]  # False if the depth is constant


def known_depth(
    depth: Float[Array, "*pixels"],
    truth: Float[Array, "*pixels"],
    mask: Bool[Array, "*pixels"] | None = None,
) -> Bool[Array, "*pixels"]:
    """Find the pixels whose depths can be compared.

    Args:
      depth: Predicted depths, [...].
      truth: True depths, 0 if unknown, [...].
      mask: True for pixels to compare, [...]. None for all.

    Returns:
      Booleans [...], True if both are finite and the truth is positive.
    """
    valid = jnp.isfinite(depth) & jnp.isfinite(truth) & (truth > 0)
    return valid if mask is None else valid & mask


def depth_errors(
    depth: Float[Array, "*pixels"],
    truth: Float[Array, "*pixels"],
    mask: Bool[Array, "*pixels"] | None = None,
) -> DepthErrors:
    """Compute errors of z-depth.

    Depths that are not positive are included, and never within delta. Align monocular
    depth with `align_depth` first.

    Args:
      depth: Predicted depths in scene units, [...].
      truth: True depths, 0 if unknown, [...].
      mask: True for pixels to compare, [...]. None for all.

    Returns:
      The errors.

    References:
      Eigen et al. 2014, arXiv:1406.2283.
    """
    depth, truth = widened(depth), widened(truth)
    valid = known_depth(depth, truth, mask)
    depth, truth = jnp.where(valid, depth, 1.0), jnp.where(valid, truth, 1.0)
    error = depth - truth
    right = (depth < DELTA * truth) & (truth < DELTA * depth)
    error_sq = _mean(error**2, valid)
    nonzero = error_sq > 0  # the root has no gradient at 0
    root = jnp.sqrt(jnp.where(nonzero, error_sq, 1.0))
    return DepthErrors(
        abs_rel=_mean(jnp.abs(error) / truth, valid),
        rmse=jnp.where(nonzero, root, error_sq),  # NaN stays NaN
        within_delta=_mean(right.astype(depth.dtype), valid),
        pixels=jnp.sum(valid).astype(depth.dtype),
    )


def align_depth(
    depth: Float[Array, "*pixels"],
    truth: Float[Array, "*pixels"],
    mask: Bool[Array, "*pixels"] | None = None,
) -> Line:
    """Fit scale and shift by least squares over the known pixels.

    The protocol of MiDaS aligns inverse depths, so pass inverse depths to follow it.
    The means are subtracted first, because the normal equations for a depth of 1000 ± 1
    would lose six digits.

    Args:
      depth: Predicted depths or inverse depths, [...].
      truth: True values, 0 if unknown, [...].
      mask: True for pixels to use, [...]. None for all.

    Returns:
      Scale and shift.

    References:
      Ranftl et al. 2020 (MiDaS), arXiv:1907.01341, equation 4.
    """
    depth, truth = widened(depth), widened(truth)
    valid = known_depth(depth, truth, mask)
    depth, truth = jnp.where(valid, depth, 0.0), jnp.where(valid, truth, 0.0)
    mean_depth, mean_truth = _mean(depth, valid), _mean(truth, valid)
    from_mean = jnp.where(valid, depth - mean_depth, 0.0)
    variance = _mean(from_mean**2, valid)
    covariance = _mean(from_mean * (truth - mean_truth), valid)
    # The mean has an error of a few ulps, which is the variance of a constant depth.
    rounding = 4 * jnp.finfo(depth.dtype).eps * mean_depth
    is_determined = variance > rounding**2
    scale = jnp.where(
        is_determined, covariance / jnp.where(is_determined, variance, 1.0), 0.0
    )
    return Line(scale, mean_truth - scale * mean_depth, is_determined)


class FlowErrors(NamedTuple):
    """Errors over the pixels whose true flow is known, NaN if there are none."""

    endpoint: Float[Array, ""]  # mean distance, pixels
    outliers: Float[Array, ""]  # share with errors above 3 px and 5 % (Fl of KITTI)
    pixels: Float[Array, ""]


def flow_errors(
    flow: Float[Array, "*pixels 2"],
    truth: Float[Array, "*pixels 2"],
    mask: Bool[Array, "*pixels"] | None = None,
) -> FlowErrors:
    """Compute the end-point error of optical flow.

    Args:
      flow: Predicted flow in pixels, [..., 2]. If it is not finite for a pixel with a
        known truth, the mean is infinite and the pixel is an outlier.
      truth: True flow, not finite if unknown, [..., 2].
      mask: True for pixels to compare, [...]. None for all.

    Returns:
      The errors.
    """
    flow, truth = widened(flow), widened(truth)
    valid = jnp.all(jnp.isfinite(truth), axis=-1)
    valid = valid if mask is None else valid & mask
    distance = _distance(flow, truth, valid)
    length = jnp.linalg.norm(jnp.where(valid[..., None], truth, 0.0), axis=-1)
    wrong = (distance > OUTLIER_PX) & (distance > OUTLIER_SHARE * length)
    return FlowErrors(
        endpoint=_mean(distance, valid),
        outliers=_mean(wrong.astype(flow.dtype), valid),
        pixels=jnp.sum(valid).astype(flow.dtype),
    )


class TrackErrors(NamedTuple):
    """Errors over the visible points, NaN if there are none."""

    endpoint: Float[Array, ""]  # mean distance, in the points' unit
    correct: Float[Array, ""]  # share of correct keypoints (PCK)
    points: Float[Array, ""]


def track_errors(
    tracks: Float[Array, "*points axes"],
    truth: Float[Array, "*points axes"],
    visible: Bool[Array, "*points"],
    threshold: float,
) -> TrackErrors:
    """Compute the errors of point tracks.

    PCK-T of DyCheck (arXiv:2210.13445) uses a threshold of 0.05 times the longer side
    of the image in pixels. For 3D tracks the threshold is a length in scene units.

    Args:
      tracks: Predicted positions, [..., axes]. Lost points are not finite, and never
        correct.
      truth: True positions, [..., axes].
      visible: True for points to compare, [...].
      threshold: Distance below which a point is correct, in the unit of the positions.

    Returns:
      The errors.

    Raises:
      ValueError: If the threshold is not positive.
    """
    if not threshold > 0:
        raise ValueError(f"threshold={threshold} must be positive")
    tracks, truth = widened(tracks), widened(truth)
    distance = _distance(tracks, truth, visible)
    return TrackErrors(
        endpoint=_mean(distance, visible),
        correct=_mean((distance < threshold).astype(tracks.dtype), visible),
        points=jnp.sum(visible).astype(tracks.dtype),
    )


def _mean(values, where):
    """Mean over a mask, NaN if it is empty."""
    count = jnp.sum(where).astype(values.dtype)
    return jnp.sum(jnp.where(where, values, 0.0)) / count


def _distance(a, b, where):
    difference = jnp.where(where[..., None], a, 0.0) - jnp.where(
        where[..., None], b, 0.0
    )
    finite = jnp.all(jnp.isfinite(difference), axis=-1)
    squares = jnp.sum(jnp.where(finite[..., None], difference, 0.0) ** 2, axis=-1)
    distinct = squares > 0  # the root has no gradient at 0
    distance = jnp.where(distinct, jnp.sqrt(jnp.where(distinct, squares, 1.0)), 0.0)
    return jnp.where(finite, distance, jnp.inf)


class Similarity(NamedTuple):
    """`scale * rotation @ point + translation`, float64 on the host."""

    scale: float
    rotation: np.ndarray  # [3, 3], determinant +1
    translation: np.ndarray  # [3]
    rank: int  # dimension of the points: 0 for a point, 1 for a line, 2 for a plane
    determined: bool  # False if other rotations fit equally well


class PathErrors(NamedTuple):
    """Camera positions after alignment, in units of the true path."""

    rmse: float  # absolute trajectory error (ATE)
    median: float
    largest: float
    alignment: Similarity


class RelativeErrors(NamedTuple):
    """Errors of the motion between frames that are `stride` apart."""

    translation_rmse: float  # units of the path
    rotation_deg: float  # mean angle


def align_points(points: np.ndarray, truth: np.ndarray, with_scale: bool) -> Similarity:
    """Find the similarity or rigid motion that aligns points with their truth.

    The rotation is not determined by points on a line, which `determined` reports (the
    residual does not show it). The result is never a reflection. For planar or mirrored
    sets it is the best rotation.

    Args:
      points: Points, [points, 3].
      truth: Their true positions, [points, 3].
      with_scale: True for a similarity, False for a rigid motion.

    Returns:
      The alignment.

    Raises:
      ValueError: If the numbers of points differ.

    References:
      Umeyama 1991, equations 34-43.
    """
    points, truth = _positions(points, "points"), _positions(truth, "truth")
    if points.shape != truth.shape:
        raise ValueError(
            "points and truth must have the same number of points, got "
            f"{len(points)} and {len(truth)}"
        )
    # In float64 relative to the centers: float32 points at a distance of 1e6 from the
    # origin would lead to an error of 1e-3 of the scale.
    center, true_center = points.mean(0), truth.mean(0)
    offsets, true_offsets = points - center, truth - true_center
    left, spread, right = np.linalg.svd(true_offsets.T @ offsets / len(points))
    is_mirrored = np.linalg.det(left) * np.linalg.det(right) < 0
    signs = np.array([1.0, 1.0, -1.0 if is_mirrored else 1.0])
    rotation = left * signs @ right
    variance = np.mean(np.sum(offsets**2, axis=1))
    largest = max(np.abs(points).max(), np.finfo(float).tiny)
    spread_out = variance > (FLAT_BELOW * largest) ** 2
    rank = min(_rank(points), _rank(truth))
    scale = float(spread @ signs / variance) if with_scale and spread_out else 1.0
    # If the two smallest singular values of a mirrored set are equal, the axis of the
    # flip is not determined.
    ambiguous = is_mirrored and spread[1] - spread[2] <= FLAT_BELOW * spread[0]
    return Similarity(
        scale=scale,
        rotation=rotation,
        translation=true_center - scale * rotation @ center,
        rank=rank,
        determined=rank >= 2 and not ambiguous,
    )


def _rank(points):
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    # Relative to the largest spread, and to the rounding errors of the coordinates.
    threshold = FLAT_BELOW * max(spread[0], np.abs(points).max())
    return int(np.sum(spread > threshold))


def path_errors(
    positions: np.ndarray, truth: np.ndarray, with_scale: bool = True
) -> PathErrors:
    """Compute the absolute trajectory error of camera positions after alignment.

    A small error means nothing unless `alignment.determined` is true.

    Args:
      positions: Camera positions, [frames, 3].
      truth: True positions, [frames, 3].
      with_scale: True to align the scale too, which images alone do not determine.

    Returns:
      The errors.

    References:
      Sturm et al. 2012.
    """
    alignment = align_points(positions, truth, with_scale)
    estimate = alignment.scale * np.asarray(positions, float) @ alignment.rotation.T
    distance = np.linalg.norm(estimate + alignment.translation - truth, axis=1)
    return PathErrors(
        rmse=float(np.sqrt(np.mean(distance**2))),
        median=float(np.median(distance)),
        largest=float(distance.max()),
        alignment=alignment,
    )


def relative_errors(
    camera_from_world: np.ndarray,
    positions: np.ndarray,
    true_camera_from_world: np.ndarray,
    true_positions: np.ndarray,
    stride: int = 1,
) -> RelativeErrors:
    """Compute the relative pose error between frames.

    It depends on the scale of the world, but not on its origin or orientation. Align
    the scale first (`align_points`).

    Args:
      camera_from_world: Rotations, [frames, 3, 3].
      positions: Camera positions, [frames, 3].
      true_camera_from_world: True rotations, [frames, 3, 3].
      true_positions: True positions, [frames, 3].
      stride: Distance between compared frames.

    Returns:
      The errors.

    Raises:
      ValueError: If `stride` is out of range.

    References:
      Sturm et al. 2012.
    """
    frames = len(positions)
    if not 1 <= stride < frames:
        raise ValueError(
            f"stride={stride} must be at least 1 and below the number of frames, "
            f"{frames}"
        )
    step, turn = _motions(camera_from_world, positions, stride)
    true_step, true_turn = _motions(true_camera_from_world, true_positions, stride)
    # R_error = R_true^T R, for the rotation of the second camera relative to the first.
    error = np.einsum("nji,njk->nik", true_turn, turn)
    distance_sq = np.sum((step - true_step) ** 2, axis=1)
    return RelativeErrors(
        translation_rmse=float(np.sqrt(distance_sq.mean())),
        rotation_deg=float(np.degrees(_angle(error)).mean()),
    )


def _motions(camera_from_world, positions, stride):
    rotation = np.asarray(camera_from_world, float)
    positions = _positions(positions, "positions")
    if rotation.shape != (len(positions), 3, 3):
        raise ValueError(
            f"expected one rotation [3, 3] for each of {len(positions)} positions, got "
            f"an array of shape {rotation.shape}"
        )
    step = positions[stride:] - positions[:-stride]
    turn = rotation[:-stride] @ rotation[stride:].swapaxes(-1, -2)
    return np.einsum("nij,nj->ni", rotation[:-stride], step), turn


def _angle(rotation):
    """Return angles of rotations in radians, unlike arccos exact near 0 and π."""
    skew = rotation - rotation.swapaxes(-1, -2)
    axis = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=-1)
    trace = np.trace(rotation, axis1=-2, axis2=-1)
    return np.arctan2(np.linalg.norm(axis, axis=-1), trace - 1)


def _positions(points, name):
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(
            f"{name} must be [points, 3] with at least one point, got {points.shape}"
        )
    if not np.all(np.isfinite(points)):
        row = int(np.argwhere(~np.isfinite(points))[0, 0])
        raise ValueError(
            f"{name}[{row}]={points[row]} must be finite; remove unknown points"
        )
    return points
