"""Conversion between scene units and the world units of a capture's own files."""

from typing import Literal

import numpy as np

from nerfies_jax.capture.capture import Capture

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
