"""Motion along a few trajectories that all Gaussians share, with their own
coefficients.

DynMF (Kratimenos et al. 2024, arXiv:2312.00112): a tiny network of the time alone makes
K trajectories b_k(t), a Gaussian keeps K coefficients c_k, and is at p + sum_k c_k
b_k(t). The factorization of all paths into K is that of a singular value decomposition,
so a scene of few bodies needs few. Like the paper, one coefficient stands for all parts
of a trajectory, here a shift and a turn; coefficients are sparse (`sparsity`) and alike
among neighbors (`effects.neighbors`). A Gaussian whose coefficients are zero does not
move, exactly, and so all start.

The paper's equations were not at hand, only its abstract and accounts of its method,
and its repository (agelosk/dynmf) holds no code: these are followed, without numbers.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.motion.bound import BoundMotion
from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import (
    FrameCondition,
    PenaltyContext,
    Term,
    from_step,
)
from nerfies_jax.training.step_counts import steps

NAME = "time_basis"
# A row whose largest coefficient is well below this counts as one at rest: it would
# move by 1e-3 of a trajectory.
REST = 1e-3


@dataclasses.dataclass(frozen=True)
class TimeBasisSpec:
    """Number of trajectories, their network, and learning rates.

    Trajectories are in scene extents (translations) and rad (rotations), coefficients
    are numbers. Ten trajectories are published, and their network is called tiny. Its
    size, the weight of the sparsity and the rates are our choice, because no code of
    the paper is public.
    """

    count: int = 10
    time: EncodingSpec = EncodingSpec(6, times_pi=True)
    depth: int = 3
    width: int = 128
    sparsity: float | None = 1e-3  # weight; None leaves it out
    warm_up: int = steps(3000)  # steps without motion
    learning_rate: float = 8e-4  # of the network
    learning_rate_end: float = 1.6e-6
    coefficient_rate: float = 1e-3
    coefficient_rate_end: float = 1e-5

    def __post_init__(self):
        if self.count < 1:
            raise ValueError(
                f"count={self.count}: a time basis has at least one trajectory"
            )
        if self.sparsity is not None and not 0 < self.sparsity < math.inf:
            raise ValueError(
                f"sparsity={self.sparsity} is a weight, finite and positive; None "
                "leaves it out"
            )
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        schedules.check_falling(self.coefficient_rate, self.coefficient_rate_end)
        network_spec(self)  # checks its sizes

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.extent)


class Trajectories(NamedTuple):
    """All trajectories at one time."""

    shift: Float[Array, "count 3"]  # scene units
    turn: Float[Array, "count 3"]  # rotation vectors, rad, in world axes


def network_spec(spec: TimeBasisSpec) -> MLPSpec:
    """From the encoded time to all trajectories.

    They start about as long as one: coefficients start at zero, and were both zero,
    neither would get a gradient.
    """
    heads = (
        ("shift", HeadSpec(3 * spec.count)),
        ("turn", HeadSpec(3 * spec.count)),
    )
    inputs = spec.time.width(1)
    return MLPSpec(inputs, spec.depth, spec.width, heads, (), "silu", "he")


SMALL_TIME_BASIS = TimeBasisSpec(time=EncodingSpec(4, times_pi=True), depth=2, width=64)


def init(key: Key[Array, ""], spec: TimeBasisSpec, dtype=jnp.float32) -> MLP:
    """A network whose trajectories are all different."""
    return mlp.init(network_spec(spec), key, dtype)


def init_coefficients(spec: TimeBasisSpec, gaussians: int, dtype=jnp.float32):
    """[gaussians, count]: all stay where they are."""
    return jnp.zeros((gaussians, spec.count), dtype)


def at_time(
    params: MLP, spec: TimeBasisSpec, extent: float, time: Float[Array, ""]
) -> Trajectories:
    """Evaluate the trajectories at a time, with `extent` (scene units) as unit."""
    encoded = encoding.encode(spec.time, time[None], None)
    made = mlp.apply(network_spec(spec), params, encoded)
    shift, turn = (made[name].reshape(spec.count, 3) for name in ("shift", "turn"))
    return Trajectories(extent * shift, turn)


def deform(
    trajectories: Trajectories,
    coefficients: Float[Array, "gaussians count"],
    gaussians: Gaussians,
) -> Gaussians:
    """Gaussians moved along the trajectories in their own measure."""
    moved = exact_product(coefficients, jnp.concatenate(trajectories, axis=-1))
    return gaussians._replace(
        mean=gaussians.mean + moved[:, :3],
        quaternion=splats.turned(gaussians, moved[:, 3:]),
    )


def sparsity(
    coefficients: Float[Array, "gaussians count"], active: Bool[Array, " gaussians"]
) -> Float[Array, ""]:
    """Compute the mean over the active Gaussians of sum_k |c_k| / max_k |c_k|.

    The sparsity term of DynMF, as others describe it. It measures the number of
    trajectories in use, from 1 to K, and not the distance. The plain quotient is 0/0
    for a static Gaussian. With `REST` added to its denominator it goes to zero there,
    and its gradient is at most K / REST.

    Args:
      coefficients: Coefficients of the Gaussians.
      active: Active Gaussians.

    Returns:
      The mean.
    """
    # Not `abs`, whose slope at zero is one: all that rests would be pushed one way.
    size = coefficients * jnp.sign(coefficients)
    used = jnp.sum(size, axis=-1) / (jnp.max(size, axis=-1) + REST)
    number = jnp.sum(active, dtype=jnp.int32)
    share = jnp.where(active, used, 0) / jnp.maximum(number, 1).astype(used.dtype)
    return jnp.sum(share)


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `TimeBasisSpec` in a run of `steps`."""

    spec: TimeBasisSpec
    extent: float  # of the scene, the unit of shifts, scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of coefficients and network."""
        spec = self.spec
        coefficients = schedules.log_linear(
            spec.coefficient_rate, spec.coefficient_rate_end, self.steps
        )
        return MotionParams(coefficients(step), self.rate(step))

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the network, and coefficients with which nothing moves."""
        _, shared_key = jax.random.split(key)
        mean = gaussians.mean
        coefficients = init_coefficients(self.spec, len(mean), mean.dtype)
        return MotionParams(coefficients, init(shared_key, self.spec))

    def apply(
        self,
        params: MotionParams,
        cache: None,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at a time."""
        trajectories = at_time(params.shared, self.spec, self.extent, frame.time)
        return deform(trajectories, params.per_gaussian, gaussians)

    def loss(self, params: MotionParams, context: PenaltyContext) -> dict[str, Term]:
        """Compute how many trajectories a Gaussian uses, once the motion has begun."""
        if self.spec.sparsity is None:
            return {}
        active = splats.active_mask(context.params.rows["splats"])
        value = sparsity(params.per_gaussian, active)
        terms = {"sparsity": Term(value, self.spec.sparsity)}
        return from_step(self.spec.warm_up, context.step, terms)
