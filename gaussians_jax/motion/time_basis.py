"""Motion along a few shared trajectories, with coefficients of each Gaussian.

DynMF (Kratimenos et al. 2024, arXiv:2312.00112): a tiny network of the time alone
computes K trajectories b_k(t). A Gaussian has K coefficients c_k and is at p + sum_k
c_k b_k(t). This factorizes all paths into K like a singular value decomposition, so a
scene of few rigid bodies needs few trajectories. As in the paper, one coefficient
applies to all components of a trajectory, here a translation and a rotation.
Coefficients are sparse (`sparsity`) and similar among neighbors (`losses.neighbors`).
A Gaussian with zero coefficients is exactly static, and all are initialized like that.

The paper's equations were not available, only its abstract and descriptions by others,
and its repository (agelosk/dynmf) has no code. These descriptions give no numbers.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import Number, SceneMetadata
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
# A Gaussian whose largest coefficient is well below this counts as static, because it
# moves by less than 1e-3 of a trajectory.
REST = 1e-3


@dataclasses.dataclass(frozen=True)
class TimeBasisSpec:
    """Number of trajectories, their network, and learning rates.

    Trajectories are in scene extents (translations) and rad (rotations), and
    coefficients have no unit. The paper uses ten trajectories and calls their network
    tiny. Its size, the weight of the sparsity and the rates are our choice, because the
    code is not public.
    """

    count: int = 10
    time: EncodingSpec = EncodingSpec(6, times_pi=True)
    depth: int = 3
    width: int = 128
    sparsity: float | None = 1e-3  # weight; None disables the loss
    warm_up: int = steps(3000)  # steps without motion
    learning_rate: float = 8e-4  # of the network
    learning_rate_end: float = 1.6e-6
    coefficient_rate: float = 1e-3
    coefficient_rate_end: float = 1e-5

    def __post_init__(self):
        if self.count < 1:
            raise ValueError(
                f"count={self.count}: a time basis needs at least one trajectory"
            )
        if self.sparsity is not None and not 0 < self.sparsity < math.inf:
            raise ValueError(
                f"sparsity={self.sparsity} must be finite and positive; None disables "
                "it"
            )
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        schedules.check_falling(self.coefficient_rate, self.coefficient_rate_end)
        network_spec(self)  # validates the sizes

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.extent)


class Trajectories(NamedTuple):
    """All trajectories at one time."""

    shift: Float[Array, "count 3"]  # scene units
    turn: Float[Array, "count 3"]  # rotation vectors, rad, in world axes


def network_spec(spec: TimeBasisSpec) -> MLPSpec:
    """Settings of the network from the encoded time to all trajectories.

    Trajectories are initialized with a length of about one. Coefficients are zero at
    first, and if trajectories were zero as well, neither would get a gradient.

    Args:
      spec: Settings.

    Returns:
      Settings of the network.
    """
    heads = (
        ("shift", HeadSpec(3 * spec.count)),
        ("turn", HeadSpec(3 * spec.count)),
    )
    inputs = spec.time.width(1)
    return MLPSpec(inputs, spec.depth, spec.width, heads, (), "silu", "he")


SMALL_TIME_BASIS = TimeBasisSpec(time=EncodingSpec(4, times_pi=True), depth=2, width=64)


def init(
    key: Key[Array, ""], spec: TimeBasisSpec, dtype: DTypeLike = jnp.float32
) -> MLP:
    """Initialize a network whose trajectories are all different.

    Args:
      key: PRNG key.
      spec: Settings of the motion.
      dtype: Type of the parameters.

    Returns:
      Parameters of the network.
    """
    return mlp.init(network_spec(spec), key, dtype)


def _init_coefficients(
    spec: TimeBasisSpec, gaussians: int, dtype: DTypeLike = jnp.float32
):
    """Initialize static coefficients [gaussians, count]."""
    return jnp.zeros((gaussians, spec.count), dtype)


def _at_time(
    params: MLP, spec: TimeBasisSpec, extent: Number, time: Float[Array, ""]
) -> Trajectories:
    """Evaluate the trajectories at a time."""
    features = encoding.encode(spec.time, time[None], None)
    outputs = mlp.apply(network_spec(spec), params, features)
    shift, turn = (outputs[name].reshape(spec.count, 3) for name in ("shift", "turn"))
    return Trajectories(extent * shift, turn)


def deform(
    trajectories: Trajectories,
    coefficients: Float[Array, "gaussians count"],
    gaussians: Gaussians,
) -> Gaussians:
    """Move Gaussians along the trajectories by their coefficients.

    Args:
      trajectories: Trajectories at a time.
      coefficients: Coefficients of each Gaussian.
      gaussians: Gaussians in their canonical state.

    Returns:
      The moved Gaussians.
    """
    offset = exact_product(coefficients, jnp.concatenate(trajectories, axis=-1))
    return gaussians._replace(
        mean=gaussians.mean + offset[:, :3],
        quaternion=splats.rotate(gaussians, offset[:, 3:]),
    )


def sparsity(
    coefficients: Float[Array, "gaussians count"], active: Bool[Array, " gaussians"]
) -> Float[Array, ""]:
    """Compute the mean over the active Gaussians of sum_k |c_k| / max_k |c_k|.

    The sparsity loss of DynMF, as others describe it. It measures the number of
    trajectories in use, from 1 to K, and not the distance. The plain quotient is 0/0
    for a static Gaussian. With `REST` added to its denominator it goes to zero there,
    and its gradient is at most K / REST.

    Args:
      coefficients: Coefficients of the Gaussians.
      active: Active Gaussians.

    Returns:
      The mean.
    """
    # Not `abs`, whose gradient at zero is one and would move static Gaussians.
    size = coefficients * jnp.sign(coefficients)
    basis_count = jnp.sum(size, axis=-1) / (jnp.max(size, axis=-1) + REST)
    number = jnp.sum(active, dtype=jnp.int32)
    share = jnp.where(active, basis_count, 0) / jnp.maximum(number, 1).astype(
        basis_count.dtype
    )
    return jnp.sum(share)


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `TimeBasisSpec` in a run of `steps`."""

    spec: TimeBasisSpec
    extent: Number  # of the scene, the unit of translations, in scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of coefficients and network."""
        spec = self.spec
        coefficients = schedules.log_linear(
            spec.coefficient_rate, spec.coefficient_rate_end, self.steps
        )
        return MotionParams(coefficients(step), self.rate(step))

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the network, and coefficients without motion."""
        _, shared_key = jax.random.split(key)
        mean = gaussians.mean
        coefficients = _init_coefficients(self.spec, len(mean), mean.dtype)
        return MotionParams(coefficients, init(shared_key, self.spec))

    def apply(
        self,
        params: MotionParams,
        cache: None,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at a time."""
        trajectories = _at_time(params.shared, self.spec, self.extent, frame.time)
        return deform(trajectories, params.per_gaussian, gaussians)

    def loss(self, params: MotionParams, context: PenaltyContext) -> dict[str, Term]:
        """Compute the number of trajectories in use, after the warm-up."""
        if self.spec.sparsity is None:
            return {}
        active = splats.active_mask(context.params.rows["splats"])
        value = sparsity(params.per_gaussian, active)
        terms = {"sparsity": Term(value, self.spec.sparsity)}
        return from_step(self.spec.warm_up, context.step, terms)
