"""Deformation by an embedding per Gaussian and a time code, with two networks.

Bae et al. 2024, "Per-Gaussian embedding-based deformation", arXiv:2404.03613 (E-D3DGS),
with the sizes of its code. A network maps the codes to residuals (section 3.2, equation
4). A coarse and a fine network read the same table of time codes (section 3.3,
`motion.codes`), and their residuals of position, scale and rotation are added. Equation
4 also has residuals of opacity and color, which the code disables for HyperNeRF's
videos. The growing number of codes of the fine network is taken from the code.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Key

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.motion import codes as motion_codes
from gaussians_jax.motion.blocks import in_blocks
from gaussians_jax.motion.kan import BoundResiduals, KanMotionSpec, Offsets
from nerfies_jax.nn import mlp
from nerfies_jax.nn.mlp import MLP, HeadSpec, Layer, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.step_counts import steps

NAME = "embedding_motion"


@dataclasses.dataclass(frozen=True)
class EmbeddingMotionSpec:
    """Settings of the motion, by default those of E-D3DGS's code for HyperNeRF.

    Differences: rotations are rotation vectors where the code adds to quaternions. The
    last layers are initialized to zero, where the code initializes them like others.
    For other videos the code fades in the residuals over a thousand steps, and learns a
    time offset per camera.

    `smoothness` is the weight of the mean squared second difference between consecutive
    time codes, which the code intends but misses because of an index error. `opacity`
    is the weight of the mean opacity, which replaces opacity resets. The code uses the
    sigmoid of the mean logit instead. A weight of zero disables its loss.
    """

    embedding: int = 32
    time_code: int = 256
    frames_per_code: int = 2  # a table of ceil(frames / 2) codes
    coarser: int = 5  # ratio of the numbers of fine and coarse time codes
    # Standard deviation and waves of the initial codes, as in `KanMotionSpec`. The
    # code initializes them to zero.
    spread: float = 0.1
    waves: float | None = None
    width: int = 128
    grow_until: int = steps(10_000)  # step from which the fine network reads all codes
    smoothness: float = 1e-4
    opacity: float = 1e-4
    warm_up: int = steps(0)  # steps without motion
    embedding_rate: float = 2.5e-3
    learning_rate: float = 1.6e-4  # of networks and time codes
    learning_rate_end: float = 1.6e-5
    block: int = 512  # Gaussians per evaluation

    def __post_init__(self):
        for name in ("width", "block"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        KanMotionSpec(  # validates the settings of the codes
            embedding=self.embedding,
            time_code=self.time_code,
            frames_per_code=self.frames_per_code,
            spread=self.spread,
            coarser=self.coarser,
            grow_until=self.grow_until,
            smoothness=self.smoothness,
            opacity=self.opacity,
            warm_up=self.warm_up,
            embedding_rate=self.embedding_rate,
        )

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.timestamps)


class Decoder(NamedTuple):
    """One of the two networks."""

    first: Layer  # reads [embedding, time code]
    heads: dict[str, MLP]  # one hidden layer each


class EmbeddingMotion(NamedTuple):
    """Shared parameters. The embeddings are per-Gaussian parameters."""

    times: Float[Array, "times code"]  # evenly spaced over [0, 1]
    # Number of codes to which the fine network resamples the table. Projection steps
    # set it, and it gets no gradient.
    rows: Float[Array, "1"]
    coarse: Decoder
    fine: Decoder


def init(
    key: Key[Array, ""],
    spec: EmbeddingMotionSpec,
    frames: int,
    dtype: DTypeLike = jnp.float32,
) -> EmbeddingMotion:
    """Initialize networks without motion.

    Args:
      key: PRNG key.
      spec: Settings.
      frames: Number of training frames.
      dtype: Floating-point type.

    Returns:
      Shared parameters.
    """
    times_key, coarse_key, fine_key = jax.random.split(key, 3)
    times = motion_codes.init_times(times_key, spec, frames, dtype)
    rows = jnp.full(1, motion_codes.fine_rows(spec, len(times), 0), dtype)
    return EmbeddingMotion(
        times,
        rows,
        _init_decoder(coarse_key, spec, dtype),
        _init_decoder(fine_key, spec, dtype),
    )


def _head_spec(spec):
    return MLPSpec(
        spec.width, 1, spec.width, (("out", HeadSpec(3, "zero")),), (), "relu", "he"
    )


def _init_decoder(key, spec, dtype):
    first_key, *keys = jax.random.split(key, 1 + len(Offsets._fields))
    inputs = spec.embedding + spec.time_code
    return Decoder(
        mlp.init_layer(first_key, inputs, spec.width, "he", dtype),
        {
            name: mlp.init(_head_spec(spec), head_key, dtype)
            for name, head_key in zip(Offsets._fields, keys, strict=True)
        },
    )


def prepare(
    params: EmbeddingMotion,
    spec: EmbeddingMotionSpec,
    embedding: Float[Array, "gaussians embedding"],
    active: Bool[Array, " gaussians"] | None = None,
) -> Float[Array, "gaussians features"]:
    """Compute the time-independent part of both first layers.

    Args:
      params: Shared parameters.
      spec: Settings.
      embedding: Embeddings of the Gaussians.
      active: Active Gaussians. Blocks without any are zero.

    Returns:
      Features [gaussians, features].
    """
    weight = jnp.concatenate(
        [
            decoder.first.weight[: spec.embedding]
            for decoder in (params.coarse, params.fine)
        ],
        axis=1,
    )
    return in_blocks(lambda rows: rows @ weight, (embedding,), active, spec.block)


def deform(
    params: EmbeddingMotion,
    spec: EmbeddingMotionSpec,
    time: Float[Array, ""],
    prepared: Float[Array, "gaussians features"],
    active: Bool[Array, " gaussians"] | None = None,
) -> Offsets:
    """Evaluate the residuals of all Gaussians at a time, summed over both networks.

    Equation 4 for the coarse and the fine time code (section 3.3).

    Args:
      params: Shared parameters.
      spec: Settings.
      time: Normalized time.
      prepared: Result of `prepare`.
      active: Active Gaussians. Blocks without any are zero.

    Returns:
      The residuals.
    """
    decoders = (params.coarse, params.fine)
    time_codes = motion_codes.read(spec, params.times, params.rows, time)
    time_parts = [
        code @ decoder.first.weight[spec.embedding :] + decoder.first.bias
        for decoder, code in zip(decoders, time_codes, strict=True)
    ]

    def evaluate(rows):
        parts = jnp.split(rows, 2, axis=-1)
        total = {name: 0.0 for name in Offsets._fields}
        for decoder, part, time_part in zip(decoders, parts, time_parts, strict=True):
            features = jax.nn.relu(part + time_part)
            for name, head in decoder.heads.items():
                residual = mlp.apply(_head_spec(spec), head, features)["out"]
                total[name] = total[name] + residual
        return total

    return Offsets(**in_blocks(evaluate, (prepared,), active, spec.block))


class Bound(BoundResiduals):
    """The `Motion` of an `EmbeddingMotionSpec` in a run of `steps`."""

    name = NAME
    init_shared = staticmethod(init)
    prepare = staticmethod(prepare)
    deform = staticmethod(deform)


# 30 codes for the built-in scene. The coarse network reads 6, the fine one 6 to 30.
SMALL_EMBEDDING_MOTION = EmbeddingMotionSpec(
    time_code=16, width=64, waves=2.0, spread=0.5, grow_until=1300
)
