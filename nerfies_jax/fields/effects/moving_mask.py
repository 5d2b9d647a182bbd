"""A learned mask of moving points, which guides the warp and the ambient surface.

Yan, Li and Lee 2023 (NeRF-DS), arXiv:2303.14435, mask guided deformation field. The
implementation follows the published code (JokerYan/NeRF-DS), because the paper's
equations were not available. The colors of a moving specular surface change, so they do
not determine correspondence. A network predicts for each observed point and time the
probability that it moves. The warp and the ambient surface read it next to their codes,
and masks of the images supervise it.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Key

from nerfies_jax.fields.effects.effect import RayOutput, Scalar, Vector
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training.effects import (
    TIMESTAMP,
    FrameCondition,
    PenaltyContext,
    Table,
    Term,
    total,
)

NAME = "mask"


@dataclasses.dataclass(frozen=True)
class MovingMaskSpec:
    """Settings of the mask network and its loss. The defaults are those of the code.

    `position` and `skips` are those of the published warp, because the code of the mask
    network was not available. Its output is a ReLU, which can be zero for all points
    and then has no gradient. Here it is a sigmoid, which starts at one half. All bands
    are open from the start. In the published code they open with those of the warp.
    `code_width` is the width of the codes in `table`, which are those of the warp. Use
    another table name for separate codes, as in the published code.
    """

    position: EncodingSpec = EncodingSpec(4)
    depth: int = 8
    width: int = 128
    skips: tuple[int, ...] = (4,)
    table: str = "motion"
    code_width: int = 8
    weight: float = 0.1

    name = NAME
    target = "warp"
    features = 1
    required_data = frozenset({"moving"})

    def __post_init__(self):
        if self.code_width < 1:
            raise ValueError(
                f"code_width={self.code_width} must be at least 1; with 0 all frames "
                "would share one mask"
            )
        if not (math.isfinite(self.weight) and self.weight >= 0):
            raise ValueError(
                f"weight={self.weight} of the mask must be finite and not negative"
            )
        network(self)  # checks depth, width and skips

    @property
    def tables(self) -> tuple[Table, ...]:
        """Table of the codes that it reads."""
        return (Table(self.table, TIMESTAMP, self.code_width),)

    def init(self, key: Key[Array, ""]) -> MLP:
        """Initialize the network."""
        return init(self, key)

    def apply(
        self, params: MLP, point: Vector, frame: FrameCondition
    ) -> Float[Array, "1"]:
        """Compute the probability that an observed point moves."""
        return share(self, params, point, frame)[None]

    def loss(self, params: MLP, context: PenaltyContext) -> dict[str, Term]:
        """Compute the error of the mask, if the capture has masks."""
        return penalty(self, params, context)


def network(spec: MovingMaskSpec) -> MLPSpec:
    """Return the settings of the network from [encoded point, code] to a logit.

    Args:
      spec: Settings.

    Returns:
      Settings of an MLP with the head "logit".
    """
    return MLPSpec(
        inputs=spec.position.width(3) + spec.code_width,
        depth=spec.depth,
        width=spec.width,
        heads=(("logit", HeadSpec(1, "small")),),
        skips=spec.skips,
    )


def init(
    spec: MovingMaskSpec, key: Key[Array, ""], dtype: DTypeLike = jnp.float32
) -> MLP:
    """Initialize the network with probabilities of one half.

    Args:
      spec: Settings.
      key: PRNG key.
      dtype: Floating-point type of the parameters.

    Returns:
      The parameters.
    """
    return mlp.init(network(spec), key, dtype)


def share(
    spec: MovingMaskSpec, params: MLP, point: Vector, condition: FrameCondition
) -> Scalar:
    """Predict the probability that an observed point moves.

    Args:
      spec: Settings.
      params: Parameters.
      point: Observed point in units of the field, [3].
      condition: Conditioning of the frame.

    Returns:
      A scalar in (0, 1).
    """
    features = encoding.encode(spec.position, point, None)
    inputs = jnp.concatenate([features, condition.codes[spec.table]])
    logit = mlp.apply(network(spec), params, inputs)["logit"][0]
    # Near one the gradient of a sigmoid rounds to zero, and a certain but wrong
    # prediction could not be corrected. The complement keeps its gradient.
    is_positive = logit > 0
    smaller = jax.nn.sigmoid(jnp.where(is_positive, -logit, logit))
    return jnp.where(is_positive, 1 - smaller, smaller)


def penalty(
    spec: MovingMaskSpec, params: MLP, context: PenaltyContext
) -> dict[str, Term]:
    """Compute the error of the rendered masks, summed over the levels.

    Args:
      spec: Settings.
      params: Parameters.
      context: Context of the step.

    Returns:
      The term "error", or none if the frames have no masks.
    """
    frames = context.frames
    assert frames is not None
    if frames.moving is None:
        return {}
    batch = context.batch
    column, line = jnp.floor(batch.pixel).astype(jnp.int32).T
    moves = frames.moving[frames.image_row(batch.row), line, column]
    predict = jax.vmap(jax.vmap(functools.partial(share, spec, params), (0, None)))
    error = total(
        difference(predict(level.point, context.condition), level, moves, batch.valid)
        for level in context.levels
    )
    return {"error": Term(error, spec.weight)}


def difference(
    shares: Float[Array, "rays samples"],
    level: RayOutput,
    moves: Bool[Array, " rays"],
    valid: Bool[Array, " rays"],
) -> Scalar:
    """Compute the mean over valid rays of Σ w |share - mask|, as in the published code.

    The rendering weights have no gradient.

    Args:
      shares: Predictions at the samples, [rays, samples].
      level: Output of the level.
      moves: Observed masks, [rays].
      valid: True for observed pixels, [rays].

    Returns:
      A scalar.
    """
    weight = jax.lax.stop_gradient(level.weight)
    errors = jnp.abs(shares - moves[:, None].astype(shares.dtype))
    error = jnp.sum(weight * errors, axis=-1)
    count = jnp.sum(valid, dtype=error.dtype)
    return jnp.sum(jnp.where(valid, error, 0)) / jnp.maximum(count, 1)
