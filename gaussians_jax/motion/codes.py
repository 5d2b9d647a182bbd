"""Codes of Gaussians and of time that motions read, and what holds them in check.

Bae et al. 2024, "Per-Gaussian embedding-based deformation", arXiv:2404.03613 (E-D3DGS),
section 3.3, with the numbers of its code. Two networks read one table of codes over
time: a coarse one as if it had a fifth of its rows, a fine one with ever more of them,
so that slow motion is found before fast motion.
"""

import dataclasses
import math
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
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
        """Numbers in the code of a Gaussian."""

    @property
    def time_code(self) -> int:
        """Numbers in the code of a moment."""

    @property
    def frames_per_code(self) -> int:
        """A table has one code for so many frames."""

    @property
    def spread(self) -> float:
        """Standard deviation of the first codes."""

    @property
    def waves(self) -> float | None:
        """Frequencies of the initial codes over space and time; None for independent
        ones.
        """

    @property
    def coarser(self) -> int | None:
        """Ratio of fine to coarse time codes; None without a coarse network."""

    @property
    def grow_until(self) -> int:
        """The step from which the fine network reads all rows."""

    @property
    def smoothness(self) -> float:
        """Weight of `second_differences`, 0 without it."""

    @property
    def opacity(self) -> float:
        """Weight of `mean_opacity`, 0 without it."""

    @property
    def warm_up(self) -> int:
        """Steps without motion."""


def moments(spec: Codes, frames: int) -> int:
    """Codes in the table of a capture of so many frames to learn from."""
    return -(-frames // spec.frames_per_code)


def init_embedding(
    key: Key[Array, ""],
    spec: Codes,
    mean: Float[Array, "gaussians 3"],
) -> Float[Array, "gaussians embedding"]:
    """A code for each Gaussian, of standard deviation `spec.spread`.

    Independent normal draws, or with `spec.waves` cosines of random direction, length
    and phase over the positions (random Fourier features, Rahimi and Recht 2007): then
    Gaussians that are near each other start alike, and what one frame says of one
    Gaussian moves those around it.
    """
    if spec.waves is None:
        drawn = jax.random.normal(key, (mean.shape[0], spec.embedding), jnp.float32)
        return spec.spread * drawn.astype(mean.dtype)
    centered = mean - jnp.mean(mean, axis=0)
    radius_sq = jnp.mean(jnp.sum(centered**2, axis=1))
    # One Gaussian, or all in one place: every code is that of the middle.
    unit = centered / jnp.sqrt(jnp.where(radius_sq > 0, radius_sq, 1))
    return _random_waves(key, spec, unit, spec.embedding)


def _random_waves(key, spec, places, width):
    """[places, width] cosines of random direction, length and phase over the places."""
    wave_key, phase_key = jax.random.split(key)
    shape = places.shape[1], width
    waves = spec.waves * jax.random.normal(wave_key, shape, jnp.float32)
    phase = jax.random.uniform(phase_key, (width,), jnp.float32, 0, 2 * jnp.pi)
    angle = exact_product(places, waves.astype(places.dtype))
    angle = angle + phase.astype(places.dtype)
    return spec.spread * math.sqrt(2) * jnp.cos(angle)


def init_times(
    key: Key[Array, ""], spec: Codes, frames: int, dtype=jnp.float32
) -> Float[Array, "moments code"]:
    """The table of codes over time, started as the embeddings are."""
    if frames < 1:
        raise ValueError(
            f"frames={frames}: a motion is learned from at least one frame"
        )
    count = moments(spec, frames)
    if spec.waves is None:
        scale = math.sqrt(3) * spec.spread  # of a uniform draw
        return codes.init(key, count, spec.time_code, scale, dtype)
    # Half the capture is to a moment what the mean radius is to a place.
    moment = jnp.linspace(-2, 2, count, dtype=dtype)[:, None]
    return _random_waves(key, spec, moment, spec.time_code)


def coarse_rows(spec: Codes, count: int) -> int:
    """Compute the number of codes that the coarse network reads, and the fine one at
    first.

    Args:
      spec: Settings.
      count: Size of the table.

    Returns:
      At least two, or all of a smaller table.
    """
    return min(count, max(2, -(-count // (spec.coarser or 1))))


def fine_rows(spec: Codes, count: int, step: int) -> int:
    """Compute the number of codes that the fine network reads after some steps, on the
    host.

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
    """After which steps that number is another one."""
    reads = [fine_rows(spec, count, step) for step in range(spec.grow_until + 1)]
    return tuple(k for k in range(1, len(reads)) if reads[k] != reads[k - 1])


def revised(spec: Codes, own: Any, step: int) -> Any:
    """A motion's parameters with the `rows` that its fine network reads from a step."""
    count = fine_rows(spec, len(own.times), step)
    return own._replace(rows=jnp.full_like(own.rows, count))


def read(
    spec: Codes,
    times: Float[Array, "moments code"],
    rows: Float[Array, "1"],
    time: Float[Array, ""],
) -> tuple[Float[Array, " code"], Float[Array, " code"]]:
    """The code at a time for the coarse network, and for the fine one.

    That reads the table as if it had `rows`, which no slope reaches.
    """
    least = jnp.asarray(coarse_rows(spec, times.shape[0]), time.dtype)
    reads = (least, jax.lax.stop_gradient(rows[0]))
    coarse, fine = (codes.at_time_of(times, count, time) for count in reads)
    return coarse, fine


def second_differences(times: Float[Array, "moments code"]) -> Float[Array, ""]:
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


def has_penalty(spec: Codes) -> bool:
    """Test if `penalty` has a term.

    Args:
      spec: Settings.

    Returns:
      True if it has one.
    """
    return spec.smoothness > 0 or spec.opacity > 0


def penalty(
    spec: Codes, times: Float[Array, "moments code"], context: PenaltyContext
) -> dict[str, Term]:
    """`smoothness`, which codes wait for their motion with, and `opacity`.

    A term of weight zero is not computed.
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
    """Base of the motions that read codes of Gaussians and of time.

    Attributes:
      frames: Number of training frames.
    """

    frames: int

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of embeddings, and of networks and time codes."""
        return MotionParams(jnp.full((), self.spec.embedding_rate), self.rate(step))

    def loss(self, params: MotionParams, context: PenaltyContext) -> dict[str, Term]:
        """Compute the penalties on codes that bend, and on opacity."""
        return penalty(self.spec, params.shared.times, context)

    @property
    def project_steps(self) -> tuple[int, ...]:
        """Steps after which the fine network reads more rows of the table."""
        if self.spec.coarser is None:
            return ()
        return growth_steps(self.spec, moments(self.spec, self.frames))

    def project(self, shared: Any, step: int) -> Any:
        """Return the shared parameters with the rows that are read from a step."""
        return revised(self.spec, shared, step)
