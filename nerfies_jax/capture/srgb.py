"""The transfer function of sRGB (IEC 61966-2-1)."""

import numpy as np
from numpy.typing import ArrayLike


def srgb_from_linear(light: np.ndarray) -> np.ndarray:
    """Convert linear light to sRGB values (IEC 61966-2-1).

    Args:
      light: Linear light, clipped to [0, 1].

    Returns:
      sRGB values in [0, 1].
    """
    light = np.clip(light, 0, 1)
    power = 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, power)


def linear_from_srgb(value: ArrayLike | float) -> np.ndarray:
    """Convert sRGB values to linear light.

    Args:
      value: sRGB values in [0, 1]. The formulas extend to values outside.

    Returns:
      Linear light.
    """
    value = np.asarray(value)
    power = ((np.maximum(value, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(value <= 0.04045, value / 12.92, power)
