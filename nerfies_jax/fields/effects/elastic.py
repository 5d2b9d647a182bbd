"""Elastic regularization, which penalizes deviations of a warp from rigid motion.

Park et al. 2021 (Nerfies), arXiv:2011.12948, "elastic regularization": a robust
function of Σ log²σ over the singular values of the warp's Jacobian, summed along each
ray with the rendering weights.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.fields.effects.effect import RayOutput, Scalar
from nerfies_jax.geometry import matrix3
from nerfies_jax.geometry.jacobi import cross, dot
from nerfies_jax.runtime.contract import checked
from nerfies_jax.training import losses, schedules
from nerfies_jax.training.effects import PenaltyContext, PyTree, Term
from nerfies_jax.training.step_counts import steps

Matrix = Float[Array, "3 3"]


@dataclasses.dataclass(frozen=True)
class ElasticSpec:
    """Settings of the elastic regularization: strength, form and sampling.

    It is evaluated on the coarse samples. `weight` is constant for `hold_steps` and
    then decays to `last_weight` along a cosine over `decay_steps` (None for a constant
    weight). The first official preset has a constant 1e-3. The others have 1e-2 for
    50_000 steps and decay to 1e-8 over 100_000.

    `points` samples of each ray are chosen at random by their weights, and only these
    are differentiated (None for all samples, as in the official code). `robust_width`
    is the logarithmic strain at which ρ stops being quadratic (None for the energy E
    itself). `scaling` is that of `losses.geman_mcclure`.

    The penalty is evaluated in one of `every` steps, with its weight multiplied by
    `every` (lazy regularization, Karras et al. 2020, arXiv:1912.04958, section 3.1).
    Its logged value is correct as a mean over that many steps.

    `fold_cost` is the cost of mirroring a unit volume, in addition to ρ. With 0 mirror
    images have no cost, as in the official code. See `displacement_cost`.
    """

    weight: float = 1e-3
    hold_steps: int = steps(0)
    decay_steps: int | None = steps(None)
    last_weight: float = 1e-8
    points: int | None = 4
    every: int = 1
    robust_width: float | None = 0.03
    scaling: str = "paper"
    fold_cost: float = 1.0

    name = "elastic"

    def __post_init__(self):
        if self.points is not None and self.points < 1:
            raise ValueError(
                f"points={self.points} per ray must be at least 1, or None for all"
            )
        if self.every < 1:
            raise ValueError(f"every={self.every} must be at least 1, for every step")
        for name in ("weight", "last_weight", "fold_cost"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name}={value} must be finite and not negative")
        schedule(self)  # checks the steps
        if self.robust_width is not None:
            losses.check_geman_mcclure(self.robust_width, self.scaling)

    def loss(self, params: PyTree, context: PenaltyContext) -> dict[str, Term]:
        """Compute the elastic energy of the warp at the coarse samples of a step."""
        value, fold_fraction = energy_of_step(self, context)
        schedule_ = schedule(self)
        weight = schedule_(context.step) if callable(schedule_) else schedule_
        return {"elastic": Term(value, weight), "folded": Term(fold_fraction, None)}


def schedule(spec: ElasticSpec) -> schedules.Schedule | float:
    """Return the weight as a schedule, or as a constant.

    Args:
      spec: Settings.

    Returns:
      A function of the step, or a number.
    """
    if spec.decay_steps is None:
        return spec.weight
    return schedules.cosine(
        spec.weight, spec.last_weight, spec.decay_steps, after=spec.hold_steps
    )


def energy_of_step(spec: ElasticSpec, context: PenaltyContext) -> tuple[Scalar, Scalar]:
    """Compute `spec.every` times `energy` every `spec.every` steps, and zero otherwise.

    The means of values and gradients over steps are then those of `energy`.

    Args:
      spec: Settings.
      context: Context of the step.

    Returns:
      The energy and the fraction of folds, scalars.
    """
    if spec.every == 1:
        return energy(spec, context)
    zero = jnp.zeros((), context.levels[0].point.dtype)

    def evaluate():
        value, fold_fraction = energy(spec, context)
        return spec.every * value, spec.every * fold_fraction

    return jax.lax.cond(context.step % spec.every == 0, evaluate, lambda: (zero, zero))


@checked
def displacement_cost(spec: ElasticSpec, displacement: Matrix) -> Scalar:
    """Compute the cost of one Jacobian of a displacement field, not of a warp.

    It is ρ(E) + `fold_cost` max(0, -det J), with J = 1 + `displacement` and E its log
    energy. Folds, where det J < 0, need two changes. E is signed, because the unsigned
    energy of a mirror image is zero. The determinant is added, because ρ saturates: at
    diag(1, 1, -1) its gradient is 1e-6, which would not undo a fold, and that of the
    determinant is one. Without folds the second term is zero and E is that of Nerfies.

    Args:
      spec: Settings.
      displacement: Jacobian of the displacement, [3, 3].

    Returns:
      The cost, a scalar.
    """
    folds = spec.fold_cost > 0
    form = matrix3.signed_log_energy if folds else matrix3.log_energy
    strain = matrix3.displacement_log_energy(displacement, form)
    if spec.robust_width is not None:
        strain = losses.geman_mcclure(strain, spec.robust_width, spec.scaling)
    if not folds:
        return strain
    return strain + spec.fold_cost * jax.nn.relu(
        -displacement_determinant(displacement)
    )


@checked
def displacement_determinant(displacement: Matrix) -> Scalar:
    """Compute det(1 + D) as a triple product.

    Args:
      displacement: Jacobian D of the displacement, [3, 3].

    Returns:
      The determinant.
    """
    # `jnp.linalg.det` uses LU, whose gradient at rank one is NaN.
    x, y, z = displacement + jnp.eye(3, dtype=displacement.dtype)
    return dot(x, cross(y, z))


def energy(spec: ElasticSpec, context: PenaltyContext) -> tuple[Scalar, Scalar]:
    """Compute the mean over rays of Σ w cost on the coarse level.

    The weights are those of the static medium, which the warp deforms. They have no
    gradient, because the penalty should stiffen space and not empty it.

    Args:
      spec: Settings.
      context: Context of the step.

    Returns:
      The energy, and the fraction of the weight that lies in folds, scalars.
    """
    level = context.levels[0]
    point, weight = draw(spec.points, level, context.key)

    def cost_at(point, condition):
        jacobian = jax.jacfwd(lambda x: context.displace(x, condition))(point)
        is_fold = displacement_determinant(jax.lax.stop_gradient(jacobian)) < 0
        return displacement_cost(spec, jacobian), is_fold.astype(point.dtype)

    costs, folds = jax.vmap(jax.vmap(cost_at, (0, None)))(point, context.condition)
    total = jnp.sum(weight)
    fold_fraction = jnp.sum(weight * folds) / jnp.where(total > 0, total, 1)
    return jnp.mean(jnp.sum(weight * costs, axis=-1)), fold_fraction


def draw(
    points: int | None, level: RayOutput, key: Key[Array, ""]
) -> tuple[Float[Array, "rays points 3"], Float[Array, "rays points"]]:
    """Sample points of each ray, with weights under which their sum is unbiased.

    Samples are chosen with probabilities proportional to their weights, and each
    represents an equal part of the ray's total weight. The standard deviation of the
    gradient, relative to its norm, is 0.67 for one sample, 0.21 for four, and 1.6 for
    four evenly spaced samples (24 rays of 16 samples through surfaces,
    docs/results/elastic_points.md).

    Args:
      points: Number of samples per ray. None for all.
      level: Output of the level.
      key: PRNG key.

    Returns:
      Points [rays, points, 3] and weights [rays, points].
    """
    weight = jax.lax.stop_gradient(level.static_weight)
    if points is None or points >= weight.shape[-1]:
        return level.point, weight
    start = jax.random.uniform(key, weight.shape[:1], weight.dtype)
    index, weight = jax.vmap(systematic, (0, 0, None))(weight, start, points)
    return jnp.take_along_axis(level.point, index[..., None], axis=1), weight


def systematic(
    weight: Float[Array, " samples"], start: Scalar, draws: int
) -> tuple[Int[Array, " draws"], Float[Array, " draws"]]:
    """Choose samples by systematic sampling, in proportion to their weights.

    A sample of weight zero is not chosen, except on an empty ray.

    Args:
      weight: Non-negative weights, [samples].
      start: Random number in [0, 1), the offset of equidistant positions on the
        cumulative weight.
      draws: Number of samples to choose.

    Returns:
      Indices of samples and the weight that each represents, [draws].
    """
    cumsum = jnp.cumsum(weight)
    total = cumsum[-1]
    positions = (start + jnp.arange(draws, dtype=weight.dtype)) * (total / draws)
    # With side="right" a position of zero skips leading samples of weight zero.
    index = jnp.searchsorted(cumsum, positions, side="right", method="compare_all")
    # A position that was rounded up to the total must not choose a trailing sample of
    # weight zero.
    index = jnp.minimum(index, jnp.sum(cumsum < total, dtype=index.dtype))
    return index, jnp.full(draws, total / draws, weight.dtype)
