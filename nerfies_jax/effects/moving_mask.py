"""A mask of what moves, learned for every point, which guides warp and slice.

Yan, Li and Lee 2023 (NeRF-DS), arXiv:2303.14435, its mask that guides the deformation
field. The text with its equations was not at hand; its code (JokerYan/NeRF-DS) is
followed. Where colors change as a mirror moves, they cannot say what corresponds. A
network says of each observed point and moment how surely it moves; the warp and the
ambient slice read that beside their code; and masks of the pictures teach it.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from nerfies_jax.effects.effect import RayOutput, Scalar, Vector
from nerfies_jax.nets import encoding, mlp
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.nets.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training.effects import (
    MOMENT,
    Effect,
    FrameCondition,
    PenaltyContext,
    Table,
    Term,
)

NAME = "mask"


@dataclasses.dataclass(frozen=True)
class MovingMaskSpec:
    """Size of the network and weight of its loss; the defaults are the paper's code's.

    `position` and `skips` are those of the warp there, for its network of masks could
    not be read. Its read-out is a ReLU, which can be zero for all points and then never
    learns; here it is a sigmoid, which starts undecided. Bands are open, where there
    they open with the warp's. `code_width` is that of the codes in `table`: those of
    the warp, or its own, as there, under a name that no other effect has.
    """

    position: EncodingSpec = EncodingSpec(4)
    depth: int = 8
    width: int = 128
    skips: tuple[int, ...] = (4,)
    table: str = "motion"
    code_width: int = 8
    weight: float = 0.1

    def __post_init__(self):
        if self.code_width < 1:
            raise ValueError(
                f"code_width={self.code_width} must be at least 1: all frames would "
                "share one mask"
            )
        if not (math.isfinite(self.weight) and self.weight >= 0):
            raise ValueError(
                f"weight={self.weight} of the mask must be finite and not negative"
            )
        network(self)  # refuses wrong depths, widths and skips


def network(spec: MovingMaskSpec) -> MLPSpec:
    """What reads [encoded point, code] and answers the logit of moving."""
    return MLPSpec(
        inputs=spec.position.width(3) + spec.code_width,
        depth=spec.depth,
        width=spec.width,
        heads=(("logit", HeadSpec(1, "small")),),
        skips=spec.skips,
    )


def effect(spec: MovingMaskSpec) -> Effect:
    """The seams of `spec`; without masks in a capture it learns from colors alone."""
    return Effect(
        NAME,
        tables=(Table(spec.table, MOMENT, spec.code_width),),
        init=lambda key: init(spec, key),
        mark=lambda *given: {NAME: share(spec, *given)[None]},
        penalty=functools.partial(penalty, spec),
        required_data=frozenset({"moving"}),
    )


def init(spec: MovingMaskSpec, key: Key[Array, ""], dtype=jnp.float32) -> MLP:
    """Nothing is known of any point."""
    return mlp.init(network(spec), key, dtype)


def share(
    spec: MovingMaskSpec, params: MLP, point: Vector, condition: FrameCondition
) -> Scalar:
    """How surely an observed point moves, in (0, 1)."""
    encoded = encoding.encode(spec.position, point, None)
    inputs = jnp.concatenate([encoded, condition.codes[spec.table]])
    logit = mlp.apply(network(spec), params, inputs)["logit"][0]
    # By what is left to one: the slope of a sigmoid near one rounds to zero, and what
    # is wrong for sure would stay so.
    moves = logit > 0
    rest = jax.nn.sigmoid(jnp.where(moves, -logit, logit))
    return jnp.where(moves, 1 - rest, rest)


def penalty(
    spec: MovingMaskSpec, params: MLP, context: PenaltyContext
) -> dict[str, Term]:
    """How far the points that are seen are from the masks, summed over the levels."""
    if context.frames.moving is None:
        return {}
    batch = context.batch
    column, line = jnp.floor(batch.pixel).astype(jnp.int32).T
    moves = context.frames.moving[batch.row, line, column]
    asked = jax.vmap(jax.vmap(functools.partial(share, spec, params), (0, None)))
    error = sum(
        difference(asked(level.point, context.condition), level, moves, batch.valid)
        for level in context.levels
    )
    return {"error": Term(error, spec.weight)}


def difference(
    shares: Float[Array, "rays samples"],
    level: RayOutput,
    moves: Bool[Array, " rays"],
    valid: Bool[Array, " rays"],
) -> Scalar:
    """Mean over filmed rays of Σ w |share - mask|, by the weights they are drawn with.

    As the paper's code has it; the weights get no slope.
    """
    weight = jax.lax.stop_gradient(level.weight)
    off = jnp.abs(shares - moves[:, None].astype(shares.dtype))
    error = jnp.sum(weight * off, axis=-1)
    count = jnp.sum(valid, dtype=error.dtype)
    return jnp.sum(jnp.where(valid, error, 0)) / jnp.maximum(count, 1)
