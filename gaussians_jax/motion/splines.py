"""Motion of each Gaussian along its own cubic spline.

SplineGS (Park et al. 2025, CVPR, arXiv:2412.09982), section 4.2, its motion-adaptive
spline (equations 3 and 4): control points at evenly spaced times, with cubic Hermite
interpolation whose tangents are the chords between the neighbors (Catmull-Rom). The
paper does not specify the tangents at the ends, where a neighbor is missing (here the
end point is repeated), and the initial number of control points. Here it is the same
for all Gaussians and constant, while the paper prunes control points (equations 7 and
8). The paper moves means only. Here rotation vectors are interpolated in the same way.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats, time_knots
from gaussians_jax.core.metadata import Number, SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.init import motion_fit
from gaussians_jax.init.motion_fit import Guess, Paths, Points
from gaussians_jax.motion.bound import BoundMotion
from nerfies_jax.geometry.precision import exact_einsum
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.step_counts import steps

NAME = "spline_motion"


@dataclasses.dataclass(frozen=True)
class SplineMotionSpec:
    """Settings of the splines. Learning rates of shifts are relative to the extent."""

    knots: int = 12  # evenly spaced over the video
    warm_up: int = steps(0)  # steps without motion
    learning_rate: float = 1e-3  # of rotations (rad) and shifts
    learning_rate_end: float = 1e-5

    def __post_init__(self):
        if self.knots < 2:
            raise ValueError(
                f"knots={self.knots} must be at least two, at the first and the last "
                "frame time"
            )
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.extent)


class Splines(NamedTuple):
    """Per-Gaussian parameters of the motion."""

    shift: Float[Array, "gaussians knots 3"]  # from the canonical mean, scene units
    turn: Float[Array, "gaussians knots 3"]  # rotation vectors, rad, in world axes


def init(
    spec: SplineMotionSpec, gaussians: int, dtype: DTypeLike = jnp.float32
) -> Splines:
    """Initialize control points without motion.

    Args:
      spec: Settings.
      gaussians: Number of Gaussians.
      dtype: Floating-point type.

    Returns:
      The control points.
    """
    zero = jnp.zeros((gaussians, spec.knots, 3), dtype)
    return Splines(zero, zero)


def deform(rows: Splines, gaussians: Gaussians, time: Float[Array, ""]) -> Gaussians:
    """Move Gaussians along their splines (equation 3).

    Args:
      rows: Control points.
      gaussians: Gaussians in their canonical state.
      time: Normalized time, clamped to [0, 1].

    Returns:
      The moved Gaussians.
    """
    weights = time_knots.spline_weights(rows.shift.shape[1], time)
    shift, turn = (exact_einsum("k,nkc->nc", weights, leaf) for leaf in rows)
    return gaussians._replace(
        mean=gaussians.mean + shift, quaternion=splats.rotate(gaussians, turn)
    )


def fit_to_paths(spec: SplineMotionSpec, paths: Paths) -> Guess:
    """Fit each path by its own least squares (equation 6), in closed form.

    Args:
      spec: Settings.
      paths: The paths.

    Returns:
      The fit.
    """
    weights = np.stack(
        [time_knots.spline_weights(spec.knots, jnp.asarray(t)) for t in paths.times]
    )
    coefficients = motion_fit.combination(weights, paths)
    mean = coefficients.mean(axis=1)
    shift = jnp.asarray(coefficients - mean[:, None], jnp.float32)
    rows = Splines(shift, jnp.zeros_like(shift))
    points = Points(jnp.asarray(mean, jnp.float32), rows, None)
    rates = Points._make((paths.unit, Splines._make((paths.unit, 0.0)), None, None))
    return Guess(points, rates)


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `SplineMotionSpec` in a run of `steps`."""

    spec: SplineMotionSpec
    extent: Number  # of the scene, the unit of shifts, in scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of the control points."""
        return MotionParams(Splines(self.extent * self.rate(step), self.rate(step)))

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize control points without motion."""
        mean = gaussians.mean
        return MotionParams(init(self.spec, len(mean), mean.dtype))

    def apply(
        self,
        params: MotionParams,
        cache: None,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at a time."""
        return deform(params.per_gaussian, gaussians, frame.time)

    def fit(self, paths: Paths, key: Key[Array, ""]) -> Guess:
        """Fit each path separately in closed form, to start a fit of all from."""
        return fit_to_paths(self.spec, paths)
