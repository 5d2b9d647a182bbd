"""Values of Gaussians for files that store them after their activations."""

from typing import NamedTuple

import numpy as np

from gaussians_jax.core.splats import LOG_SCALE_RANGE, Splats


class Activated(NamedTuple):
    """Gaussians after their activations, in float64.

    Attributes:
      mean: Means [gaussians, 3].
      quaternion: Unit quaternions, wxyz [gaussians, 4].
      scale: Standard deviations along the axes [gaussians, 3].
      opacity: Opacities in [0, 1], [gaussians].
      harmonics: Coefficients of all degrees [gaussians, coefficients, 3].
    """

    mean: np.ndarray
    quaternion: np.ndarray
    scale: np.ndarray
    opacity: np.ndarray
    harmonics: np.ndarray


def activate(rows: Splats) -> Activated:
    """Compute the values that a renderer uses.

    Args:
      rows: Raw parameters of active Gaussians, finite, in NumPy.

    Returns:
      The activated Gaussians.
    """
    return Activated(
        np.asarray(rows.mean, np.float64),
        unit_quaternion(np.asarray(rows.quaternion)),
        np.exp(np.clip(np.asarray(rows.log_scale, np.float64), *LOG_SCALE_RANGE)),
        opacity_of(rows),
        np.concatenate([rows.sh_dc, rows.sh_rest], axis=1).astype(np.float64),
    )


def opacity_of(rows: Splats) -> np.ndarray:
    """Compute opacities, without overflow for logits of any size.

    Args:
      rows: Raw parameters in NumPy.

    Returns:
      Opacities in [0, 1], float64 [gaussians].
    """
    logit = np.asarray(rows.opacity_logit, np.float64)
    return 1 / (1 + np.exp(-np.clip(logit, -700, 700)))


def unit_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Normalize quaternions.

    Args:
      quaternion: Quaternions wxyz of any length, [gaussians, 4]. Zero is the identity.

    Returns:
      Unit quaternions, float64 [gaussians, 4].
    """
    quaternion = np.asarray(quaternion, np.float64)
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    unit = np.divide(
        quaternion, length, where=length > 0, out=np.zeros_like(quaternion)
    )
    return np.where(length > 0, unit, [1.0, 0.0, 0.0, 0.0])
