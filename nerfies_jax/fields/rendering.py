"""Volume rendering for any network: sample points along rays, and composite.

`sample_along_rays` and `composite` take any leading axes and are independent of the
network that is evaluated between them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from nerfies_jax.fields import compositing
from nerfies_jax.geometry.precision import at_least_float32, widened
from nerfies_jax.runtime.contract import checked

SPACINGS = ("linear", "disparity")


class RaySamples(NamedTuple):
    """Samples along rays, from near to far."""

    t: Float[Array, "*rays samples"]  # distance from the origin, in scene units
    points: Float[Array, "*rays samples 3"]  # positions in scene units
    directions: Float[Array, "*rays samples 3"]  # directions of the rays


class Rendered(NamedTuple):
    """Rendered rays."""

    color: Float[Array, "*rays channels"]
    depth: Float[Array, "*rays"]  # expected distance along the ray, in scene units
    weights: Float[Array, "*rays samples"]  # rendering weights
    alpha: Float[Array, "*rays"]  # opacity, the sum of the weights


@checked
def sample_along_rays(
    key: Key[Array, ""] | None,
    origins: Float[Array, "*rays 3"],
    directions: Float[Array, "*rays 3"],
    near: Float[Array, "..."] | float,
    far: Float[Array, "..."] | float,
    num_samples: int,
    *,
    spacing: str = "linear",
) -> RaySamples:
    """Sample one distance in each of `num_samples` equal bins of every ray.

    Args:
      key: PRNG key from `jax.random.key` for a random position of each sample in its
        bin. None for the middle of each bin.
      origins: Ray origins in scene units, [..., 3].
      directions: Ray directions of unit length, [..., 3].
      near: Distance at which the bins begin, a number or an array that broadcasts to
        the leading axes of `origins`.
      far: Distance at which the bins end. If it is not larger than `near`, all samples
        of the ray are at `far`.
      num_samples: Number of samples per ray, at least 1.
      spacing: "linear" for bins equal in distance, "disparity" for bins equal in
        inverse distance, which requires `near > 0` and supports `far=inf`.

    Returns:
      Distances t [..., num_samples] in ascending order, points [..., num_samples, 3]
      and directions [..., num_samples, 3]. Half-precision rays give float32 samples.

    Raises:
      ValueError: If a shape or type, `num_samples` or `spacing` is invalid, or if
        `near` or `far` is invalid, unless they are traced.

    References:
      Stratified sampling, Mildenhall et al. 2020, arXiv:2003.08934, section 4.
    """
    if num_samples < 1:
        raise ValueError(f"num_samples={num_samples} must be at least 1")
    if spacing not in SPACINGS:
        raise ValueError(f"unknown spacing {spacing!r}; choose from {SPACINGS}")
    origins, directions = widened(origins), widened(directions)
    near, far = widened(jnp.asarray(near)), widened(jnp.asarray(far))
    rays = origins.shape[:-1]
    for name, bound in (("near", near), ("far", far)):
        try:
            fits = np.broadcast_shapes(bound.shape, rays) == rays
        except ValueError:
            fits = False
        if not fits:
            raise ValueError(
                f"sample_along_rays: `{name}` has shape {list(bound.shape)}, which "
                f"does not broadcast to the rays {list(rays)}"
            )
    _check_bounds(near, far, spacing)
    dtype = jnp.result_type(origins, near, far)
    shape = (*rays, num_samples)
    jitter = jnp.full(shape, 0.5, dtype)
    if key is not None:
        jitter = jax.random.uniform(key, shape, dtype)
    near, far = (jnp.asarray(bound, dtype)[..., None] for bound in (near, far))
    place = jnp.arange(num_samples, dtype=dtype)
    from_near = (place + jitter) / num_samples
    if spacing == "linear":
        t = near + (far - near) * from_near
    else:
        # Computed separately, because 1 - from_near loses digits: the farthest samples
        # would be off by a tenth if far is 1e6 times near.
        from_far = ((num_samples - place) - jitter) / num_samples
        t = 1 / (from_far / near + from_near / far)
    t = jnp.clip(t, near, far)
    directions = jnp.broadcast_to(directions[..., None, :], (*shape, 3))
    points = origins[..., None, :] + t[..., None] * directions
    return RaySamples(t, points, directions)


def _check_bounds(near, far, spacing):
    if spacing == "linear" and _is_concrete(far) and bool(jnp.any(jnp.isinf(far))):
        raise ValueError(
            "sample_along_rays: bins of equal length cannot reach far=inf; use "
            "spacing='disparity' or a finite far"
        )
    if spacing == "disparity" and _is_concrete(near) and not bool(jnp.all(near > 0)):
        raise ValueError(
            "sample_along_rays: spacing='disparity' needs near > 0, got "
            f"{float(jnp.min(near)):g}"
        )


def _is_concrete(array):
    return not isinstance(array, jax.core.Tracer)


@checked(broadcast=True)
@at_least_float32
def composite(
    density: Float[Array, " samples"],
    color: Float[Array, "samples channels"],
    t: Float[Array, " samples"],
    background: Float[Array, " channels"] | None = None,
    *,
    last_interval: Float[Array, ""] | float = compositing.AT_INFINITY,
) -> Rendered:
    """Composite colors along rays by volume rendering.

    Sample i represents the interval from t[i] to t[i + 1], and the last sample an
    interval of length `last_interval`. Leading axes of all arguments broadcast.

    Args:
      density: Volume density at the samples per scene unit, non-negative,
        [..., samples]. Infinite density is opaque.
      color: Color or any features at the samples, [..., samples, channels].
      t: Distance of the samples along unit directions in ascending order, in scene
        units, [..., samples].
      background: Color behind the ray, [..., channels]. None is black.
      last_interval: Length of the last sample's interval in scene units, [...]. With
        the default of 1e10, as in the code of NeRF, any density there is opaque. Pass
        far - t[-1] for a last sample like the others.

    Returns:
      Color [..., channels], expected depth [...], weights [..., samples] and opacity
      alpha [...]. Weights are non-negative and sum to at most one, up to rounding. The
      depth is the mean of t by the weights. Below an opacity of 1e-3 it goes to the
      last t, so that value and gradient are bounded also for empty rays. Arguments in
      half precision are computed in float32 and rounded once.

    Raises:
      ValueError: If a shape or type is wrong.

    References:
      Mildenhall et al. 2020, arXiv:2003.08934, equation 3.
    """
    interval = compositing.intervals(t, last_interval)
    # An infinite density times an interval of length zero is NaN, also in the gradient.
    finite = jnp.minimum(density, jnp.finfo(density.dtype).max)
    weights = compositing.weights(finite * interval)
    # Sums of products, because a GPU may round matrix products to ten bits.
    ray_color = jnp.sum(weights[:, None] * color, axis=0)
    alpha = jnp.sum(weights)
    if background is not None:
        ray_color = ray_color + (1 - alpha) * background
    depth = compositing.expected_distance(weights, t, t[-1])
    return Rendered(ray_color, depth, weights, alpha)
