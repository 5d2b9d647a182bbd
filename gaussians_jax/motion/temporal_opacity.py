"""Gaussians that are visible during a part of the video only.

The temporal opacity of Spacetime Gaussians (Li et al. 2024, arXiv:2312.16812, equation
7 as readers quote it: the text was not at hand) by itself, beside any motion: what
turns its back on the camera need not be the same Gaussians as what it shows then, and a
track that is lost need not be found again. One that was lifted from a moving pixel is
first seen around the time of that picture, for about as long as tracks there were
followed; any other one all the time, until training finds a time for it.
"""

import dataclasses
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.fit import check_positive

NAME = "temporal_opacity"
# Of the width of the opacity over time, in films: from a ten-thousandth to longer than
# any. Outside it has no slope, and the quotient s / w stays finite.
LOG_WIDTH_RANGE = (-9.0, 9.0)
ALWAYS = LOG_WIDTH_RANGE[1] / 2  # 90 films: the least share of one film is 0.99997


@dataclasses.dataclass(frozen=True)
class TemporalOpacitySpec:
    """Initial duration of visibility, and its learning rates.

    `width` is relative to the duration of nearby tracks. 1/e of the opacity is left at
    that distance from the Gaussian's own time.
    """

    width: float = 0.5
    width_rate: float = 3e-2  # of the logarithm
    time_rate: float = 1e-3  # of the time of its own, in films

    def __post_init__(self):
        check_positive(**dataclasses.asdict(self))

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the part of a scene with these settings."""
        return Bound(self)


class Fading(NamedTuple):
    """When a Gaussian is to be seen."""

    time: Float[Array, " gaussians"]  # of its own, in films from the first frame
    log_width: Float[Array, " gaussians"]  # of films


def visible_share(
    since: Float[Array, "*gaussians"], log_width: Float[Array, "*gaussians"]
) -> Float[Array, "*gaussians"]:
    """Compute exp(-(s / w)^2) with w = exp(`log_width`).

    The paper's code has the same, and the paper writes exp(-c s^2) with c = 1 / w^2.
    Value and gradients are finite for any width. The published exponential of an
    unclamped width is 0/0 at s = 0 once the width has underflowed.

    Args:
      since: Time s from the Gaussian's own time, in units of the video.
      log_width: Logarithm of the width.

    Returns:
      Factors of the opacity.
    """
    held = jnp.clip(log_width, *LOG_WIDTH_RANGE)
    return jnp.exp(-jnp.square(since * jnp.exp(-held)))


def faded(rows: Fading, gaussians: Gaussians, time: Float[Array, ""]) -> Gaussians:
    """Gaussians with the share of their opacity that is left at a time in [0, 1]."""
    share = visible_share(time - rows.time, rows.log_width)
    return gaussians._replace(opacity=gaussians.opacity * share)


def always(gaussians: int, dtype) -> Fading:
    """Seen all the time."""
    own = jnp.full(gaussians, 0.5, dtype)
    return Fading(own, jnp.full(gaussians, ALWAYS, dtype))


def around(
    spec: TemporalOpacitySpec,
    time: Float[np.ndarray, " gaussians"],
    followed: Float[np.ndarray, " gaussians"],
) -> Fading:
    """Initialize visibility around a time, for as long as nearby tracks, on the host.

    Args:
      spec: Settings.
      time: Normalized times.
      followed: Durations of nearby tracks, in units of the video.

    Returns:
      Per-Gaussian parameters.
    """
    least = math.exp(LOG_WIDTH_RANGE[0])
    width = np.log(np.maximum(spec.width * followed, least))
    return Fading._make((time, width))


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Motion` of a `TemporalOpacitySpec`: it moves nothing, and fades."""

    spec: TemporalOpacitySpec

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of times and widths."""
        del step
        rates = jnp.full((), self.spec.time_rate), jnp.full((), self.spec.width_rate)
        return MotionParams(Fading(*rates))

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize Gaussians that are visible at all times."""
        mean = gaussians.mean
        return MotionParams(always(len(mean), mean.dtype))

    def apply(
        self,
        params: MotionParams,
        cache: None,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Fade the Gaussians at a time."""
        return faded(params.per_gaussian, gaussians, frame.time)

    def lifted_rows(
        self,
        time: Float[np.ndarray, " gaussians"],
        followed: Float[np.ndarray, " gaussians"],
    ) -> Fading:
        """Return the times and widths of Gaussians lifted from moving pixels."""
        return around(self.spec, time, followed)
