"""Internal records of the parts of a field, which `render_ray` and the step read."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from nerfies_jax.fields.effects.protocols import Conditioning, Medium, Warp
from nerfies_jax.training.effects import FrameCondition, PyTree, Record, Table
from nerfies_jax.training.protocols import (
    Regularizer,
    as_terms,
    name_of,
    rate_at,
    regularizer_hooks,
)

Vector = Float[Array, "3"]
Features = Float[Array, " features"]
TARGETS = ("trunk", "color", "warp")  # readers of a conditioning


@dataclasses.dataclass(frozen=True)
class FieldRecord(Record):
    """Hooks of a part of a radiance field; None where a part has none.

    All are of one point of one ray, in units of the field. `params` is what the part's
    `init` returned, None without one.
    """

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


def compile_warp(warp: Warp) -> FieldRecord:
    """Compile a warp to the internal record that a field is built from."""
    hooks = _hooks(warp, "warp")
    if hasattr(warp, "lift"):
        hooks |= {"lift": warp.lift, "lift_width": getattr(warp, "features", 0)}
    wave = getattr(warp, "shortest_wave", None)
    return FieldRecord(**hooks, displace=warp.apply, shortest_wave=wave)


def compile_conditioning(conditioning: Conditioning) -> FieldRecord:
    """Compile a conditioning to the internal record."""
    hooks, target = _hooks(conditioning), conditioning.target
    name, apply, width = hooks["name"], conditioning.apply, conditioning.features
    if target == "color":
        return FieldRecord(
            **hooks,
            condition=lambda params, frame: apply(params, None, frame),
            condition_width=width,
        )
    if target == "trunk":
        return FieldRecord(**hooks, lift=apply, lift_width=width)
    if target == "warp":
        return FieldRecord(**hooks, mark=lambda *given: {name: apply(*given)})
    raise ValueError(
        f"target={target!r} of {name!r} must be one of {', '.join(TARGETS)}"
    )


def compile_medium(medium: Medium, features: int) -> FieldRecord:
    """Compile a medium, for a trunk with so many features, to the internal record."""
    hooks = _hooks(medium) | {"init": functools.partial(medium.init, features=features)}
    return FieldRecord(
        **hooks,
        medium=medium.apply,
        beta_min=getattr(medium, "beta_min", None),
        beta_power=getattr(medium, "beta_power", 0.0),
    )


def compile_regularizer(regularizer: Regularizer) -> FieldRecord:
    """Compile a regularizer to the internal record."""
    return FieldRecord(**regularizer_hooks(regularizer))


def _hooks(part, name=None):
    """The hooks that all parts may have."""
    rate, penalty = getattr(part, "learning_rate", None), None
    if hasattr(part, "loss"):
        penalty = lambda own, context: as_terms(part.loss(own, context))  # noqa: E731
    return {
        "name": name or name_of(part),
        "init": getattr(part, "init", None),
        "learning_rate": None if rate is None else functools.partial(rate_at, rate),
        "penalty": penalty,
        "required_data": frozenset(getattr(part, "required_data", ())),
        "tables": tuple(getattr(part, "tables", ())),
    }
