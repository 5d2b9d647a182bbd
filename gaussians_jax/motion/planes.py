"""Motion from planes over space and time (4DGS), decoded by a small network.

4DGS (Wu et al. 2024, arXiv:2310.08528): six planes at several resolutions are
interpolated at the canonical mean and the time (equation 7, the product over planes,
with levels concatenated), and a small network maps the features to residuals of mean,
rotation and scale (equation 8). Spatial planes are regularized to be smooth, and those
of time to be smooth and near one, as in K-Planes (`nn.planes`). The coarse stage
without motion is the `warm_up`. The paper itself was not available: numbers are taken
from a paper that cites it, the rest from its code (hustvl/4DGaussians).

Differences: the heads are linear layers of one network, where the code has a hidden
layer for each. Rotations are rotation vectors, where the code adds to quaternions. The
time uses all of its planes, where the published code uses the half above their middle.
`variation` is the total variation, where that code has second differences along one
axis.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core.metadata import Number, SceneMetadata, is_traced
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.motion.basis import Offsets, apply
from gaussians_jax.motion.bound import BoundMotion
from nerfies_jax.nn import mlp, planes
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.nn.planes import Level, PlanesSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import (
    FrameCondition,
    PenaltyContext,
    Term,
    from_step,
    total,
)
from nerfies_jax.training.step_counts import steps

NAME = "plane_motion"
Corner = tuple[Number, ...]  # of three coordinates
Features = Float[Array, "gaussians levels features"]


@dataclasses.dataclass(frozen=True)
class PlaneMotionSpec:
    """Settings of planes, network and regularization, with the sizes for HyperNeRF.

    Rates of planes do not depend on the scene's unit, and heads output scene extents.
    Weights are of sums over planes and levels. Zero disables a loss.
    """

    planes: PlanesSpec = PlanesSpec(timestamps=150)
    depth: int = 1
    width: int = 128
    variation: float = 2e-4  # weight of the total variation of spatial planes
    bend: float = 1e-3  # weight of second differences in time
    unrest: float = 1e-4  # weight of the distance of the time planes from one
    warm_up: int = steps(3000)  # steps without motion
    plane_rate: float = 1.6e-3
    plane_rate_end: float = 1.6e-4
    learning_rate: float = 1.6e-4  # of the network
    learning_rate_end: float = 1.6e-5

    def __post_init__(self):
        if self.planes.timestamps is None or self.planes.combination != "product":
            raise ValueError(
                "the planes of a motion need timestamps and a product, got timestamps="
                f"{self.planes.timestamps} and combination={self.planes.combination!r}"
            )
        for name in ("variation", "bend", "unrest"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name}={getattr(self, name)} must be finite and not negative"
                )
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        schedules.check_falling(self.plane_rate, self.plane_rate_end)
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        network_spec(self)  # validates the sizes

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.extent, metadata.box)


class Motion(NamedTuple):
    """Parameters of planes and network."""

    planes: tuple[Level, ...]
    network: MLP


def network_spec(spec: PlaneMotionSpec) -> MLPSpec:
    """Settings of the network from features to residuals, which are small at first.

    Args:
      spec: Settings of the motion.

    Returns:
      Settings of the network.
    """
    heads = tuple((name, HeadSpec(3, "small")) for name in Offsets._fields)
    inputs = spec.planes.width(4)
    return MLPSpec(inputs, spec.depth, spec.width, heads, (), "relu", "he")


# Forward and backward of 10,000 Gaussians on one core: 10 ms for the planes and 5 for
# the network. The paper's size takes 120 ms, and its regularization 12.
SMALL_PLANE_MOTION = PlaneMotionSpec(
    planes=PlanesSpec(vertices=32, multiples=(1, 2), timestamps=24, features=8),
    width=64,
    plane_rate_end=1.6e-5,
    learning_rate_end=1.6e-6,
)


def init(
    key: Key[Array, ""], spec: PlaneMotionSpec, dtype: DTypeLike = jnp.float32
) -> Motion:
    """Initialize planes and a network that hardly move anything.

    Args:
      key: PRNG key.
      spec: Settings of the motion.
      dtype: Type of the parameters.

    Returns:
      Parameters of the planes and the network.
    """
    planes_key, network_key = jax.random.split(key)
    return Motion(
        planes.init(spec.planes, planes_key, dtype),
        mlp.init(network_spec(spec), network_key, dtype),
    )


def _in_unit_cube(
    box: tuple[Corner, Corner], mean: Float[Array, "gaussians 3"]
) -> Float[Array, "gaussians 3"]:
    """Map means to the unit cube over a box."""
    low, high = (jnp.asarray(corner, mean.dtype) for corner in box)
    return (mean - low) / (high - low)


def prepare(
    params: Motion, spec: PlaneMotionSpec, position: Float[Array, "gaussians 3"]
) -> Features:
    """Interpolate the spatial planes, which do not depend on the time.

    Args:
      params: Parameters of the motion.
      spec: Settings of the motion.
      position: Positions in the unit cube of the planes.

    Returns:
      The features of each position.
    """
    return jax.vmap(
        lambda point: planes.space_features(spec.planes, params.planes, point)
    )(position)


def offsets(
    params: Motion,
    spec: PlaneMotionSpec,
    position: Float[Array, "gaussians 3"],
    time: Float[Array, ""],
    cached: Features,
) -> Offsets:
    """Evaluate the residuals of Gaussians at a time.

    Args:
      params: Shared parameters.
      spec: Settings.
      position: Positions in the unit cube.
      time: Normalized time.
      cached: Result of `prepare` for the same positions.

    Returns:
      Residuals, those of means in scene extents.
    """
    lines = planes.at_time(params.planes, time)

    def features(point, space):
        time_features = planes.time_features(spec.planes, lines, point)
        return planes.features(spec.planes, space, time_features)

    plane_features = jax.vmap(features)(position, cached)
    return Offsets(**mlp.apply(network_spec(spec), params.network, plane_features))


def smoothness(spec: PlaneMotionSpec, levels: tuple[Level, ...]) -> dict[str, Term]:
    """Compute the total variation in space, and smoothness and sparsity in time.

    A term of weight zero is not computed.

    Args:
      spec: Settings.
      levels: The planes.

    Returns:
      The terms by name.
    """
    space = [plane for level in levels for plane in level.space]
    time = [plane for level in levels for plane in level.time]
    losses = {
        "variation": (planes.total_variation, space, spec.variation),
        "bend": (planes.time_smoothness, time, spec.bend),
        "unrest": (planes.l1_time_planes, time, spec.unrest),
    }
    return {
        name: Term(total(map(loss, planes_of)), weight)
        for name, (loss, planes_of, weight) in losses.items()
        if weight > 0
    }


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `PlaneMotionSpec` in a run of `steps`.

    `box` is the minimum and maximum corner of the volume of the planes, scene units.
    """

    spec: PlaneMotionSpec
    extent: Number  # of the scene, the unit of shifts, in scene units
    box: tuple[Corner, Corner] | None

    name = NAME

    def __post_init__(self):
        if is_traced(self.box):
            return
        if self.box is None or not np.all(np.less(*self.box)):
            raise ValueError(
                f"the planes of a motion need a bounding box, got box={self.box}; pass "
                "the minimum and maximum corner to SceneMetadata, as scene.metadata_of "
                "does"
            )

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of the planes and of the network."""
        first, last = self.spec.plane_rate, self.spec.plane_rate_end
        planes = schedules.log_linear(first, last, self.steps)(step)
        return MotionParams(shared=Motion._make((planes, self.rate(step))))

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the planes and the network."""
        _, shared_key = jax.random.split(key)
        return MotionParams(shared=init(shared_key, self.spec))

    def precompute(self, params: MotionParams, gaussians: Splats) -> Features:
        """Interpolate the spatial planes."""
        assert self.box is not None
        return prepare(
            params.shared, self.spec, _in_unit_cube(self.box, gaussians.mean)
        )

    def apply(
        self,
        params: MotionParams,
        cache: Features,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at a time."""
        assert self.box is not None
        position = _in_unit_cube(self.box, gaussians.mean)
        residuals = offsets(params.shared, self.spec, position, frame.time, cache)
        return apply(gaussians, residuals._replace(mean=self.extent * residuals.mean))

    def loss(self, params: MotionParams, context: PenaltyContext) -> dict[str, Term]:
        """Compute the regularization of the planes, after the warm-up."""
        terms = smoothness(self.spec, params.shared.planes)
        return from_step(self.spec.warm_up, context.step, terms)
