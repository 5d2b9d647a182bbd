"""What the field schedules and optax does not: functions of a traced step.

Take constant, cosine, piecewise and joined schedules from optax. All here hold their
last value after their last step, work on Python, NumPy and traced steps, and refuse
nonsense when they are built.
"""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from nerfies_jax.nets import encoding

Schedule = Callable[..., Float[Array, "*steps"]]  # of an integer step


def check_falling(learning_rate: float, learning_rate_end: float) -> None:
    """Raise ValueError unless a rate falls, or stays, from one positive number on."""
    if not 0 < learning_rate_end <= learning_rate < math.inf:
        raise ValueError(
            f"the rate falls from learning_rate={learning_rate} to "
            f"learning_rate_end={learning_rate_end}; both are positive and finite, "
            "and the second is not larger"
        )


def log_linear(
    start: float, end: float, steps: int, *, delay_steps: int = 0, delay: float = 1.0
) -> Schedule:
    """From `start` to `end` along a straight line in the logarithm.

    Over the first `delay_steps` it is multiplied with delay + (1 - delay) sin(pi/2 t),
    t from 0 to 1, as in Mip-NeRF, 3DGS and Deformable 3DGS (their `lr_delay_mult`).
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
    """A straight line from `start` at step `after` to `end`, `steps` later.

    The annealed window's alpha of Nerfies and HyperNeRF is `ramp(0, bands, 80_000)`.
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
    """Weights of bands, or levels, that open one by one over `steps`, from `after` on.

    Nerfies (Park et al. 2021), coarse to fine; at least one band.
    """
    alpha = ramp(0.0, float(bands), steps, after=after)(step)
    return encoding.anneal(bands, alpha.astype(dtype))


def cosine(start: float, end: float, steps: int, *, after: int = 0) -> Schedule:
    """`start` up to step `after`, then half a cosine down (or up) to `end`.

    Nerfies' elastic weight is `cosine(1e-2, 1e-8, 100_000, after=50_000)`. optax's own
    decays to a share of its first value and cannot rise.
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
    """Standard deviation of the noise on time, in units of the capture's duration.

    Annealed smooth training of Yang et al. 2023 (Deformable 3DGS), arXiv:2309.13101,
    equation 6: `scale` of one frame interval, falling linearly to nothing. Their code
    divides by the images left in the epoch instead of `frames`, so that its noise grows
    to a whole duration once per epoch; this is the published form.
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
    """`start` plus the number of `steps` that are completed, an integer.

    The spherical-harmonics degree of 3DGS is `staircase((1000, 2000, 3000))`.
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
    """How much of the stretch has passed, from 0 to 1."""
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
