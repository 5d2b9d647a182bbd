"""Entropy coding of learned numbers: rate under a normal distribution, and noise.

Parameters are stored rounded to a step. During training uniform noise as wide as the
step stands in for rounding (Balle et al. 2017, "End-to-end optimized image
compression", arXiv:1611.01704, section 3). Bits are those of an ideal coder that knows
the distribution. It is normal as in Balle et al. 2018, arXiv:1802.01436 (equations 7
and 11), but with a mean and a step, which are zero and one there. In 2017 it is
piecewise linear.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

# Laws and steps may be those of channels, for many values each.
Numbers = Float[Array, "*#batch"]
# Logarithms of standard deviations and steps are clamped to this range.
LOG_RANGE = (-12.0, 8.0)
FARTHEST = 60.0  # standard deviations (2600 bits): from there on bits are a line
FLAT = 0.002  # standard deviations: a law is a parabola over a step below it


def noisy(key: Key[Array, ""], values: Numbers, step: Numbers) -> Numbers:
    """Add uniform noise one step wide, which stands in for rounding.

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


def rounded(values: Numbers, mean: Numbers, step: Numbers) -> Numbers:
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

    Both ends are taken on the side of the distribution where probabilities are small,
    as logarithms. As a difference of probabilities, float32 gives 0 and so infinitely
    many bits from 5.5 standard deviations on.

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
    # By the size of the distance, whose gradient at zero is zero as the answer's is.
    away = (values - mean) / scale
    away, wide = away * jnp.sign(away), step / scale
    # Between two ends that all but meet float32 sees nothing: there the law is a curve.
    flat = wide < FLAT
    held = jnp.where(flat, 1.0, wide)
    # Farther away the square of the distance has no digits left for a gradient.
    beyond = jnp.maximum(away - held / 2 - FARTHEST, 0)
    away = away - beyond
    near = jax.scipy.special.log_ndtr(held / 2 - away)
    far = jax.scipy.special.log_ndtr(-held / 2 - away)
    between = near + jnp.log(-jnp.expm1(far - near))
    density = -away * away / 2 - math.log(2 * math.pi) / 2
    low = jnp.where(flat, wide, 1.0)
    bend = (away * away - 1) * low * low / 24  # what the middle tells of the mean
    level = jnp.log(low) + density + bend
    return (FARTHEST * beyond - jnp.where(flat, level, between)) / math.log(2)
