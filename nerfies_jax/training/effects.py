"""Internal records of the components of a scene, and their loss terms and keys.

Components implement small protocols (`nerfies_jax.training.protocols` and the
`protocols` modules of both representations). `build` converts each to a `Record` of
hooks, which the training step and the renderer call. `FieldRecord` and `SplatRecord`
add the hooks of their representation. A hook that is None adds no parameters, no state
and no compiled operations: the step of a scene without components is that of a static
scene.
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

# A table of codes has one row for each distinct training timestamp, or one for each
# exposure ("appearance id") of the capture.
TIMESTAMP, APPEARANCE = "timestamp", "appearance"


class Table(NamedTuple):
    """Table of latent codes. Components that name the same table share its codes.

    Attributes:
      name: Name of the table, the key of `FrameCondition.codes`.
      by: `TIMESTAMP` ("timestamp", a row for each frame time) or `APPEARANCE`
        ("appearance", a row for each exposure).
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
      rendering: The rendered frame. None if the loss renders by itself.
      truth: Observed colors, sRGB in [0, 1].
      valid: Mask of the observed pixels. None for all.
      depth: Known z-depth in scene units, 0 where it is unknown. None without depths.
      frames: All training frames. If they are streamed, only this one has pixels.
      row: Row of this frame among them.
    """

    rendering: Rendering | None
    truth: Float[Array, "height width 3"]
    valid: Bool[Array, "height width"] | None
    depth: Float[Array, "height width"] | None
    frames: Frames | None = None
    row: Int[Array, ""] | int | None = None


class PenaltyContext(NamedTuple):
    """Inputs of a loss. Attributes that the representation lacks are None.

    Attributes:
      condition: Conditioning of the frame. Of fields with a leading axis of rays.
      step: Number of completed steps.
      key: PRNG key of this component in this step.
      params: Parameters of the whole scene, `splats.Params` of Gaussians.
      displace: Fields only. Displacement of a point by the composition of all warps.
      condition_of: Fields only. Conditioning of a training frame by its row.
      batch: Fields only. `effect.Batch` of the rays.
      levels: Fields only. `effect.RayOutput` of each level, coarse to fine.
      frames: Fields only. All training frames, in scene units.
      box: Fields only. `effect.Box`, from scene units to those of the field.
      observation: Gaussians only. The frame of the step.
      at_time: Gaussians only. (parameters from `splats.take_rows`, time) ->
        `Gaussians`.
      state: State of this component, if it has one.
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
      value: Value, which is logged.
      weight: Factor of the value in the loss. None to log it only.
    """

    value: Scalar
    weight: Scalar | float | None


@dataclasses.dataclass(frozen=True)
class Record:
    """Hooks of a component in both representations. Unused hooks are None.

    Attributes:
      name: Key of its parameters, its state and its metrics.
      init: Returns the initial parameters, given a key (fields) or a key and
        `splats.Splats` (Gaussians).
      learning_rate: Returns the learning rate of these parameters at a traced step.
        None for the common rate of a field.
      penalty: (parameters of the component, context) -> terms, logged as `name/term`.
      required_data: Fields of `Frames` that it reads, of "depths", "points", "flow" and
        "moving". Each is None if the capture lacks it.
    """

    name: str
    init: Callable[..., PyTree] | None = None
    learning_rate: Callable[..., PyTree] | None = None
    penalty: Callable[[PyTree, PenaltyContext], dict[str, Term]] | None = None
    required_data: frozenset[str] = frozenset()


R = TypeVar("R", bound=Record)


def stream(name: str) -> int:
    """Return a number to fold into a key, for an effect or table by its name.

    With consecutive numbers, leaving out an effect would change the random numbers of
    all later ones, and an ablation would also compare two initializations.

    Args:
      name: The name.

    Returns:
      A hash of the name.
    """
    return zlib.crc32(name.encode())


def join(
    own: tuple[R, ...], more: tuple[R, ...], reserved_names: tuple[str, ...]
) -> tuple[R, ...]:
    """Concatenate the records of a spec and further ones, checking their names.

    Args:
      own: Records of the components of a spec.
      more: Further records.
      reserved_names: Names that the parameters of the scene already use.

    Returns:
      All records.

    Raises:
      ValueError: If two components have the same name.
    """
    names = list(reserved_names)
    for part in (*own, *more):
        if part.name in names:
            raise ValueError(
                f"a component is named {part.name!r}, but this name is in use; choose "
                f"another than {', '.join(names)}"
            )
        names.append(part.name)
    return (*own, *more)


def penalty_terms(
    effects: tuple[Record, ...],
    own_params: Mapping[str, PyTree],
    context: PenaltyContext,
    states: Mapping[str, PyTree],
) -> dict[str, Term]:
    """Compute the terms of all effects by `effect/term`, with a key for each effect.

    Args:
      effects: Records of the components.
      own_params: Parameters of the components by name.
      context: Rendered frame or rays, key and step.
      states: States of the components by name.

    Returns:
      Terms by `component/term`.
    """
    terms: dict[str, Term] = {}
    for effect in effects:
        if effect.penalty is None:
            continue
        effect_context = context._replace(
            key=jax.random.fold_in(context.key, stream(effect.name)),
            state=states.get(effect.name),
        )
        effect_terms = effect.penalty(own_params.get(effect.name), effect_context)
        terms |= {f"{effect.name}/{name}": term for name, term in effect_terms.items()}
    return terms


def from_step(
    first: int, step: Int[Array, ""] | None, terms: Mapping[str, Term]
) -> dict[str, Term]:
    """Return the terms with weights that are zero before step `first`.

    Before the warm-up of a motion ends, only the regularizers produce gradients, and
    Adam would drive the motion to zero.

    Args:
      first: First step with weights.
      step: Number of completed steps.
      terms: Terms by name.

    Returns:
      The terms.
    """
    if first == 0:
        return dict(terms)
    assert step is not None  # losses with a warm-up are computed in training steps
    factor = jnp.where(step < first, 0.0, 1.0)
    return {
        name: term
        if term.weight is None
        else term._replace(weight=factor * term.weight)
        for name, term in terms.items()
    }


def weighted_sum(terms: Mapping[str, Term], first: Scalar | None = None) -> Scalar:
    """Compute the loss, the sum of terms with their weights.

    Args:
      terms: Terms by name.
      first: Term to add in front, or None.

    Returns:
      The sum, in the order of the terms.
    """
    summands = [t.weight * t.value for t in terms.values() if t.weight is not None]
    return total(summands if first is None else [first, *summands])


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
