"""Volume rendering along one ray.

Everything is for one ray, from its origin outward, and callers `jax.vmap`. The *optical
depth* of a sample is its density times the length of its interval. Light is transmitted
through a depth d with probability exp(-d). Densities must be finite and non-negative,
and distances sorted. Sums over a ray are made in float32 or float64. In bfloat16 the
weights of a ray of 128 samples would be off by 1e-2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nerfies_jax.geometry.precision import at_least_float32

# The length of the last interval where the last sample stands for all behind it: any
# density of a trained field is opaque over it, and its square is finite in float32.
AT_INFINITY = 1e10
# Opacity below which a ray counts as going on to its far end: a quarter of a level of
# an 8-bit image. Bounds the gradient of the expected distance by 1e3 of the ray's span.
EMPTY_BELOW = 1e-3
# Opacity up to which `thinned` takes log1p, and above it a sum of logarithms. Not 1/2:
# from 0.3 to 0.42 XLA's log1p of float64 is off by up to 120 eps on the CPU, and by
# less than one eps below.
THIN_BELOW = 0.25


class Composite(NamedTuple):
    """Color, opacity and distances of one ray."""

    color: Float[Array, "3"]
    alpha: Float[Array, ""]  # share of the light that stops; may round to 1 + 1e-6
    distance: Float[Array, ""]  # expected, of what stops it
    median_distance: Float[Array, ""]  # by which half the light has stopped


def intervals(
    distances: Float[Array, " samples"], last: float | Float[Array, ""]
) -> Float[Array, " samples"]:
    """Return the lengths of the intervals of samples, from each to the next one.

    Args:
      distances: Sorted distances along a unit direction, [samples].
      last: Length of the last interval: `AT_INFINITY`, or the rest of the ray.

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
      Share of the light that stops at each sample, [samples]. They sum to at most one
      (up to 1e-6).

    References:
      Mildenhall et al. 2020, arXiv:2003.08934, equation 3.
    """
    # 1 - exp(-x) would round to 0 in thin air. (JAX's slope of expm1 is exp(-x) to 6e-8
    # of one; with all its digits behind walls the gradient takes 1.8 times as long.)
    return _transmittance(optical_depth) * -jnp.expm1(-optical_depth)


@at_least_float32
def media_weights(
    optical_depth: Float[Array, "media samples"],
) -> Float[Array, "media samples"]:
    """Compute the weights of samples of several media on one ray.

    Light reaches a sample through all the media before it, and at the sample each
    medium counts as if it were alone, as for the transient objects of NeRF-W and, after
    `thinned`, the blending of NSFF. Where media overlap in one sample, their weights
    sum to more than `weights` of their joint depth, at most by the number of media.
    Opacity and distances are therefore computed from the joint depth
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
def thinned(
    optical_depth: Float[Array, "*samples"], share_logit: Float[Array, "*samples"]
) -> Float[Array, "*samples"]:
    """Scale the opacity of samples: -log(1 - v (1 - exp(-d))) for v = sigmoid(l).

    NSFF multiplies opacities by its blending weight v. As an optical depth it can share
    the transmittance of other media.

    Args:
      optical_depth: Optical depth d, non-negative, [...].
      share_logit: Logit l of the factor v, [...].

    Returns:
      Optical depths, [...].
    """
    share = jax.nn.sigmoid(share_logit)
    # log1p keeps all digits of thin air but has 1 - v exp(..) → 0 for v → 1; the sum
    # (1 - v) + v exp(-d) of the same terms in logarithms is right there and loses small
    # depths to cancellation.
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
        with an interval of `AT_INFINITY`. Its color then counts, but `alpha`,
        `distance` and `median_distance` leave it out, as `alpha` does in the Nerfies
        code. (That code also adds white behind such a sample, where none can be
        visible.)

    Returns:
      The composited ray.
    """
    # Sums of products: a matrix product may be rounded to ten bits on a GPU.
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

    Rays with an opacity below `EMPTY_BELOW` get the rest of it at `far`, so that value
    and gradient stay bounded down to weights of zero.

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
    """Find the first sample by which half of the light has stopped.

    Args:
      weights: Weights of the samples, [samples].

    Returns:
      Index of the sample, the last one if less than half of the light stops.
    """
    passed = _running_sum(weights) >= 0.5
    return jnp.where(jnp.any(passed), jnp.argmax(passed), weights.shape[0] - 1)


def _composite(color, weights, distances, background):
    if background is None:
        finite = weights[:-1]
        alpha = jnp.sum(finite)
    else:
        finite = weights
        alpha = jnp.sum(finite)
        color = color + (1 - alpha) * background
    distance = expected_distance(finite, distances[: finite.shape[0]], distances[-1])
    # The median may read the sample at infinity: it falls back to it anyway.
    median = distances[median_index(weights)]
    return Composite(color, alpha, distance, median)


_running_sum = at_least_float32(jnp.cumsum)


def _transmittance(optical_depth):
    # Summed without the sample itself, not subtracted afterwards: in float32 an opaque
    # sample would swallow the depth in front of it and the weights would sum to 1.6.
    before = jnp.cumsum(optical_depth[:-1])
    return jnp.exp(-jnp.concatenate([jnp.zeros_like(optical_depth[:1]), before]))
