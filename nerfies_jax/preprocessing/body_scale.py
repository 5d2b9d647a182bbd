"""Scale of a rigid object in a video, from the smoothness of its motion.

Images determine the distances of a rigid object from the cameras up to one factor for
the whole video. With a wrong factor, its path contains a share of the camera motion. If
the camera moves less smoothly than the object, this determines the factor.

Minimizing the acceleration itself is biased: an object in the camera has none but that
of the camera, so the factor is too small, and even zero if the object accelerates more
than the camera. The acceleration relative to the factor is the likelihood of the
observed directions instead. It is quadratic in the inverse factor, and its minimum is
unbiased if the accelerations of object and camera are uncorrelated.
"""

from typing import NamedTuple

import numpy as np

from nerfies_jax.preprocessing.paths import second_differences

# Accelerations of the camera below this share of its distance per squared frame are
# rounding errors.
LEAST_ACCELERATION = 1e-6


class Scale(NamedTuple):
    """Factor of the distances of an object from the cameras."""

    factor: float  # to apply to the distances, 1 if it is undetermined
    deviation: float  # relative standard deviation, infinite if it is undetermined


def from_smoothness(time: np.ndarray, camera: np.ndarray, center: np.ndarray) -> Scale:
    """Estimate the factor with which the motion of an object is smoothest.

    The sum over all points of an object has the same minimum as its center, since
    offsets of points from the center do not depend on the camera.

    Args:
      time: Times in increasing order, [frames].
      camera: Positions of the cameras in scene units, [frames, 3].
      center: Positions of the center of the object up to the factor, [frames, 3].

    Returns:
      The factor. It is undetermined with fewer than three frames, if the camera moves
      uniformly, or if the directions contradict every positive factor. Its deviation is
      large if the object moves like the camera.
    """
    stencils = second_differences(time).astype(center.dtype)
    count = len(stencils)

    def acceleration(place):
        return sum(stencils[:, k, None] * place[k : k + count] for k in range(3))

    known = acceleration(camera)
    strength = float((known**2).sum())
    distance = float(np.median(np.linalg.norm(center - camera, axis=-1)))
    if not strength > count * (LEAST_ACCELERATION * distance) ** 2:
        return Scale(1.0, np.inf)
    offset = acceleration(center - camera)
    # The acceleration relative to the factor is `inverse * known + offset`.
    inverse = -float((known * offset).sum()) / strength
    if not inverse > 0:
        return Scale(1.0, np.inf)
    rest = inverse * known + offset
    variance = float((rest**2).sum()) / (3 * count - 1) / strength
    deviation = np.sqrt(variance * _inflation(known, rest)) / inverse
    return Scale(1 / inverse, float(deviation))


def _inflation(known, rest):
    """Return the factor of a variance due to correlations over time (Bartlett 1935)."""
    total = 1.0
    for lag in range(1, len(known) // 2 + 1):
        product = 1.0
        for series in (known, rest):
            power = float((series**2).sum())
            shifted = float((series[lag:] * series[:-lag]).sum())
            product *= shifted / power if power > 0 else 0.0
        total += 2 * product
    return max(total, 1.0)
