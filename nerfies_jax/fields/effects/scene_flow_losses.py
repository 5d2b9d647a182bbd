"""Loss terms of neural scene flow fields, as functions of arrays.

Li et al. 2021, arXiv:2011.13084, with details from the public code. Rays without a
neighboring timestamp are excluded by `present`. A mean over no rays is zero.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.fields import compositing
from nerfies_jax.geometry.precision import near_one

Scalar = Float[Array, ""]
# Minimum of the mean deviation of the depths of a batch as a fraction of their median.
# It bounds normalized depths by a thousand, and their gradients.
FLATTEST = 1e-3
# Weights up to this value count as zero. The gradient of a mean by a weight is up to
# the values over the largest weight, which must not overflow float32.
FAINTEST = 1e-30


def fading(decay_steps: int, step: Int[Array, ""]) -> Scalar:
    """Compute the decay of the weights of depth and flow by factors of ten.

    In NSFF, depth and flow are predictions of other networks, which serve only as
    initialization.

    Args:
      decay_steps: Number of steps for a factor of ten.
      step: Number of completed steps.

    Returns:
      A factor in (0, 1].
    """
    periods = (step // decay_steps).astype(jnp.result_type(float))
    return jnp.exp(-math.log(10) * periods)


def weighted_mean(
    values: Float[Array, "*axes channels"], weight: Float[Array, "*axes"]
) -> Scalar:
    """Compute the mean over channels, and over the other axes by weight.

    Args:
      values: Values, [..., channels].
      weight: Non-negative weights, [...].

    Returns:
      The mean, and 0 without gradient if no weight exceeds `FAINTEST`.
    """
    # Dividing by `total + eps` would reduce the mean if all weights are small. Weights
    # are scaled to about one, because the gradient of a quotient has the square of the
    # divisor. In float32 it is 0 if all weights are below 1e-19.
    is_zero = jnp.max(weight) <= FAINTEST
    scaled_weight, _ = near_one(jnp.where(is_zero, 1, weight))
    scaled_weight = jnp.where(is_zero, 0, scaled_weight)
    total = jnp.where(is_zero, 1, jnp.sum(scaled_weight))
    return jnp.sum(scaled_weight * jnp.mean(values, axis=-1)) / total


def mean_where(
    values: Float[Array, "rays channels"], present: Bool[Array, " rays"]
) -> Scalar:
    """Compute the mean over rays that are present.

    Args:
      values: Values, [rays, channels].
      present: True for rays to use, [rays].

    Returns:
      The mean, a scalar.
    """
    return weighted_mean(values, present.astype(values.dtype))


def warp_error(
    color: Float[Array, "rays 3"],
    target: Float[Array, "rays 3"],
    weight: Float[Array, "rays samples"],
    visible: Float[Array, "rays samples"],
    mask: Float[Array, " rays"],
) -> Scalar:
    """Compute the squared error of a neighbor's colors, warped to this timestamp.

    Rays are weighted by their composited `visible`, 1 - disocclusion. The rendering
    weights have no gradient in this weight, so that density explains color and does not
    reduce the weight of rays.

    Args:
      color: Rendered colors of the neighbor along the warped rays, [rays, 3].
      target: Observed colors, [rays, 3].
      weight: Rendering weights, [rays, samples].
      visible: Probability that the sample is visible at both timestamps, [rays,
        samples].
      mask: Weights of rays, [rays].

    Returns:
      The error, a scalar.
    """
    ray_visible = jnp.sum(jax.lax.stop_gradient(weight) * visible, axis=-1)
    return weighted_mean(jnp.square(color - target), mask * ray_visible)


def cycle(
    flow: Float[Array, "rays samples 3"],
    back: Float[Array, "rays samples 3"],
    visible: Float[Array, "rays samples"],
    present: Bool[Array, " rays"],
) -> Scalar:
    """Compute the mean of |f + b| per axis, the cycle consistency of flow.

    Args:
      flow: Flow f, [rays, samples, 3].
      back: Flow b back from where f leads, [rays, samples, 3].
      visible: Probability that the sample is visible at both timestamps, [rays,
        samples].
      present: True for rays with a neighbor, [rays].

    Returns:
      A scalar.
    """
    return weighted_mean(jnp.abs(flow + back), jnp.where(present[:, None], visible, 0))


def magnitude(
    flow: Float[Array, "rays samples 3"],
    weight: Float[Array, "rays samples"],
    present: Bool[Array, " rays"],
) -> Scalar:
    """Compute the mean of |Σ w f| per axis, which prefers a static scene.

    The public code sums over x, y and z instead of over samples. The rendering weights
    have no gradient, so that moving regions do not become transparent.

    Args:
      flow: Flow f, [rays, samples, 3].
      weight: Rendering weights w, [rays, samples].
      present: True for rays with a neighbor, [rays].

    Returns:
      A scalar.
    """
    frozen_weight = jax.lax.stop_gradient(weight)[..., None]
    return mean_where(jnp.abs(jnp.sum(frozen_weight * flow, axis=-2)), present)


def smoothness(
    flow: Float[Array, "rays samples 3"], present: Bool[Array, " rays"]
) -> Scalar:
    """Compute the mean difference of the flow of neighboring samples, per axis.

    It is computed along whole rays. The public code omits the last 5 %, where its
    coordinates diverge.

    Args:
      flow: Flow, [rays, samples, 3].
      present: True for rays with a neighbor, [rays].

    Returns:
      A scalar.
    """
    change = jnp.mean(jnp.abs(jnp.diff(flow, axis=-2)), axis=-1)
    return mean_where(change, present)


def kinetic(
    forward: Float[Array, "rays samples 3"],
    backward: Float[Array, "rays samples 3"],
    present: Bool[Array, " rays"],
) -> Scalar:
    """Compute half the mean squared acceleration, forward plus backward flow, per axis.

    Args:
      forward: Flow to the next timestamp, [rays, samples, 3].
      backward: Flow to the previous timestamp, [rays, samples, 3].
      present: True for rays with both neighbors, [rays].

    Returns:
      A scalar.
    """
    return 0.5 * mean_where(jnp.mean(jnp.square(forward + backward), axis=-1), present)


def entropy(share_logit: Float[Array, "rays samples"]) -> Scalar:
    """Compute the mean of -v log v of the blending weight, which favors 0 and 1.

    Args:
      share_logit: Logits of v, [rays, samples].

    Returns:
      A scalar.
    """
    # log(v + 1e-8) would have almost no gradient for small v.
    share = jax.nn.sigmoid(share_logit)
    return -jnp.mean(share * jax.nn.log_sigmoid(share_logit))


def dynamic_weights(
    spacing: Float[Array, "rays samples"], density: Float[Array, "rays samples"]
) -> Float[Array, "rays samples"]:
    """Compute the rendering weights of the medium alone, without blending.

    Args:
      spacing: Lengths of the samples' intervals, [rays, samples].
      density: Densities of the medium, [rays, samples].

    Returns:
      Weights, [rays, samples].
    """
    return jax.vmap(compositing.weights)(density * spacing)


def expected_value(
    weight: Float[Array, "rays samples"], values: Float[Array, "rays samples axes"]
) -> Float[Array, "rays axes"]:
    """Compute the expected value along a ray.

    Light that passes all samples gets the value of the last one.

    Args:
      weight: Rendering weights, [rays, samples].
      values: Values of the samples, [rays, samples, axes].

    Returns:
      Expected values, [rays, axes].
    """
    transmittance = 1 - jnp.sum(weight, axis=-1, keepdims=True)
    return (
        jnp.sum(weight[..., None] * values, axis=-2)
        + transmittance * values[..., -1, :]
    )


def normalized_depth(
    depth: Float[Array, " rays"],
    target: Float[Array, " rays"],
    valid: Bool[Array, " rays"],
) -> Scalar:
    """Compute the squared difference of depths normalized by median and deviation.

    It is invariant to scale and offset, like monocular depth.

    Args:
      depth: Rendered depths, [rays].
      target: Depths of the capture, [rays].
      valid: True where the depth is known, [rays].

    Returns:
      The error, zero with fewer than two known depths.

    References:
      Ranftl et al. 2020, arXiv:1907.01341, equation 5.
    """
    enough = jnp.sum(valid) > 1
    valid = valid & enough
    difference = _normalize(depth, valid) - _normalize(target, valid)
    return mean_where(jnp.square(difference)[:, None], valid)


def _normalize(depth, valid):
    """Normalize by median and mean deviation, with gradients. Unknown depths give 0."""
    count = jnp.sum(valid)
    sorted_depth = jnp.sort(jnp.where(valid, depth, jnp.inf))
    median = sorted_depth[jnp.maximum((count - 1) // 2, 0)]
    offset = jnp.where(valid, depth - jnp.where(count > 0, median, 0), 0)
    spread = mean_where(jnp.abs(offset)[:, None], valid)
    least = FLATTEST * jnp.abs(jax.lax.stop_gradient(jnp.where(count > 0, median, 1)))
    return offset / jnp.maximum(spread, jnp.where(least > 0, least, 1))
