"""The sizes that are measured, and exponents fitted to them."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np


class Axis(NamedTuple):
    """One size of a scene that grows, while the others stay."""

    sizes: tuple[int, ...]
    about: str  # the scene
    splats: bool = True


_PIXELS = (176 * 132, 704 * 528, 1280 * 720, 1920 * 1080)
AXES = {
    "Gaussians": Axis(
        (1_000, 10_000, 100_000, 1_000_000), "static splats, 352x264 pixels"
    ),
    "pixels, 1,500 Gaussians": Axis(_PIXELS, "static splats, 176x132 to 1920x1080"),
    "pixels, 10,000 Gaussians": Axis(_PIXELS, "static splats, 176x132 to 1920x1080"),
    "frames": Axis((30, 300, 2_000), "static splats, 10,000 Gaussians, 176x132"),
    "bases": Axis((2, 8, 32), "`splats-tracked-small`, 5,000 Gaussians, 176x132"),
    "knots": Axis((10, 40, 160), "`splats-tracked-small`, 5,000 Gaussians, 176x132"),
    "rays": Axis((128, 512, 2_048), "`nerf-small`", splats=False),
}


class Fit(NamedTuple):
    """Exponent of a power law fitted to measurements."""

    exponent: float
    error: float  # standard error, NaN for two sizes
    steepest: float  # largest exponent between two neighboring sizes


def fit(points: Mapping[str, Mapping[str, Any]], name: str) -> Fit:
    """Fit the exponent of a measurement, by least squares over logarithms.

    Args:
      points: Measurements by size.
      name: Name of the measurement.

    Returns:
      The fit. Its numbers are NaN for fewer than two sizes, or measurements that are
      not positive.
    """
    pairs = sorted(
        (int(size), point.get(name, math.nan)) for size, point in points.items()
    )
    x, y = (np.array(column, float) for column in zip(*pairs, strict=True))
    if len(x) < 2 or not np.all(y > 0):
        return Fit(math.nan, math.nan, math.nan)
    x, y = np.log(x), np.log(y)
    centered_x = x - x.mean()
    exponent = float(centered_x @ y / (centered_x @ centered_x))
    residual = y - y.mean() - exponent * centered_x
    error = math.nan
    if len(x) > 2:
        error = float(
            np.sqrt(residual @ residual / (len(x) - 2) / (centered_x @ centered_x))
        )
    return Fit(exponent, error, float(np.max(np.diff(y) / np.diff(x))))
