"""3DGS-MCMC densification: a fixed budget of Gaussians that are relocated.

Kheradmand et al. 2024, "3D Gaussian splatting as Markov chain Monte Carlo",
arXiv:2404.09591. In contrast to `densification` there are no gradient thresholds,
resets and statistics. Noise is added to the means in every step (`position_noise`),
opacity and scale are penalized (`penalty`), and events (`refine`) run on the host.
"""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.protocols import Population, StepInfo, StrategyEvent
from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.optim import densification
from gaussians_jax.optim import optimizer as row_optimizer
from nerfies_jax.geometry import quaternion
from nerfies_jax.geometry.precision import exact_einsum, exact_product
from nerfies_jax.training.effects import PenaltyContext, Term
from nerfies_jax.training.step_counts import steps

PyTree = Any

# Trapezoidal rule over [0, 6.4] in steps of 0.1. The integrand is even and entire, so
# the rule converges geometrically. Tests compare with 400-digit sums up to 1000 copies.
_NODES = np.arange(64) * 0.1


@dataclasses.dataclass(frozen=True)
class MCMCStrategySpec:
    """Settings of 3DGS-MCMC: relocation, growth and noise.

    The values are those of the paper's code, where `cap_max` is set for each scene to
    the final number of Kerbl et al. 2023. The noise depends on the unit of the scene:
    it is proportional to the square of the scales and to the extent, which is a factor
    of the learning rate of the means.
    """

    refine_every: int = 100  # steps
    refine_start_iter: int = steps(500)
    refine_stop_iter: int = steps(25_000)
    min_opacity: float = 0.005  # Gaussians at or below it are relocated
    growth: float = 1.05  # factor of the number of Gaussians per event
    cap_max: int = 1_000_000  # Gaussians
    noise_lr: float = 5e5  # per unit of the learning rate of the means
    opacity_reg: float = 0.01
    scale_reg: float = 0.01  # per scene unit

    name = "mcmc"

    def __post_init__(self):
        if not 0 < self.min_opacity < 1:
            raise ValueError(
                f"min_opacity={self.min_opacity} must lie in (0, 1); 0.005 is usual"
            )
        if not 1 <= self.growth < math.inf:
            raise ValueError(
                f"growth={self.growth} must be at least 1; 1 adds no Gaussians"
            )
        for name in ("refine_every", "cap_max"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"{name}={getattr(self, name)} must be at least 1; to keep the "
                    "number of Gaussians constant, disable the strategy (None)"
                )
        for name in ("noise_lr", "opacity_reg", "scale_reg"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(
                    f"{name}={value} must be finite and not negative; 0 disables it"
                )

    def init(self, gaussians: Splats) -> tuple[()]:
        """Return an empty state, because no statistics are needed."""
        return ()

    def update(self, state: tuple[()], info: StepInfo) -> tuple[()]:
        """Return the empty state."""
        return state

    def events(self, steps: int) -> tuple[StrategyEvent, ...]:
        """Return the events that relocate and add Gaussians."""
        last = min(self.refine_stop_iter, steps)
        when = tuple(range(self.refine_start_iter, last, self.refine_every))
        return (StrategyEvent("relocate and add", when, self._refine),)

    def _refine(self, population: Population) -> Population:
        params, moments, _ = refine(
            population.optimizer,
            population.params,
            population.moments,
            population.key,
            self,
        )
        return population._replace(params=params, moments=moments)

    def loss(self, params: Params, context: PenaltyContext) -> dict[str, Term]:
        """Compute the penalty on opacities and scales."""
        return {"penalty": Term(penalty(params.rows["splats"], self), 1.0)}

    def perturb(
        self,
        key: Key[Array, ""],
        params: Params,
        learning_rate: Float[Array, ""] | float,
    ) -> Params:
        """Return the parameters with noise on the means."""
        return _inject_noise(key, params, learning_rate, self)


def compute_relocation(
    opacity: Float[Array, " n"],
    scale: Float[Array, "n 3"],
    copies: Int[Array, " n"],
    least: float,
) -> tuple[Float[Array, " n"], Float[Array, "n 3"]]:
    """Compute opacity and scale of copies that together replace one Gaussian.

    The opacity satisfies (1 - o')^copies = 1 - o, and the scale conserves the mass of
    the composite along a line through the center. As in the reference, the opacity of a
    copy is at least `least`, which the scale compensates. Logits are finite.

    Args:
      opacity: Opacity of the Gaussians in [0, 1].
      scale: Their scales in scene units.
      copies: Number of copies that replace each.
      least: Smallest opacity.

    Returns:
      Opacity and scales of a copy.

    References:
      Kheradmand et al. 2024 (3DGS-MCMC, arXiv:2404.09591), Equation 9.
    """
    count = copies.astype(opacity.dtype)
    largest = 1 - float(jnp.finfo(opacity.dtype).epsneg)
    # log1p(-1) is -inf and expm1 of it is -1, so an opaque one becomes opaque copies.
    copy_opacity = jnp.clip(-jnp.expm1(jnp.log1p(-opacity) / count), least, largest)
    # The paper's double sum of alternating binomials equals this integral of the
    # composite of n copies of o' exp(-u^2). All terms are positive, so nothing cancels
    # in float32, and no table limits the number of copies (51 in the reference).
    profile = jnp.asarray(np.exp(-(_NODES**2)), opacity.dtype)
    weight = jnp.asarray(np.where(_NODES == 0, 0.5, 1.0), opacity.dtype)
    composite = -jnp.expm1(count[:, None] * jnp.log1p(-copy_opacity[:, None] * profile))
    mass = exact_product(composite, weight) * (2 * 0.1 / math.sqrt(math.pi))
    return copy_opacity, scale * (opacity / mass)[:, None]


def relocate(
    optimizer: optax.GradientTransformation,
    params: Params,
    moments: PyTree,
    key: Key[Array, ""],
    spec: MCMCStrategySpec,
) -> tuple[Params, PyTree, densification.Report]:
    """Move every faint Gaussian to a visible one, on the host.

    Targets are sampled in proportion to their opacity. A target and its copies share
    opacity and scale (`compute_relocation`) and start with zero moments. A Gaussian
    that is not finite is relocated as well, and reported as broken. If nothing is
    visible, faint ones are not relocated, and the report counts them as refused.

    Args:
      optimizer: The optimizer.
      params: All parameters.
      moments: State of the optimizer.
      key: PRNG key.
      spec: Settings.

    Returns:
      Parameters, optimizer state and a report.
    """
    rows = params.rows["splats"]
    active, finite, opacity = _opacities(rows)
    faint = active & ~(finite & (opacity > spec.min_opacity))
    visible = active & ~faint
    report = densification.Report(
        active=int(active.sum()),
        capacity=len(active),
        broken=int((active & ~finite).sum()),
    )
    if not faint.any():
        return params, moments, report
    if not visible.any():
        return params, moments, report._replace(refused=int(faint.sum()))
    source = np.arange(len(active))
    source[faint] = _draw(key, opacity, visible, int(faint.sum()))
    params, moments = _spread(optimizer, params, moments, source, ~active, spec)
    return params, moments, report._replace(relocated=int(faint.sum()))


def refine(
    optimizer: optax.GradientTransformation,
    params: Params,
    moments: PyTree,
    key: Key[Array, ""],
    spec: MCMCStrategySpec,
) -> tuple[Params, PyTree, densification.Report]:
    """Relocate faint Gaussians and add new ones, on the host.

    Args:
      optimizer: The optimizer.
      params: All parameters.
      moments: State of the optimizer.
      key: PRNG key.
      spec: Settings.

    Returns:
      Parameters, optimizer state and a report.
    """
    move_key, add_key = jax.random.split(key)
    params, moments, relocation = relocate(optimizer, params, moments, move_key, spec)
    params, moments, addition = add(optimizer, params, moments, add_key, spec)
    report = addition._replace(
        relocated=relocation.relocated,
        refused=relocation.refused + addition.refused,
        broken=relocation.broken,
    )
    return params, moments, report


def add(
    optimizer: optax.GradientTransformation,
    params: Params,
    moments: PyTree,
    key: Key[Array, ""],
    spec: MCMCStrategySpec,
) -> tuple[Params, PyTree, densification.Report]:
    """Grow the number of Gaussians by `spec.growth` up to the cap, on the host.

    The number is rounded down, as in the reference: with a factor of 1.05, fewer than
    20 Gaussians do not grow.

    Args:
      optimizer: The optimizer.
      params: All parameters.
      moments: State of the optimizer.
      key: PRNG key.
      spec: Settings.

    Returns:
      Parameters, optimizer state and a report.
    """
    rows = params.rows["splats"]
    active, finite, opacity = _opacities(rows)
    count = int(active.sum())
    requested_count = int(spec.growth * count) - count
    extra = max(min(requested_count, spec.cap_max - count), 0)
    visible = active & finite & (opacity > 0)
    report = densification.Report(
        active=count, capacity=len(active), refused=requested_count - extra
    )
    if extra == 0 or not visible.any():
        return params, moments, report._replace(refused=requested_count)
    capacity = max(splats.capacity_for(count + extra, spec.cap_max), len(active))
    source = np.zeros(capacity, int)
    source[: len(active)] = np.arange(len(active))
    inactive = np.ones(capacity, bool)
    inactive[: len(active)] = ~active
    slots = np.flatnonzero(inactive)[:extra]
    source[slots] = _draw(key, opacity, visible, extra)
    inactive[slots] = False
    params, moments = _spread(optimizer, params, moments, source, inactive, spec)
    report = report._replace(cloned=extra, active=count + extra, capacity=capacity)
    return params, moments, report


def _opacities(rows):
    """Return whether each Gaussian is active, whether it is finite, and its opacity."""
    finite, opacity, _ = densification.row_summary(rows)
    active = np.asarray(splats.active_mask(rows))
    return active, np.asarray(finite), np.asarray(opacity, np.float64)


def _draw(key, opacity, visible, count):
    """Sample `count` of the visible Gaussians in proportion to their opacity."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    probability = np.where(visible, opacity, 0)
    return rng.choice(len(opacity), size=count, p=probability / probability.sum())


def _spread(optimizer, params, moments, source, inactive, spec):
    copies = np.bincount(source[~inactive], minlength=len(source))[source]
    return _share(
        optimizer,
        params,
        moments,
        source.astype(np.int32),
        np.where(inactive, 1, copies).astype(np.int32),
        inactive,
        spec.min_opacity,
    )


@functools.partial(jax.jit, static_argnames=("optimizer", "least"))
def _share(optimizer, params, moments, source, copies, inactive, least):
    params, moments = row_optimizer.gather_rows(
        optimizer, params, moments, source, copies > 1, inactive
    )
    rows = params.rows["splats"]
    gaussians = splats.activate(rows)
    opacity, scale = compute_relocation(
        gaussians.opacity, gaussians.scale, copies, least
    )
    is_shared = copies > 1
    logit = jnp.log(opacity) - jnp.log1p(-opacity)
    rows = rows._replace(
        opacity_logit=jnp.where(is_shared, logit, rows.opacity_logit),
        log_scale=jnp.where(is_shared[:, None], jnp.log(scale), rows.log_scale),
    )
    return params._replace(rows=params.rows | {"splats": rows}), moments


def position_noise(
    key: Key[Array, ""],
    rows: Splats,
    learning_rate: Float[Array, ""] | float,
    spec: MCMCStrategySpec,
) -> Float[Array, "gaussians 3"]:
    """Sample the noise that is added to the means after an update.

    The noise has the shape of each covariance, is proportional to the learning rate of
    the means, and affects faint Gaussians only. Inactive ones have none.

    Args:
      key: PRNG key.
      rows: Raw parameters.
      learning_rate: Current learning rate of the means.
      spec: Settings.

    Returns:
      Displacements in scene units.

    References:
      Kheradmand et al. 2024 (3DGS-MCMC, arXiv:2404.09591), Equation 8.
    """
    gaussians = splats.activate(rows)
    noise = jax.random.normal(key, rows.mean.shape, rows.mean.dtype)
    axes = jax.vmap(quaternion.to_matrix)(
        rows.quaternion
    )  # columns are the principal axes
    principal = exact_einsum("nji,nj->ni", axes, noise) * gaussians.scale**2
    displacement = exact_einsum("nij,nj->ni", axes, principal)
    faint = jax.nn.sigmoid(-100 * (gaussians.opacity - spec.min_opacity))
    rate = jnp.asarray(spec.noise_lr * learning_rate, faint.dtype)
    strength = jnp.where(splats.active_mask(rows), faint * rate, 0)
    return strength[:, None] * displacement


def _inject_noise(
    key: Key[Array, ""],
    params: Params,
    learning_rate: Float[Array, ""] | float,
    spec: MCMCStrategySpec,
) -> Params:
    """Add `position_noise` to the means."""
    rows = params.rows["splats"]
    noise = position_noise(key, rows, learning_rate, spec)
    rows = rows._replace(mean=rows.mean + noise)
    return params._replace(rows=params.rows | {"splats": rows})


def mean_opacity_and_scale(
    rows: Splats,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compute the mean opacity and the mean scale of the active Gaussians.

    Args:
      rows: Raw parameters.

    Returns:
      The mean opacity, and the mean of all three scales in scene units. Both are zero
      without active Gaussians.
    """
    gaussians = splats.activate(rows)
    active = splats.active_mask(rows)
    count = jnp.maximum(jnp.sum(active), 1).astype(gaussians.opacity.dtype)
    opacity = jnp.sum(jnp.where(active, gaussians.opacity, 0)) / count
    scale = jnp.sum(jnp.where(active[:, None], gaussians.scale, 0)) / (3 * count)
    return opacity, scale


def penalty(rows: Splats, spec: MCMCStrategySpec) -> Float[Array, ""]:
    """Penalize the mean opacity and scale of the active Gaussians.

    The paper uses sums, its code means.

    Args:
      rows: Raw parameters.
      spec: Settings.

    Returns:
      The penalty.

    References:
      Kheradmand et al. 2024 (3DGS-MCMC, arXiv:2404.09591), Equation 10.
    """
    opacity, scale = mean_opacity_and_scale(rows)
    return spec.opacity_reg * opacity + spec.scale_reg * scale
