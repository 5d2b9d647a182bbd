"""Deformation by a per-Gaussian embedding and a time code, with a coarse and a fine
network.

Bae et al. 2024, "Per-Gaussian embedding-based deformation", arXiv:2404.03613 (E-D3DGS),
with the sizes of its code. A network makes residuals of the codes (section 3.2,
equation 4); there are a coarse and a fine one, which read the same table of codes over
time (section 3.3, `motion_codes`), and their residuals of position, scale and rotation
add. Equation 4 has residuals of opacity and color as well, which the code switches off
for HyperNeRF's films; that the fine network reads ever more rows is from the code.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.motion import codes as motion_codes
from gaussians_jax.motion import kan as kan_motion
from gaussians_jax.motion.blocks import in_blocks
from gaussians_jax.motion.kan import KanMotionSpec, Offsets
from nerfies_jax.nn import mlp
from nerfies_jax.nn.mlp import MLP, HeadSpec, Layer, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import (
    FrameCondition,
)
from nerfies_jax.training.step_counts import steps

NAME = "embedding_motion"


@dataclasses.dataclass(frozen=True)
class EmbeddingMotionSpec:
    """Sizes, growth and penalties, by default those of E-D3DGS's code for HyperNeRF's
    videos.

    Rotations are rotation vectors where the code adds to quaternions, and the last
    layers start at zero, where its start as any layer; for other films it fades offsets
    in over a thousand steps, and learns how late a camera is. `smoothness` weighs the
    mean square of second differences between codes that follow each other, which the
    code means and misses by an index. `opacity` weighs the mean opacity, in the place
    of resets; the code takes the sigmoid of the mean logit. A weight of zero leaves its
    term out.
    """

    embedding: int = 32
    time_code: int = 256
    frames_per_code: int = 2  # a table of ceil(frames / 2) codes
    coarser: int = 5  # of so many rows one stays for the coarse network
    # Standard deviation and waves of the first codes, as in `KanMotionSpec`; the code's
    # are all zero.
    spread: float = 0.1
    waves: float | None = None
    width: int = 128
    grow_until: int = steps(10_000)  # when the fine network reads all rows
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
        KanMotionSpec(  # checks what codes are made of
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
        """Return the motion for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.moments)


class Decoder(NamedTuple):
    """One of the two networks."""

    first: Layer  # reads [embedding, time code]
    heads: dict[str, MLP]  # one hidden layer each


class EmbeddingMotion(NamedTuple):
    """Shared parameters. The embeddings are per-Gaussian parameters."""

    times: Float[Array, "moments code"]  # evenly over [0, 1]
    # As if of so many the table was read by the fine network; an event sets it, and no
    # slope reaches it.
    rows: Float[Array, "1"]
    coarse: Decoder
    fine: Decoder


def init(
    key: Key[Array, ""], spec: EmbeddingMotionSpec, frames: int, dtype=jnp.float32
) -> EmbeddingMotion:
    """Networks that move nothing yet, for a capture of `frames` to learn from."""
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
    """Compute the time-independent part of both first layers from the embeddings."""
    weight = jnp.concatenate(
        [one.first.weight[: spec.embedding] for one in (params.coarse, params.fine)],
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
    """Offsets of every Gaussian at one time, those of both networks added up.

    Equation 4 twice, of the coarse and the fine code of the time (section 3.3).
    """
    decoders = (params.coarse, params.fine)
    reads = motion_codes.read(spec, params.times, params.rows, time)
    shares = [
        code @ one.first.weight[spec.embedding :] + one.first.bias
        for one, code in zip(decoders, reads, strict=True)
    ]

    def evaluate(rows):
        parts = jnp.split(rows, 2, axis=-1)
        total = {name: 0.0 for name in Offsets._fields}
        for one, part, share in zip(decoders, parts, shares, strict=True):
            features = jax.nn.relu(part + share)
            for name, head in one.heads.items():
                answer = mlp.apply(_head_spec(spec), head, features)["out"]
                total[name] = total[name] + answer
        return total

    return Offsets(**in_blocks(evaluate, (prepared,), active, spec.block))


@dataclasses.dataclass(frozen=True)
class Bound(motion_codes.BoundCodes):
    """The `Motion` of a `EmbeddingMotionSpec` in a run of `steps`."""

    spec: EmbeddingMotionSpec

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
        return kan_motion.apply(gaussians, offsets)


# 30 codes for the built-in scene: the coarse network reads six, the fine one six to 30.
SMALL_EMBEDDING_MOTION = EmbeddingMotionSpec(
    time_code=16, width=64, waves=2.0, spread=0.5, grow_until=1300
)
