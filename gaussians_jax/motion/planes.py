"""Motion from planes over space and time (4DGS), decoded by a small network.

4DGS (Wu et al. 2024, arXiv:2310.08528): six planes at several resolutions are read at
the canonical mean and the time (equation 7, the product over planes, levels side by
side), and a small network makes of the features how far mean, rotation and scale are
from their canonical values (equation 8). Planes of space are kept smooth, those of time
steady and near one, as in K-Planes (`nets.planes`). Its coarse stage, in which nothing
moves, is the `warm_up`. The text was not at hand: the numbers are those of a reader who
quotes it, the rest is as in its code (hustvl/4DGaussians).

As there but for: the heads are linear read-outs of one network, there each has a hidden
layer of its own; turns are rotation vectors, there they are added to the quaternion;
the time has all of its planes, of which the published code uses the half above their
middle; and `variation` is the total variation, where that code has second differences
along one axis.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core.metadata import SceneMetadata
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
Corner = tuple[float, ...]  # of three coordinates
Features = Float[Array, "gaussians levels features"]


@dataclasses.dataclass(frozen=True)
class PlaneMotionSpec:
    """Planes, network, and regularization of the planes, with the sizes for HyperNeRF
    scenes.

    Rates of planes do not depend on the scene's unit, heads answer in its extents.
    Weights are of the sums over planes and levels; zero leaves a term out.
    """

    planes: PlanesSpec = PlanesSpec(moments=150)
    depth: int = 1
    width: int = 128
    variation: float = 2e-4  # weight, planes of space
    bend: float = 1e-3  # weight, planes of time
    unrest: float = 1e-4  # weight, planes of time
    warm_up: int = steps(3000)  # steps without motion
    plane_rate: float = 1.6e-3
    plane_rate_end: float = 1.6e-4
    learning_rate: float = 1.6e-4  # of the network
    learning_rate_end: float = 1.6e-5

    def __post_init__(self):
        if self.planes.moments is None or self.planes.combination != "product":
            raise ValueError(
                "a motion takes planes with moments that are multiplied, got moments="
                f"{self.planes.moments} and {self.planes.combination!r}"
            )
        for name in ("variation", "bend", "unrest"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name}={getattr(self, name)} is a weight, finite and not negative"
                )
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        schedules.check_falling(self.plane_rate, self.plane_rate_end)
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        network_spec(self)  # checks its sizes

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.extent, metadata.box)


class Motion(NamedTuple):
    """Parameters of the field."""

    planes: tuple[Level, ...]
    network: MLP


def network_spec(spec: PlaneMotionSpec) -> MLPSpec:
    """From the features of a place at a time to the offsets, small at first."""
    heads = tuple((name, HeadSpec(3, "small")) for name in Offsets._fields)
    inputs = spec.planes.width(4)
    return MLPSpec(inputs, spec.depth, spec.width, heads, (), "relu", "he")


# One core, forward and backward, 10,000 Gaussians: 10 ms to read the planes and 5 for
# the network; 120 ms for the paper's size, and 12 for its penalties.
SMALL_PLANE_MOTION = PlaneMotionSpec(
    planes=PlanesSpec(vertices=32, multiples=(1, 2), moments=24, features=8),
    width=64,
    plane_rate_end=1.6e-5,
    learning_rate_end=1.6e-6,
)


def init(key: Key[Array, ""], spec: PlaneMotionSpec, dtype=jnp.float32) -> Motion:
    """A field that hardly moves anything yet."""
    planes_key, network_key = jax.random.split(key)
    return Motion(
        planes.init(spec.planes, planes_key, dtype),
        mlp.init(network_spec(spec), network_key, dtype),
    )


def places(
    box: tuple[Corner, Corner], mean: Float[Array, "gaussians 3"]
) -> Float[Array, "gaussians 3"]:
    """Means in the unit cube over the box (its low and its high corner)."""
    low, high = (jnp.asarray(corner, mean.dtype) for corner in box)
    return (mean - low) / (high - low)


def prepare(
    params: Motion, spec: PlaneMotionSpec, place: Float[Array, "gaussians 3"]
) -> Features:
    """Read the spatial planes, which do not depend on the time."""
    return jax.vmap(lambda one: planes.space_features(spec.planes, params.planes, one))(
        place
    )


def offsets(
    params: Motion,
    spec: PlaneMotionSpec,
    place: Float[Array, "gaussians 3"],
    time: Float[Array, ""],
    ready: Features,
) -> Offsets:
    """Compute the offsets of Gaussians at a time.

    Args:
      params: Shared parameters.
      spec: Settings.
      place: Positions in the unit cube.
      time: Normalized time.
      ready: Result of `prepare` for the same positions.

    Returns:
      Offsets, those of means in scene extents.
    """
    lines = planes.at_time(params.planes, time)

    def features(one, space):
        now = planes.time_features(spec.planes, lines, one)
        return planes.features(spec.planes, space, now)

    encoded = jax.vmap(features)(place, ready)
    return Offsets(**mlp.apply(network_spec(spec), params.network, encoded))


def smoothness(spec: PlaneMotionSpec, levels: tuple[Level, ...]) -> dict[str, Term]:
    """Total variation in space, steadiness in time, and how far time is from one.

    A term of weight zero is not computed.
    """
    space = [plane for level in levels for plane in level.space]
    time = [plane for level in levels for plane in level.time]
    asked = {
        "variation": (planes.total_variation, space, spec.variation),
        "bend": (planes.time_smoothness, time, spec.bend),
        "unrest": (planes.l1_time_planes, time, spec.unrest),
    }
    return {
        name: Term(total(map(of_one, every)), weight)
        for name, (of_one, every, weight) in asked.items()
        if weight > 0
    }


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `PlaneMotionSpec` in a run of `steps`.

    `box` is the low and the high corner of the volume of the planes, scene units.
    """

    spec: PlaneMotionSpec
    extent: float  # of the scene, the unit of shifts, scene units
    box: tuple[Corner, Corner] | None

    name = NAME

    def __post_init__(self):
        if self.box is None or not all(
            low < high for low, high in zip(*self.box, strict=True)
        ):
            raise ValueError(
                f"the planes of a motion lie in a box of the scene, got box={self.box};"
                " give SceneMetadata its low and its high corner, as scene.metadata_of "
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
        """Read the planes of space."""
        assert self.box is not None
        return prepare(params.shared, self.spec, places(self.box, gaussians.mean))

    def apply(
        self,
        params: MotionParams,
        cache: Features,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at a time."""
        assert self.box is not None
        place = places(self.box, gaussians.mean)
        off = offsets(params.shared, self.spec, place, frame.time, cache)
        return apply(gaussians, off._replace(mean=self.extent * off.mean))

    def loss(self, params: MotionParams, context: PenaltyContext) -> dict[str, Term]:
        """Compute the smoothness of the planes, once the motion has begun."""
        terms = smoothness(self.spec, params.shared.planes)
        return from_step(self.spec.warm_up, context.step, terms)
