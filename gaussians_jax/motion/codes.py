"""Embeddings of Gaussians and time codes that motions read, and their regularization.

Bae et al. 2024, "Per-Gaussian embedding-based deformation", arXiv:2404.03613 (E-D3DGS),
section 3.3, with the numbers of its code. Two networks read one table of time codes:
the coarse one resamples it to a fifth of its codes, the fine one to a growing number of
codes, so that slow motion is learned before fast motion.
"""

import dataclasses
import math
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Params
from gaussians_jax.motion.bound import BoundMotion
from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.nn import codes
from nerfies_jax.training.effects import PenaltyContext, Term, from_step


@runtime_checkable
class Codes(Protocol):
    """Settings of a motion that time codes depend on."""

    @property
    def embedding(self) -> int:
        """Size of the embedding of a Gaussian."""

    @property
    def time_code(self) -> int:
        """Size of a time code."""

    @property
    def frames_per_code(self) -> int:
        """Number of frames per time code."""

    @property
    def spread(self) -> float:
        """Standard deviation of the initial codes."""

    @property
    def waves(self) -> float | None:
        """Frequency of the initial codes in space and time. None: independent."""

    @property
    def coarser(self) -> int | None:
        """Ratio of fine to coarse time codes. None: no coarse network."""

    @property
    def grow_until(self) -> int:
        """Step from which the fine network reads all codes."""

    @property
    def smoothness(self) -> float:
        """Weight of `second_differences`, 0 to disable it."""

    @property
    def opacity(self) -> float:
        """Weight of `mean_opacity`, 0 to disable it."""

    @property
    def warm_up(self) -> int:
        """Number of steps without motion."""


def code_count(spec: Codes, frames: int) -> int:
    """Return the number of time codes for a number of training frames.

    Args:
      spec: Settings of the codes.
      frames: Number of training frames.

    Returns:
      Number of codes.
    """
    return -(-frames // spec.frames_per_code)


def init_embedding(
    key: Key[Array, ""],
    spec: Codes,
    mean: Float[Array, "gaussians 3"],
) -> Float[Array, "gaussians embedding"]:
    """Initialize an embedding for each Gaussian, of standard deviation `spec.spread`.

    Values are independent and normal. With `spec.waves` they are cosines of random
    direction, frequency and phase over the positions (random Fourier features, Rahimi
    and Recht 2007). Nearby Gaussians then have similar embeddings, and the gradient of
    one Gaussian in one frame moves those around it.

    Args:
      key: PRNG key.
      spec: Settings.
      mean: Means of the Gaussians.

    Returns:
      The embeddings.
    """
    if spec.waves is None:
        noise = jax.random.normal(key, (mean.shape[0], spec.embedding), jnp.float32)
        return spec.spread * noise.astype(mean.dtype)
    centered_mean = mean - jnp.mean(mean, axis=0)
    radius_sq = jnp.mean(jnp.sum(centered_mean**2, axis=1))
    # A single position has the phase of the center.
    unit = centered_mean / jnp.sqrt(jnp.where(radius_sq > 0, radius_sq, 1))
    return _random_waves(key, spec, unit, spec.embedding)


def _random_waves(key, spec, positions, width):
    """Return cosines [places, width] of random direction, frequency and phase."""
    wave_key, phase_key = jax.random.split(key)
    shape = positions.shape[1], width
    waves = spec.waves * jax.random.normal(wave_key, shape, jnp.float32)
    phase = jax.random.uniform(phase_key, (width,), jnp.float32, 0, 2 * jnp.pi)
    angle = exact_product(positions, waves.astype(positions.dtype))
    angle = angle + phase.astype(positions.dtype)
    return spec.spread * math.sqrt(2) * jnp.cos(angle)


def init_times(
    key: Key[Array, ""], spec: Codes, frames: int, dtype: DTypeLike = jnp.float32
) -> Float[Array, "times code"]:
    """Initialize the table of time codes like the embeddings.

    Args:
      key: PRNG key.
      spec: Settings.
      frames: Number of training frames.
      dtype: Floating-point type.

    Returns:
      The table.
    """
    if frames < 1:
        raise ValueError(f"frames={frames}: a motion needs at least one training frame")
    count = code_count(spec, frames)
    if spec.waves is None:
        scale = math.sqrt(3) * spec.spread  # bound of a uniform distribution
        return codes.init(key, count, spec.time_code, scale, dtype)
    # [-2, 2] has about the spread of the positions, whose mean square distance is one.
    time = jnp.linspace(-2, 2, count, dtype=dtype)[:, None]
    return _random_waves(key, spec, time, spec.time_code)


def coarse_rows(spec: Codes, count: int) -> int:
    """Compute the number of codes of the coarse network, and of the fine one at first.

    Args:
      spec: Settings.
      count: Size of the table.

    Returns:
      At least two, or all of a smaller table.
    """
    return min(count, max(2, -(-count // (spec.coarser or 1))))


def fine_rows(spec: Codes, count: int, step: int) -> int:
    """Compute the number of codes of the fine network after some steps, on the host.

    Args:
      spec: Settings.
      count: Size of the table.
      step: Number of steps.

    Returns:
      Number of codes.
    """
    least = coarse_rows(spec, count)
    if step >= spec.grow_until:
        return count
    return least + (count - least) * step // spec.grow_until


def growth_steps(spec: Codes, count: int) -> tuple[int, ...]:
    """Return the steps after which the number of codes of the fine network changes.

    Args:
      spec: Settings of the codes.
      count: Number of codes at the end.

    Returns:
      Numbers of completed steps, sorted.
    """
    counts = [fine_rows(spec, count, step) for step in range(spec.grow_until + 1)]
    return tuple(k for k in range(1, len(counts)) if counts[k] != counts[k - 1])


def revised(spec: Codes, shared: Any, step: int) -> Any:
    """Return shared parameters with the number of codes of the fine network.

    Args:
      spec: Settings of the codes.
      shared: Shared parameters of the motion.
      step: Number of completed steps.

    Returns:
      The parameters.
    """
    count = fine_rows(spec, len(shared.times), step)
    return shared._replace(rows=jnp.full_like(shared.rows, count))


def read(
    spec: Codes,
    times: Float[Array, "times code"],
    rows: Float[Array, "1"],
    time: Float[Array, ""],
) -> tuple[Float[Array, " code"], Float[Array, " code"]]:
    """Interpolate the time codes of the coarse and of the fine network.

    Args:
      spec: Settings.
      times: Table of codes.
      rows: Number of codes to which the fine network resamples the table. It gets no
        gradient.
      time: Normalized time.

    Returns:
      The coarse and the fine code.
    """
    least = jnp.asarray(coarse_rows(spec, times.shape[0]), time.dtype)
    counts = (least, jax.lax.stop_gradient(rows[0]))
    coarse, fine = (codes.at_time_of(times, count, time) for count in counts)
    return coarse, fine


def second_differences(times: Float[Array, "times code"]) -> Float[Array, ""]:
    """Compute the mean square of second differences between consecutive codes.

    Args:
      times: Table of codes.

    Returns:
      The mean, 0 for fewer than three codes.
    """
    if times.shape[0] < 3:
        return jnp.zeros((), times.dtype)
    return jnp.mean(jnp.square(jnp.diff(times, 2, axis=0)))


def mean_opacity(params: Params) -> Float[Array, ""]:
    """Compute the mean opacity of the active Gaussians, 0 without any.

    Args:
      params: Trained parameters.

    Returns:
      The mean.
    """
    rows = params.rows["splats"]
    active = splats.active_mask(rows)
    opacity = jnp.where(active, splats.activate(rows).opacity, 0)
    return jnp.sum(opacity) / jnp.maximum(jnp.sum(active), 1).astype(opacity.dtype)


def penalty(
    spec: Codes, times: Float[Array, "times code"], context: PenaltyContext
) -> dict[str, Term]:
    """Compute the losses of the codes: `smoothness` after the warm-up, and `opacity`.

    A term of weight zero is not computed.

    Args:
      spec: Settings.
      times: Table of codes.
      context: Context of the step.

    Returns:
      The terms by name.
    """
    terms: dict[str, Term] = {}
    if spec.smoothness > 0:
        bend = {"smoothness": Term(second_differences(times), spec.smoothness)}
        terms |= from_step(spec.warm_up, context.step, bend)
    if spec.opacity > 0:
        terms["opacity"] = Term(mean_opacity(context.params), spec.opacity)
    return terms


@dataclasses.dataclass(frozen=True)
class BoundCodes(BoundMotion):
    """Base of the motions that read embeddings and time codes.

    Attributes:
      frames: Number of training frames.
    """

    frames: int

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of embeddings, and of networks and time codes."""
        return MotionParams(jnp.full((), self.spec.embedding_rate), self.rate(step))

    def loss(self, params: MotionParams, context: PenaltyContext) -> dict[str, Term]:
        """Compute the smoothness of time codes, and the mean opacity."""
        return penalty(self.spec, params.shared.times, context)

    @property
    def project_steps(self) -> tuple[int, ...]:
        """Steps after which the fine network reads more time codes."""
        if self.spec.coarser is None:
            return ()
        return growth_steps(self.spec, code_count(self.spec, self.frames))

    def project(self, shared: Any, step: int) -> Any:
        """Return the shared parameters with the number of codes from a step on."""
        return revised(self.spec, shared, step)
