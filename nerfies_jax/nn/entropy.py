"""Entropy coding of parameters: bit rate under a normal distribution, and noise.

Parameters are stored rounded to multiples of a step. During training, uniform noise of
the width of the step replaces rounding (Balle et al. 2017, "End-to-end optimized image
compression", arXiv:1611.01704, section 3). The number of bits is that of an ideal
entropy coder that knows the distribution. The distribution is normal as in Balle et al.
2018, arXiv:1802.01436 (equations 7 and 11), but with a mean and a step, which are zero
and one there. In the 2017 paper it is piecewise linear.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

# Means, scales and steps broadcast, for example one per channel.
Numbers = Float[Array, "*#batch"]
# Logarithms of standard deviations and steps are clamped to this range.
LOG_RANGE = (-12.0, 8.0)
# Distance from the mean in standard deviations from which on the number of bits (2600
# there) is extrapolated linearly.
FARTHEST = 60.0
# Below this step in standard deviations the density is expanded to second order.
FLAT = 0.002


def noisy(key: Key[Array, ""], values: Numbers, step: Numbers) -> Numbers:
    """Add uniform noise of the width of one step, in place of rounding.

    Args:
      key: PRNG key.
      values: Values, [...].
      step: Quantization steps, positive, [...].

    Returns:
      Noisy values, [...].

    References:
      Balle et al. 2018, arXiv:1802.01436, equation 4.
    """
    noise = jax.random.uniform(key, values.shape, jnp.float32, -0.5, 0.5)
    return values + noise.astype(values.dtype) * step


def quantize(values: Numbers, mean: Numbers, step: Numbers) -> Numbers:
    """Round values to whole steps from the mean of their distribution.

    Args:
      values: Values, [...].
      mean: Means of their distributions, [...].
      step: Quantization steps, positive, [...].

    Returns:
      Rounded values, [...].
    """
    return mean + step * jnp.round((values - mean) / step)


def bits(values: Numbers, mean: Numbers, log_scale: Numbers, step: Numbers) -> Numbers:
    """Compute -log2 of the normal probability of half a step around each value.

    Both ends of the interval are evaluated as log probabilities in the tail of the
    distribution. The plain difference of probabilities is 0 in float32 from 5.5
    standard deviations on, which means infinitely many bits.

    Args:
      values: Values, [...].
      mean: Means of their distributions, [...].
      log_scale: Natural logarithms of their standard deviations, [...].
      step: Quantization steps, positive, [...].

    Returns:
      Bits per value, [...].

    References:
      Balle et al. 2018, arXiv:1802.01436, equation 11, which prints the probability.
    """
    scale = jnp.exp(jnp.clip(log_scale, *LOG_RANGE))
    # x sign(x) has gradient zero at zero, unlike |x|.
    distance = (values - mean) / scale
    distance, width = distance * jnp.sign(distance), step / scale
    # In float32 the log probabilities of the two ends of a narrow interval are equal.
    narrow = width < FLAT
    wide_width = jnp.where(narrow, 1.0, width)
    # Farther away the square of the distance has no digits left for a gradient.
    beyond = jnp.maximum(distance - wide_width / 2 - FARTHEST, 0)
    distance = distance - beyond
    near = jax.scipy.special.log_ndtr(wide_width / 2 - distance)
    far = jax.scipy.special.log_ndtr(-wide_width / 2 - distance)
    wide_log_mass = near + jnp.log(-jnp.expm1(far - near))
    log_density = -distance * distance / 2 - math.log(2 * math.pi) / 2
    narrow_width = jnp.where(narrow, width, 1.0)
    curvature = (distance * distance - 1) * narrow_width * narrow_width / 24
    narrow_log_mass = jnp.log(narrow_width) + log_density + curvature
    log_mass = jnp.where(narrow, narrow_log_mass, wide_log_mass)
    return (FARTHEST * beyond - log_mass) / math.log(2)
