"""Checks of depths against the scene, and of masks and depths that were not read."""

import pathlib

import numpy as np

from nerfies_jax.capture import units
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.gate_finding import Finding

WRONG_UNITS = 20.0  # factor between stored depths and the scene that units explain
# Names of factors between the units of depths and of cameras.
UNITS = (
    (1000.0, "the depths are in millimeters and the cameras in meters"),
    (100.0, "the depths are in centimeters and the cameras in meters"),
    (0.001, "the depths are in meters and the cameras in millimeters"),
    (0.01, "the depths are in meters and the cameras in centimeters"),
)
MASKS = ("masks", "mask", "motion_masks", "dynamic_masks")
DEPTHS = ("depth", "depths", "depth_maps", "disp")
SAMPLES = 1_000_000  # of the pixels; more change no median


def findings(capture: Capture) -> list[Finding]:
    """Check the units of depths, and find folders that nothing in the capture names.

    Args:
      capture: The capture.

    Returns:
      The findings.
    """
    return [*_depths(capture), *_unread(capture)]


def _unread(capture):
    """Folders next to the capture whose names promise what was not read."""
    if capture.path is None:
        return []
    root = pathlib.Path(capture.path)
    root = root if root.is_dir() else root.parent
    found = []
    for names, has, way_out in (
        (MASKS, capture.valid is not None or capture.moving is not None, "masks"),
        (DEPTHS, capture.depths is not None, "depths"),
    ):
        there = [name for name in names if _has_files(root / name)]
        if there and not has:
            problem = (
                f"the folder {there[0]} is not read: nothing in the capture names its "
                f"files; they can be given as external {way_out}"
            )
            found.append(Finding(f"folder {there[0]}", "not read", problem))
    return found


def _has_files(folder):
    return folder.is_dir() and any(folder.iterdir())


def _depths(capture):
    """Compare stored depths with those of the points, or with near and far."""
    if capture.depths is None:
        return []
    known = capture.depths.ravel()[:: max(1, capture.depths.size // SAMPLES)]
    known = known[known > 0]
    subject = "depths"
    if not capture.depths.any():
        problem = "depth is stored, but no pixel has one above 0"
        return [Finding(subject, "none", problem)]
    if not known.size:
        return []
    near, far = capture.near, capture.far
    median = float(np.median(known))
    beyond = float(((known < near) | (known > far)).mean())
    usual = units.usual_depth(capture)
    ratio = median / usual
    of_points = units.point_depths(capture).size
    stated = (
        f"the median stored depth is {median:.3g} scene units, {ratio:.3g} times that "
        + ("of the points" if of_points else f"between near and far ({usual:.3g})")
        + f"; near is {near:.3g} and far {far:.3g}"
    )
    value = f"median {median:.3g}, {beyond:.0%} outside near and far"
    if 1 / WRONG_UNITS < ratio < WRONG_UNITS:
        problem = f"{beyond:.0%} of depths: {stated}" if beyond > 0.5 else ""
        scaled = abs(np.log(capture.scale)) > np.log(2)
        if problem and scaled and abs(np.log(ratio / capture.scale)) < np.log(1.5):
            problem += "; they seem to be in scene units, and world units are expected"
        return [Finding(subject, value, problem)]
    factor, reason = min(UNITS, key=lambda one: abs(np.log(ratio / one[0])))
    way_out = "convert the depths to the unit of the cameras or remove them"
    if abs(np.log(ratio / capture.scale)) < abs(np.log(ratio / factor)):
        factor, reason = capture.scale, "the depths are in scene units already"
    if abs(np.log(ratio / factor)) < np.log(3):
        way_out = f"probably {reason}, so multiply the depths by {1 / factor:g}"
    return [Finding(subject, value, f"{stated}; {way_out}", refused=True)]
