"""Motion as a network of Gaussian kernels, of a code for each Gaussian and the time.

"Sonata", equation 11: a learned embedding of each Gaussian and a learned code of the
time go through an RBF-KAN to residuals of position, scale and rotation. Where the paper
is silent this follows Bae et al. 2024, "Per-Gaussian embedding-based deformation",
arXiv:2404.03613 (E-D3DGS), whose inputs, neighbors and constants it shares, and where
`coarser` is set its two networks, a coarse and a fine one (`motion_codes`).

The first layer of the network is a sum over its inputs. What the embeddings add to it
is the same at all times (`prepare`), what the time adds the same for all Gaussians.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
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
    """Sizes and schedule; the paper gives the size of the embedding, and E-D3DGS the
    rest.

    `position`, `scale` and `rotation` enable the residuals (the paper's ablation). A
    disabled head has no parameters. `network` "bspline" is the KAN that the paper
    argues against, with cubic B-splines instead of Gaussians (equations 4 and 5). "mlp"
    is its ablation without a KAN: as many ReLU layers of the same inputs and heads, and
    as wide as makes the
      number of
    parameters equal, unless `mlp_width` is given.
    """

    embedding: int = 32
    time_code: int = 256
    frames_per_code: int = 2  # a table of ceil(frames / 2) codes
    # Standard deviation of the first embeddings and time codes. E-D3DGS starts from
    # zero embeddings, which a penalty on differing neighbors never tells apart.
    spread: float = 0.1
    # First embeddings as random waves over space, so many radians from the middle of
    # the Gaussians to their root mean square distance; None draws each by itself.
    waves: float | None = None
    hidden: tuple[int, ...] = (128, 128)
    kernels: int = 8
    base: bool = True
    norm: bool = True
    trainable_kernels: bool = False
    network: str = "kan"
    mlp_width: int | None = None
    position: bool = True
    scale: bool = True
    rotation: bool = True
    # Of so many rows of the table one stays for a coarse network; None: there is none.
    coarser: int | None = None
    grow_until: int = steps(10_000)  # when the fine network beside it reads all rows
    # Weights, of which zero leaves the term out: of `motion_codes.second_differences`,
    # and of the mean opacity, in the place of resets.
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
                "embedding, time_code, frames_per_code and block are at least 1, "
                "warm_up is not negative and there is a hidden layer; got "
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
                f"mlp_width={self.mlp_width} is read by network='mlp' only"
            )
        if not (self.position or self.scale or self.rotation):
            raise ValueError(
                "position, scale and rotation are all off; leave the motion out instead"
            )
        if not 0 < self.spread < math.inf:
            raise ValueError(
                f"spread={self.spread}: equal codes stay equal; start at about 0.1"
            )
        if (self.coarser is not None and self.coarser < 1) or self.grow_until < 0:
            raise ValueError(
                f"coarser={self.coarser} must be at least 1, or none, and grow_until="
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
        field_spec(self)  # checks what the network is made of

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.moments)


class KanMotion(NamedTuple):
    """Shared parameters. The embeddings are per-Gaussian parameters."""

    times: Float[Array, "moments code"]  # evenly over [0, 1]
    field: KAN | MLP  # the fine one of two
    # As if of so many the table was read by the fine network; an event sets it, and no
    # slope reaches it.
    rows: Float[Array, "1"] | None = None
    coarse: KAN | MLP | None = None


class Offsets(NamedTuple):
    """Residuals of position, scale and rotation, None where disabled."""

    position: Float[Array, "gaussians 3"] | None  # scene units
    log_scale: Float[Array, "gaussians 3"] | None  # added to the logarithm
    turn: Float[Array, "gaussians 3"] | None  # rotation vector, rad, in world axes


def field_spec(spec: KanMotionSpec) -> KANSpec | MLPSpec:
    """The network from [embedding, time code] to the residuals that are on.

    Its heads start at zero, and so does the motion.
    """
    kan_spec = _kan_spec(spec)
    if spec.network != "mlp":
        return kan_spec
    width = spec.mlp_width
    if width is None:
        width = equal_width(kan_spec)
    return _mlp_spec(kan_spec, width)


def _kan_spec(spec):
    wanted = {
        "position": spec.position,
        "log_scale": spec.scale,
        "turn": spec.rotation,
    }
    heads = tuple(
        (name, HeadSpec(3, "zero")) for name, is_on in wanted.items() if is_on
    )
    return KANSpec(
        in_features=spec.embedding + spec.time_code,
        hidden=spec.hidden,
        heads=heads,
        kernels=spec.kernels,
        base=spec.base,
        norm=spec.norm,
        trainable_kernels=spec.trainable_kernels,
        basis="bspline" if spec.network == "bspline" else "rbf",
    )


def _mlp_spec(spec: KANSpec, width):
    return MLPSpec(
        spec.in_features, len(spec.hidden), width, spec.heads, (), "relu", "he"
    )


def equal_width(spec: KANSpec) -> int:
    """The width of an MLP with the KAN's layers and nearest to its parameters."""
    goal = parameter_count(spec)
    width = 1
    while parameter_count(_mlp_spec(spec, width + 1)) <= goal:
        width += 1
    below, above = (
        abs(parameter_count(_mlp_spec(spec, w)) - goal) for w in (width, width + 1)
    )
    return width if below <= above else width + 1


def parameter_count(spec: KANSpec | MLPSpec) -> int:
    """Count the parameters of the network, which do not depend on the number of
    Gaussians.

    Args:
      spec: Settings of the network.

    Returns:
      Number of parameters.
    """
    each, trained = 1, 0
    if isinstance(spec, KANSpec):
        widths = spec.widths()
        each = spec.kernels + spec.base
        trained = 2 * spec.kernels * sum(widths) if spec.trainable_kernels else 0
    else:
        widths = (spec.inputs, *(spec.width,) * spec.depth)
    outputs = (*widths[1:], sum(head.width for _, head in spec.heads))
    return trained + sum(
        each * read * out + out for read, out in zip(widths, outputs, strict=True)
    )


# One core, forward and backward with what is prepared, at 5k and 10k Gaussians: 16 and
# 30 ms; `mlp_motion.SMALL_MOTION` takes 12 and 23 in the same run. SiLU would add a
# quarter, a sixth kernel a fifth. The default sizes take 270 ms at 10k, an MLP of as
# many parameters 370, the 8x256 of Deformable 3DGS 510.
SMALL_KAN_MOTION = KanMotionSpec(time_code=16, hidden=(32, 32), kernels=5, base=False)


def init(
    key: Key[Array, ""], spec: KanMotionSpec, frames: int, dtype=jnp.float32
) -> KanMotion:
    """A field that moves nothing yet, for a capture of `frames` to learn from."""
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

    With two networks, both contributions are next to each other. They take 4 bytes per
    feature of the first layer and Gaussian: 5 MB for 10,000 Gaussians with the default
    sizes. On one core, deforming 10,000 takes 68 ms without and 58 with this, or 10 and
    7 in the small sizes.

    Args:
      params: Shared parameters.
      spec: Settings.
      embedding: Per-Gaussian embeddings.
      active: Active Gaussians. Blocks without any are zero.

    Returns:
      Contributions [gaussians, features].
    """

    def both(rows):
        parts = [_first_layer_part(spec, one, rows, 0) for one in _fields(params)]
        return jnp.concatenate(parts, axis=-1)

    return in_blocks(both, (embedding,), active, spec.block)


def deform(
    params: KanMotion,
    spec: KanMotionSpec,
    time: Float[Array, ""],
    prepared: Float[Array, "gaussians features"],
    active: Bool[Array, " gaussians"] | None = None,
) -> Offsets:
    """Evaluate the residuals of all Gaussians at a time, zero in blocks without active
    ones.
    """
    fields = _fields(params)
    read: tuple[Float[Array, " code"], ...]
    if params.coarse is None:
        read = (codes.at_time(params.times, time),)
    else:
        assert params.rows is not None
        read = motion_codes.read(spec, params.times, params.rows, time)
    shares = [
        _first_layer_part(spec, one, code, spec.embedding)
        for one, code in zip(fields, read, strict=True)
    ]

    def evaluate(rows):
        parts = jnp.split(rows, len(fields), axis=-1)
        answers = [
            _after_first_layer(spec, one, part + share)
            for one, part, share in zip(fields, parts, shares, strict=True)
        ]
        return functools.reduce(functools.partial(jax.tree.map, jnp.add), answers)

    heads = in_blocks(evaluate, (prepared,), active, spec.block)
    return Offsets(*(heads.get(name) for name in Offsets._fields))


def _fields(params):
    """The networks: one, or a coarse and a fine one, whose answers add."""
    return (params.field,) if params.coarse is None else (params.coarse, params.field)


def _first_layer_part(spec, field, part, start):
    """Compute the contribution of the inputs from `start` on to the first layer,
    without bias.
    """
    if isinstance(field, KAN):
        return kan.first_layer_part(field_spec(spec), field, part, start)
    return part @ field.hidden[0].weight[start : start + part.shape[-1]]


def _after_first_layer(spec, field, first):
    """The heads' outputs from the sum of the first layer's parts."""
    network = field_spec(spec)
    if isinstance(field, KAN):
        return kan.after_first_layer(network, field, first)
    layer, *others = field.hidden
    features = mlp.ACTIVATIONS[network.activation](first + layer.bias)
    rest = dataclasses.replace(network, inputs=network.width, depth=len(others))
    return mlp.apply(rest, MLP(tuple(others), field.heads), features)


def apply(gaussians: Gaussians, offsets: Offsets) -> Gaussians:
    """Gaussians moved by the offsets there are.

    Position adds. The logarithm of the scale adds, as in E-D3DGS, held to the range of
    the scale's own. The paper's rotation has three numbers where a quaternion has four:
    a rotation vector, applied after the Gaussian's own turn, exp(turn) q / |q|, of unit
    length whatever the network says. Opacity and color stay.
    """
    if offsets.position is not None:
        gaussians = gaussians._replace(mean=gaussians.mean + offsets.position)
    if offsets.log_scale is not None:
        factor = jnp.exp(jnp.clip(offsets.log_scale, *splats.LOG_SCALE_RANGE))
        gaussians = gaussians._replace(scale=gaussians.scale * factor)
    if offsets.turn is not None:
        gaussians = gaussians._replace(
            quaternion=splats.turned(gaussians, offsets.turn)
        )
    return gaussians


@dataclasses.dataclass(frozen=True)
class Bound(motion_codes.BoundCodes):
    """The `Motion` of a `KanMotionSpec` in a run of `steps`."""

    spec: KanMotionSpec

    name = NAME

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the embeddings, the time codes and the networks."""
        rows_key, shared_key = jax.random.split(key)
        return MotionParams(
            motion_codes.init_embedding(rows_key, self.spec, gaussians.mean),
            init(shared_key, self.spec, self.frames),
        )

    def precompute(
        self, params: MotionParams, gaussians: Splats
    ) -> Float[Array, "gaussians features"]:
        """Evaluate what does not depend on the time."""
        active = splats.active_mask(gaussians)
        return prepare(params.shared, self.spec, params.per_gaussian, active)

    def apply(
        self,
        params: MotionParams,
        cache: Float[Array, "gaussians features"],
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at a time."""
        active = splats.in_use(gaussians)
        offsets = deform(params.shared, self.spec, frame.time, cache, active)
        return apply(gaussians, offsets)
