"""Features of anchors: their networks, quantization and entropy model.

The distribution of a reference feature is normal, with a mean and a deviation per
channel. That of residual features is normal with parameters from a network of the
reference feature. These are a factorized and a context model as in Balle et al. 2018,
arXiv:1802.01436, for images (equation 6, where the distribution has no fixed form, and
equation 7, where it has no mean). `anchor_motion` says how this relates to ADC-GS
(Huang et al. 2025, arXiv:2505.08196), whose equations were not available.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
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
    """Settings of the rate loss, of its start and of the quantization."""

    weight: float = 1e-3  # of the mean bits per feature value
    start: int = steps(20_000)  # first step with quantization noise and this loss
    step: float = 0.1  # initial quantization step, in units of the features; learned
    width: int = 32  # of the network that predicts residual from reference features
    learning_rate: float = 2e-4
    learning_rate_end: float = 1e-5

    def __post_init__(self):
        if not 0 <= self.weight < math.inf:
            raise ValueError(f"weight={self.weight} must be finite and not negative")
        if self.start < 0 or self.width < 1 or not 0 < self.step < math.inf:
            raise ValueError(
                "start must be at least 0, width at least 1 and step positive, got "
                f"start={self.start}, width={self.width} and step={self.step}"
            )
        schedules.check_falling(self.learning_rate, self.learning_rate_end)


@dataclasses.dataclass(frozen=True)
class AnchorMotionSpec:
    """Sizes and schedules, by default those of ADC-GS's code for HyperNeRF's videos.

    Features are initialized from a normal distribution of deviation `spread`, where the
    code has zeros, and children are `first_scale` times as large as their anchor.
    Without `moves` there is neither coarse nor fine motion, nor its inputs, and
    children are static.
    """

    count: int = 10  # children of an anchor
    reference: int = 32
    residual: int = 16  # per child; the first half produces it, the second moves it
    time_code: int = 256
    frames_per_code: int = 2
    width: int = 128  # of the motion networks
    make_width: int = 32  # of the network that produces children
    spread: float = 0.5
    first_scale: float = 0.4
    rate: RateSpec | None = RateSpec()  # None: no quantization
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
                f"residual={self.residual} must be even and at least 2; one half "
                "produces a child, the other moves it"
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
        for network in (_make_spec, coarse_spec, fine_spec):
            network(self)  # validates the sizes

    def bind(self, run_steps: int, metadata: SceneMetadata) -> Any:
        """Return the motion for a run of `run_steps` on this capture."""
        from gaussians_jax.motion import anchor_motion  # imports this module

        return anchor_motion.Bound(self, run_steps, metadata.timestamps)


class Features(NamedTuple):
    """Per-Gaussian parameters: features of anchors and of their children."""

    reference: Float[Array, "anchors reference"]
    residual: Float[Array, "anchors children residual"]  # first half without motion


class Law(NamedTuple):
    """Prior of the features: per channel, or from a network for residual features."""

    mean: Float[Array, " reference"]
    log_scale: Float[Array, " reference"]
    log_step: Float[Array, " reference"]
    residual_log_step: Float[Array, " residual"]
    context: MLP  # from a reference feature to mean and log_scale of residual ones


class Anchors(NamedTuple):
    """Shared parameters."""

    times: Float[Array, "times code"] | None  # evenly spaced over [0, 1]
    make: MLP
    coarse: MLP | None  # None without motion, like `times` and `fine`
    fine: MLP | None
    law: Law | None


def residual_width(spec: AnchorMotionSpec) -> int:
    """Return the number of residual features per child.

    Args:
      spec: Settings of the motion.

    Returns:
      The number.
    """
    return spec.residual if spec.moves else spec.residual // 2


def _make_spec(spec: AnchorMotionSpec) -> MLPSpec:
    """Settings of the network from [reference, half of residual] to a child."""
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
    """Settings of the network from [reference, time code] to motion of an anchor.

    Args:
      spec: Settings of the motion.

    Returns:
      Settings of the network.
    """
    return _moving_spec(spec, spec.reference)


def fine_spec(spec: AnchorMotionSpec) -> MLPSpec:
    """Settings of the network from [half of residual, time code] to child motion.

    Args:
      spec: Settings of the motion.

    Returns:
      Settings of the network.
    """
    return _moving_spec(spec, spec.residual // 2)


def _moving_spec(spec, inputs):
    heads = tuple((name, HeadSpec(3, "zero")) for name in Offsets._fields)
    return MLPSpec(inputs + spec.time_code, 2, spec.width, heads, (), "relu", "he")


def _context_spec(spec: AnchorMotionSpec) -> MLPSpec:
    """Settings of the network from reference features to the prior of residual ones."""
    each = spec.count * residual_width(spec)
    heads = (("mean", HeadSpec(each, "zero")), ("log_scale", HeadSpec(each, "zero")))
    assert spec.rate is not None
    return MLPSpec(spec.reference, 1, spec.rate.width, heads, (), "relu", "he")


def init_features(
    key: Key[Array, ""],
    spec: AnchorMotionSpec,
    count: int,
    dtype: DTypeLike = jnp.float32,
) -> Features:
    """Initialize random features of anchors.

    Args:
      key: PRNG key.
      spec: Settings.
      count: Number of anchors.
      dtype: Floating-point type.

    Returns:
      The features.
    """
    shapes = (count, spec.reference), (count, spec.count, spec.residual)
    noise = (
        spec.spread * jax.random.normal(subkey, shape, jnp.float32).astype(dtype)
        for subkey, shape in zip(jax.random.split(key), shapes, strict=True)
    )
    reference, residual = noise
    return Features(reference, residual[..., : residual_width(spec)])


def init(
    key: Key[Array, ""],
    spec: AnchorMotionSpec,
    frames: int,
    dtype: DTypeLike = jnp.float32,
) -> Anchors:
    """Initialize networks without motion.

    Args:
      key: PRNG key.
      spec: Settings.
      frames: Number of training frames.
      dtype: Floating-point type.

    Returns:
      Shared parameters.
    """
    times_key, make_key, coarse_key, fine_key, law_key = jax.random.split(key, 5)
    make = mlp.init(_make_spec(spec), make_key, dtype)
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
    context = mlp.init(_context_spec(spec), key, dtype)
    log_spread = math.log(spec.spread)
    head = context.heads["log_scale"]
    context.heads["log_scale"] = head._replace(
        bias=jnp.full_like(head.bias, log_spread)
    )
    first = math.log(spec.rate.step)
    return Law(
        mean=jnp.zeros(spec.reference, dtype),
        log_scale=jnp.full(spec.reference, log_spread, dtype),
        log_step=jnp.full(spec.reference, first, dtype),
        residual_log_step=jnp.full(residual_width(spec), first, dtype),
        context=context,
    )


def _law_of_residual(
    law: Law, spec: AnchorMotionSpec, reference: Float[Array, "anchors reference"]
) -> tuple[
    Float[Array, "anchors children residual"], Float[Array, "anchors children residual"]
]:
    """Compute means and logarithms of deviations of the residual features.

    The prior has more features than `spec` if a scene is rendered without its motion.
    """
    outputs = mlp.apply(_context_spec(spec), law.context, reference)
    shape = (len(reference), spec.count, len(law.residual_log_step))
    return outputs["mean"].reshape(shape), outputs["log_scale"].reshape(shape)


def quantize(features: Features, law: Law, spec: AnchorMotionSpec) -> Features:
    """Round features to whole steps from their means, with straight-through gradients.

    Args:
      features: The features.
      law: Their prior.
      spec: Settings.

    Returns:
      The features as they are stored.
    """
    step, residual_step = _steps(law)
    reference = _straight_through(
        features.reference, entropy.quantize(features.reference, law.mean, step)
    )
    mean, _ = _law_of_residual(law, spec, reference)
    quantized = entropy.quantize(features.residual, mean, residual_step)
    return Features(reference, _straight_through(features.residual, quantized))


def _straight_through(values, rounded_values):
    """Return rounded values with the gradient of the unrounded ones."""
    return values + jax.lax.stop_gradient(rounded_values - values)


def _steps(law):
    """Return the quantization step of each channel, positive."""
    return (
        jnp.exp(jnp.clip(log_step, *entropy.LOG_RANGE))
        for log_step in (law.log_step, law.residual_log_step)
    )


def add_noise(key: Key[Array, ""], features: Features, law: Law) -> Features:
    """Add noise as wide as a quantization step to features.

    Args:
      key: PRNG key.
      features: The features.
      law: Their prior, which has the steps.

    Returns:
      The noisy features.
    """
    keys = jax.random.split(key)
    return Features(
        *(
            entropy.noisy(one, values, step)
            for one, values, step in zip(keys, features, _steps(law), strict=True)
        )
    )


def bits(
    features: Features, law: Law, spec: AnchorMotionSpec
) -> tuple[
    Float[Array, "anchors reference"], Float[Array, "anchors children residual"]
]:
    """Compute the bits of an ideal coder for each quantized feature value.

    Args:
      features: The features.
      law: Their prior.
      spec: Settings.

    Returns:
      Bits (`entropy.bits`) of reference and of residual features.
    """
    step, residual_step = _steps(law)
    first = entropy.bits(features.reference, law.mean, law.log_scale, step)
    mean, log_scale = _law_of_residual(law, spec, features.reference)
    return first, entropy.bits(features.residual, mean, log_scale, residual_step)


def make_children(
    net: Anchors, spec: AnchorMotionSpec, features: Features, rest: int
) -> Carried:
    """Compute the children of anchors in their canonical state.

    Args:
      net: Shared parameters.
      spec: Settings.
      features: Features of the anchors.
      rest: Number of higher harmonics, which are zero.

    Returns:
      Parameters of the children relative to their anchors.
    """
    half = spec.residual // 2
    shape = (*features.residual.shape[:2], spec.reference)
    reference = jnp.broadcast_to(features.reference[:, None], shape)
    inputs = jnp.concatenate([reference, features.residual[..., :half]], axis=-1)
    heads = mlp.apply(_make_spec(spec), net.make, inputs)
    turn = jax.vmap(jax.vmap(quaternion.exp))(heads["turn"])
    return Carried(
        offset=heads["offset"],
        log_scale=heads["log_scale"] + math.log(spec.first_scale),
        quaternion=turn,
        opacity_logit=heads["opacity_logit"][..., 0],
        sh_dc=heads["sh_dc"][..., None, :],
        sh_rest=jnp.zeros((*shape[:2], rest, 3), inputs.dtype),
    )
