"""Features of anchors: what is made of them, and what they cost to keep.

The law of a reference feature is normal, with a mean and a deviation for each channel,
that of the residual ones is normal as a network makes it of the former: a factorized
model and one with a context, as Balle et al. 2018, arXiv:1802.01436, have them for
pictures (equation 6, where the law has no fixed form, and equation 7, where it has no
mean). Which part of ADC-GS (Huang et al. 2025, arXiv:2505.08196) this is, and that its
equations were not at hand, is said in `anchor_motion`.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.motion import codes as motion_codes
from gaussians_jax.motion.carried import Carried
from gaussians_jax.motion.kan import KanMotionSpec, Offsets
from nerfies_jax.geometry import quaternion
from nerfies_jax.nn import entropy, mlp
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.step_counts import steps


@dataclasses.dataclass(frozen=True)
class RateSpec:
    """Weight of the bits, its first step, and the first steps of quantization."""

    weight: float = 1e-3  # of the mean bits of a number of the features
    start: int = steps(20_000)  # of noise and cost
    step: float = 0.1  # first, in units of the features; it is learned
    width: int = 32  # of the network that tells residual from reference features
    learning_rate: float = 2e-4
    learning_rate_end: float = 1e-5

    def __post_init__(self):
        if not 0 <= self.weight < math.inf:
            raise ValueError(f"weight={self.weight} must be finite and not negative")
        if self.start < 0 or self.width < 1 or not 0 < self.step < math.inf:
            raise ValueError(
                f"start >= 0, width >= 1 and a positive step, got start={self.start}, "
                f"width={self.width} and step={self.step}"
            )
        schedules.check_falling(self.learning_rate, self.learning_rate_end)


@dataclasses.dataclass(frozen=True)
class AnchorMotionSpec:
    """Sizes and schedules, by default those of ADC-GS's code for HyperNeRF's videos.

    Features are initialized from a normal distribution of deviation `spread`, where the
    code has zeros, and children are `first_scale` as large as their anchor. Without
    `moves` there is neither coarse nor fine motion, nor its inputs, and children are
    static.
    """

    count: int = 10  # Gaussians of an anchor
    reference: int = 32
    residual: int = 16  # of each of them; the first half makes it, the other moves it
    time_code: int = 256
    frames_per_code: int = 2
    width: int = 128  # of the networks that move
    make_width: int = 32  # of the one that makes
    spread: float = 0.5
    first_scale: float = 0.4
    rate: RateSpec | None = RateSpec()  # None: features are kept as they are
    moves: bool = True
    warm_up: int = steps(5000)  # steps without motion
    feature_rate: float = 7.5e-3
    feature_rate_end: float = 5e-5
    make_rate: float = 2e-3
    make_rate_end: float = 2e-5
    learning_rate: float = 4e-4  # of networks and time codes
    learning_rate_end: float = 4e-6
    block: int = 512  # anchors per evaluation

    def __post_init__(self):
        for name in ("count", "reference", "time_code", "frames_per_code", "block"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        if self.residual < 2 or self.residual % 2:
            raise ValueError(
                f"residual={self.residual} must be even: half makes, half moves"
            )
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        if not (0 < self.spread < math.inf and 0 < self.first_scale < math.inf):
            raise ValueError(
                f"spread={self.spread} and first_scale={self.first_scale} must be "
                "positive and finite"
            )
        for name in ("feature_rate", "make_rate", "learning_rate"):
            schedules.check_falling(getattr(self, name), getattr(self, f"{name}_end"))
        for network in (make_spec, coarse_spec, fine_spec):
            network(self)  # checks its sizes

    def bind(self, run_steps: int, metadata: SceneMetadata) -> Any:
        """Return the motion for a run of `run_steps` of this capture."""
        from gaussians_jax.motion import anchor_motion  # it reads this module

        return anchor_motion.Bound(self, run_steps, metadata.moments)


class Features(NamedTuple):
    """The rows: what an anchor and what each it carries is made of."""

    reference: Float[Array, "anchors reference"]
    residual: Float[Array, "anchors carried residual"]  # half of it without motion


class Law(NamedTuple):
    """Prior of the features: one distribution per channel, or one from a network."""

    mean: Float[Array, " reference"]
    log_scale: Float[Array, " reference"]
    log_step: Float[Array, " reference"]
    residual_log_step: Float[Array, " residual"]
    context: MLP  # of a reference feature: mean and log_scale of its residual ones


class Anchors(NamedTuple):
    """Parameters that all anchors share."""

    times: Float[Array, "moments code"] | None  # evenly over [0, 1]
    make: MLP
    coarse: MLP | None  # None, as `times` and `fine`, where nothing moves
    fine: MLP | None
    law: Law | None


def residual_width(spec: AnchorMotionSpec) -> int:
    """Residual features of one: without motion, only those that it is made of."""
    return spec.residual if spec.moves else spec.residual // 2


def make_spec(spec: AnchorMotionSpec) -> MLPSpec:
    """From [reference, half of residual] to what a Gaussian is against its anchor."""
    heads = (
        ("offset", HeadSpec(3)),
        ("log_scale", HeadSpec(3, "zero")),
        ("turn", HeadSpec(3, "zero")),
        ("opacity_logit", HeadSpec(1, "zero")),
        ("sh_dc", HeadSpec(3, "zero")),
    )
    inputs, width = spec.reference + spec.residual // 2, spec.make_width
    return MLPSpec(inputs, 2, width, heads, (), "relu", "he")


def coarse_spec(spec: AnchorMotionSpec) -> MLPSpec:
    """From [reference, code of the time] to how an anchor is moved."""
    return _moving_spec(spec, spec.reference)


def fine_spec(spec: AnchorMotionSpec) -> MLPSpec:
    """From [other half of residual, code of the time] to how a carried one is moved."""
    return _moving_spec(spec, spec.residual // 2)


def _moving_spec(spec, reads):
    heads = tuple((name, HeadSpec(3, "zero")) for name in Offsets._fields)
    return MLPSpec(reads + spec.time_code, 2, spec.width, heads, (), "relu", "he")


def context_spec(spec: AnchorMotionSpec) -> MLPSpec:
    """From a reference feature to the law of the residual ones of its anchor."""
    each = spec.count * residual_width(spec)
    heads = (("mean", HeadSpec(each, "zero")), ("log_scale", HeadSpec(each, "zero")))
    assert spec.rate is not None
    return MLPSpec(spec.reference, 1, spec.rate.width, heads, (), "relu", "he")


def init_features(
    key: Key[Array, ""], spec: AnchorMotionSpec, count: int, dtype=jnp.float32
) -> Features:
    """Features of so many anchors that nothing is known of."""
    shapes = (count, spec.reference), (count, spec.count, spec.residual)
    drawn = (
        jax.random.normal(one, shape, jnp.float32)
        for one, shape in zip(jax.random.split(key), shapes, strict=True)
    )
    first, others = (spec.spread * one.astype(dtype) for one in drawn)
    return Features(first, others[..., : residual_width(spec)])


def init(
    key: Key[Array, ""], spec: AnchorMotionSpec, frames: int, dtype=jnp.float32
) -> Anchors:
    """Networks that move nothing yet, for a capture of `frames` to learn from."""
    times_key, make_key, coarse_key, fine_key, law_key = jax.random.split(key, 5)
    make = mlp.init(make_spec(spec), make_key, dtype)
    law = None if spec.rate is None else _init_law(law_key, spec, dtype)
    if not spec.moves:
        return Anchors(None, make, None, None, law)
    table = KanMotionSpec(
        time_code=spec.time_code, frames_per_code=spec.frames_per_code, spread=0.5
    )
    return Anchors(
        motion_codes.init_times(times_key, table, frames, dtype),
        make,
        mlp.init(coarse_spec(spec), coarse_key, dtype),
        mlp.init(fine_spec(spec), fine_key, dtype),
        law,
    )


def _init_law(key, spec, dtype):
    context = mlp.init(context_spec(spec), key, dtype)
    wide = math.log(spec.spread)
    head = context.heads["log_scale"]
    context.heads["log_scale"] = head._replace(bias=jnp.full_like(head.bias, wide))
    first = math.log(spec.rate.step)
    return Law(
        mean=jnp.zeros(spec.reference, dtype),
        log_scale=jnp.full(spec.reference, wide, dtype),
        log_step=jnp.full(spec.reference, first, dtype),
        residual_log_step=jnp.full(residual_width(spec), first, dtype),
        context=context,
    )


def law_of_residual(
    law: Law, spec: AnchorMotionSpec, reference: Float[Array, "anchors reference"]
) -> tuple[
    Float[Array, "anchors carried residual"], Float[Array, "anchors carried residual"]
]:
    """Means and logarithms of deviations of the residual features.

    As many as the law has: what was trained to move may be drawn without.
    """
    made = mlp.apply(context_spec(spec), law.context, reference)
    shape = (len(reference), spec.count, len(law.residual_log_step))
    return made["mean"].reshape(shape), made["log_scale"].reshape(shape)


def kept(features: Features, law: Law, spec: AnchorMotionSpec) -> Features:
    """The features rounded to whole steps from their means, as they are kept.

    Slopes pass as if they were not rounded.
    """
    step, residual_step = _steps(law)
    reference = _through(
        features.reference, entropy.rounded(features.reference, law.mean, step)
    )
    mean, _ = law_of_residual(law, spec, reference)
    whole = entropy.rounded(features.residual, mean, residual_step)
    return Features(reference, _through(features.residual, whole))


def _through(values, rounded):
    """The rounded values, with the slope of the others."""
    return values + jax.lax.stop_gradient(rounded - values)


def _steps(law):
    """Steps of rounding of each channel, positive."""
    return (
        jnp.exp(jnp.clip(log_step, *entropy.LOG_RANGE))
        for log_step in (law.log_step, law.residual_log_step)
    )


def noised(key: Key[Array, ""], features: Features, law: Law) -> Features:
    """The features as far off as rounding could take them."""
    keys = jax.random.split(key)
    return Features(
        *(
            entropy.noisy(one, values, step)
            for one, values, step in zip(keys, features, _steps(law), strict=True)
        )
    )


def bits(
    features: Features, law: Law, spec: AnchorMotionSpec
) -> tuple[Float[Array, "anchors reference"], Float[Array, "anchors carried residual"]]:
    """Compute the bits of an ideal coder for each quantized feature value.

    `entropy.bits`, under the priors of reference and residual features.
    """
    step, residual_step = _steps(law)
    first = entropy.bits(features.reference, law.mean, law.log_scale, step)
    mean, log_scale = law_of_residual(law, spec, features.reference)
    return first, entropy.bits(features.residual, mean, log_scale, residual_step)


def made(
    net: Anchors, spec: AnchorMotionSpec, features: Features, rest: int
) -> Carried:
    """Produce the children of anchors in canonical position, with `rest` harmonics."""
    half = spec.residual // 2
    shape = (*features.residual.shape[:2], spec.reference)
    reference = jnp.broadcast_to(features.reference[:, None], shape)
    reads = jnp.concatenate([reference, features.residual[..., :half]], axis=-1)
    heads = mlp.apply(make_spec(spec), net.make, reads)
    turn = jax.vmap(jax.vmap(quaternion.exp))(heads["turn"])
    return Carried(
        offset=heads["offset"],
        log_scale=heads["log_scale"] + math.log(spec.first_scale),
        quaternion=turn,
        opacity_logit=heads["opacity_logit"][..., 0],
        sh_dc=heads["sh_dc"][..., None, :],
        sh_rest=jnp.zeros((*shape[:2], rest, 3), reads.dtype),
    )
