"""Motion of a code for each Gaussian and the time, a coarse network and a fine one.

Bae et al. 2024, "Per-Gaussian embedding-based deformation", arXiv:2404.03613 (E-D3DGS),
section 3, with the sizes of its code. Both networks read the same table of codes over
time: the coarse one as if it had a fifth of its rows, the fine one with ever more of
them (`EmbeddingMotion.rows`), so that slow motion is found before fast motion. Their
residuals of position, scale and rotation add.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from gaussians_jax import splats
from gaussians_jax.effects import kan_motion
from gaussians_jax.effects.blocks import in_blocks
from gaussians_jax.effects.kan_motion import KanMotionSpec, Offsets
from gaussians_jax.splats import Gaussians, Params
from nerfies_jax.nets import codes, mlp
from nerfies_jax.nets.mlp import MLP, HeadSpec, Layer, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import (
    Effect,
    FrameCondition,
    PenaltyContext,
    Term,
    from_step,
)
from nerfies_jax.training.step_counts import steps

NAME = "embedding_motion"


@dataclasses.dataclass(frozen=True)
class EmbeddingMotionSpec:
    """Sizes, growth and penalties; defaults of E-D3DGS's code for HyperNeRF's films.

    Rotations are rotation vectors where the code adds to quaternions, and the last
    layers start at zero. `smoothness` weighs the mean square of second differences
    between codes that follow each other, which the code means and misses by an index.
    `opacity` weighs the mean opacity, in the place of resets; the code takes the
    sigmoid of the mean logit.
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
        for name in ("coarser", "width", "block"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        if self.grow_until < 0:
            raise ValueError(f"grow_until={self.grow_until} must not be negative")
        for name in ("smoothness", "opacity"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name}={getattr(self, name)} must be finite and not negative"
                )
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        first_codes(self)  # checks what codes are made of


class Decoder(NamedTuple):
    """One of the two networks."""

    first: Layer  # reads [embedding, time code]
    heads: dict[str, MLP]  # one hidden layer each


class EmbeddingMotion(NamedTuple):
    """Parameters that all Gaussians share; the embeddings are rows."""

    times: Float[Array, "moments code"]  # evenly over [0, 1]
    # As if of so many the table was read by the fine network; an event sets it, and no
    # slope reaches it.
    rows: Float[Array, "1"]
    coarse: Decoder
    fine: Decoder


def first_codes(spec: EmbeddingMotionSpec) -> KanMotionSpec:
    """How embeddings and codes of time start: as those of the motion by a KAN."""
    return KanMotionSpec(
        embedding=spec.embedding,
        time_code=spec.time_code,
        frames_per_code=spec.frames_per_code,
        spread=spec.spread,
        waves=spec.waves,
        warm_up=spec.warm_up,
        embedding_rate=spec.embedding_rate,
    )


def moments(spec: EmbeddingMotionSpec, frames: int) -> int:
    """Rows of the table, for so many frames to learn from."""
    return -(-frames // spec.frames_per_code)


def coarse_rows(spec: EmbeddingMotionSpec, count: int) -> int:
    """What the coarse network reads of a table of `count`, and the fine one at first.

    Two at least, or there is no motion; all of a smaller table.
    """
    return min(count, max(2, -(-count // spec.coarser)))


def fine_rows(spec: EmbeddingMotionSpec, count: int, step: int) -> int:
    """How many rows the fine network reads after so many steps; host side."""
    least = coarse_rows(spec, count)
    if step >= spec.grow_until:
        return count
    return least + (count - least) * step // spec.grow_until


def growth_steps(spec: EmbeddingMotionSpec, count: int) -> tuple[int, ...]:
    """After which steps that number is another one."""
    reads = [fine_rows(spec, count, step) for step in range(spec.grow_until + 1)]
    return tuple(k for k in range(1, len(reads)) if reads[k] != reads[k - 1])


def init(
    key: Key[Array, ""], spec: EmbeddingMotionSpec, frames: int, dtype=jnp.float32
) -> EmbeddingMotion:
    """Networks that move nothing yet, for a capture of `frames` to learn from."""
    times_key, coarse_key, fine_key = jax.random.split(key, 3)
    times = kan_motion.init_times(times_key, first_codes(spec), frames, dtype)
    rows = jnp.full(1, fine_rows(spec, len(times), 0), dtype)
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
    """What the embeddings add to both first layers, side by side, whatever the time."""
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
    """Offsets of every Gaussian at one time, those of both networks added up."""
    count = params.times.shape[0]
    least = jnp.asarray(coarse_rows(spec, count), time.dtype)
    reads = (least, jax.lax.stop_gradient(params.rows[0]))
    decoders = (params.coarse, params.fine)
    shares = [
        codes.at_time_of(params.times, rows, time) @ one.first.weight[spec.embedding :]
        + one.first.bias
        for one, rows in zip(decoders, reads, strict=True)
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


def second_differences(
    times: Float[Array, "moments code"],
) -> Float[Array, ""]:
    """Mean square of how codes bend from row to row; 0 of fewer than three."""
    if times.shape[0] < 3:
        return jnp.zeros((), times.dtype)
    return jnp.mean(jnp.square(jnp.diff(times, 2, axis=0)))


def mean_opacity(params: Params) -> Float[Array, ""]:
    """Of the active Gaussians; 0 without any."""
    rows = params.rows["splats"]
    active = splats.active_mask(rows)
    opacity = jnp.where(active, splats.activate(rows).opacity, 0)
    return jnp.sum(opacity) / jnp.maximum(jnp.sum(active), 1).astype(opacity.dtype)


def effect(spec: EmbeddingMotionSpec, steps: int, frames: int) -> Effect:
    """The seams that this motion fills, for a run of `steps` over `frames`."""
    count = moments(spec, frames)

    def prepared(params: Params) -> Float[Array, "gaussians features"]:
        active = splats.active_mask(params.rows["splats"])
        return prepare(params.nets[NAME], spec, params.rows[NAME], active)

    def moved(
        params: Params,
        gaussians: Gaussians,
        condition: FrameCondition,
        ready: Float[Array, "gaussians features"],
    ) -> Gaussians:
        active = splats.active_mask(params.rows["splats"])
        offsets = deform(params.nets[NAME], spec, condition.time, ready, active)
        return kan_motion.apply(gaussians, offsets)

    def penalty(own: EmbeddingMotion, context: PenaltyContext) -> dict[str, Term]:
        bend = {"smoothness": Term(second_differences(own.times), spec.smoothness)}
        opacity = mean_opacity(context.params)
        return {
            **from_step(spec.warm_up, context.step, bend),
            "opacity": Term(opacity, spec.opacity),
        }

    def revise(own: EmbeddingMotion, step: int) -> EmbeddingMotion:
        return own._replace(rows=jnp.full_like(own.rows, fine_rows(spec, count, step)))

    return Effect(
        name=NAME,
        init_rows=lambda key, rows: kan_motion.init_embedding(
            key, first_codes(spec), rows.mean
        ),
        init=functools.partial(init, spec=spec, frames=frames),
        row_learning_rate=lambda step: jnp.full((), spec.embedding_rate),
        learning_rate=schedules.log_linear(
            spec.learning_rate, spec.learning_rate_end, steps
        ),
        warm_up=spec.warm_up,
        prepare=prepared,
        deform=moved,
        penalty=penalty,
        revise=revise,
        revise_at=growth_steps(spec, count),
    )


# 30 codes for the built-in scene: the coarse network reads six, the fine one six to 30.
SMALL_EMBEDDING_MOTION = EmbeddingMotionSpec(
    time_code=16, width=64, waves=2.0, spread=0.5, grow_until=1300
)
