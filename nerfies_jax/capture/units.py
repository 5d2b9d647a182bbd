"""Conversion between scene units and the world units of a capture's own files."""

from typing import Literal

import numpy as np

from nerfies_jax.capture.capture import Capture, point_depths

Units = Literal["scene", "world"]


def places_in(units: Units, capture: Capture, points: np.ndarray) -> np.ndarray:
    """Convert points from scene units.

    Args:
      units: "scene" or "world".
      capture: The capture, for its scale and center.
      points: Points in scene units, [..., 3].

    Returns:
      float64 points in `units`, [..., 3].
    """
    points = np.asarray(points, np.float64)
    if units == "scene":
        return points
    return points / capture.scale + np.asarray(capture.center)


def usual_depth(capture: Capture) -> float:
    """The median z-depth of the points, or the middle of near and far without them."""
    depths = point_depths(capture)
    if depths.size:
        return float(np.median(depths))
    return float(np.sqrt(capture.near * capture.far))


def float32_step(points: np.ndarray) -> float:
    """The largest distance between neighboring float32 numbers at these coordinates."""
    largest = np.abs(points).max(initial=0.0)
    return float(np.spacing(np.float32(largest)))


def in_pixels(capture: Capture, length: float) -> float:
    """A length in scene units as it appears at the usual depth, in pixels."""
    focal = float(np.median(capture.cameras.focal_px))
    return length * focal / usual_depth(capture)
