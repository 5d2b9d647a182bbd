"""The terms of neural scene flow fields, each a function of arrays alone.

Li et al. 2021, arXiv:2011.13084, as settled by the public code. Rays without a
neighboring moment are counted out by `present`; a mean over nothing is zero.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.geometry.precision import near_one
from nerfies_jax.radiance import compositing

Scalar = Float[Array, ""]
# Mean deviation of the depths of a batch, as a share of their median, below which they
# count as flat: bounds the normalized depth by a thousand and its slope.
FLATTEST = 1e-3
# Weights below count as none: the slope of a mean in a weight is up to the values over
# the largest weight, and float32 holds 3e38.
FAINTEST = 1e-30


def fading(decay_steps: int, step: Int[Array, ""]) -> Scalar:
    """A tenth every `decay_steps`: how much the capture's depth and flow still count.

    They are guesses of other networks in NSFF, good for a start.
    """
    passed = (step // decay_steps).astype(jnp.result_type(float))
    return jnp.exp(-math.log(10) * passed)


def weighted_mean(
    values: Float[Array, "*axes channels"], weight: Float[Array, "*axes"]
) -> Scalar:
    """Mean over channels and over the other axes by `weight`.

    0, without a slope, where no weight reaches `FAINTEST`.
    """
    # Selected, not `total + eps`, which fades all weights that are small together. And
    # of weights near one: a quotient's slope has the divisor's square, which is 0
    # in float32 where all weights are below 1e-19, and the slope then 0 · inf.
    none = jnp.max(weight) <= FAINTEST
    scaled, _ = near_one(jnp.where(none, 1, weight))
    share = jnp.where(none, 0, scaled)
    total = jnp.where(none, 1, jnp.sum(share))
    return jnp.sum(share * jnp.mean(values, axis=-1)) / total


def mean_where(
    values: Float[Array, "rays channels"], present: Bool[Array, " rays"]
) -> Scalar:
    """Mean over the rays that are `present`."""
    return weighted_mean(values, present.astype(values.dtype))


def warped(
    color: Float[Array, "rays 3"],
    target: Float[Array, "rays 3"],
    weight: Float[Array, "rays samples"],
    visible: Float[Array, "rays samples"],
    mask: Float[Array, " rays"],
) -> Scalar:
    """Squared error of a neighbor's colors brought here, where it shows the same.

    Rays count by their composited `visible`, 1 - disocclusion. The weights of
    compositing are held fixed there: density is to explain color, not to make rays
    count less.
    """
    seen = jnp.sum(jax.lax.stop_gradient(weight) * visible, axis=-1)
    return weighted_mean(jnp.square(color - target), mask * seen)


def cycle(
    flow: Float[Array, "rays samples 3"],
    back: Float[Array, "rays samples 3"],
    visible: Float[Array, "rays samples"],
    present: Bool[Array, " rays"],
) -> Scalar:
    """Mean of |f + b|: there and back again, per axis."""
    return weighted_mean(jnp.abs(flow + back), jnp.where(present[:, None], visible, 0))


def magnitude(
    flow: Float[Array, "rays samples 3"],
    weight: Float[Array, "rays samples"],
    present: Bool[Array, " rays"],
) -> Scalar:
    """Mean of |Σ w f| per axis: what is seen should stand still if it can.

    The public code sums over x, y and z where the samples are meant. `weight` is held
    fixed: what moves shall not become transparent for it.
    """
    fixed = jax.lax.stop_gradient(weight)[..., None]
    return mean_where(jnp.abs(jnp.sum(fixed * flow, axis=-2)), present)


def smoothness(
    flow: Float[Array, "rays samples 3"], present: Bool[Array, " rays"]
) -> Scalar:
    """Mean |f(next sample on the ray) - f|, per axis.

    Over whole rays: the code leaves out the last 5 %, where its coordinates blow up.
    """
    change = jnp.mean(jnp.abs(jnp.diff(flow, axis=-2)), axis=-1)
    return mean_where(change, present)


def kinetic(
    forward: Float[Array, "rays samples 3"],
    backward: Float[Array, "rays samples 3"],
    present: Bool[Array, " rays"],
) -> Scalar:
    """Half the mean squared acceleration, forward + backward flow, per axis.

    Of rays with both neighbors.
    """
    return 0.5 * mean_where(jnp.mean(jnp.square(forward + backward), axis=-1), present)


def entropy(share_logit: Float[Array, "rays samples"]) -> Scalar:
    """Mean of -v log v of the blending weight: static or not, rather than half."""
    # log_sigmoid: log(v + 1e-8) has no slope left where v is small.
    share = jax.nn.sigmoid(share_logit)
    return -jnp.mean(share * jax.nn.log_sigmoid(share_logit))


def dynamic_weights(
    spacing: Float[Array, "rays samples"], density: Float[Array, "rays samples"]
) -> Float[Array, "rays samples"]:
    """Of the medium alone, unblended, at samples that stand for so much of a ray."""
    return jax.vmap(compositing.weights)(density * spacing)


def settle(
    weight: Float[Array, "rays samples"], values: Float[Array, "rays samples axes"]
) -> Float[Array, "rays axes"]:
    """Expected value along a ray; light that no sample stops ends at the last one."""
    passed = 1 - jnp.sum(weight, axis=-1, keepdims=True)
    return jnp.sum(weight[..., None] * values, axis=-2) + passed * values[..., -1, :]


def normalized_depth(
    predicted: Float[Array, " rays"],
    target: Float[Array, " rays"],
    known: Bool[Array, " rays"],
) -> Scalar:
    """Squared difference of depths, each less its median and over its mean deviation.

    Blind to scale and offset, as the depth of a single picture is (Ranftl et al. 2020,
    arXiv:1907.01341, equation 5). Zero with fewer than two known depths.
    """
    enough = jnp.sum(known) > 1
    known = known & enough
    difference = _normalize(predicted, known) - _normalize(target, known)
    return mean_where(jnp.square(difference)[:, None], known)


def _normalize(depth, known):
    """Zero where unknown. The slopes of median and deviation are kept."""
    count = jnp.sum(known)
    ordered = jnp.sort(jnp.where(known, depth, jnp.inf))
    median = ordered[jnp.maximum((count - 1) // 2, 0)]
    offset = jnp.where(known, depth - jnp.where(count > 0, median, 0), 0)
    spread = mean_where(jnp.abs(offset)[:, None], known)
    least = FLATTEST * jnp.abs(jax.lax.stop_gradient(jnp.where(count > 0, median, 1)))
    return offset / jnp.maximum(spread, jnp.where(least > 0, least, 1))
