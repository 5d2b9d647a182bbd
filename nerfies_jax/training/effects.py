"""Internal records of the parts of a scene, and their terms, names and keys.

Parts fill small protocols (`nerfies_jax.training.protocols` and its neighbors in both
packages). `build` compiles each to a `Record` of hooks, which the step and the renderer
read; `FieldRecord` and `SplatRecord` add those of their representation. A hook left
`None` has no parameters, no state and no operations: the compiled step of a scene
without parts is that of a static scene.
"""

import dataclasses
import functools
import operator
import zlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from nerfies_jax.training.model import Frames, Rendering

PyTree = Any
Scalar = Float[Array, ""]
Vector = Float[Array, "3"]
Features = Float[Array, " features"]

# What a table of codes has a row for: the distinct times that were learned from, or the
# exposures ("appearance ids") of the capture.
MOMENT, APPEARANCE = "moment", "appearance"


class Table(NamedTuple):
    """Table of latent codes. Parts that name the same one share its codes.

    Attributes:
      name: Name of the table, the key of `FrameCondition.codes`.
      by: `MOMENT` ("moment", a row for each frame time) or `APPEARANCE` ("appearance",
        a row for each exposure).
      width: Number of entries of a code.
    """

    name: str
    by: str
    width: int


class FrameCondition(NamedTuple):
    """Per-frame conditioning.

    Attributes:
      time: Frame time in [0, 1] over the capture.
      codes: Latent codes by the name of their table. Gaussians have none.
      step: Number of completed training steps, for schedules. None in a trained scene
        of Gaussians.
      key: PRNG key of a training step on Gaussians. None once trained.
    """

    time: Scalar
    codes: dict[str, Float[Array, " code"]] = {}  # noqa: RUF012
    step: Int[Array, ""] | None = None
    key: Key[Array, ""] | None = None


class Observation(NamedTuple):
    """Rendered and observed image of one frame.

    Attributes:
      rendering: The rendered frame. None where a loss renders by itself.
      truth: Observed colors, sRGB in [0, 1].
      valid: Observed pixels. None: all.
      depth: Known z-depth, scene units, 0 where it is unknown. None: nowhere.
      frames: All training frames.
      row: Row of this frame among them.
    """

    rendering: Rendering | None
    truth: Float[Array, "height width 3"]
    valid: Bool[Array, "height width"] | None
    depth: Float[Array, "height width"] | None
    frames: Frames | None = None
    row: Int[Array, ""] | int | None = None


class PenaltyContext(NamedTuple):
    """Inputs of a loss. None where the representation does not have them.

    Attributes:
      condition: Conditioning of the frame; on a field with a leading axis of rays.
      step: Number of completed steps.
      key: PRNG key of this part in this step.
      params: Parameters of the whole scene, `splats.Params` of Gaussians.
      displace: On a field: displacement of a point by all warps together.
      condition_of: On a field: conditioning of a training frame by its row.
      batch: On a field: `effect.Batch` of the rays.
      levels: On a field: `effect.RayOutput` of each level, coarse to fine.
      frames: On a field: all training frames, in scene units.
      box: On a field: `effect.Box`, from scene units to those of the field.
      observation: On Gaussians: the frame of the step.
      at_time: On Gaussians: (parameters as by `splats.take_rows`, time) -> `Gaussians`.
      state: State of this part, where it has one.
    """

    condition: FrameCondition
    step: Int[Array, ""]
    key: Key[Array, ""]
    params: PyTree
    displace: Callable[[Vector, FrameCondition], Vector] | None = None
    condition_of: Callable[[Int[Array, ""]], FrameCondition] | None = None
    batch: Any = None
    levels: Any = None
    frames: Frames | None = None
    box: Any = None
    observation: Observation | None = None
    at_time: Callable[[Any, Scalar], Any] | None = None
    state: PyTree = None


class Term(NamedTuple):
    """One term of the loss.

    Attributes:
      value: Value that is logged.
      weight: Factor with which it is added to the loss. None: logged only.
    """

    value: Scalar
    weight: Scalar | float | None


@dataclasses.dataclass(frozen=True)
class Record:
    """Hooks of a part that both representations have; None where a part has none.

    Attributes:
      name: Key of its parameters, its state and its metrics.
      init: Returns the initial parameters, of a key; of Gaussians of a key and
        `splats.Splats`.
      learning_rate: Returns the rate of what `init` returned, at a traced step. None:
        the common rate of a field.
      penalty: (own parameters, context) -> terms, logged as `name/term`.
      required_data: What it reads of "depths", "points", "flow" and "moving" in
        `Frames`, each None where a capture has none.
    """

    name: str
    init: Callable[..., PyTree] | None = None
    learning_rate: Callable[..., PyTree] | None = None
    penalty: Callable[[PyTree, PenaltyContext], dict[str, Term]] | None = None
    required_data: frozenset[str] = frozenset()


R = TypeVar("R", bound=Record)


def stream(name: str) -> int:
    """Return a number to fold into a key, for an effect or a table of some name.

    With consecutive numbers instead, everything after an effect would be drawn anew
    when it is left out, and an ablation would compare two initializations as well.

    Args:
      name: The name.

    Returns:
      A hash of the name.
    """
    return zlib.crc32(name.encode())


def joined(
    own: tuple[R, ...], more: tuple[R, ...], reserved: tuple[str, ...]
) -> tuple[R, ...]:
    """Return the parts of a scene and further ones behind them.

    Args:
      own: Records of the parts of a spec.
      more: Further records.
      reserved: Names that the parameters of the scene have already.

    Raises:
      ValueError: If two parts have one name.
    """
    names = list(reserved)
    for part in (*own, *more):
        if part.name in names:
            raise ValueError(
                f"there is something named {part.name!r} already; the names taken are "
                f"{', '.join(names)}; give the part another"
            )
        names.append(part.name)
    return (*own, *more)


def penalty_terms(
    effects: tuple[Record, ...],
    own_params: Mapping[str, PyTree],
    context: PenaltyContext,
    states: Mapping[str, PyTree],
) -> dict[str, Term]:
    """The terms of all effects by `effect/term`, each effect with a key of its own."""
    terms: dict[str, Term] = {}
    for effect in effects:
        if effect.penalty is None:
            continue
        own = context._replace(
            key=jax.random.fold_in(context.key, stream(effect.name)),
            state=states.get(effect.name),
        )
        own_terms = effect.penalty(own_params.get(effect.name), own)
        terms |= {f"{effect.name}/{name}": term for name, term in own_terms.items()}
    return terms


def from_step(
    first: int, step: Int[Array, ""] | None, terms: Mapping[str, Term]
) -> dict[str, Term]:
    """Return the same terms, of no weight before step `first`.

    Before the warm-up of a motion ends, only the regularizers produce gradients, and
    Adam would drive the motion to zero.
    """
    if first == 0:
        return dict(terms)
    assert step is not None  # a loss is of a step where it has a warm-up
    begun = jnp.where(step < first, 0.0, 1.0)
    return {
        name: term if term.weight is None else term._replace(weight=begun * term.weight)
        for name, term in terms.items()
    }


def weighted_sum(terms: Mapping[str, Term], first: Scalar | None = None) -> Scalar:
    """Compute the loss, the sum of terms with their weights.

    Args:
      terms: Terms by name.
      first: Value to start from.

    Returns:
      The sum, in the order of the terms.
    """
    weighted = [t.weight * t.value for t in terms.values() if t.weight is not None]
    return total(weighted if first is None else [first, *weighted])


def total(values: Iterable[Scalar]) -> Scalar:
    """Add scalars.

    Args:
      values: The scalars, at least one.

    Returns:
      Their sum.
    """
    return functools.reduce(operator.add, values)


def values(terms: Mapping[str, Term]) -> dict[str, Scalar]:
    """Return the logged values of terms, without their weights.

    Args:
      terms: Terms by name.

    Returns:
      Values by name.
    """
    return {name: term.value for name, term in terms.items()}
