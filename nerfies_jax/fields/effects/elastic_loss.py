"""Elastic energy of any warp, for use without a preset."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.fields.effects import elastic
from nerfies_jax.geometry.precision import widened
from nerfies_jax.runtime.contract import checked


@checked
def elastic_loss(
    warp: Callable[[jax.Array], jax.Array],
    points: Float[Array, "*batch 3"],
    weights: Float[Array, "*batch"] | None = None,
    *,
    robust_width: float | None = None,
    scaling: str = "paper",
    fold_cost: float = 0.0,
) -> Float[Array, ""]:
    """Compute the mean elastic energy of a warp at points.

    The energy is the sum of log²σ over the singular values σ of the warp's Jacobian,
    which `jax.jacfwd` computes here. It is zero for rotations and translations and
    twice differentiable everywhere, also at equal singular values and at folds.

    Args:
      warp: The deformation, from one point [3] to one point [3]. It may close over
        traced parameters.
      points: Points in scene units, [..., 3].
      weights: Non-negative weights of the points, [...], for a weighted mean, which is
        zero if all weights are zero. None for equal weights.
      robust_width: Logarithmic strain at which the Geman-McClure loss of the paper
        stops being quadratic, 0.03 in the paper. None to use the energy itself.
      scaling: "paper" for this loss as printed, "official" for that of the published
        code, which multiplies it by `robust_width`.
      fold_cost: Cost of mirroring a unit volume. With 0, as in the published code,
        mirror images have no cost.

    Returns:
      The mean energy, a scalar. Strains are resolved to the rounding of the Jacobian,
      1e-7 in float32.

    Raises:
      ValueError: If a shape or type is wrong, or the warp does not return [3].

    References:
      Park et al. 2021 (Nerfies), arXiv:2011.12948, section 3.3.
    """
    if points.dtype != widened(points).dtype:
        raise ValueError(
            f"elastic_loss: `points` are {points.dtype}, which resolve no strain below "
            f"{float(jnp.finfo(points.dtype).eps):.1g}; cast them to float32"
        )
    spec = elastic.ElasticSpec(
        robust_width=robust_width, scaling=scaling, fold_cost=fold_cost
    )

    def displacement(point):
        warped_point = warp(point)
        if jnp.shape(warped_point) != (3,):
            raise ValueError(
                f"elastic_loss: `warp` returns {list(jnp.shape(warped_point))} for one "
                "point [3], expected [3]; `warp` must take a single point"
            )
        return warped_point - point

    def energy(point):
        return elastic.displacement_cost(spec, jax.jacfwd(displacement)(point))

    energies = jax.vmap(energy)(points.reshape(-1, 3))
    if weights is None:
        return jnp.mean(energies)
    weights = weights.reshape(-1)
    total = jnp.sum(weights)
    return jnp.sum(weights * energies) / jnp.where(total > 0, total, 1)
