"""What a ray sees of the samples on it.

Everything is for one ray, from its origin outwards; callers `jax.vmap`. The *optical
depth* of a sample is its density times the length it stands for. Light that meets a
depth d gets through with probability exp(-d). Preconditions: densities are finite and
not negative, distances are sorted. Sums over a ray are made in float32 at least: in
bfloat16 the weights of a ray of 128 samples would be off by 1e-2.
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
# an 8-bit picture. Bounds the slope of the expected distance by 1e3 of the ray's span.
EMPTY_BELOW = 1e-3
# Opacity up to which `thinned` takes log1p, and above it a sum of logarithms. Not 1/2:
# from 0.3 to 0.42 XLA's log1p of float64 is off by up to 120 eps on the CPU, and by
# less than one eps below.
THIN_BELOW = 0.25


class Composite(NamedTuple):
    """What one ray sees."""

    color: Float[Array, "3"]
    alpha: Float[Array, ""]  # share of the light that stops; may round to 1 + 1e-6
    distance: Float[Array, ""]  # expected, of what stops it
    median_distance: Float[Array, ""]  # by which half the light has stopped


def intervals(
    distances: Float[Array, " samples"], last: float | Float[Array, ""]
) -> Float[Array, " samples"]:
    """The length each sample stands for: from itself to the next one.

    `last` is the length of the last one: `AT_INFINITY`, or what is left of the ray.
    Distances are along unit directions.
    """
    last = jnp.broadcast_to(jnp.asarray(last, distances.dtype), (1,))
    return jnp.concatenate([jnp.diff(distances), last])


@at_least_float32
def weights(optical_depth: Float[Array, " samples"]) -> Float[Array, " samples"]:
    """How much of the light stops at each sample; sums to at most one (up to 1e-6).

    Equation 3 of Mildenhall et al. 2020, arXiv:2003.08934.
    """
    # 1 - exp(-x) would round to 0 in thin air. (JAX's slope of expm1 is exp(-x) to 6e-8
    # of one; with all its digits behind walls the gradient takes 1.8 times as long.)
    return _transmittance(optical_depth) * -jnp.expm1(-optical_depth)


@at_least_float32
def media_weights(
    optical_depth: Float[Array, "media samples"],
) -> Float[Array, "media samples"]:
    """How much each of several media on one ray adds to its color.

    Light reaches a sample through all the media before it, and at the sample each
    medium counts as if it were alone: the transient objects of NeRF-W (Martin-Brualla
    et al. 2021, arXiv:2008.02268) and, after `thinned`, the blending of NSFF (Li et al.
    2021, arXiv:2011.13084). Where two media overlap in one sample their weights sum to
    more than `weights` of their joint depth, up to as often as there are media; opacity
    and distances are therefore read from the joint depth (`composite_media`).
    """
    reaching = _transmittance(jnp.sum(optical_depth, axis=0))
    return reaching * -jnp.expm1(-optical_depth)


@at_least_float32
def thinned(
    optical_depth: Float[Array, "*samples"], share_logit: Float[Array, "*samples"]
) -> Float[Array, "*samples"]:
    """Optical depth whose opacity is sigmoid(`share_logit`) times that of another.

    -log(1 - v (1 - exp(-d))): NSFF multiplies opacities by its blending weight v, which
    as a depth can share the transmittance of other media.
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
    """Color, opacity and distances of a ray.

    A `background` shines through what the samples let pass. `None` says that the last
    sample is the background, its interval being `AT_INFINITY`: its color counts but
    `alpha`, `distance` and `median_distance` leave it out, as `alpha` does in the
    Nerfies code. (That code also adds white behind such a sample, where none can be
    seen.)
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
    """`composite` of several media by `media_weights`; `alpha` is of all together."""
    each = media_weights(optical_depth)
    color = jnp.sum(each[..., None] * colors, axis=(0, 1))
    joint = weights(jnp.sum(optical_depth, axis=0))
    return _composite(color, joint, distances, background)


def expected_distance(
    weights: Float[Array, " samples"],
    distances: Float[Array, " samples"],
    far: Float[Array, ""],
) -> Float[Array, ""]:
    """Mean of `distances` by `weights`; `far` where nothing is hit.

    Rays of less than `EMPTY_BELOW` opacity get the rest of it at `far`, so that value
    and slope stay bounded down to weights of zero.
    """
    alpha = jnp.sum(weights)
    missing = jnp.maximum(EMPTY_BELOW - alpha, 0)
    return (jnp.sum(weights * distances) + missing * far) / (alpha + missing)


def median_index(weights: Float[Array, " samples"]) -> Int[Array, ""]:
    """The first sample by which half the light has stopped; the last if none."""
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
