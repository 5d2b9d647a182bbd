"""Internal records of the components of a field, for rendering and training."""

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
TARGETS = ("trunk", "color", "warp")  # networks that can read a conditioning


@dataclasses.dataclass(frozen=True)
class FieldRecord(Record):
    """Hooks of a component of a radiance field. Unused hooks are None.

    They are functions of one point of one ray, in units of the field. `params` is the
    result of `init`, or None without `init`.
    """

    tables: tuple[Table, ...] = ()
    # (params, condition) -> inputs of the color branch, besides the view direction
    condition: Callable[[PyTree, FrameCondition], Features] | None = None
    condition_width: int = 0
    # (params, point, condition) -> displacement: template point minus observed point
    displace: Callable[[PyTree, Vector, FrameCondition], Vector] | None = None
    # Shortest wavelength of the displacement in space. If it is long enough, frames are
    # rendered with displacements on a grid (`frustum_grid`). None if unknown.
    shortest_wave: float | None = None
    # (params, observed point, condition) -> inputs of the trunk, besides the point,
    # such as ambient coordinates
    trunk_features: Callable[[PyTree, Vector, FrameCondition], Features] | None = None
    trunk_width: int = 0
    # (params, observed point, condition) -> codes of the point by name, which are added
    # to those of the frame for all `displace` and `trunk_features` hooks
    point_codes: (
        Callable[[PyTree, Vector, FrameCondition], dict[str, Features]] | None
    ) = None
    # (params, level, `effect.Surface`, condition) -> `effect.SurfaceOutput`, with
    # `surface_width` inputs of the color branch for each sample
    surface: Callable[[PyTree, str, Any, FrameCondition], Any] | None = None
    surface_width: int = 0
    # (params, `effect.Sample`, condition) -> `effect.Medium`, on the last level only
    medium: Callable[[PyTree, Any, FrameCondition], Any] | None = None
    # Minimum standard deviation of a ray's color, if the medium has a `beta`.
    beta_min: float | None = None
    beta_power: float = 0.0  # of `transient.photometric`; zero is the likelihood


def compile_warp(warp: Warp) -> FieldRecord:
    """Convert a warp to the internal record.

    Args:
      warp: The warp, bound to a run.

    Returns:
      The record.
    """
    hooks = _hooks(warp, "warp")
    if hasattr(warp, "trunk_features"):
        hooks["trunk_features"] = warp.trunk_features
        hooks["trunk_width"] = getattr(warp, "features", 0)
    wave = getattr(warp, "shortest_wave", None)
    return FieldRecord(**hooks, displace=warp.apply, shortest_wave=wave)


def compile_conditioning(conditioning: Conditioning) -> FieldRecord:
    """Convert a conditioning to the internal record.

    Args:
      conditioning: The conditioning, bound to a run.

    Returns:
      The record.

    Raises:
      ValueError: If the target is unknown.
    """
    hooks, target = _hooks(conditioning), conditioning.target
    name, apply, width = hooks["name"], conditioning.apply, conditioning.features
    if target == "color":
        return FieldRecord(
            **hooks,
            condition=lambda params, frame: apply(params, None, frame),
            condition_width=width,
        )
    if target == "trunk":
        return FieldRecord(**hooks, trunk_features=apply, trunk_width=width)
    if target == "warp":
        return FieldRecord(**hooks, point_codes=lambda *args: {name: apply(*args)})
    raise ValueError(
        f"target={target!r} of {name!r} must be one of {', '.join(TARGETS)}"
    )


def compile_medium(medium: Medium, features: int) -> FieldRecord:
    """Convert a medium to the internal record, for a trunk of `features` features.

    Args:
      medium: The medium, bound to a run.
      features: Number of features of the trunk.

    Returns:
      The record.
    """
    hooks = _hooks(medium) | {"init": functools.partial(medium.init, features=features)}
    return FieldRecord(
        **hooks,
        medium=medium.apply,
        beta_min=getattr(medium, "beta_min", None),
        beta_power=getattr(medium, "beta_power", 0.0),
    )


def compile_regularizer(regularizer: Regularizer) -> FieldRecord:
    """Convert a regularizer to the internal record.

    Args:
      regularizer: The regularizer, bound to a run.

    Returns:
      The record.
    """
    return FieldRecord(**regularizer_hooks(regularizer))


def _hooks(component, name=None):
    """Return the hooks that all components can have."""
    rate, penalty = getattr(component, "learning_rate", None), None
    if hasattr(component, "loss"):
        penalty = lambda own, context: as_terms(component.loss(own, context))  # noqa: E731
    return {
        "name": name or name_of(component),
        "init": getattr(component, "init", None),
        "learning_rate": None if rate is None else functools.partial(rate_at, rate),
        "penalty": penalty,
        "required_data": frozenset(getattr(component, "required_data", ())),
        "tables": tuple(getattr(component, "tables", ())),
    }
