"""Motion-guided densification: the gradient threshold depends on the motion.

MoBa-GS, section 3.4: a Gaussian is cloned or split only if its screen-space gradient
and its motion both exceed a threshold (equation 7). In this form, static regions are
never densified, however badly they are reconstructed: a scene that starts from random
points keeps those for its background, and a scene whose motion has not begun is not
densified at all. The soft form requires a larger gradient of static Gaussians instead.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gaussians_jax.core.metadata import Number, is_traced
from gaussians_jax.core.protocols import StepInfo, StrategyEvent
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.optim.densification import DefaultStrategySpec
from nerfies_jax.training.step_counts import steps

PyTree = Any
FORMS = ("soft", "hard")
# Number of Gaussians from which the median is computed. At 10k Gaussians on one core,
# `traveled` takes 0.2 ms, and 5.6 ms with all Gaussians, mostly for sorting.
MEDIAN_ROWS = 512


@dataclasses.dataclass(frozen=True)
class MotionGrowthSpec:
    """Settings of motion-guided densification.

    `start` is the step from which motion is used. It should be some hundred steps after
    the warm-up of the motion. In the soft form a static Gaussian needs 1 + `beta` times
    the gradient, one at the threshold `motion` twice as much, and a fast one no more
    than without this component. The paper does not give the threshold. If all Gaussians
    move by more than our default, densification is unchanged, bit for bit. This is so
    in the built-in scene from tracks, where static objects move by 0.015 to 0.03 of the
    extent.
    """

    form: str = "soft"  # or "hard", the rule as printed
    start: int = steps(5000)  # step
    motion: float = 1e-3  # threshold, as a share of the scene's extent
    beta: float = 4.0  # of the soft form

    def __post_init__(self):
        if self.form not in FORMS:
            raise ValueError(f"unknown form {self.form!r}; choose from {FORMS}")
        if self.start < 0:
            raise ValueError(f"start={self.start} must not be negative")
        if not 0 < self.motion < math.inf:
            raise ValueError(
                f"motion={self.motion} must be positive and finite; for densification "
                "independent of motion disable this component (motion_growth=none)"
            )
        if not 1 < self.beta < math.inf:
            raise ValueError(
                f"beta={self.beta} must be finite and above 1, or static regions are "
                'densified as easily as moving ones; to exclude them use form="hard"'
            )


class Travel(NamedTuple):
    """Bounding box of the observed displacements of each Gaussian."""

    low: Float[Array, "gaussians 3"]  # scene units; above `high` if never observed
    high: Float[Array, "gaussians 3"]


def no_travel(gaussians: Splats | Gaussians) -> Travel:
    """Return the state before any observation.

    Args:
      gaussians: The Gaussians.

    Returns:
      The state, with one row for each.
    """
    mean = gaussians.mean
    # The largest float, not infinity, because the loop stops if a state is not finite.
    most = jnp.finfo(mean.dtype).max
    return Travel(jnp.full_like(mean, most), jnp.full_like(mean, -most))


def traveled(state: Travel, canonical: Gaussians, deformed: Gaussians) -> Travel:
    """Add the positions at one time to the bounding boxes.

    Displacements are relative to the median displacement of the active Gaussians at
    that time, because a common motion, such as that of the camera, is not motion of a
    Gaussian. If most of a scene moves rigidly, the remainder therefore counts as
    moving. Displacements that are not finite are ignored.

    Args:
      state: Bounding boxes.
      canonical: Gaussians in their canonical state.
      deformed: The Gaussians at the time.

    Returns:
      The bounding boxes with the added positions.
    """
    displacement = deformed.mean - canonical.mean
    finite = jnp.all(jnp.isfinite(displacement), axis=1)
    # The opacity of an inactive Gaussian is exactly zero.
    common = common_motion(displacement, finite & (canonical.opacity > 0))
    relative = displacement - common
    finite = finite[:, None]
    return Travel(
        jnp.where(finite, jnp.minimum(state.low, relative), state.low),
        jnp.where(finite, jnp.maximum(state.high, relative), state.high),
    )


def common_motion(
    displacement: Float[Array, "gaussians 3"], counts: Bool[Array, " gaussians"]
) -> Float[Array, "3"]:
    """Compute the median displacement of the selected Gaussians, zero without any.

    It uses every k-th Gaussian, at most `MEDIAN_ROWS`. If most are static, or move
    together, such a sample suffices.

    Args:
      displacement: Displacements.
      counts: Selected Gaussians.

    Returns:
      The median of each component.
    """
    stride = max(1, -(-displacement.shape[0] // MEDIAN_ROWS))
    counts, displacement = counts[::stride], displacement[::stride]
    sorted_displacement = jnp.sort(
        jnp.where(counts[:, None], displacement, jnp.inf), axis=0
    )
    number = jnp.sum(counts, dtype=jnp.int32)
    middle = (
        sorted_displacement[jnp.maximum(number - 1, 0) // 2]
        + sorted_displacement[number // 2]
    ) / 2
    return jnp.where(number > 0, middle, jnp.zeros_like(middle))


def motion(state: Travel) -> Float[np.ndarray, " gaussians"]:
    """Compute the observed motion of each Gaussian, on the host.

    It is half the diagonal of the bounding box of its positions, which does not depend
    on the order of the frames. On a straight path with evenly spaced times it is the
    largest distance from the mean position. In general it is between 1/2 and sqrt(3)
    times as large, and one time gives no motion. A running largest distance from the
    mean would depend on the order: 0.9 to 1.6 times on a path that swings once through
    24 frames.

    Args:
      state: Bounding boxes.

    Returns:
      Distances in scene units, zero if never observed.
    """
    low, high = (np.asarray(x, np.float64) for x in state)
    is_observed = (low <= high).all(axis=1, keepdims=True)
    side = np.subtract(high, low, where=is_observed, out=np.zeros_like(low))
    # Scaled by the largest side, because its square may overflow or underflow.
    longest = side.max(axis=1, initial=0.0, keepdims=True)
    relative_side = np.divide(side, longest, where=longest > 0, out=np.zeros_like(side))
    return longest[:, 0] / 2 * np.linalg.norm(relative_side, axis=1)


def growth_factor(
    spec: MotionGrowthSpec, motion: Float[np.ndarray, " gaussians"], threshold: float
) -> Float[np.ndarray, " gaussians"]:
    """Compute the factor of the gradient in [0, 1].

    The soft form is 1 / (1 + beta^(1 - m/tau)). The obvious softening, a threshold
    tau_grad (1 + beta exp(-m/tau)), does not converge to equation 7: with increasing
    beta it stops everything that moves less than tau log(beta). With m log(beta) / tau
    in the exponent the midpoint stays at tau, and the limit of beta is the hard form.

    Args:
      spec: Settings.
      motion: Motion of each Gaussian.
      threshold: Threshold tau in the same unit.

    Returns:
      Factors.
    """
    if spec.form == "hard":
        return (motion > threshold).astype(np.float64)
    # The exponent is at most one, so the power may underflow but not overflow.
    return 1 / (1 + spec.beta ** (1 - motion / threshold))


def grow_score(
    spec: MotionGrowthSpec, extent: Number, state: Travel, step: int
) -> Float[np.ndarray, " gaussians"]:
    """Compute the factor of each Gaussian's gradient at a step, on the host.

    Args:
      spec: Settings.
      extent: Spread of the cameras in scene units.
      state: Observed travel of the Gaussians.
      step: Number of completed steps.

    Returns:
      Factors in [0, 1].
    """
    rows, dtype = state.low.shape[0], state.low.dtype
    if step < spec.start:
        return np.ones(rows, dtype)
    return growth_factor(spec, motion(state), spec.motion * float(extent)).astype(dtype)


class Guided(NamedTuple):
    """State of a `MotionGuided` strategy."""

    stats: PyTree  # state of the guided strategy
    travel: Travel


@dataclasses.dataclass(frozen=True)
class MotionGuided:
    """The default strategy with a gradient threshold that depends on the motion."""

    base: DefaultStrategySpec
    spec: MotionGrowthSpec
    extent: Number  # of the scene, in scene units

    def __post_init__(self):
        if is_traced(self.extent):
            return
        if not 0 < self.extent < math.inf:
            raise ValueError(
                f"extent={self.extent} of the scene must be positive and finite; see "
                "`splats.scene_extent`"
            )

    @property
    def cap_max(self) -> int:
        """Largest number of Gaussians."""
        return self.base.cap_max

    def init(self, gaussians: Splats) -> Guided:
        """Return the state before any view."""
        return Guided(self.base.init(gaussians), no_travel(gaussians))

    def update(self, state: Guided, info: StepInfo) -> Guided:
        """Return the state after one more view."""
        travel = traveled(state.travel, info.canonical, info.deformed)
        return Guided(self.base.update(state.stats, info), travel)

    def events(self, steps: int) -> tuple[StrategyEvent, ...]:
        """Return the events of the guided strategy."""
        return tuple(
            event._replace(apply=functools.partial(self._apply, event))
            for event in self.base.events(steps)
        )

    def _apply(self, event, population):
        stats, travel = population.state
        if event.changes_rows:
            factor = grow_score(self.spec, self.extent, travel, population.step)
            stats = stats._replace(grad2d=stats.grad2d * jnp.asarray(factor))
        new_population = event.apply(population._replace(state=stats))
        return new_population._replace(state=Guided(new_population.state, travel))
