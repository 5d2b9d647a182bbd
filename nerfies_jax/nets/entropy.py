"""What learned numbers cost to keep: bits under a normal law, noise for rounding.

Balle et al. 2017, "End-to-end optimized image compression", arXiv:1611.01704, section
3: what is kept is rounded to a step, and while it is trained noise as wide as the step
stands in for that. The bits are those of an ideal coder that knows the law, which is
normal as in Balle et al. 2018, arXiv:1802.01436 (equations 7 and 11), but with a mean
and a step, which are zero and one there; in 2017 it is piecewise linear.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

# Laws and steps may be those of channels, for many values each.
Numbers = Float[Array, "*#batch"]
# Of standard deviations and steps, as logarithms: what lies outside counts as the end.
LOG_RANGE = (-12.0, 8.0)
FARTHEST = 60.0  # standard deviations (2600 bits): from there on bits are a line
FLAT = 0.002  # standard deviations: a law is a parabola over a step below it


def noisy(key: Key[Array, ""], values: Numbers, step: Numbers) -> Numbers:
    """Values as far off as rounding could take them: even noise, one step wide.

    Equation 4 of Balle et al. 2018.
    """
    noise = jax.random.uniform(key, values.shape, jnp.float32, -0.5, 0.5)
    return values + noise.astype(values.dtype) * step


def rounded(values: Numbers, mean: Numbers, step: Numbers) -> Numbers:
    """Values as they are kept: whole steps from the mean of their law."""
    return mean + step * jnp.round((values - mean) / step)


def bits(values: Numbers, mean: Numbers, log_scale: Numbers, step: Numbers) -> Numbers:
    """-log2 of the share of a normal law that lies within half a step of each value.

    Equation 11 of Balle et al. 2018, which prints the share. Both ends are taken on the
    side of the law where shares are small, as logarithms: as a difference of shares
    float32 has 0, and so infinitely many bits, from 5.5 standard deviations on. `step`
    is positive.
    """
    scale = jnp.exp(jnp.clip(log_scale, *LOG_RANGE))
    # By the size of the distance, whose slope at zero is zero as the answer's is.
    away = (values - mean) / scale
    away, wide = away * jnp.sign(away), step / scale
    # Between two ends that all but meet float32 sees nothing: there the law is a curve.
    flat = wide < FLAT
    held = jnp.where(flat, 1.0, wide)
    # Farther away the square of the distance has no digits left for a slope.
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
