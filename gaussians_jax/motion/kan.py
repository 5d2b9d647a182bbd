"""Motion as an RBF-KAN of an embedding per Gaussian and a time code.

"Sonata", equation 11: a learned embedding of each Gaussian and a learned code of the
time are mapped by an RBF-KAN to residuals of position, scale and rotation. Details that
the paper does not give are those of Bae et al. 2024, "Per-Gaussian embedding-based
deformation", arXiv:2404.03613 (E-D3DGS), whose inputs, neighbors and constants it
shares. With `coarser` there are a coarse and a fine network as in E-D3DGS
(`motion.codes`).

The first layer of the network is a sum over its inputs. The contribution of the
embeddings is the same at all times (`prepare`), and that of the time is the same for
all Gaussians.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.motion import codes as motion_codes
from gaussians_jax.motion.blocks import in_blocks
from nerfies_jax.nn import codes, kan, mlp
from nerfies_jax.nn.kan import KAN, KANSpec
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.step_counts import steps

NAME = "kan_motion"
NETWORKS = ("kan", "mlp", "bspline")


@dataclasses.dataclass(frozen=True)
class KanMotionSpec:
    """Settings of the motion, with sizes of E-D3DGS and the embedding of the paper.

    `position`, `scale` and `rotation` enable the residuals (the paper's ablation). A
    disabled head has no parameters. `network="bspline"` is the KAN that the paper
    argues against, with cubic B-splines instead of Gaussians (equations 4 and 5).
    `network="mlp"` is its ablation without a KAN: ReLU layers with the same inputs,
    heads and depth, with the width that gives an equal number of parameters unless
    `mlp_width` is given.
    """

    embedding: int = 32
    time_code: int = 256
    frames_per_code: int = 2  # a table of ceil(frames / 2) codes
    # Standard deviation of the initial embeddings and time codes. E-D3DGS initializes
    # embeddings to zero, and the neighbors loss then never lets them differ.
    spread: float = 0.1
    # Initial embeddings are random waves over space, with this phase (rad) from the
    # center of the Gaussians to their root mean square distance. None: independent.
    waves: float | None = None
    hidden: tuple[int, ...] = (128, 128)
    kernels: int = 8
    base: bool = True
    norm: bool = True
    trainable_kernels: bool = False
    width_jitter: float | None = None  # as for `nn.kan.KANSpec`
    network: str = "kan"
    mlp_width: int | None = None
    position: bool = True
    scale: bool = True
    rotation: bool = True
    # Ratio of the numbers of fine and coarse time codes. None: no coarse network.
    coarser: int | None = None
    grow_until: int = steps(10_000)  # step from which the fine network reads all codes
    # Weights of `motion.codes.second_differences` and of the mean opacity, which
    # replaces opacity resets. Zero disables a loss.
    smoothness: float = 0.0
    opacity: float = 0.0
    warm_up: int = steps(0)  # steps without motion
    embedding_rate: float = 2.5e-3
    learning_rate: float = 1.6e-4  # of network and time codes
    learning_rate_end: float = 1.6e-5
    block: int = 512  # Gaussians per evaluation

    def __post_init__(self):
        sizes = self.embedding, self.time_code, self.frames_per_code, self.block
        if min(sizes) < 1 or self.warm_up < 0 or not self.hidden:
            raise ValueError(
                "embedding, time_code, frames_per_code and block must be at least 1, "
                "warm_up must not be negative and hidden not empty; got "
                f"embedding={self.embedding}, time_code={self.time_code}, "
                f"frames_per_code={self.frames_per_code}, block={self.block}, "
                f"warm_up={self.warm_up}, hidden={self.hidden}"
            )
        if self.network not in NETWORKS:
            raise ValueError(
                f"unknown network {self.network!r}; choose from {NETWORKS}"
            )
        if self.mlp_width is not None and self.network != "mlp":
            raise ValueError(
                f"mlp_width={self.mlp_width} is used by network='mlp' only; leave it "
                "out"
            )
        if not (self.position or self.scale or self.rotation):
            raise ValueError(
                "position, scale and rotation are all off; disable the motion instead"
            )
        if not 0 < self.spread < math.inf:
            raise ValueError(
                f"spread={self.spread} must be positive, because equal codes stay "
                "equal; use about 0.1"
            )
        if (self.coarser is not None and self.coarser < 1) or self.grow_until < 0:
            raise ValueError(
                f"coarser={self.coarser} must be at least 1, or None, and grow_until="
                f"{self.grow_until} not negative"
            )
        if not all(0 <= x < math.inf for x in (self.smoothness, self.opacity)):
            raise ValueError(
                f"smoothness={self.smoothness} and opacity={self.opacity} must be "
                "finite and not negative"
            )
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        if not self.embedding_rate > 0:
            raise ValueError(f"embedding_rate={self.embedding_rate} must be positive")
        field_spec(self)  # validates the settings of the network

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.timestamps)


class KanMotion(NamedTuple):
    """Shared parameters. The embeddings are per-Gaussian parameters."""

    times: Float[Array, "times code"]  # evenly spaced over [0, 1]
    field: KAN | MLP  # the fine network, if there are two
    # Number of codes to which the fine network resamples the table. Projection steps
    # set it, and it gets no gradient.
    rows: Float[Array, "1"] | None = None
    coarse: KAN | MLP | None = None


class Offsets(NamedTuple):
    """Residuals of position, scale and rotation, None where disabled."""

    position: Float[Array, "gaussians 3"] | None  # scene units
    log_scale: Float[Array, "gaussians 3"] | None  # added to the logarithm
    turn: Float[Array, "gaussians 3"] | None  # rotation vector, rad, in world axes


def field_spec(spec: KanMotionSpec) -> KANSpec | MLPSpec:
    """Settings of the network from [embedding, time code] to the enabled residuals.

    The heads are initialized to zero, so that nothing moves.

    Args:
      spec: Settings of the motion.

    Returns:
      Settings of the network.
    """
    kan_spec = _kan_spec(spec)
    if spec.network != "mlp":
        return kan_spec
    width = spec.mlp_width
    if width is None:
        width = _equal_width(kan_spec)
    return _mlp_spec(kan_spec, width)


def _kan_spec(spec):
    head_flags = {
        "position": spec.position,
        "log_scale": spec.scale,
        "turn": spec.rotation,
    }
    heads = tuple(
        (name, HeadSpec(3, "zero")) for name, is_on in head_flags.items() if is_on
    )
    return KANSpec(
        in_features=spec.embedding + spec.time_code,
        hidden=spec.hidden,
        heads=heads,
        kernels=spec.kernels,
        base=spec.base,
        norm=spec.norm,
        trainable_kernels=spec.trainable_kernels,
        width_jitter=spec.width_jitter,
        basis="bspline" if spec.network == "bspline" else "rbf",
    )


def _mlp_spec(spec: KANSpec, width):
    return MLPSpec(
        spec.in_features, len(spec.hidden), width, spec.heads, (), "relu", "he"
    )


def _equal_width(spec: KANSpec) -> int:
    """Find the width of an MLP with the KAN's depth and about as many parameters."""
    goal = parameter_count(spec)
    width = 1
    while parameter_count(_mlp_spec(spec, width + 1)) <= goal:
        width += 1
    below, above = (
        abs(parameter_count(_mlp_spec(spec, w)) - goal) for w in (width, width + 1)
    )
    return width if below <= above else width + 1


def parameter_count(spec: KANSpec | MLPSpec) -> int:
    """Count the parameters of the network, without per-Gaussian parameters.
    Args:
      spec: Settings of the network.

    Returns:
      Number of parameters.
    """
    per_input, kernel_parameters = 1, 0
    if isinstance(spec, KANSpec):
        widths = spec.widths()
        per_input = spec.kernels + spec.base
        kernel_parameters = (
            2 * spec.kernels * sum(widths) if spec.trainable_kernels else 0
        )
    else:
        widths = (spec.inputs, *(spec.width,) * spec.depth)
    outputs = (*widths[1:], sum(head.width for _, head in spec.heads))
    return kernel_parameters + sum(
        per_input * inputs * outputs_of + outputs_of
        for inputs, outputs_of in zip(widths, outputs, strict=True)
    )


# Forward and backward with `prepare`, for 5k and 10k Gaussians on one core: 16 and 30
# ms, compared with 12 and 23 for a `MotionSpec` of 4x64. SiLU would add a quarter, a
# sixth kernel a fifth. The default sizes take 270 ms for 10k, an MLP with as many
# parameters 370, the 8x256 network of Deformable 3DGS 510.
SMALL_KAN_MOTION = KanMotionSpec(time_code=16, hidden=(32, 32), kernels=5, base=False)


def init(
    key: Key[Array, ""],
    spec: KanMotionSpec,
    frames: int,
    dtype: DTypeLike = jnp.float32,
) -> KanMotion:
    """Initialize a motion model without motion.

    Args:
      key: PRNG key.
      spec: Settings.
      frames: Number of training frames.
      dtype: Floating-point type.

    Returns:
      Shared parameters.
    """
    times_key, field_key, coarse_key = jax.random.split(key, 3)
    times = motion_codes.init_times(times_key, spec, frames, dtype)
    network = field_spec(spec)

    def init_field(key):
        if isinstance(network, KANSpec):
            return kan.init(key, network, dtype)
        return mlp.init(network, key, dtype)

    field = init_field(field_key)
    if spec.coarser is None:
        return KanMotion(times, field)
    rows = jnp.full(1, motion_codes.fine_rows(spec, len(times), 0), dtype)
    return KanMotion(times, field, rows, init_field(coarse_key))


def prepare(
    params: KanMotion,
    spec: KanMotionSpec,
    embedding: Float[Array, "gaussians embedding"],
    active: Bool[Array, " gaussians"] | None = None,
) -> Float[Array, "gaussians features"]:
    """Compute the time-independent contribution of the embeddings to the first layer.

    With two networks, their contributions are concatenated. They take 4 bytes per
    feature of the first layer and Gaussian: 5 MB for 10,000 Gaussians with the default
    sizes. On one core, the deformation of 10,000 takes 68 ms without and 58 with this
    cache, or 10 and 7 in the small sizes.

    Args:
      params: Shared parameters.
      spec: Settings.
      embedding: Per-Gaussian embeddings.
      active: Active Gaussians. Blocks without any are zero.

    Returns:
      Contributions [gaussians, features].
    """

    def features(rows):
        parts = [_first_layer_part(spec, field, rows, 0) for field in _fields(params)]
        return jnp.concatenate(parts, axis=-1)

    return in_blocks(features, (embedding,), active, spec.block)


def deform(
    params: KanMotion,
    spec: KanMotionSpec,
    time: Float[Array, ""],
    prepared: Float[Array, "gaussians features"],
    active: Bool[Array, " gaussians"] | None = None,
) -> Offsets:
    """Evaluate the residuals of all Gaussians at a time.

    Args:
      params: Shared parameters.
      spec: Settings.
      time: Normalized time.
      prepared: Result of `prepare`.
      active: Active Gaussians. Blocks without any are zero.

    Returns:
      The residuals.
    """
    fields = _fields(params)
    time_codes: tuple[Float[Array, " code"], ...]
    if params.coarse is None:
        time_codes = (codes.at_time(params.times, time),)
    else:
        assert params.rows is not None
        time_codes = motion_codes.read(spec, params.times, params.rows, time)
    time_parts = [
        _first_layer_part(spec, field, code, spec.embedding)
        for field, code in zip(fields, time_codes, strict=True)
    ]

    def evaluate(rows):
        parts = jnp.split(rows, len(fields), axis=-1)
        residuals = [
            _after_first_layer(spec, field, part + time_part)
            for field, part, time_part in zip(fields, parts, time_parts, strict=True)
        ]
        return functools.reduce(functools.partial(jax.tree.map, jnp.add), residuals)

    heads = in_blocks(evaluate, (prepared,), active, spec.block)
    return Offsets(*(heads.get(name) for name in Offsets._fields))


def _fields(params):
    """Return the networks whose residuals are added."""
    return (params.field,) if params.coarse is None else (params.coarse, params.field)


def _first_layer_part(spec, field, part, start):
    """Return the contribution of inputs from `start` on to the first layer, no bias."""
    if isinstance(field, KAN):
        return kan.first_layer_part(field_spec(spec), field, part, start)
    return part @ field.hidden[0].weight[start : start + part.shape[-1]]


def _after_first_layer(spec, field, first):
    """Compute the outputs of the heads from the sum of the first layer's parts."""
    network = field_spec(spec)
    if isinstance(field, KAN):
        return kan.after_first_layer(network, field, first)
    layer, *others = field.hidden
    features = mlp.ACTIVATIONS[network.activation](first + layer.bias)
    remaining = dataclasses.replace(network, inputs=network.width, depth=len(others))
    return mlp.apply(remaining, MLP(tuple(others), field.heads), features)


def apply(gaussians: Gaussians, offsets: Offsets) -> Gaussians:
    """Apply the enabled residuals to Gaussians.

    The position is added. The residual of the scale is added to its logarithm, as in
    E-D3DGS, and clamped to the range of the logarithm. The paper's rotation has three
    numbers where a quaternion has four. Here it is a rotation vector, applied after the
    Gaussian's own rotation, exp(turn) q / |q|, which has unit length for any network
    output. Opacity and color do not change.

    Args:
      gaussians: Canonical Gaussians.
      offsets: Residuals.

    Returns:
      The deformed Gaussians.
    """
    if offsets.position is not None:
        gaussians = gaussians._replace(mean=gaussians.mean + offsets.position)
    if offsets.log_scale is not None:
        factor = jnp.exp(jnp.clip(offsets.log_scale, *splats.LOG_SCALE_RANGE))
        gaussians = gaussians._replace(scale=gaussians.scale * factor)
    if offsets.turn is not None:
        gaussians = gaussians._replace(
            quaternion=splats.rotate(gaussians, offsets.turn)
        )
    return gaussians


@dataclasses.dataclass(frozen=True)
class BoundResiduals(motion_codes.BoundCodes):
    """Base of the motions by residuals that networks compute from both codes."""

    # Functions of the module of the motion.
    init_shared: ClassVar[Callable[..., Any]]
    prepare: ClassVar[Callable[..., Any]]
    deform: ClassVar[Callable[..., Offsets]]

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the embeddings, the time codes and the networks."""
        rows_key, shared_key = jax.random.split(key)
        return MotionParams(
            motion_codes.init_embedding(rows_key, self.spec, gaussians.mean),
            self.init_shared(shared_key, self.spec, self.frames),
        )

    def precompute(
        self, params: MotionParams, gaussians: Splats
    ) -> Float[Array, "gaussians features"]:
        """Compute the features that do not depend on the time."""
        active = splats.active_mask(gaussians)
        return self.prepare(params.shared, self.spec, params.per_gaussian, active)

    def apply(
        self,
        params: MotionParams,
        cache: Float[Array, "gaussians features"],
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at a time."""
        active = splats.in_use(gaussians)
        offsets = self.deform(params.shared, self.spec, frame.time, cache, active)
        return apply(gaussians, offsets)


class Bound(BoundResiduals):
    """The `Motion` of a `KanMotionSpec` in a run of `steps`."""

    name = NAME
    init_shared = staticmethod(init)
    prepare = staticmethod(prepare)
    deform = staticmethod(deform)
