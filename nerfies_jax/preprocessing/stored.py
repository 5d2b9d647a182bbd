"""Findings about depth, masks and lens distortion stored with a capture."""

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as camera_records
from nerfies_jax.geometry import lens as lenses
from nerfies_jax.preprocessing import dense_points
from nerfies_jax.preprocessing.findings import (
    CERTAIN,
    DEPTH,
    LENS,
    MASKS,
    Finding,
    cannot_tell,
    judge,
)
from nerfies_jax.preprocessing.paths import STATIC_SCORE
from nerfies_jax.preprocessing.record import MOVES, Evidence
from nerfies_jax.preprocessing.tracks import pixel_of
from nerfies_jax.preprocessing.view_set import MIN_POINTS, Views

KNOWN_SHARE = 0.2  # minimum share of pixels with depth
DEPTH_ERROR = 0.1  # maximum of the median relative error compared with parallax
DEPTH_SURE = 0.03  # maximum relative deviation of a depth from parallax for comparison
MISSED_SHARE = 0.3  # maximum share of moving tracks outside the masks
MIN_MOVING = 200  # observations of moving tracks, over all frames
LENS_PX = 0.5  # typical accuracy of cameras
GRID = 9  # pixels in each direction at which distortion is evaluated


def depth(capture: Capture, views: Views, evidence: Evidence) -> Finding:
    """Decide if the depth of the capture agrees with parallax, up to one scale.

    Args:
      capture: The capture.
      views: Its frames.
      evidence: Its preprocessing.

    Returns:
      The finding.
    """
    threshold = f"{KNOWN_SHARE:.0%} of the pixels, with an error of {DEPTH_ERROR:.0%}"
    if capture.depths is None:
        return Finding(DEPTH, "the capture has none", threshold, False, CERTAIN)
    depths = capture.depths[views.row]
    share = float((depths > 0).mean())
    if share < KNOWN_SHARE:
        measurement = f"depth for {share:.1%} of the pixels"
        return Finding(DEPTH, measurement, threshold, False, CERTAIN, {"share": share})
    ratio = _over_parallax(depths, views, evidence)
    if len(ratio) < MIN_POINTS:
        return cannot_tell(
            DEPTH,
            f"depth for {share:.1%} of the pixels, but no parallax to check it",
            threshold,
        )
    scale = float(np.median(ratio))
    error = float(np.median(np.abs(ratio / scale - 1)))
    wrong, confidence = judge(error, DEPTH_ERROR, 0.0)
    measurement = (
        f"depth for {share:.1%} of the pixels, with a median error of {error:.1%} "
        f"compared with parallax, after scaling by {1 / scale:.3g}"
    )
    numbers = {"share": share, "error_share": error, "scale": 1 / scale}
    agrees = None if wrong is None else not wrong
    return Finding(DEPTH, measurement, threshold, agrees, confidence, numbers)


def _over_parallax(depths, views, evidence):
    """Return the ratios of stored depth to the depth of static tracks."""
    static_rows = np.flatnonzero(
        (evidence.score < STATIC_SCORE) & (not evidence.unusable)
    )
    tracks, static_fit = (
        evidence.tracks.take(static_rows),
        evidence.static_fit.take(static_rows),
    )
    sure = dense_points.depth_deviation(views, tracks, static_fit) < DEPTH_SURE
    tracks, static_fit = tracks.take(sure), static_fit.take(sure)
    row, column = pixel_of(tracks.pixel, depths.shape[1:])
    own = depths[np.arange(len(depths)), row, column]
    is_known = tracks.visible & (own > 0) & (static_fit.depth > 0)
    return own[is_known] / static_fit.depth[is_known]


def masks(capture: Capture, evidence: Evidence) -> Finding:
    """Decide if the masks of the capture contain the observed motion.

    Args:
      capture: The capture.
      evidence: Its preprocessing.

    Returns:
      The finding.
    """
    threshold = f"at most {MISSED_SHARE:.0%} of the moving tracks outside the masks"
    if capture.moving is None:
        return Finding(MASKS, "the capture has none", threshold, False, CERTAIN)
    moving = capture.moving[evidence.row]
    share = float(moving.mean())
    numbers = {"share": share}
    measurement = f"masks on {share:.1%} of the pixels"
    if share in (0.0, 1.0):
        return Finding(MASKS, measurement, threshold, False, CERTAIN, numbers)
    tracks = evidence.tracks.take((evidence.score > MOVES) & (not evidence.unusable))
    count, frames = int(tracks.visible.sum()), int(tracks.visible.any(0).sum())
    if count < MIN_MOVING:
        return cannot_tell(
            MASKS,
            f"{measurement}, but too few moving tracks to check them",
            threshold,
        )
    row, column = pixel_of(tracks.pixel, moving.shape[1:])
    inside = moving[np.arange(len(moving)), row, column] & tracks.visible
    part = 1 - float(inside.sum() / count)
    # Whole regions are in or out: one region a frame.
    error = np.sqrt(part * (1 - part) / frames)
    wrong, confidence = judge(part, MISSED_SHARE, float(error))
    agrees = None if wrong is None else not wrong
    measurement += f"; {part:.1%} of the moving tracks are outside"
    return Finding(
        MASKS, measurement, threshold, agrees, confidence, numbers | {"missed": part}
    )


def lens(capture: Capture) -> Finding:
    """Measure the lens distortion of a capture as stored.

    Args:
      capture: The capture.

    Returns:
      The finding, with the largest displacement of a pixel.
    """
    threshold = f"{LENS_PX:g} px"
    cameras = capture.cameras
    width, height = capture.size
    across, down = np.meshgrid(
        np.linspace(0, width, GRID), np.linspace(0, height, GRID)
    )
    pixel = np.stack([across, down], -1).reshape(-1, 2)
    parts = [cameras.radial, cameras.tangential, cameras.focal_px[:, None]]
    if cameras.fisheye is not None:
        parts.append(cameras.fisheye)
    parameters = np.concatenate(parts, axis=1)
    worst = 0.0
    for row in np.unique(parameters, axis=0, return_index=True)[1]:
        focal = np.array([1, cameras.pixel_aspect[row]]) * cameras.focal_px[row]
        slope = ((pixel - cameras.principal_point_px[row]) / focal).astype(np.float32)
        camera = jax.tree.map(jnp.float32, camera_records.take(cameras, row))
        distorted_xy = jax.vmap(lenses.distort, (None, 0))(camera, jnp.asarray(slope))
        shift = np.linalg.norm((np.asarray(distorted_xy) - slope) * focal, axis=-1)
        worst = max(worst, float(shift.max()))
    bends, confidence = judge(worst, LENS_PX, 0.0)
    measurement = f"lens distortion displaces pixels by up to {worst:.2g} px"
    if bends:
        measurement += "; training and evaluation model it"
    return Finding(LENS, measurement, threshold, bends, confidence, {"most_px": worst})
