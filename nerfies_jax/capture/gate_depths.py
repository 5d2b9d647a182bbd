"""Checks of depths against the scene, and of masks and depths that are not read."""

import pathlib

import numpy as np

from nerfies_jax.capture import units
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.gate_finding import Finding

# Smallest ratio of stored depths to the scene that indicates another unit.
WRONG_UNITS = 20.0
# Ratios of stored depths to the scene, and their explanations.
UNITS = (
    (1000.0, "the depths are in millimeters and the cameras in meters"),
    (100.0, "the depths are in centimeters and the cameras in meters"),
    (0.001, "the depths are in meters and the cameras in millimeters"),
    (0.01, "the depths are in meters and the cameras in centimeters"),
)
MASKS = ("masks", "mask", "motion_masks", "dynamic_masks")
DEPTHS = ("depth", "depths", "depth_maps", "disp")
SAMPLES = 1_000_000  # pixels, enough for an accurate median


def findings(capture: Capture) -> list[Finding]:
    """Check the units of depths, and find folders of masks or depths that are not read.

    Args:
      capture: The capture.

    Returns:
      The findings.
    """
    return [*_depths(capture), *_unread(capture)]


def _unread(capture):
    """Folders in the capture whose names suggest masks or depths that are not read."""
    if capture.path is None:
        return []
    root = pathlib.Path(capture.path)
    root = root if root.is_dir() else root.parent
    results = []
    for names, was_read, kind in (
        (MASKS, capture.valid is not None or capture.moving is not None, "masks"),
        (DEPTHS, capture.depths is not None, "depths"),
    ):
        existing = [name for name in names if _has_files(root / name)]
        if existing and not was_read:
            problem = (
                f"the folder {existing[0]} is not read: nothing in the capture refers "
                f"to its files; they can be used as external {kind}"
            )
            results.append(Finding(f"folder {existing[0]}", "not read", problem))
    return results


def _has_files(folder):
    return folder.is_dir() and any(folder.iterdir())


def _depths(capture):
    """Compare stored depths with those of the points, or with near and far."""
    if capture.depths is None:
        return []
    sample = capture.depths.ravel()[:: max(1, capture.depths.size // SAMPLES)]
    sample = sample[sample > 0]
    subject = "depths"
    if not capture.depths.any():
        problem = "depth is stored, but no pixel has one above 0"
        return [Finding(subject, "none", problem)]
    if not sample.size:
        return []
    near, far = capture.near, capture.far
    median = float(np.median(sample))
    beyond = float(((sample < near) | (sample > far)).mean())
    expected_depth = units.usual_depth(capture)
    ratio = median / expected_depth
    has_points = units.point_depths(capture).size
    statement = (
        f"the median stored depth is {median:.3g} scene units, {ratio:.3g} times that "
        + (
            "of the points"
            if has_points
            else f"between near and far ({expected_depth:.3g})"
        )
        + f"; near is {near:.3g} and far {far:.3g}"
    )
    value = f"median {median:.3g}, {beyond:.0%} outside near and far"
    if 1 / WRONG_UNITS < ratio < WRONG_UNITS:
        problem = f"{beyond:.0%} of depths: {statement}" if beyond > 0.5 else ""
        is_scaled = abs(np.log(capture.scale)) > np.log(2)
        if problem and is_scaled and abs(np.log(ratio / capture.scale)) < np.log(1.5):
            problem += "; they seem to be in scene units, and world units are expected"
        return [Finding(subject, value, problem)]
    factor, reason = min(UNITS, key=lambda unit: abs(np.log(ratio / unit[0])))
    remedy = "convert the depths to the unit of the cameras or remove them"
    if abs(np.log(ratio / capture.scale)) < abs(np.log(ratio / factor)):
        factor, reason = capture.scale, "the depths are in scene units already"
    if abs(np.log(ratio / factor)) < np.log(3):
        remedy = f"probably {reason}, so multiply the depths by {1 / factor:g}"
    return [Finding(subject, value, f"{statement}; {remedy}", refused=True)]
