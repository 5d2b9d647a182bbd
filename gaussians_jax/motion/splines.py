"""Motion of each Gaussian along its own cubic spline.

SplineGS (Park et al. 2025, CVPR, arXiv:2412.09982), section 4.2, its motion-adaptive
spline (equations 3 and 4): control points at even times, and between them a cubic
Hermite polynomial whose slopes are those of the chord between the neighbors, which is
Catmull-Rom. Left open are the slopes at the ends, where a neighbor is missing (here
the end stands for it), and how many control points there are at first. All Gaussians
have as many here; the paper takes away those that hardly matter (equations 7 and 8). It
moves means; here turns have control points, too: rotation vectors, interpolated alike.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats, time_knots
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.init import path_fit
from gaussians_jax.init.path_fit import Guess, Paths, Points
from gaussians_jax.motion.bound import BoundMotion
from nerfies_jax.geometry.precision import exact_einsum
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.step_counts import steps

NAME = "spline_motion"


@dataclasses.dataclass(frozen=True)
class SplineMotionSpec:
    """Number and learning rates of control points, with shifts in scene extents."""

    knots: int = 12  # evenly over the film
    warm_up: int = steps(0)  # steps without motion
    learning_rate: float = 1e-3  # of turns (rad) and shifts
    learning_rate_end: float = 1e-5

    def __post_init__(self):
        if self.knots < 2:
            raise ValueError(
                f"knots={self.knots}: a motion has at least two, its first and its "
                "last instant"
            )
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.extent)


class Splines(NamedTuple):
    """Per-Gaussian parameters of the motion."""

    shift: Float[Array, "gaussians knots 3"]  # from the mean of its row, scene units
    turn: Float[Array, "gaussians knots 3"]  # rotation vectors, rad, in world axes


def init(spec: SplineMotionSpec, gaussians: int, dtype=jnp.float32) -> Splines:
    """Nothing moves yet."""
    zero = jnp.zeros((gaussians, spec.knots, 3), dtype)
    return Splines(zero, zero)


def deform(rows: Splines, gaussians: Gaussians, time: Float[Array, ""]) -> Gaussians:
    """Move Gaussians along their splines, with the time clamped to [0, 1].

    Equation 3, of shifts from the mean of the row.
    """
    weights = time_knots.spline_weights(rows.shift.shape[1], time)
    shift, turn = (exact_einsum("k,nkc->nc", weights, leaf) for leaf in rows)
    return gaussians._replace(
        mean=gaussians.mean + shift, quaternion=splats.turned(gaussians, turn)
    )


def fit_to_paths(spec: SplineMotionSpec, paths: Paths) -> Guess:
    """Each path by its own least squares (equation 6), in closed form."""
    weights = np.stack(
        [time_knots.spline_weights(spec.knots, jnp.asarray(t)) for t in paths.times]
    )
    fitted = path_fit.combination(weights, paths)
    mean = fitted.mean(axis=1)
    shift = jnp.asarray(fitted - mean[:, None], jnp.float32)
    rows = Splines(shift, jnp.zeros_like(shift))
    points = Points(jnp.asarray(mean, jnp.float32), rows, None)
    rates = Points._make((paths.unit, Splines._make((paths.unit, 0.0)), None, None))
    return Guess(points, rates)


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `SplineMotionSpec` in a run of `steps`."""

    spec: SplineMotionSpec
    extent: float  # of the scene, the unit of shifts, scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of the control points."""
        return MotionParams(Splines(self.extent * self.rate(step), self.rate(step)))

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize control points with which nothing moves."""
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
        """Return a closed-form fit of each path by itself, from which a fit starts."""
        return fit_to_paths(self.spec, paths)
