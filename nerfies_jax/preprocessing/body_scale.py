"""Scale of a rigid object in a video, from the smoothness of its motion.

Images determine the distances of a rigid object from the cameras up to one factor for
the whole video. With a wrong factor, its path contains a share of the camera motion. If
the camera moves less smoothly than the object, this determines the factor.

Minimizing the acceleration itself is biased: an object in the camera has none but that
of the camera, so the factor is too small, and even zero if the object accelerates more
than the camera. The acceleration relative to the factor is the likelihood of the
observed directions instead. It is quadratic in the inverse factor, and its minimum is
unbiased if the accelerations of object and camera are uncorrelated.

In a short video they often are correlated by chance, along one axis: an oscillating
door and a camera that sweeps a little faster. Many objects hardly accelerate along
another axis, because they swing in a plane or slide on a line, and a wrong factor adds
the acceleration of the camera there as well. The likelihood under an unknown covariance
of the accelerations makes use of it.
"""

from typing import NamedTuple

import numpy as np

from nerfies_jax.preprocessing.paths import second_differences

# Accelerations of the camera below this share of its distance per squared frame are
# rounding errors.
LEAST_ACCELERATION = 1e-6
# Steps in frames between the three positions of an acceleration. Single frames are
# mostly noise, and long steps show the motion itself.
HOPS = (1, 2, 4, 6)
FRAMES_EACH = 6  # of one independent acceleration
# Parameters that the accelerations determine: the factor, and the covariance of each
# axis with all three.
DETERMINED = 4
FACTORS, MOST_LOG = 401, 0.3  # tested factors, and the logarithm of the largest one
NOISE = 1e-5  # of the distance, standard deviation of accelerations by rounding


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

    camera_accel = acceleration(camera)
    strength = float((camera_accel**2).sum())
    distance = float(np.median(np.linalg.norm(center - camera, axis=-1)))
    if not strength > count * (LEAST_ACCELERATION * distance) ** 2:
        return Scale(1.0, np.inf)
    offset = acceleration(center - camera)
    # The acceleration relative to the factor is `inverse * camera_accel + offset`.
    inverse = -float((camera_accel * offset).sum()) / strength
    if not inverse > 0:
        return Scale(1.0, np.inf)
    residual = inverse * camera_accel + offset
    variance = float((residual**2).sum()) / (3 * count - 1) / strength
    deviation = np.sqrt(variance * _inflation(camera_accel, residual)) / inverse
    return Scale(1 / inverse, float(deviation))


def most_likely(
    time: np.ndarray,
    camera: np.ndarray,
    center: np.ndarray,
    deviation: float,
    least_nats: float = 0.0,
) -> float:
    """Find the factor under which the accelerations of an object are most likely.

    They have an unknown covariance between axes, so their negative log likelihood is
    the logarithm of its determinant (the concentrated likelihood of a multivariate
    regression, as in Anderson 1951). Rigid objects of the built-in scenes are 0 to 1.2
    % from their true distance with this factor, and 0 to 4 % without.

    Args:
      time: Times in increasing order, [frames].
      camera: Positions of the cameras in scene units, [frames, 3].
      center: Positions of the center of the object, [frames, 3].
      deviation: Relative standard deviation of the distances without the factor.
      least_nats: Logarithm of the likelihood ratio from which a factor is applied.

    Returns:
      The factor to apply to the distances from the cameras, 1 if no other one is more
      likely by `least_nats`, and for few frames or cameras that move uniformly.
    """
    independent = len(time) / FRAMES_EACH - DETERMINED
    hops = [hop for hop in HOPS if len(time) > 2 * hop]
    if independent <= 0 or not hops or not deviation > 0:
        return 1.0
    log = np.linspace(-MOST_LOG, MOST_LOG, FACTORS)
    offset = center - camera
    noise = NOISE * np.median(np.linalg.norm(offset, axis=-1))
    spread = np.zeros(FACTORS)
    for hop in hops:
        camera_accel, offset_accel = (
            _accelerations(time, place, hop) for place in (camera, offset)
        )
        residual = camera_accel + np.exp(log)[:, None, None] * offset_accel
        # Relative to the factor, so that a small one is not more likely by itself.
        residual *= np.exp(-log)[:, None, None]
        covariance = np.einsum("nti,ntj->nij", residual, residual) / len(camera_accel)
        covariance += noise**2 * np.eye(3)
        spread += np.linalg.slogdet(covariance)[1] / len(hops)
    cost = 0.5 * independent * spread + 0.5 * (log / deviation) ** 2
    best, paths_own = np.argmin(cost), len(log) // 2
    if cost[paths_own] - cost[best] < least_nats:
        return 1.0
    return float(np.exp(log[best]))


def _accelerations(time, place, hop):
    """Return second differences of every `hop`-th frame, [accelerations, 3]."""
    parts = []
    for first in range(hop):
        stencils = second_differences(time[first::hop])
        some, count = place[first::hop], len(stencils)
        parts.append(sum(stencils[:, k, None] * some[k : k + count] for k in range(3)))
    return np.concatenate(parts)


def _inflation(accel, residual):
    """Return the factor of a variance due to correlations over time (Bartlett 1935)."""
    total = 1.0
    for lag in range(1, len(accel) // 2 + 1):
        product = 1.0
        for series in (accel, residual):
            power = float((series**2).sum())
            autocovariance = float((series[lag:] * series[:-lag]).sum())
            product *= autocovariance / power if power > 0 else 0.0
        total += 2 * product
    return max(total, 1.0)
