"""The motion of a scene: every effect that deforms, one after the other."""

from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, Float

from gaussians_jax import splats
from gaussians_jax.splats import Gaussians, Params
from nerfies_jax.training.effects import Effect, FrameCondition

PyTree = Any
Effects = tuple[Effect, ...]


def prepare(effects: Effects, params: Params) -> dict[str, PyTree]:
    """By the name of the effect, what depends on the parameters but not on the time.

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
    """The trained Gaussians as they are at one time, from what `prepare` returned."""
    gaussians = splats.activate(params.rows["splats"])
    for effect in effects:
        if effect.deform is not None:
            ready = prepared.get(effect.name)
            gaussians = effect.deform(params, gaussians, FrameCondition(time), ready)
    return gaussians


def deform_in_training(
    effects: Effects,
    params: Params,
    gaussians: Gaussians,
    condition: FrameCondition,
    states: dict[str, PyTree] | None = None,
) -> Gaussians:
    """`gaussians` as they are at a moment of training.

    `states` are those of effects that are `ready_by_state`; without them these are
    prepared anew. An effect is not evaluated before its warm-up is over: under the
    loop's scan the switch is a branch, and such a step costs what it costs without the
    effect.
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
