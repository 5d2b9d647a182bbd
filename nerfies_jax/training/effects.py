"""The seams an effect may fill, and what all effects share: terms, names and keys.

An effect is a frozen spec that says *which* and one `Effect` of pure functions that
says *how*. A seam left `None` has no parameters, no state and no operations: the
compiled step of a scene without effects is that of a static scene. A representation
serves the seams of its own kind and those of both, and refuses the others (`joined`).

What belongs to one representation alone is not known on this floor and stands here as
`Any`, with the name of the record beside it.
"""

import zlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training.model import Frames, Rendering
from nerfies_jax.training.schedules import Schedule

PyTree = Any
Scalar = Float[Array, ""]
Vector = Float[Array, "3"]
Features = Float[Array, " features"]

# What a table of codes has a row for: the distinct times that were learned from, or the
# exposures ("appearance ids") of the capture.
MOMENT, APPEARANCE = "moment", "appearance"

FIELD_SEAMS = (
    "tables",
    "condition",
    "condition_width",
    "displace",
    "shortest_wave",
    "lift",
    "lift_width",
    "mark",
    "surface",
    "surface_width",
    "medium",
    "beta_min",
    "beta_power",
)
SPLAT_SEAMS = (
    "init_rows",
    "row_learning_rate",
    "lifted_rows",
    "warm_up",
    "place",
    "prepare",
    "deform",
    "derive_rows",
    "derive",
    "significance",
    "fit_to_paths",
    "state",
    "ready_by_state",
    "update_state",
    "grow_score",
    "revise",
    "revise_at",
    "expose",
    "pose",
    "found",
)


class Table(NamedTuple):
    """A latent table; effects that name the same one share its codes."""

    name: str
    by: str  # MOMENT or APPEARANCE
    width: int


class FrameCondition(NamedTuple):
    """When a frame was filmed, and what is known of it."""

    time: Scalar  # in [0, 1] over the capture
    # By table, looked up; a scene of Gaussians has no tables.
    codes: dict[str, Float[Array, " code"]] = {}  # noqa: RUF012
    # Completed steps of training, for schedules; None in a trained scene of Gaussians,
    # while a field is always drawn as far as it was trained.
    step: Int[Array, ""] | None = None
    key: Key[Array, ""] | None = None  # of a step on Gaussians, None once trained


class Observation(NamedTuple):
    """One frame as it was drawn and as it was filmed."""

    rendering: Rendering | None  # None where a loss brings its own
    truth: Float[Array, "height width 3"]  # sRGB in [0, 1]
    valid: Bool[Array, "height width"] | None  # None: everywhere
    depth: Float[Array, "height width"] | None  # z-depth, scene units; 0 unknown
    frames: Frames | None = None  # all that is learned from
    row: Int[Array, ""] | int | None = None  # of this frame among them


class PenaltyContext(NamedTuple):
    """What a penalty may look at; None is what the representation does not have."""

    condition: FrameCondition  # on a field with a leading axis of rays
    step: Int[Array, ""]
    key: Key[Array, ""]  # of this effect in this step
    params: PyTree  # of the whole scene; of Gaussians `splats.Params`
    # On a radiance field: the rays of the step as rendered, and the field itself.
    # Of all warps together, in units of the field:
    displace: Callable[[Vector, FrameCondition], Vector] | None = None
    # Of one frame learned from, by its row:
    condition_of: Callable[[Int[Array, ""]], FrameCondition] | None = None
    batch: Any = None  # `effect.Batch`, leading axis rays
    levels: Any = None  # `effect.RayOutput`s, coarse to fine, leading axis rays
    frames: Frames | None = None  # all that is learned from, in scene units
    box: Any = None  # `effect.Box`, from scene units to those of the field
    # On Gaussians: the frame of the step, and the scene at other times.
    observation: Observation | None = None
    # (rows as by `splats.take_rows`, time) -> `Gaussians`
    at_time: Callable[[Any, Scalar], Any] | None = None
    state: PyTree = None  # of this effect, where it keeps one


class Term(NamedTuple):
    """One term of the loss; `weight * value` is descended, `value` is logged."""

    value: Scalar
    weight: Scalar | float | None  # None: logged only


class Effect(NamedTuple):
    """What one effect does, each seam optional.

    `params` is the effect's own, what its `init` returned, None without one; only where
    it says `scene` it is the `splats.Params` of all, for deforming takes rows.
    """

    name: str  # of its parameters, its state and its metrics
    # Of both representations.
    init: Callable[[Key[Array, ""]], PyTree] | None = None
    # Of what `init` returned, at a traced step. None: the common rate of a field;
    # Gaussians have none, and need one.
    learning_rate: Schedule | None = None
    # (params, context) -> terms, logged as `effect/term`
    penalty: Callable[[PyTree, PenaltyContext], dict[str, Term]] | None = None
    # Of "depths", "points", "flow" and "moving" in `Frames`, each None where a capture
    # has none.
    # Gaussians are drawn with depth where one asks for "depths".
    required_data: frozenset[str] = frozenset()
    # Of radiance fields, all in units of the field, for one point of one ray.
    tables: tuple[Table, ...] = ()
    # (params, condition) -> what the color branch reads beside the view direction
    condition: Callable[[PyTree, FrameCondition], Features] | None = None
    condition_width: int = 0
    # (params, point, condition) -> displacement: template point minus observed point
    displace: Callable[[PyTree, Vector, FrameCondition], Vector] | None = None
    # Of that along space: of long ones pictures ask on a grid (`frustum_grid`).
    # None: not known, and all samples ask.
    shortest_wave: float | None = None
    # (params, observed point, condition) -> features the trunk reads beside the point's
    lift: Callable[[PyTree, Vector, FrameCondition], Features] | None = None
    lift_width: int = 0
    # (params, observed point, condition) -> codes of the point by name, which join
    # those of the frame for every `displace` and `lift`
    mark: Callable[[PyTree, Vector, FrameCondition], dict[str, Features]] | None = None
    # (params, level, `effect.Surface`, condition) -> `effect.Look`: what color reads
    # of each sample, so many features
    surface: Callable[[PyTree, str, Any, FrameCondition], Any] | None = None
    surface_width: int = 0
    # (params, `effect.Sample`, condition) -> `effect.Medium`; on the last level only
    medium: Callable[[PyTree, Any, FrameCondition], Any] | None = None
    # Least standard deviation of a ray's color, where the medium has a `beta`.
    beta_min: float | None = None
    beta_power: float = 0.0  # `transient.photometric`; zero is the likelihood
    # Of Gaussians.
    # (key, `splats.Splats`) -> leaves with a row for each Gaussian
    init_rows: Callable[[Key[Array, ""], Any], PyTree] | None = None
    row_learning_rate: Schedule | None = None  # needed where there are rows
    # (time of the picture, for how long tracks near were followed) [gaussians] each, in
    # films -> the rows of those lifted from moving pixels; host side
    lifted_rows: Callable[[Any, Any], PyTree] | None = None
    # (what `init` returned, `splats.Splats`) -> the same, put where the first Gaussians
    # are; host side
    place: Callable[[PyTree, Any], PyTree] | None = None
    warm_up: int = 0  # steps before which it does not deform
    # scene -> what stays as it is while the parameters do, whatever the time
    prepare: Callable[[Any], PyTree] | None = None
    # (scene, `Gaussians`, condition, what `prepare` returned or None) -> `Gaussians`
    deform: Callable[[Any, Any, FrameCondition, PyTree], Any] | None = None
    # What is drawn in the place of the rows, where each of them carries several
    # Gaussians, those of the first row first; one effect of a scene at most.
    # (scene, condition or None once trained) -> `splats.Splats` at rest, and what else
    # `derive` reads
    derive_rows: Callable[[Any, FrameCondition | None], tuple[Any, PyTree]] | None = (
        None
    )
    # (scene, what `derive_rows` returned, rows as `Gaussians` where `deform` left them,
    # condition) -> `Gaussians`; what is drawn has the looks at rest
    derive: Callable[[Any, tuple[Any, PyTree], Any, FrameCondition], Any] | None = None
    # what `derive` returned -> how much the slope of each counts in that of its row,
    # which the density control compares; None: all that is seen alike
    significance: Callable[[Any], Any] | None = None
    # (params, picture [height, width, 3] sRGB, appearance id) -> the picture as it was
    # filmed; of all that is drawn, in training and afterwards
    expose: Callable[[PyTree, Any, Int[Array, ""]], Any] | None = None
    # (params, cameras of the frames that are learned from) -> the same, refined;
    # whoever reads the frames of a step has these
    pose: Callable[[PyTree, Camera], Camera] | None = None
    # (params, capture) -> the capture with all cameras as `pose` has them; host side
    found: Callable[[PyTree, Any], Any] | None = None
    # (`path_fit.Paths`, key) -> `path_fit.Guess`, from which the motion is fitted to
    # tracks; host side. None: it is fitted from where `init` starts it.
    fit_to_paths: Callable[[Any, Key[Array, ""]], Any] | None = None
    # scene -> state, arrays only; host side, at the start and after every change of the
    # rows, up to the next
    state: Callable[[Any], PyTree] | None = None
    # Whether in training `deform` gets the state for what `prepare` returns: where that
    # is dear, and good enough until the rows change.
    ready_by_state: bool = False
    # (state, canonical `Gaussians`, moved, condition) -> state; pure, in every step
    update_state: Callable[[PyTree, Any, Any, FrameCondition], PyTree] | None = None
    # (state, step) -> [rows] factor of the gradient that the density control compares
    # with its threshold; host side
    grow_score: Callable[[PyTree, int], Any] | None = None
    # (params, step) -> params of the same shapes, after each of these steps; host side
    revise: Callable[[PyTree, int], PyTree] | None = None
    revise_at: tuple[int, ...] = ()


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
    own: tuple[Effect, ...],
    more: tuple[Effect, ...],
    refused: tuple[str, ...],
    reserved: tuple[str, ...],
) -> tuple[Effect, ...]:
    """The effects of a spec and, behind them, `more`.

    `refused` are the seams that the representation cannot serve, `reserved` the names
    that its parameters have already.
    """
    names = list(reserved)
    for effect in (*own, *more):
        if effect.name in names:
            raise ValueError(
                f"there is something named {effect.name!r} already; the names taken "
                f"are {', '.join(names)}; give the effect another"
            )
        names.append(effect.name)
        for seam in refused:
            if getattr(effect, seam) != Effect._field_defaults[seam]:
                raise ValueError(
                    f"the effect {effect.name!r} fills the seam {seam!r}, which this "
                    "representation does not have; leave the seam or the effect out"
                )
    return (*own, *more)


def penalty_terms(
    effects: tuple[Effect, ...],
    own_params: Mapping[str, PyTree],
    context: PenaltyContext,
    states: Mapping[str, PyTree],
) -> dict[str, Term]:
    """The terms of all effects by `effect/term`, each effect with a key of its own."""
    terms = {}
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
    """The same terms, of no weight before step `first`.

    What a motion does not show yet (`Effect.warm_up`) only its penalties would train,
    in full steps of Adam, to what they like best: no motion at all.
    """
    if first == 0:
        return dict(terms)
    begun = jnp.where(step < first, 0.0, 1.0)
    return {
        name: term._replace(weight=begun * term.weight) for name, term in terms.items()
    }


def weighted_sum(terms: Mapping[str, Term], first: Scalar | int = 0) -> Scalar:
    """Compute the loss, the sum of terms with their weights.

    Args:
      terms: Terms by name.
      first: Value to start from.

    Returns:
      The sum, in the order of the terms.
    """
    weighted = (t.weight * t.value for t in terms.values() if t.weight is not None)
    return sum(weighted, first)


def values(terms: Mapping[str, Term]) -> dict[str, Scalar]:
    """Return the logged values of terms, without their weights.

    Args:
      terms: Terms by name.

    Returns:
      Values by name.
    """
    return {name: term.value for name, term in terms.items()}
