"""Schedules of the traced step that the literature uses and optax does not have.

Use optax for constant, cosine decay, piecewise and joined schedules. All schedules here
keep their last value after their last step, accept Python, NumPy and traced steps, and
check their settings when they are built.
"""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from nerfies_jax.nn import encoding

Schedule = Callable[..., Float[Array, "*steps"]]  # of an integer step


def check_falling(learning_rate: float, learning_rate_end: float) -> None:
    """Check that a learning rate decreases or stays, and is positive.

    Args:
      learning_rate: First learning rate.
      learning_rate_end: Last learning rate.

    Raises:
      ValueError: If a rate is not positive and finite, or the last exceeds the first.
    """
    if not 0 < learning_rate_end <= learning_rate < math.inf:
        raise ValueError(
            f"the rate falls from learning_rate={learning_rate} to "
            f"learning_rate_end={learning_rate_end}; both are positive and finite, "
            "and the second is not larger"
        )


def log_linear(
    start: float, end: float, steps: int, *, delay_steps: int = 0, delay: float = 1.0
) -> Schedule:
    """Make a schedule linear in the logarithm, with an optional delayed warm-up.

    Over the first `delay_steps` it is multiplied with delay + (1 - delay) sin(pi/2 t),
    t from 0 to 1, as in Mip-NeRF, 3DGS and Deformable 3DGS (their `lr_delay_mult`).

    Args:
      start: First value, positive.
      end: Last value, positive.
      steps: Number of steps from the first to the last value.
      delay_steps: Number of steps of the warm-up. 0 for none.
      delay: Factor at the first step of the warm-up, in (0, 1].

    Returns:
      The schedule, a function of the step.

    Raises:
      ValueError: If a setting is out of range.
    """
    _span("log_linear", steps)
    _ends("log_linear", start=start, end=end)
    if delay_steps < 0 or not 0 < delay <= 1:
        raise ValueError(
            "a delayed warm-up needs delay_steps >= 0 and a factor 0 < delay <= 1, got "
            f"delay_steps={delay_steps}, delay={delay}"
        )
    ratio = math.log(end / start)

    def schedule(step):
        # exp of a small number times a constant: float32 keeps the rate to 2e-7, while
        # interpolating log(start) and log(end) loses 1e-6 at rates of 1e-7.
        rate = start * jnp.exp(ratio * _share(step, steps))
        if delay_steps:
            warm = jnp.sin(0.5 * jnp.pi * _share(step, delay_steps))
            rate = rate * (delay + (1 - delay) * warm)
        return rate

    return schedule


def ramp(start: float, end: float, steps: int, *, after: int = 0) -> Schedule:
    """Make a schedule that is linear in the step.

    The window's alpha of Nerfies and HyperNeRF is `ramp(0, bands, 80_000)`.

    Args:
      start: Value up to step `after`.
      end: Last value.
      steps: Number of steps from the first to the last value.
      after: Step at which the ramp begins.

    Returns:
      The schedule, a function of the step.

    Raises:
      ValueError: If a setting is out of range.
    """
    _span("ramp", steps, after)
    _finite("ramp", start=start, end=end)

    def schedule(step):
        share = _share(step, steps, after)
        return _with_ends(share, start + share * (end - start), start, end)

    return schedule


def band_window(
    bands: int, steps: int, step: Int[Array, ""], dtype: DTypeLike, *, after: int = 0
) -> Float[Array, " bands"]:
    """Compute the coarse-to-fine window of bands or levels that open one by one.

    Args:
      bands: Number of bands, at least one.
      steps: Number of steps until all are open.
      step: Current step, traced.
      dtype: Floating-point type of the result.
      after: Step at which the first band begins to open.

    Returns:
      Weights in [0, 1], [bands].

    References:
      Park et al. 2021 (Nerfies), arXiv:2011.12948, equation 8.
    """
    alpha = ramp(0.0, float(bands), steps, after=after)(step)
    return encoding.anneal(bands, alpha.astype(dtype))


def cosine(start: float, end: float, steps: int, *, after: int = 0) -> Schedule:
    """Make a schedule that follows half a cosine from one value to another.

    The elastic weight of Nerfies is `cosine(1e-2, 1e-8, 100_000, after=50_000)`. The
    schedule of optax decays to a share of its first value and cannot increase.

    Args:
      start: Value up to step `after`.
      end: Last value.
      steps: Number of steps from the first to the last value.
      after: Step at which the value begins to change.

    Returns:
      The schedule, a function of the step.

    Raises:
      ValueError: If a setting is out of range.
    """
    _span("cosine", steps, after)
    _finite("cosine", start=start, end=end)

    def schedule(step):
        share = _share(step, steps, after)
        # Squares, not (1 + cos) / 2, which leaves 3e-8 of the start where none should
        # be left: as much as a small end.
        risen = jnp.sin(0.5 * jnp.pi * share) ** 2
        left = jnp.cos(0.5 * jnp.pi * share) ** 2
        return _with_ends(share, left * start + risen * end, start, end)

    return schedule


def time_noise(frames: int, steps: int = 20_000, scale: float = 0.1) -> Schedule:
    """Make the schedule of the noise on time of annealed smooth training.

    It starts at `scale` of one frame interval and falls linearly to zero. The published
    code divides by the images left in the epoch instead of `frames`, so that its noise
    grows to the whole duration once per epoch. This is the form in the paper.

    Args:
      frames: Number of frames of the capture.
      steps: Number of steps until the noise is zero.
      scale: Initial standard deviation in frame intervals, non-negative.

    Returns:
      The schedule of the standard deviation, in units of the capture's duration.

    Raises:
      ValueError: If a setting is out of range.

    References:
      Yang et al. 2023 (Deformable 3DGS), arXiv:2309.13101, equation 6.
    """
    if frames < 1:
        raise ValueError(
            f"time noise is a share of the interval between frames, got frames={frames}"
        )
    if not (math.isfinite(scale) and scale >= 0):
        raise ValueError(
            f"time noise needs a scale that is not negative, got scale={scale}"
        )
    return ramp(scale / frames, 0.0, steps)


def staircase(steps: tuple[int, ...], start: int = 0) -> Schedule:
    """Make a schedule that increases by one at each of some steps.

    The spherical-harmonics degree of 3DGS is `staircase((1000, 2000, 3000))`.

    Args:
      steps: Steps in ascending order, non-negative.
      start: Value before the first of them.

    Returns:
      The schedule, with int32 values.

    Raises:
      ValueError: If the steps are not ascending or negative.
    """
    if list(steps) != sorted(set(steps)) or any(step < 0 for step in steps):
        raise ValueError(
            f"a staircase rises at growing steps that are not negative, got {steps}"
        )
    edges = jnp.asarray(steps, jnp.int32)

    def schedule(step):
        reached = jnp.asarray(step, jnp.int32)[..., None] >= edges
        return start + jnp.sum(reached, axis=-1, dtype=jnp.int32)

    return schedule


def _share(step, steps, after=0):
    """Share of the interval that has passed, from 0 to 1."""
    # Subtracted as integers: float32 counts no further than 16.7 million steps.
    passed = jnp.clip(jnp.asarray(step, jnp.int32) - after, 0, steps)
    share = passed.astype(jnp.result_type(float)) / steps
    # XLA multiplies with the rounded 1 / steps: at the end that is not quite one.
    return jnp.where(passed == steps, 1.0, share)


def _with_ends(share, between, start, end):
    """Exact at both ends: XLA contracts (1 - share) * start, which then misses zero."""
    return jnp.where(share <= 0, start, jnp.where(share >= 1, end, between))


def _span(name, steps, after=0):
    if steps < 1 or after < 0:
        raise ValueError(
            f"{name} needs at least one step and a start that is not negative, got "
            f"steps={steps}, after={after}"
        )


def _finite(name, **values):
    for key, value in values.items():
        if not math.isfinite(value):
            raise ValueError(f"{name} needs a finite {key}, got {value}")


def _ends(name, **values):
    for key, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(
                f"{name} runs in the logarithm and needs a finite {key} > 0, got "
                f"{value}; use `ramp` to reach zero"
            )
