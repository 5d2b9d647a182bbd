"""Scene units, which everything here is in, and those of a capture's own files."""

from typing import Literal

import numpy as np

from nerfies_jax.capture.capture import Capture

Units = Literal["scene", "world"]


def places_in(units: Units, capture: Capture, points: np.ndarray) -> np.ndarray:
    """Points [..., 3] in scene units as points in `units`; float64."""
    points = np.asarray(points, np.float64)
    if units == "scene":
        return points
    return points / capture.scale + np.asarray(capture.center)
