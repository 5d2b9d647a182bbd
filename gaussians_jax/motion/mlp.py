"""Motion of all Gaussians as one network of position and time.

Yang et al. 2023, "Deformable 3D Gaussians", arXiv:2309.13101. The network maps the
encoded canonical mean and the encoded time to residuals of mean, rotation and scale.
"""

import dataclasses
import zlib
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.motion.blocks import in_blocks
from gaussians_jax.motion.bound import BoundMotion
from nerfies_jax.geometry import quaternion
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import HeadSpec, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.step_counts import steps

NAME = "mlp_motion"
SCALE_RULES = ("log", "linear")


@dataclasses.dataclass(frozen=True)
class SmoothingSpec:
    """Noise on the time that decays over training (section 3.3, "annealing smooth").

    Its initial standard deviation is `first` times the interval between two frames.
    """

    first: float = 0.1
    steps: int = steps(20_000)

    def __post_init__(self):
        if not (self.first >= 0 and self.steps >= 1):
            raise ValueError(
                "smoothing needs first >= 0 and steps >= 1, got "
                f"first={self.first}, steps={self.steps}"
            )


@dataclasses.dataclass(frozen=True)
class MotionSpec:
    """The network and its schedule, by default those of the paper for real captures.

    `time_code` is the width of a code that a small network computes from the encoded
    time (30 for the paper's synthetic scenes, where the time has six frequencies).
    `scale_rule="log"` multiplies scales by an exponential. "linear" adds to them as in
    the paper, which may make them negative.
    """

    position: EncodingSpec = EncodingSpec(10)
    time: EncodingSpec = EncodingSpec(10)
    time_code: int | None = None
    depth: int = 8
    width: int = 256
    skips: tuple[int, ...] = (5,)  # layers that read the input again
    scale_rule: str = "log"
    warm_up: int = steps(3000)  # steps without motion
    smoothing: SmoothingSpec | None = SmoothingSpec()
    learning_rate: float = 8e-4
    learning_rate_end: float = 1.6e-6
    # Gaussians per evaluation. Forward and backward of 10k on one core with 8x256 take
    # 598 ms and 11 MB in blocks of 512, 601 ms and 194 MB at once.
    block: int = 512

    def __post_init__(self):
        if self.scale_rule not in SCALE_RULES:
            raise ValueError(
                f"unknown scale_rule {self.scale_rule!r}; choose from {SCALE_RULES}"
            )
        if self.block < 1 or self.warm_up < 0:
            raise ValueError(
                f"block={self.block} must be at least 1 and warm_up={self.warm_up} "
                "not negative"
            )
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.timestamps)


class Motion(NamedTuple):
    """Parameters of the deformation network."""

    trunk: mlp.MLP
    time: mlp.MLP | None  # computes the time code


class Offsets(NamedTuple):
    """Residuals of position, scale and rotation."""

    mean: Float[Array, "gaussians 3"]  # scene units
    quaternion: Float[Array, "gaussians 4"]  # added to the unit quaternion
    scale: Float[Array, "gaussians 3"]  # of the logarithm, or in scene units


def trunk_spec(spec: MotionSpec) -> MLPSpec:
    """Settings of the network from [encoded position, time features] to three heads.

    The heads are initialized so that their output is 1e-4 of a Glorot initialization's,
    and the motion is continuous when the warm-up ends. The paper's code initializes
    them like hidden layers, and the scene jumps.

    Args:
      spec: Settings of the motion.

    Returns:
      Settings of the network.
    """
    heads = (
        ("mean", HeadSpec(3, "small")),
        ("quaternion", HeadSpec(4, "small")),
        ("scale", HeadSpec(3, "small")),
    )
    inputs = spec.position.width(3) + _time_width(spec)
    return MLPSpec(inputs, spec.depth, spec.width, heads, spec.skips, "relu", "he")


def _time_spec(spec: MotionSpec) -> MLPSpec:
    """Settings of the network from the encoded time to its code."""
    assert spec.time_code is not None
    heads = (("code", HeadSpec(spec.time_code)),)
    return MLPSpec(spec.time.width(1), 1, spec.width, heads, (), "relu", "he")


def _time_width(spec):
    return spec.time.width(1) if spec.time_code is None else spec.time_code


def init(
    key: Key[Array, ""], spec: MotionSpec, dtype: DTypeLike = jnp.float32
) -> Motion:
    """Initialize a network that hardly moves anything.

    Args:
      key: PRNG key.
      spec: Settings of the motion.
      dtype: Type of the parameters.

    Returns:
      Parameters of the networks.
    """
    trunk_key, time_key = jax.random.split(key)
    trunk = mlp.init(trunk_spec(spec), trunk_key, dtype)
    if spec.time_code is None:
        return Motion(trunk, None)
    return Motion(trunk, mlp.init(_time_spec(spec), time_key, dtype))


def deform(
    params: Motion,
    spec: MotionSpec,
    mean: Float[Array, "gaussians 3"],
    time: Float[Array, ""],
    active: Bool[Array, " gaussians"] | None = None,
) -> Offsets:
    """Evaluate the residuals of all Gaussians at a time.

    No gradient reaches the means through the network, as in the paper, because the
    network itself changes. Blocks without active Gaussians are zero and are not
    evaluated.

    Args:
      params: Shared parameters.
      spec: Settings.
      mean: Canonical means.
      time: Normalized time.
      active: Active Gaussians.

    Returns:
      The residuals.
    """
    at_time = fold_time(params, spec, time)
    if mean.shape[0] == 0:
        return Offsets(mean, jnp.zeros((0, 4), mean.dtype), mean)
    return in_blocks(
        lambda points: offsets_at_time(at_time, spec, points),
        (jax.lax.stop_gradient(mean),),
        active,
        spec.block,
    )


def fold_time(params: Motion, spec: MotionSpec, time: Float[Array, ""]) -> mlp.MLP:
    """Evaluate the first layer for a time, to a network of the position alone.

    The contribution of the time is the same for all Gaussians and is computed once.

    Args:
      params: Shared parameters.
      spec: Settings.
      time: Normalized time.

    Returns:
      The trunk at that time.
    """
    features = encoding.encode(spec.time, time[None], None)
    if params.time is not None:
        features = mlp.apply(_time_spec(spec), params.time, features)["code"]
    return mlp.with_known(trunk_spec(spec), params.trunk, features)


def offsets_at_time(
    at_time: mlp.MLP, spec: MotionSpec, points: Float[Array, "points 3"]
) -> Offsets:
    """Evaluate the residuals of points at the time of `fold_time`.

    Args:
      at_time: Result of `fold_time`.
      spec: Settings.
      points: Canonical means.

    Returns:
      The residuals.
    """
    features = jax.vmap(lambda point: encoding.encode(spec.position, point, None))(
        points
    )
    position_only = dataclasses.replace(trunk_spec(spec), inputs=spec.position.width(3))
    return Offsets(**mlp.apply(position_only, at_time, features))


def apply(gaussians: Gaussians, offsets: Offsets, scale_rule: str) -> Gaussians:
    """Apply residuals to Gaussians.

    The rotation is q / |q| + offset, which the renderer normalizes. A zero quaternion
    counts as the identity.

    Args:
      gaussians: Canonical Gaussians.
      offsets: Residuals.
      scale_rule: "log" or "linear".

    Returns:
      The deformed Gaussians.
    """
    unit = jax.vmap(quaternion.normalize)(gaussians.quaternion)
    if scale_rule == "log":
        # Clamped like the canonical logarithm, so that large residuals stay finite.
        factor = jnp.exp(jnp.clip(offsets.scale, *splats.LOG_SCALE_RANGE))
        scale = gaussians.scale * factor
    else:
        scale = gaussians.scale + offsets.scale
    return Gaussians(
        mean=gaussians.mean + offsets.mean,
        quaternion=unit + offsets.quaternion,
        scale=scale,
        opacity=gaussians.opacity,
    )


def smooth_time(
    key: Key[Array, ""],
    spec: SmoothingSpec,
    time: Float[Array, ""],
    step: Int[Array, ""],
    frames: int,
) -> Float[Array, ""]:
    """Add noise to a time that decays linearly to zero at `spec.steps`.

    Equation 6 of the paper, with an interval between frames of 1 / `frames`. The
    published code divides by the number of frames that are left in the epoch, so its
    interval grows to 1 within every epoch, which is 26 times the intended noise (root
    mean square at 400 frames).

    Args:
      key: PRNG key.
      spec: Settings.
      time: Normalized time.
      step: Training step.
      frames: Number of training frames.

    Returns:
      The time with noise.
    """
    deviation = schedules.time_noise(frames, spec.steps, spec.first)(step)
    noise = jax.random.normal(key, (), time.dtype)
    return time + noise * deviation.astype(time.dtype)


@dataclasses.dataclass(frozen=True)
class BoundNetworks(BoundMotion):
    """Base of the motions by networks of position and time.

    Attributes:
      frames: Number of training frames.
    """

    frames: int

    name: ClassVar[str]
    init_shared: ClassVar[Callable[..., Any]]  # of the module of the motion

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rate of the networks."""
        return MotionParams(shared=self.rate(step))

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the networks."""
        _, shared_key = jax.random.split(key)
        return MotionParams(shared=self.init_shared(shared_key, self.spec))

    def noisy_time(self, frame: FrameCondition) -> Float[Array, ""]:
        """Return the time of a frame, with the noise of early training steps.

        Args:
          frame: Time, step and key of the frame.

        Returns:
          Time in units of the capture, which may leave [0, 1].
        """
        smoothing = self.spec.smoothing
        if smoothing is None or frame.step is None:
            return frame.time
        assert frame.key is not None
        key = jax.random.fold_in(frame.key, zlib.crc32(self.name.encode()) >> 1)
        return smooth_time(key, smoothing, frame.time, frame.step, self.frames)


class Bound(BoundNetworks):
    """The `Motion` of a `MotionSpec` in a run of `steps`."""

    name = NAME
    init_shared = staticmethod(init)

    def apply(
        self,
        params: MotionParams,
        cache: None,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to a time, which is noisy early in training."""
        time, active = self.noisy_time(frame), splats.in_use(gaussians)
        offsets = deform(params.shared, self.spec, gaussians.mean, time, active)
        return apply(gaussians, offsets, self.spec.scale_rule)
