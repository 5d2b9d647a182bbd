"""Motion of each Gaussian as a polynomial in time, about a time of its own.

Spacetime Gaussians (Li et al. 2024, arXiv:2312.16812): a Gaussian has a time of its own
m, at which it is where its row says; s = t - m later its mean is off by a cubic in s
(equation 8, degree 3), its rotation by a turn that grows with s (equation 9, degree 1),
and its opacity is exp(-(s / w)^2) of its own (equation 7, `temporal_opacity`), with a
width w that is learned. No network, and nothing shared. The text was not at hand: the
numbers are those of readers who quote it, the rest is as in its code
(oppo-us-research/SpacetimeGaussians).

The turn is a rotation vector, where the paper's quaternion grows linearly. The time of
its own learns from motion as well, where the published code cuts that slope and lets
opacity alone move it. Colors from features (there they too change with s) and sampling
where errors are large are not there.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.init import path_fit
from gaussians_jax.init.path_fit import Guess, Paths
from gaussians_jax.motion import temporal_opacity
from gaussians_jax.motion.bound import BoundMotion
from gaussians_jax.motion.temporal_opacity import Fading
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.fit import check_positive
from nerfies_jax.training.step_counts import steps

NAME = "polynomial_motion"


@dataclasses.dataclass(frozen=True)
class FadingSpec:
    """Opacity over time, with the initial width in units of the video.

    One film of width leaves 1/e of the opacity at its far end: the published start.
    Times of their own are drawn over the film; without fading all are its middle.
    """

    width: float = 1.0
    width_rate: float = 3e-2  # of the logarithm
    time_rate: float = 1e-4  # of the time of its own, in films

    def __post_init__(self):
        check_positive(**dataclasses.asdict(self))


@dataclasses.dataclass(frozen=True)
class PolynomialMotionSpec:
    """Degree and learning rates. Rates of means are in scene extents."""

    degree: int = 3
    fading: FadingSpec | None = FadingSpec()
    warm_up: int = steps(0)  # steps without motion
    learning_rate: float = 5e-4
    learning_rate_end: float = 5e-6
    turn_rate: float = 1e-3  # rad for each film

    def __post_init__(self):
        if not 1 <= self.degree <= 8:
            raise ValueError(
                f"degree={self.degree} must be 1 to 8; what a cubic cannot follow "
                "takes a spline (SplineMotionSpec)"
            )
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        check_positive(turn_rate=self.turn_rate)
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.extent)


class Polynomials(NamedTuple):
    """Per-Gaussian parameters of the motion."""

    shift: Float[Array, "gaussians degree 3"]  # scene units a film, a film squared, ...
    turn: Float[Array, "gaussians 3"]  # rotation vector, rad a film, in world axes
    fading: Fading | None


def init(key: Key[Array, ""], spec: PolynomialMotionSpec, gaussians: int, dtype):
    """Nothing moves yet."""
    fading = None
    if spec.fading is not None:
        drawn = jax.random.uniform(key, (gaussians,), jnp.float32).astype(dtype)
        width = jnp.full(gaussians, math.log(spec.fading.width), dtype)
        fading = Fading(drawn, width)
    return Polynomials(
        jnp.zeros((gaussians, spec.degree, 3), dtype),
        jnp.zeros((gaussians, 3), dtype),
        fading,
    )


def deform(
    rows: Polynomials, gaussians: Gaussians, time: Float[Array, ""]
) -> Gaussians:
    """Gaussians as they are at one time in [0, 1]: equations 7 to 9."""
    own = 0.5 if rows.fading is None else rows.fading.time
    since = time - own
    # Horner's rule, without powers: a power has no slope of its own at zero.
    shift = jnp.zeros_like(gaussians.mean)
    for degree in reversed(range(rows.shift.shape[1])):
        shift = (shift + rows.shift[:, degree]) * since[..., None]
    if rows.fading is not None:
        gaussians = temporal_opacity.faded(rows.fading, gaussians, time)
    return gaussians._replace(
        mean=gaussians.mean + shift,
        quaternion=splats.turned(gaussians, rows.turn * since[..., None]),
    )


def fit_to_paths(spec: PolynomialMotionSpec, paths: Paths) -> Guess:
    """Each path by its own least squares, in closed form, to be seen all the time."""
    since = paths.times.astype(float) - 0.5
    powers = since[:, None] ** range(spec.degree + 1)
    fitted = jnp.asarray(path_fit.combination(powers, paths), jnp.float32)
    count = len(fitted)
    fading = rate = None
    if spec.fading is not None:
        fading = temporal_opacity.always(count, jnp.float32)
        rate = 0.0
    rows = Polynomials(fitted[:, 1:], jnp.zeros((count, 3), jnp.float32), fading)
    points = path_fit.Points(fitted[:, 0], rows, None)
    rates = Polynomials._make((paths.unit, 0.0, rate))
    return Guess(points, path_fit.Points._make((paths.unit, rates, None, None)))


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `PolynomialMotionSpec` in a run of `steps`."""

    spec: PolynomialMotionSpec
    extent: float  # of the scene, the unit of shifts, scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of the coefficients."""
        spec, fading = self.spec, None
        if spec.fading is not None:
            fading = Fading._make((spec.fading.time_rate, spec.fading.width_rate))
        rates = self.extent * self.rate(step), spec.turn_rate, fading
        rows = Polynomials._make(rates)
        return MotionParams(rows)

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize coefficients with which nothing moves."""
        rows_key, _ = jax.random.split(key)
        mean = gaussians.mean
        return MotionParams(init(rows_key, self.spec, len(mean), mean.dtype))

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
