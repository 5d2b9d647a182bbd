"""Motion of each Gaussian as a polynomial in time, around a temporal center.

Spacetime Gaussians (Li et al. 2024, arXiv:2312.16812): a Gaussian has a temporal center
m, at which it is in its canonical state. At s = t - m its mean is displaced by a cubic
in s (equation 8, degree 3), its rotation changes linearly in s (equation 9, degree 1),
and its opacity is multiplied by exp(-(s / w)^2) (equation 7, `temporal_opacity`), with
a learned width w. There is no network, and nothing is shared. The paper itself was not
available: numbers are taken from papers that cite it, the rest from its code
(oppo-us-research/SpacetimeGaussians).

Differences: the rotation is a rotation vector, where the paper's quaternion is linear
in s. The temporal center also gets a gradient from the motion, which the published code
stops, so that only the opacity moves it. Colors from features (which depend on s in the
paper) and error-guided sampling are missing.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import Number, SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.init import motion_fit
from gaussians_jax.init.motion_fit import Guess, Paths
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
    """Settings of the temporal opacity, in units of the duration of the video.

    With a width of one, as published, 1/e of the opacity is left at a distance of one
    video. Temporal centers are initialized at random over the video. Without temporal
    opacity they are all in its middle.
    """

    width: float = 1.0
    width_rate: float = 3e-2  # of the logarithm
    time_rate: float = 1e-4  # of the temporal center, in videos

    def __post_init__(self):
        check_positive(**dataclasses.asdict(self))


@dataclasses.dataclass(frozen=True)
class PolynomialMotionSpec:
    """Degree and learning rates. Rates of means are relative to the scene's extent."""

    degree: int = 3
    fading: FadingSpec | None = FadingSpec()
    warm_up: int = steps(0)  # steps without motion
    learning_rate: float = 5e-4
    learning_rate_end: float = 5e-6
    turn_rate: float = 1e-3  # rad per video

    def __post_init__(self):
        if not 1 <= self.degree <= 8:
            raise ValueError(
                f"degree={self.degree} must be 1 to 8; for motions that a cubic cannot "
                "follow use a spline (SplineMotionSpec)"
            )
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        check_positive(turn_rate=self.turn_rate)
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.extent)


class Polynomials(NamedTuple):
    """Per-Gaussian parameters of the motion."""

    shift: Float[Array, "gaussians degree 3"]  # scene units per video^(1, 2, ...)
    turn: Float[Array, "gaussians 3"]  # rotation vector, rad per video, world axes
    fading: Fading | None


def init(key: Key[Array, ""], spec: PolynomialMotionSpec, gaussians: int, dtype):
    """Initialize coefficients without motion.

    Args:
      key: PRNG key of the temporal centers.
      spec: Settings.
      gaussians: Number of Gaussians.
      dtype: Floating-point type.

    Returns:
      Per-Gaussian parameters.
    """
    fading = None
    if spec.fading is not None:
        center = jax.random.uniform(key, (gaussians,), jnp.float32).astype(dtype)
        width = jnp.full(gaussians, math.log(spec.fading.width), dtype)
        fading = Fading(center, width)
    return Polynomials(
        jnp.zeros((gaussians, spec.degree, 3), dtype),
        jnp.zeros((gaussians, 3), dtype),
        fading,
    )


def deform(
    rows: Polynomials, gaussians: Gaussians, time: Float[Array, ""]
) -> Gaussians:
    """Move Gaussians to their state at a time, equations 7 to 9.

    Args:
      rows: Per-Gaussian parameters.
      gaussians: Gaussians in their canonical state.
      time: Normalized time in [0, 1].

    Returns:
      The Gaussians at that time.
    """
    center = 0.5 if rows.fading is None else rows.fading.time
    since = time - center
    # Horner's rule, because the gradient of a power is undefined at zero.
    shift = jnp.zeros_like(gaussians.mean)
    for degree in reversed(range(rows.shift.shape[1])):
        shift = (shift + rows.shift[:, degree]) * since[..., None]
    if rows.fading is not None:
        gaussians = temporal_opacity.faded(rows.fading, gaussians, time)
    return gaussians._replace(
        mean=gaussians.mean + shift,
        quaternion=splats.rotate(gaussians, rows.turn * since[..., None]),
    )


def fit_to_paths(spec: PolynomialMotionSpec, paths: Paths) -> Guess:
    """Fit each path by its own least squares, in closed form, with constant opacity.

    Args:
      spec: Settings.
      paths: The paths.

    Returns:
      The fit.
    """
    since = paths.times.astype(float) - 0.5
    powers = since[:, None] ** range(spec.degree + 1)
    coefficients = jnp.asarray(motion_fit.combination(powers, paths), jnp.float32)
    count = len(coefficients)
    fading = rate = None
    if spec.fading is not None:
        fading = temporal_opacity.always(count, jnp.float32)
        rate = 0.0
    rows = Polynomials(coefficients[:, 1:], jnp.zeros((count, 3), jnp.float32), fading)
    points = motion_fit.Points(coefficients[:, 0], rows, None)
    rates = Polynomials._make((paths.unit, 0.0, rate))
    return Guess(points, motion_fit.Points._make((paths.unit, rates, None, None)))


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `PolynomialMotionSpec` in a run of `steps`."""

    spec: PolynomialMotionSpec
    extent: Number  # of the scene, the unit of shifts, in scene units

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
        """Initialize coefficients without motion."""
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
        """Fit each path separately in closed form, to start a fit of all from."""
        return fit_to_paths(self.spec, paths)
