"""Schedules from the literature that optax does not have.

Use optax for constant, cosine decay, piecewise and joined schedules. The schedules here
keep their last value after their last step, accept Python, NumPy and traced steps, and
check their settings when they are made.
"""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from nerfies_jax.nn import encoding

Schedule = Callable[..., Float[Array, "*steps"]]  # (integer step) -> value


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
            f"learning_rate_end={learning_rate_end}; both must be positive and finite, "
            "and the second must not be larger"
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
    _check_steps("log_linear", steps)
    _check_positive("log_linear", start=start, end=end)
    if delay_steps < 0 or not 0 < delay <= 1:
        raise ValueError(
            "a delayed warm-up needs delay_steps >= 0 and a factor 0 < delay <= 1, got "
            f"delay_steps={delay_steps}, delay={delay}"
        )
    ratio = math.log(end / start)

    def schedule(step):
        # In float32 this has a relative error of 2e-7. Interpolating log(start) and
        # log(end) has 1e-6 at rates of 1e-7.
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
    _check_steps("ramp", steps, after)
    _check_finite("ramp", start=start, end=end)

    def schedule(step):
        share = _share(step, steps, after)
        return _with_ends(share, start + share * (end - start), start, end)

    return schedule


def band_window(
    bands: int, steps: int, step: Int[Array, ""], dtype: DTypeLike, *, after: int = 0
) -> Float[Array, " bands"]:
    """Compute the coarse-to-fine window of bands or levels.

    Args:
      bands: Number of bands, at least one.
      steps: Number of steps until all bands are open.
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
    schedule of optax decays to a fraction of its first value and cannot increase.

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
    _check_steps("cosine", steps, after)
    _check_finite("cosine", start=start, end=end)

    def schedule(step):
        share = _share(step, steps, after)
        # Squares, because (1 + cos) / 2 does not reach zero: at the end it leaves 3e-8
        # of the first value, which can be as large as the last value.
        end_weight = jnp.sin(0.5 * jnp.pi * share) ** 2
        start_weight = jnp.cos(0.5 * jnp.pi * share) ** 2
        return _with_ends(share, start_weight * start + end_weight * end, start, end)

    return schedule


def time_noise(frames: int, steps: int = 20_000, scale: float = 0.1) -> Schedule:
    """Make the schedule of the noise on time of annealed smooth training.

    It starts at `scale` frame intervals and falls linearly to zero, as in the paper.
    The published code divides by the number of images left in the epoch instead of by
    `frames`, so that its noise grows to the whole duration in each epoch.

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
            f"frames={frames} must be at least 1, to define the interval between frames"
        )
    if not (math.isfinite(scale) and scale >= 0):
        raise ValueError(f"time noise needs a finite scale >= 0, got scale={scale}")
    return ramp(scale / frames, 0.0, steps)


def _share(step, steps, after=0):
    """Compute the fraction of the interval that has passed, from 0 to 1."""
    # Subtracted as integers, because float32 cannot count beyond 16.7 million steps.
    progress = jnp.clip(jnp.asarray(step, jnp.int32) - after, 0, steps)
    share = progress.astype(jnp.result_type(float)) / steps
    # XLA multiplies by the rounded 1 / steps, so the last value may differ from one.
    return jnp.where(progress == steps, 1.0, share)


def _with_ends(share, between, start, end):
    """Make both ends exact. XLA contracts (1 - share) * start, which misses zero."""
    return jnp.where(share <= 0, start, jnp.where(share >= 1, end, between))


def _check_steps(name, steps, after=0):
    if steps < 1 or after < 0:
        raise ValueError(
            f"{name} needs steps >= 1 and after >= 0, got steps={steps}, after={after}"
        )


def _check_finite(name, **values):
    for key, value in values.items():
        if not math.isfinite(value):
            raise ValueError(f"{name} needs a finite {key}, got {value}")


def _check_positive(name, **values):
    for key, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(
                f"{name} interpolates logarithms and needs a finite {key} > 0, got "
                f"{value}; use `ramp` to reach zero"
            )
