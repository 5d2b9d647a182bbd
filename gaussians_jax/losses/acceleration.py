"""Acceleration penalty for small motions, which leaves large motions free.

MoBa-GS, section 3.3 ("intrinsic structural prior"), describes an acceleration penalty
that decays exponentially for moving points, without a formula. This one uses the second
difference in time of SC-GS, arXiv:2312.14937, with a weight that decays with the
distance from the canonical position, and adds the first difference.
"""

import dataclasses
import math
import zlib

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import Number, SceneMetadata, is_traced
from gaussians_jax.core.splats import Params
from nerfies_jax.training.effects import PenaltyContext, Term
from nerfies_jax.training.step_counts import steps

NAME = "acceleration"
_STREAM = zlib.crc32(NAME.encode()) >> 1  # of the step's key, to sample Gaussians


@dataclasses.dataclass(frozen=True)
class AccelerationSpec:
    """Settings of the acceleration penalty.

    `decay` is the distance from the canonical position at which the weight has decayed
    to 1/e, as a share of the scene's extent. It is also the unit of the differences, so
    that `weight` means the same in every scene. `drift` is the weight of the first
    difference relative to the second. The second alone does not penalize a constant
    velocity: static points drifted by 9 cm at an acceleration of 1e-17.
    """

    weight: float = 1e-2
    decay: float = 1e-2
    drift: float = 1.0
    interval: float = 1.0  # between the compared times, in frames
    samples: int = 1024  # Gaussians sampled in a step
    start: int = steps(0)  # first step with this penalty

    def __post_init__(self):
        for name in ("weight", "drift"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name}={value} must be finite and not negative")
        for name in ("decay", "interval"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"{name}={value} must be finite and positive")
        if self.samples < 1 or self.start < 0:
            raise ValueError(
                "samples must be at least 1 and start at least 0, got "
                f"samples={self.samples} and start={self.start}"
            )

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the regularizer for this capture."""
        return Bound(self, metadata.extent, metadata.timestamps)


def sample_times(time: Float[Array, ""], interval: float) -> Float[Array, "3"]:
    """Return three times an `interval` apart, with `time` in the middle.

    Near the ends of the capture they are shifted inwards together, because a motion is
    not trained outside of it.

    Args:
      time: Normalized time.
      interval: Distance of the times, at most one half.

    Returns:
      Times in [0, 1].
    """
    interval = min(interval, 0.5)
    middle = jnp.clip(time, interval, 1 - interval)
    offsets = jnp.asarray([-interval, 0, interval], time.dtype)
    return jnp.clip(middle + offsets, 0, 1)


def acceleration_loss(
    canonical: Float[Array, "gaussians 3"],
    before: Float[Array, "gaussians 3"],
    now: Float[Array, "gaussians 3"],
    after: Float[Array, "gaussians 3"],
    decay: Number,
    drift: float,
) -> Float[Array, ""]:
    """Compute the weighted mean of squared accelerations and velocities.

    The loss is the mean of exp(-|p - c| / s) (|p+ - 2 p + p-|^2 + drift |(p+ - p-) /
    2|^2) / s^2, where c, p-, p, p+ are the positions and s is `decay`. The weight has
    no gradient, so that a point cannot reduce the penalty by moving away.

    Args:
      canonical: Canonical positions in scene units.
      before: Positions at the earlier time.
      now: Positions at the middle time.
      after: Positions at the later time.
      decay: Distance at which the weight has decayed to 1/e, in scene units.
      drift: Weight of the velocities.

    Returns:
      The loss.
    """
    weight = _stillness(canonical, now, decay)
    # Differences of two close positions are exact, in contrast to their sum.
    ahead, behind = (after - now) / decay, (now - before) / decay
    energy = jnp.sum(jnp.square(ahead - behind), axis=-1)
    if drift > 0:
        speed_sq = jnp.sum(jnp.square((ahead + behind) / 2), axis=-1)
        energy = energy + drift * speed_sq
    return jnp.mean(weight * energy)


def _stillness(canonical, now, decay):
    displacement = jax.lax.stop_gradient(now - canonical) / decay
    return jnp.exp(-jnp.sqrt(jnp.sum(jnp.square(displacement), axis=-1)))


def draw_active(
    key: Key[Array, ""], active: Bool[Array, " gaussians"], count: int
) -> Int[Array, " count"]:
    """Sample active Gaussians uniformly, with replacement.

    Args:
      key: PRNG key.
      active: True for active Gaussians. If there are none, any are sampled.
      count: Number of samples.

    Returns:
      Indices.
    """
    rank = jnp.cumsum(active)
    ranks = jax.random.randint(key, (count,), 1, jnp.maximum(rank[-1], 1) + 1)
    rows = jnp.searchsorted(rank, ranks.astype(rank.dtype))
    return jnp.minimum(rows, active.shape[0] - 1)


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Regularizer` of an `AccelerationSpec`, for `frames` spread over [0, 1].

    It evaluates `spec.samples` Gaussians at three times. Forward and backward on one
    core take 8 ms for 1024 samples with a motion network 4 x 64, and 155 ms with 8 x
    256, a third of the time to move all of 10k Gaussians once.
    """

    spec: AccelerationSpec
    extent: Number  # of the scene, in scene units
    frames: int

    name = NAME

    def __post_init__(self):
        if is_traced(self.extent):
            return
        if self.frames < 2 or not 0 < self.extent < math.inf:
            raise ValueError(
                "an acceleration penalty needs at least two frames and a finite, "
                f"positive extent, got frames={self.frames} and extent={self.extent}; "
                "leave it out of this scene"
            )

    def loss(self, params: Params, context: PenaltyContext) -> dict[str, Term]:
        """Compute the acceleration of some Gaussians around the time of a frame."""
        spec, condition = self.spec, context.condition
        interval = spec.interval / (self.frames - 1)
        decay = spec.decay * self.extent
        active = splats.active_mask(params.rows["splats"])
        assert condition.key is not None
        assert condition.step is not None
        key = jax.random.fold_in(condition.key, _STREAM)
        rows = draw_active(key, active, min(spec.samples, active.shape[0]))

        assert context.at_time is not None
        at_time = context.at_time

        def evaluate(params):
            sample = splats.take_rows(params, rows)
            canonical = sample.rows["splats"].mean
            times = sample_times(condition.time, interval)
            before, now, after = (at_time(sample, t).mean for t in times)
            value = acceleration_loss(canonical, before, now, after, decay, spec.drift)
            static = jnp.mean(_stillness(canonical, now, decay))
            any_active = jnp.any(active)
            return jnp.where(any_active, value, 0), jnp.where(any_active, static, 0)

        def nothing(params):
            zero = jnp.zeros((), params.rows["splats"].mean.dtype)
            return zero, zero

        if spec.start == 0:
            value, static = evaluate(params)
        else:
            value, static = jax.lax.cond(
                condition.step < spec.start, nothing, evaluate, params
            )
        return {"unrest": Term(value, spec.weight), "still": Term(static, None)}
