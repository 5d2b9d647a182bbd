"""Background regularization, which penalizes displacements of static points.

Park et al. 2021 (Nerfies), arXiv:2011.12948. Without it the warp and the template can
drift together without any change of the images.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nerfies_jax.fields.effects.effect import Scalar
from nerfies_jax.training import losses
from nerfies_jax.training.effects import PenaltyContext, PyTree, Term


@dataclasses.dataclass(frozen=True)
class BackgroundSpec:
    """Settings of the background regularization: points, noise and cost.

    Each micro-batch of a step uses `points` points.

    `noise` (standard deviation) and `width` are in units of the field, whose box is the
    captured volume. In the official code the volume fills a box of diagonal one.
    `width` is the displacement at which ρ stops being quadratic. None is for the mean
    distance without ρ, as the loss is printed in the paper. `scaling` is that of
    the official code by default, for which a `weight` of one corresponds to 1e-3 with
    the ρ of the paper (`losses.geman_mcclure`).

    Building a scene fails if its capture has no static points.
    """

    points: int = 16_384
    noise: float = 1e-3
    width: float | None = 1e-3
    scaling: str = "official"
    weight: float = 1.0

    name = "background"
    required_data = frozenset({"points"})

    def __post_init__(self):
        if self.points < 1:
            raise ValueError(f"points={self.points} per step must be at least 1")
        for name in ("noise", "weight"):
            value = getattr(self, name)
            if not 0 <= value < float("inf"):
                raise ValueError(f"{name}={value} must be finite and not negative")
        if self.width is not None:
            losses.check_geman_mcclure(self.width, self.scaling)

    def loss(self, params: PyTree, context: PenaltyContext) -> dict[str, Term]:
        """Compute the cost of displacements of static points in random frames."""
        return {"background": Term(drift(self, context), self.weight)}


def drift(spec: BackgroundSpec, context: PenaltyContext) -> Scalar:
    """Compute the mean over static points of ρ(|displacement|²), or of |displacement|.

    All points are used if there are at most `spec.points`. Otherwise that many are
    sampled with replacement. Each point is evaluated in a random frame, with noise.

    Args:
      spec: Settings.
      context: Context of the step.

    Returns:
      A scalar.
    """
    # The official code uses one key for frames and noise.
    choice_key, frame_key, noise_key = jax.random.split(context.key, 3)
    assert context.frames is not None
    point = context.frames.points
    assert point is not None  # `required_data`
    if point.shape[0] > spec.points:
        rows = jax.random.randint(choice_key, (spec.points,), 0, point.shape[0])
        point = point[rows]
    point = (point - context.box.center) * context.box.scale
    noise = jax.random.normal(noise_key, point.shape, point.dtype)
    frames = context.frames.times.shape[0]
    rows = jax.random.randint(frame_key, point.shape[:1], 0, frames)
    return mean_drift(spec, context, point + spec.noise * noise, rows)


def mean_drift(
    spec: BackgroundSpec,
    context: PenaltyContext,
    point: Float[Array, "points 3"],
    rows: Int[Array, " points"],
) -> Scalar:
    """Compute the mean of ρ(|displacement|²), or of |displacement|, over points.

    Args:
      spec: Settings.
      context: Context of the step.
      point: Points in units of the field, [points, 3].
      rows: Training frame of each point, [points].

    Returns:
      A scalar.
    """
    assert context.condition_of is not None
    assert context.displace is not None
    conditions = jax.vmap(context.condition_of)(rows)
    displacement = jax.vmap(context.displace)(point, conditions)
    # The squared length, because the length has no gradient at zero.
    squares = jnp.sum(displacement**2, axis=-1)
    if spec.width is None:
        # The gradient of the length is not defined at zero, and is zero here.
        positive = squares > 0
        length = jnp.sqrt(jnp.where(positive, squares, 1))
        return jnp.mean(jnp.where(positive, length, 0))
    costs = losses.geman_mcclure(squares, spec.width, spec.scaling)
    return jnp.mean(costs)
