"""Volume rendering along one ray.

Functions take one ray, from its origin outward. Use `jax.vmap` for several. The
*optical depth* of a sample is its density times the length of its interval. Light is
transmitted through a depth d with probability exp(-d). Densities must be finite and
non-negative, and distances sorted. Sums over a ray are computed in float32 or float64.
In bfloat16 the weights of a ray of 128 samples would have errors of 1e-2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nerfies_jax.geometry.precision import at_least_float32

# Length of the last interval if the last sample represents everything behind it. Any
# density of a trained field is opaque over it, and its square is finite in float32.
AT_INFINITY = 1e10
# Opacity, a quarter of a level of an 8-bit image, below which the expected distance
# goes to the far end of the ray. Bounds its gradient by 1e3 times the length of the
# ray.
EMPTY_BELOW = 1e-3
# Opacity up to which `scale_opacity` uses log1p instead of a sum of logarithms. It is
# not 1/2, because from 0.3 to 0.42 XLA's log1p of float64 has errors of up to 120 eps
# on a CPU. Below they are less than one eps.
THIN_BELOW = 0.25


class Composite(NamedTuple):
    """Color, opacity and distances of one ray."""

    color: Float[Array, "3"]
    alpha: Float[Array, ""]  # opacity; may round to 1 + 1e-6
    distance: Float[Array, ""]  # expected distance at which light is absorbed
    median_distance: Float[Array, ""]  # distance at which half of the light is absorbed


def intervals(
    distances: Float[Array, " samples"], last: float | Float[Array, ""]
) -> Float[Array, " samples"]:
    """Return the lengths of the intervals of samples, from each to the next one.

    Args:
      distances: Sorted distances along a unit direction, [samples].
      last: Length of the last interval, `AT_INFINITY` or the remaining length.

    Returns:
      Lengths, [samples].
    """
    last = jnp.broadcast_to(jnp.asarray(last, distances.dtype), (1,))
    return jnp.concatenate([jnp.diff(distances), last])


@at_least_float32
def weights(optical_depth: Float[Array, " samples"]) -> Float[Array, " samples"]:
    """Compute the volume rendering weights of samples.

    Args:
      optical_depth: Density times interval length, non-negative, [samples].

    Returns:
      Fraction of the light that is absorbed at each sample, [samples]. The sum is at
      most one (up to 1e-6).

    References:
      Mildenhall et al. 2020, arXiv:2003.08934, equation 3.
    """
    # 1 - exp(-x) would round to 0 for small depths. (The gradient of expm1 in JAX has
    # an absolute error of 6e-8. Computing it with full relative precision would take
    # 1.8 times as long.)
    return _transmittance(optical_depth) * -jnp.expm1(-optical_depth)


@at_least_float32
def media_weights(
    optical_depth: Float[Array, "media samples"],
) -> Float[Array, "media samples"]:
    """Compute the weights of samples of several media on one ray.

    Light reaches a sample through all media in front of it. At the sample each medium
    is treated as if it were alone, as for the transient objects of NeRF-W and, after
    `scale_opacity`, the blending of NSFF. If media overlap in a sample, their weights
    sum to more than `weights` of their joint depth, at most by a factor of the number
    of media. Opacity and distances are therefore computed from the joint depth
    (`composite_media`).

    Args:
      optical_depth: Density times interval length, non-negative, [media, samples].

    Returns:
      Weights, [media, samples].

    References:
      Martin-Brualla et al. 2021 (NeRF-W), arXiv:2008.02268. Li et al. 2021 (NSFF),
      arXiv:2011.13084.
    """
    reaching = _transmittance(jnp.sum(optical_depth, axis=0))
    return reaching * -jnp.expm1(-optical_depth)


@at_least_float32
def scale_opacity(
    optical_depth: Float[Array, "*samples"], share_logit: Float[Array, "*samples"]
) -> Float[Array, "*samples"]:
    """Scale the opacity of samples: -log(1 - v (1 - exp(-d))) for v = sigmoid(l).

    NSFF multiplies opacities by its blending weight v. Expressed as an optical depth,
    this can be combined with the transmittance of other media.

    Args:
      optical_depth: Optical depth d, non-negative, [...].
      share_logit: Logit l of the factor v, [...].

    Returns:
      Optical depths, [...].
    """
    share = jax.nn.sigmoid(share_logit)
    # log1p is accurate for small depths, but its argument approaches -1 for v → 1. The
    # sum (1 - v) + v exp(-d) in logarithms is accurate there, and cancels for small
    # depths.
    thin = share * -jnp.expm1(-optical_depth) < THIN_BELOW
    safe = jnp.where(thin, optical_depth, 0)
    near_clear = -jnp.log1p(share * jnp.expm1(-safe))
    near_opaque = -jnp.logaddexp(
        jax.nn.log_sigmoid(-share_logit),
        jax.nn.log_sigmoid(share_logit) - optical_depth,
    )
    return jnp.where(thin, near_clear, near_opaque)


def composite(
    weights: Float[Array, " samples"],
    colors: Float[Array, "samples 3"],
    distances: Float[Array, " samples"],
    background: Float[Array, "3"] | None,
) -> Composite:
    """Composite color, opacity and distances of a ray.

    Args:
      weights: Weights of the samples, [samples].
      colors: Colors of the samples, [samples, 3].
      distances: Sorted distances of the samples, [samples].
      background: Color behind the ray, [3]. None if the last sample is the background,
        with an interval of `AT_INFINITY`. It then contributes to the color, but not to
        `alpha`, `distance` and `median_distance`, as in the `alpha` of the Nerfies
        code. (That code also adds white behind such a sample, which cannot be visible.)

    Returns:
      The composited ray.
    """
    # Sums of products, because a GPU may round matrix products to ten bits.
    color = jnp.sum(weights[:, None] * colors, axis=0)
    return _composite(color, weights, distances, background)


def composite_media(
    optical_depth: Float[Array, "media samples"],
    colors: Float[Array, "media samples 3"],
    distances: Float[Array, " samples"],
    background: Float[Array, "3"] | None,
) -> Composite:
    """Composite several media by `media_weights`.

    Args:
      optical_depth: Density times interval length, [media, samples].
      colors: Colors of the samples, [media, samples, 3].
      distances: Sorted distances of the samples, [samples].
      background: As for `composite`.

    Returns:
      The composited ray, whose opacity is that of all media together.
    """
    each = media_weights(optical_depth)
    color = jnp.sum(each[..., None] * colors, axis=(0, 1))
    joint = weights(jnp.sum(optical_depth, axis=0))
    return _composite(color, joint, distances, background)


def expected_distance(
    weights: Float[Array, " samples"],
    distances: Float[Array, " samples"],
    far: Float[Array, ""],
) -> Float[Array, ""]:
    """Compute the mean distance by weights.

    If the opacity of a ray is below `EMPTY_BELOW`, the difference is added at `far`, so
    that value and gradient are bounded also for weights of zero.

    Args:
      weights: Weights of the samples, [samples].
      distances: Distances of the samples, [samples].
      far: Distance of an empty ray.

    Returns:
      The distance, a scalar.
    """
    alpha = jnp.sum(weights)
    missing = jnp.maximum(EMPTY_BELOW - alpha, 0)
    return (jnp.sum(weights * distances) + missing * far) / (alpha + missing)


def median_index(weights: Float[Array, " samples"]) -> Int[Array, ""]:
    """Find the first sample by which half of the light is absorbed.

    Args:
      weights: Weights of the samples, [samples].

    Returns:
      Index of the sample, or of the last one if less than half is absorbed.
    """
    is_past_half = _running_sum(weights) >= 0.5
    return jnp.where(
        jnp.any(is_past_half), jnp.argmax(is_past_half), weights.shape[0] - 1
    )


def _composite(color, weights, distances, background):
    if background is None:
        finite = weights[:-1]
        alpha = jnp.sum(finite)
    else:
        finite = weights
        alpha = jnp.sum(finite)
        color = color + (1 - alpha) * background
    distance = expected_distance(finite, distances[: finite.shape[0]], distances[-1])
    # The median may include the sample at infinity, which is its fallback anyway.
    median = distances[median_index(weights)]
    return Composite(color, alpha, distance, median)


_running_sum = at_least_float32(jnp.cumsum)


def _transmittance(optical_depth):
    # The sum excludes the sample itself. Subtracting it from the inclusive sum would
    # lose the depth in front of an opaque sample in float32, and weights would sum to
    # 1.6.
    before = jnp.cumsum(optical_depth[:-1])
    return jnp.exp(-jnp.concatenate([jnp.zeros_like(optical_depth[:1]), before]))
