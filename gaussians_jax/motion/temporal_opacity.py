"""Gaussians that are visible during a part of the video only.

The temporal opacity of Spacetime Gaussians (Li et al. 2024, arXiv:2312.16812, equation
7 as cited by others, because the paper was not available), combined with any motion. It
allows a surface that turns away and its other side to be different Gaussians, and a
track that is lost to continue as a new one. A Gaussian lifted from a moving pixel is
initially visible around the time of that frame, for as long as nearby tracks last. Any
other Gaussian is always visible until training changes its time.
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
# Range of the logarithm of the width, in videos. Outside there is no gradient, and the
# quotient s / w stays finite.
LOG_WIDTH_RANGE = (-9.0, 9.0)
ALWAYS = LOG_WIDTH_RANGE[1] / 2  # 90 videos: opacities are at least 0.99997 of theirs


@dataclasses.dataclass(frozen=True)
class TemporalOpacitySpec:
    """Initial duration of visibility, and its learning rates.

    `width` is relative to the duration of nearby tracks. At that distance from the
    temporal center, 1/e of the opacity is left.
    """

    width: float = 0.5
    width_rate: float = 3e-2  # of the logarithm
    time_rate: float = 1e-3  # of the temporal center, in videos

    def __post_init__(self):
        check_positive(**dataclasses.asdict(self))

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the component of a scene with these settings."""
        return Bound(self)


class Fading(NamedTuple):
    """Temporal center and width of the opacity of each Gaussian."""

    time: Float[Array, " gaussians"]  # temporal center, in videos from the first frame
    log_width: Float[Array, " gaussians"]  # width in videos


def visible_share(
    since: Float[Array, "*gaussians"], log_width: Float[Array, "*gaussians"]
) -> Float[Array, "*gaussians"]:
    """Compute exp(-(s / w)^2) with w = exp(`log_width`).

    The paper's code is the same, and the paper writes exp(-c s^2) with c = 1 / w^2.
    Values and gradients are finite for any width. The published exponential of an
    unclamped width is 0/0 at s = 0 once the width underflows.

    Args:
      since: Time s since the temporal center, in units of the video.
      log_width: Logarithm of the width.

    Returns:
      Factors of the opacity.
    """
    clamped_log_width = jnp.clip(log_width, *LOG_WIDTH_RANGE)
    return jnp.exp(-jnp.square(since * jnp.exp(-clamped_log_width)))


def faded(rows: Fading, gaussians: Gaussians, time: Float[Array, ""]) -> Gaussians:
    """Multiply opacities by `visible_share` at a time.

    Args:
      rows: Temporal centers and widths.
      gaussians: The Gaussians.
      time: Normalized time in [0, 1].

    Returns:
      The Gaussians with the opacity at that time.
    """
    share = visible_share(time - rows.time, rows.log_width)
    return gaussians._replace(opacity=gaussians.opacity * share)


def always(gaussians: int, dtype) -> Fading:
    """Return parameters of Gaussians that are visible at all times.

    Args:
      gaussians: Number of Gaussians.
      dtype: Type of the parameters.

    Returns:
      Centers and logarithms of widths.
    """
    center = jnp.full(gaussians, 0.5, dtype)
    return Fading(center, jnp.full(gaussians, ALWAYS, dtype))


def _around(
    spec: TemporalOpacitySpec,
    time: Float[np.ndarray, " gaussians"],
    visibility: Float[np.ndarray, " gaussians"],
) -> Fading:
    """Initialize visibility around a time, as long as nearby tracks, on the host."""
    least = math.exp(LOG_WIDTH_RANGE[0])
    width = np.log(np.maximum(spec.width * visibility, least))
    return Fading._make((time, width))


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Motion` of a `TemporalOpacitySpec`, which changes opacities only."""

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
        """Multiply the opacities by their value at a time."""
        return faded(params.per_gaussian, gaussians, frame.time)

    def lifted_rows(
        self,
        time: Float[np.ndarray, " gaussians"],
        followed: Float[np.ndarray, " gaussians"],
    ) -> Fading:
        """Return the times and widths of Gaussians lifted from moving pixels.

        Args:
          time: Time at which each Gaussian was lifted, in [0, 1].
          followed: Share of the video in which nearby tracks are visible.

        Returns:
          Parameters of the Gaussians, on the host.
        """
        return _around(self.spec, time, followed)
