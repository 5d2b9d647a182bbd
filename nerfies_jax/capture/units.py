"""Conversion between scene units and the world units of a capture's files."""

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
    """Return a typical depth of a capture.

    Args:
      capture: The capture.

    Returns:
      The median z-depth of its points, or without points the geometric mean of near and
      far, in scene units.
    """
    depths = point_depths(capture)
    if depths.size:
        return float(np.median(depths))
    return float(np.sqrt(capture.near * capture.far))


def float32_step(points: np.ndarray) -> float:
    """Return the spacing of float32 numbers at the largest of some coordinates.

    Args:
      points: Coordinates of any shape.

    Returns:
      The spacing, in the unit of the coordinates.
    """
    largest = np.abs(points).max(initial=0.0)
    return float(np.spacing(np.float32(largest)))


def in_pixels(capture: Capture, length: float) -> float:
    """Convert a length in scene units to pixels at the typical depth.

    Args:
      capture: The capture.
      length: Length in scene units.

    Returns:
      Length in pixels.
    """
    focal = float(np.median(capture.cameras.focal_px))
    return length * focal / usual_depth(capture)
