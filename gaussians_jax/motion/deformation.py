"""Motion of a scene: all deforming effects, one after the other.

Effects deform the Gaussians of the scene. If one of them defines children
(`derive_rows`, `derive`), the children are rendered instead.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gaussians_jax.core import splats
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Gaussians, Params, Splats
from nerfies_jax.training.effects import FrameCondition

PyTree = Any
Effects = tuple[SplatRecord, ...]


def prepare(effects: Effects, params: Params) -> dict[str, PyTree]:
    """Compute what depends on the parameters but not on the time, by effect name.

    A pure function: what it returned is right as long as `params` are the same arrays.
    """
    return {
        effect.name: effect.prepare(params)
        for effect in effects
        if effect.prepare is not None
    }


def deform(
    effects: Effects,
    params: Params,
    prepared: dict[str, PyTree],
    time: Float[Array, ""],
) -> Gaussians:
    """Compute the Gaussians to render at one time of a trained scene."""
    moved = deform_rows(effects, params, prepared, time)
    derivation = _derivation(effects)
    if derivation is None:
        return moved
    derive_rows, derive = derivation
    return derive(params, derive_rows(params, None), moved, FrameCondition(time))


def deform_rows(
    effects: Effects,
    params: Params,
    prepared: dict[str, PyTree],
    time: Float[Array, ""],
) -> Gaussians:
    """The rows of a trained scene as they are at one time."""
    gaussians = splats.activate(params.rows["splats"])
    for effect in effects:
        if effect.deform is not None:
            ready = prepared.get(effect.name)
            gaussians = effect.deform(params, gaussians, FrameCondition(time), ready)
    return gaussians


def derives(effects: Effects) -> SplatRecord | None:
    """Return the effect that defines child Gaussians, None if there is none."""
    return next((effect for effect in effects if effect.derive is not None), None)


def _derivation(effects):
    """Return `derive_rows` and `derive` of the effect that has them, or None."""
    by = derives(effects)
    return None if by is None else (by.derive_rows, by.derive)


def check_derived(effects: Effects) -> None:
    """Raise ValueError where more than one effect says what is drawn, or half of it."""
    named = [e.name for e in effects if e.derive is not None]
    if len(named) > 1:
        raise ValueError(
            f"{' and '.join(named)} each say what rows carry; leave all but one out"
        )
    for effect in effects:
        if (effect.derive is None) != (effect.derive_rows is None):
            raise ValueError(
                f"the effect {effect.name!r} fills one of derive and derive_rows; what "
                "rows carry needs both, at rest and at a time"
            )


def drawn_rows(effects: Effects, params: Params) -> Splats:
    """Return the raw parameters of the rendered Gaussians in canonical position."""
    derivation = _derivation(effects)
    if derivation is None:
        return params.rows["splats"]
    derive_rows, _ = derivation
    return derive_rows(params, None)[0]


def drawn(
    effects: Effects, params: Params, moved: Gaussians, condition: FrameCondition
) -> tuple[Splats, Gaussians]:
    """Return the rendered Gaussians in training: canonical parameters, and moved."""
    derivation = _derivation(effects)
    if derivation is None:
        return params.rows["splats"], moved
    derive_rows, derive = derivation
    derived = derive_rows(params, condition)
    return derived[0], derive(params, derived, moved, condition)


def significance(
    effects: Effects, gaussians: Gaussians
) -> Float[Array, " gaussians"] | None:
    """Weight the children of each Gaussian; None for equal weights."""
    by = derives(effects)
    if by is None or by.significance is None:
        return None
    return by.significance(gaussians)


def carried_by_each(effects: Effects, params: Params) -> int:
    """Return the number of children per Gaussian."""
    if derives(effects) is None:
        return 1
    drawn = jax.eval_shape(lambda params: drawn_rows(effects, params), params)
    return drawn.mean.shape[0] // params.rows["splats"].mean.shape[0]


def probe(effects: Effects, params: Params) -> Float[Array, "gaussians 2"]:
    """Zeros whose slope is that of the places in the picture of what is drawn, px."""
    mean = params.rows["splats"].mean
    count = carried_by_each(effects, params) * mean.shape[0]
    return jnp.zeros((count, 2), mean.dtype)


def deform_in_training(
    effects: Effects,
    params: Params,
    gaussians: Gaussians,
    condition: FrameCondition,
    states: dict[str, PyTree] | None = None,
) -> Gaussians:
    """Deform the Gaussians of a scene at a frame time in training.

    An effect is not evaluated before its warm-up ends. Under the loop's scan the
    condition is a branch, so such a step costs as much as without the effect.

    Args:
      effects: Effects of the scene.
      params: Trained parameters.
      gaussians: Canonical Gaussians.
      condition: Frame time, codes, step and key.
      states: State of effects that are `ready_by_state`. Without it they are prepared
        anew.

    Returns:
      The deformed Gaussians.
    """
    for effect in effects:
        if effect.deform is None:
            continue

        def moved(params, gaussians, effect=effect):
            ready = None
            if effect.ready_by_state and states is not None:
                ready = states[effect.name]
            elif effect.prepare is not None:
                ready = effect.prepare(params)
            return effect.deform(params, gaussians, condition, ready)

        if not effect.warm_up:
            gaussians = moved(params, gaussians)
            continue
        assert condition.step is not None
        gaussians = jax.lax.cond(
            condition.step < effect.warm_up,
            lambda params, gaussians: gaussians,
            moved,
            params,
            gaussians,
        )
    return gaussians


def deformer(
    effects: Effects, condition: FrameCondition
) -> Callable[[Params, Float[Array, ""]], Gaussians]:
    """A function of rows and of a time near `condition`, for `PenaltyContext`."""

    def at_time(params, time):
        gaussians = splats.activate(params.rows["splats"])
        then = condition._replace(time=time)
        return deform_in_training(effects, params, gaussians, then)

    return at_time
