"""Depth supervision from sensors or monocular estimates.

"Sonata" names a depth loss and leaves its form open. A depth of one picture is known up
to scale and offset only; the forms here are those of Ranftl et al. 2020 ("MiDaS"),
arXiv:1907.01341, section 5, and Li et al. 2021 ("NSFF"), arXiv:2011.13084.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.geometry.precision import widened
from nerfies_jax.runtime.contract import checked
from nerfies_jax.training import losses
from nerfies_jax.training.effects import Observation, PenaltyContext, Term

NAME = "depth"
KINDS = ("correlation", "affine", "metric")
SPACES = ("depth", "disparity")
# Deviation of the depths of a picture, as a share of their middle, below which they
# count as flat: what is divided by it stays below a thousand, and so do slopes.
FLATTEST = 1e-3


@dataclasses.dataclass(frozen=True)
class DepthSpec:
    """Form and weight of the depth loss.

    "correlation" is 1 - r, Pearson's, invariant to a positive scale and any offset. A
    least-squares scale and offset leave a share 1 - r^2 of the variance, which also
    accepts an inverted depth. "affine" normalizes both depths by their median and their
    mean distance from it, which is more robust to large errors of a part. It is
    constant where every pixel is on the wrong side of the median, and from random
    initializations two of five fits ended early, and none with correlation. "metric"
    compares depths as they are, for sensors and renderers.

    `space="disparity"` compares 1 / z, in which distant surfaces count less. An
    estimate that is affine in disparity is not affine in depth: choose the space of the
    estimate.
    """

    kind: str = "correlation"
    space: str = "depth"
    weight: float = 0.1
    opaque: float = 0.5  # least opacity of a pixel whose depth is compared

    name = NAME
    required_data = frozenset({"depths"})

    def __post_init__(self):
        if self.kind not in KINDS or self.space not in SPACES:
            raise ValueError(
                f"kind is one of {KINDS} and space one of {SPACES}, got "
                f"{self.kind!r} and {self.space!r}"
            )
        if not (0 <= self.weight < math.inf and 0 < self.opaque < 1):
            raise ValueError(
                "weight is finite and not negative, and 0 < opaque < 1; got "
                f"weight={self.weight} and opaque={self.opaque}"
            )

    def loss(self, params: Any, context: PenaltyContext) -> dict[str, Term]:
        """Compute the difference of rendered and known depth in one frame."""
        assert context.observation is not None
        return terms(self, context.observation)


@checked
def affine(
    depth: Float[Array, " pixels"],
    truth: Float[Array, " pixels"],
    known: Bool[Array, " pixels"],
) -> Float[Array, ""]:
    """Mean |a - b| of the depths, each less its median and over its mean deviation.

    Both are positive where `known`. Equations 5 to 7 of Ranftl et al. 2020. Zero with
    fewer than two known pixels.
    """
    depth, truth = widened(depth), widened(truth)
    known = known & (jnp.sum(known) > 1)
    return losses.l1(
        _about_median(depth, known)[:, None],
        _about_median(truth, known)[:, None],
        known,
    )


@checked
def correlation(
    depth: Float[Array, " pixels"],
    truth: Float[Array, " pixels"],
    known: Bool[Array, " pixels"],
) -> Float[Array, ""]:
    """Compute 1 - Pearson's r over the known pixels.

    Args:
      depth: Rendered depths.
      truth: Reference depths.
      known: True where both are known.

    Returns:
      A value in [0, 2], zero with fewer than two known pixels.
    """
    depth, truth = widened(depth), widened(truth)
    known = known & (jnp.sum(known) > 1)
    # Half the mean square of the difference of standardized depths: 1 - r itself would
    # have no digit left where the depths agree.
    a, b = (_about_mean(x, known)[:, None] for x in (depth, truth))
    return losses.mse(a, b, known) / 2


@checked
def metric(
    depth: Float[Array, " pixels"],
    truth: Float[Array, " pixels"],
    known: Bool[Array, " pixels"],
) -> Float[Array, ""]:
    """Compute mean |depth - truth| over the mean of the known truth.

    It is relative, so its weight means the same in every unit of length.

    Args:
      depth: Rendered depths.
      truth: Reference depths.
      known: True where both are known.

    Returns:
      The relative error, zero without known pixels.
    """
    depth, truth = widened(depth), widened(truth)
    scale = losses.masked_mean(truth[:, None], known)
    error = losses.l1(depth[:, None], truth[:, None], known)
    return error / jnp.where(scale > 0, scale, 1)


def _about_median(depth, known):
    """Normalize by median and deviation, with gradients through both; zero where
    unknown.
    """
    middle = _median(depth, known)
    offset = jnp.where(known, depth - middle, 0)
    return _divided(offset, losses.masked_mean(jnp.abs(offset)[:, None], known), middle)


def _about_mean(depth, known):
    middle = losses.masked_mean(depth[:, None], known)
    offset = jnp.where(known, depth - middle, 0)
    variance = losses.masked_mean(jnp.square(offset)[:, None], known)
    # Divided by at least 1e-3 of the middle, so the square root's slope is bounded.
    least = jnp.square(FLATTEST * jax.lax.stop_gradient(middle))
    deviation = jnp.sqrt(jnp.where(variance > least, variance, 1))
    return _divided(offset, jnp.where(variance > least, deviation, 0), middle)


def _divided(offset, deviation, middle):
    least = FLATTEST * jnp.abs(jax.lax.stop_gradient(middle))
    return offset / jnp.maximum(deviation, jnp.where(least > 0, least, 1))


def _median(depth, known):
    """Return the lower median of positive depths, 0 without any."""
    count = jnp.sum(known)
    fixed = jax.lax.stop_gradient(jnp.where(known, depth, 1))
    middle = nth_smallest(fixed, known, jnp.maximum(count - 1, 0) // 2)
    place = jnp.argmax(known & (fixed == middle))
    return jnp.where(count > 0, jnp.where(known, depth, 0)[place], 0)


def nth_smallest(
    values: Float[Array, " n"], known: Bool[Array, " n"], rank: Int[Array, ""]
) -> Float[Array, ""]:
    """Return the known value that has `rank` known ones below it, for positive values.

    The bits of positive floats are ordered like the floats, so the answer is built from
    its highest bit down, one count for each bit. Exact; 130k values, one core: 1.3 ms,
    where sorting them takes 28.
    """
    size = jnp.finfo(values.dtype).bits
    integer = jnp.dtype(f"int{size}")
    bits = jax.lax.bitcast_convert_type(values, integer)

    def settle(turn, settled):
        one = jnp.ones((), integer)
        higher = settled | (one << (size - 2 - turn).astype(integer))
        below = jnp.sum(known & (bits < higher))
        return jnp.where(below <= rank, higher, settled)

    settled = jax.lax.fori_loop(0, size - 1, settle, jnp.zeros((), integer))
    return jax.lax.bitcast_convert_type(settled, values.dtype)


FORMS = {"affine": affine, "correlation": correlation, "metric": metric}


def terms(spec: DepthSpec, observation: Observation) -> dict[str, Term]:
    """The difference of drawn and filmed depth, and the share of pixels compared.

    Pixels count that are filmed, whose depth is known (positive and finite) and that
    the drawing covers with at least `opaque`: elsewhere an expected depth is that of a
    haze. Without any depth there are no terms and no operations.
    """
    truth, rendering = observation.depth, observation.rendering
    if truth is None:
        return {}
    assert rendering is not None
    assert rendering.depth is not None  # as drawn for `required_data`
    # Depths are often kept in half precision, which neither counts nor centers them.
    truth, drawn = widened(truth), widened(rendering.depth)
    known = (truth > 0) & jnp.isfinite(truth) & (drawn > 0) & jnp.isfinite(drawn)
    known = known & (rendering.alpha >= spec.opaque)
    if observation.valid is not None:
        known = known & observation.valid
    # Selected before anything is computed of them: unknown pixels may hold NaN.
    drawn, truth = (jnp.where(known, x, 1).reshape(-1) for x in (drawn, truth))
    if spec.space == "disparity":
        drawn, truth = 1 / drawn, 1 / truth
    known = known.reshape(-1)
    error = FORMS[spec.kind](drawn, truth, known)
    share = jnp.mean(known.astype(error.dtype))
    return {"error": Term(error, spec.weight), "known": Term(share, None)}
