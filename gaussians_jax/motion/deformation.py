"""Motion of a scene: all deforming components, one after the other.

If one of the components defines child Gaussians (`derive_rows`, `derive`), the children
are rendered instead of their parents.
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
    """Compute the caches of all components, which do not depend on the time.

    Args:
      effects: Components of the scene.
      params: Trained parameters. The caches are valid for these only.

    Returns:
      The caches by name of the component.
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
    """Compute the Gaussians to render at one time of a trained scene.

    Args:
      effects: Components of the scene.
      params: Trained parameters.
      prepared: Result of `prepare`.
      time: Normalized time.

    Returns:
      The Gaussians, or their children.
    """
    result = deform_rows(effects, params, prepared, time)
    derivation = _derivation(effects)
    if derivation is None:
        return result
    derive_rows, derive = derivation
    return derive(params, derive_rows(params, None), result, FrameCondition(time))


def deform_rows(
    effects: Effects,
    params: Params,
    prepared: dict[str, PyTree],
    time: Float[Array, ""],
) -> Gaussians:
    """Compute the Gaussians at one time of a trained scene, without their children.

    Args:
      effects: Components of the scene.
      params: Trained parameters.
      prepared: Result of `prepare`.
      time: Normalized time.

    Returns:
      The Gaussians.
    """
    gaussians = splats.activate(params.rows["splats"])
    for effect in effects:
        if effect.deform is not None:
            cache = prepared.get(effect.name)
            gaussians = effect.deform(params, gaussians, FrameCondition(time), cache)
    return gaussians


def child_component(effects: Effects) -> SplatRecord | None:
    """Return the component that defines child Gaussians, or None.

    Args:
      effects: Records of the components.

    Returns:
      The record, or None without child Gaussians.
    """
    return next((effect for effect in effects if effect.derive is not None), None)


def _derivation(effects):
    """Return `derive_rows` and `derive` of the component that has them, or None."""
    component = child_component(effects)
    return None if component is None else (component.derive_rows, component.derive)


def check_derived(effects: Effects) -> None:
    """Raise ValueError unless one component at most defines children, completely.

    Args:
      effects: Records of the components.

    Raises:
      ValueError: If several define children, or one lacks a hook.
    """
    names = [e.name for e in effects if e.derive is not None]
    if len(names) > 1:
        raise ValueError(
            f"{' and '.join(names)} both define child Gaussians; leave all but one out"
        )
    for effect in effects:
        if (effect.derive is None) != (effect.derive_rows is None):
            raise ValueError(
                f"the component {effect.name!r} has only one of derive and "
                "derive_rows; child Gaussians need both"
            )


def rendered_rows(effects: Effects, params: Params) -> Splats:
    """Return the raw parameters of the rendered Gaussians in their canonical state.

    Args:
      effects: Records of the components.
      params: Parameters of the scene.

    Returns:
      Parameters of the children, or of the Gaussians if they have none.
    """
    derivation = _derivation(effects)
    if derivation is None:
        return params.rows["splats"]
    derive_rows, _ = derivation
    return derive_rows(params, None)[0]


def rendered(
    effects: Effects, params: Params, deformed: Gaussians, condition: FrameCondition
) -> tuple[Splats, Gaussians]:
    """Return the rendered Gaussians in training: canonical parameters, and deformed.

    Args:
      effects: Components of the scene.
      params: Trained parameters.
      deformed: Deformed Gaussians, without their children.
      condition: Frame time, step and key.

    Returns:
      Raw parameters, and Gaussians at the frame time.
    """
    derivation = _derivation(effects)
    if derivation is None:
        return params.rows["splats"], deformed
    derive_rows, derive = derivation
    child_state = derive_rows(params, condition)
    return child_state[0], derive(params, child_state, deformed, condition)


def significance(
    effects: Effects, gaussians: Gaussians
) -> Float[Array, " gaussians"] | None:
    """Return the weights of children in their parents' statistics, None if equal.

    Args:
      effects: Records of the components.
      gaussians: The rendered Gaussians.

    Returns:
      Weights, not negative.
    """
    component = child_component(effects)
    if component is None or component.significance is None:
        return None
    return component.significance(gaussians)


def children_per_gaussian(effects: Effects, params: Params) -> int:
    """Return the number of children per Gaussian.

    Args:
      effects: Records of the components.
      params: Parameters of the scene.

    Returns:
      The number, 1 if Gaussians are rendered themselves.
    """
    if child_component(effects) is None:
        return 1
    children = jax.eval_shape(lambda params: rendered_rows(effects, params), params)
    return children.mean.shape[0] // params.rows["splats"].mean.shape[0]


def probe(effects: Effects, params: Params) -> Float[Array, "gaussians 2"]:
    """Return zeros to add to the projected means, to get their gradients.

    Args:
      effects: Components of the scene.
      params: Trained parameters.

    Returns:
      Zeros for all rendered Gaussians, in pixels.
    """
    mean = params.rows["splats"].mean
    count = children_per_gaussian(effects, params) * mean.shape[0]
    return jnp.zeros((count, 2), mean.dtype)


def deform_in_training(
    effects: Effects,
    params: Params,
    gaussians: Gaussians,
    condition: FrameCondition,
    states: dict[str, PyTree] | None = None,
) -> Gaussians:
    """Deform the Gaussians of a scene at a frame time in training.

    A component is not evaluated before its warm-up ends. In a scanned loop the
    condition is a branch, so such a step costs as much as without the component.

    Args:
      effects: Components of the scene.
      params: Trained parameters.
      gaussians: Canonical Gaussians.
      condition: Frame time, codes, step and key.
      states: State of components that are `ready_by_state`. Without it their caches are
        computed.

    Returns:
      The deformed Gaussians.
    """
    for effect in effects:
        if effect.deform is None:
            continue

        def deform_by(params, gaussians, effect=effect):
            cache = None
            if effect.ready_by_state and states is not None:
                cache = states[effect.name]
            elif effect.prepare is not None:
                cache = effect.prepare(params)
            return effect.deform(params, gaussians, condition, cache)

        if not effect.warm_up:
            gaussians = deform_by(params, gaussians)
            continue
        assert condition.step is not None
        gaussians = jax.lax.cond(
            condition.step < effect.warm_up,
            lambda params, gaussians: gaussians,
            deform_by,
            params,
            gaussians,
        )
    return gaussians


def deformer(
    effects: Effects, condition: FrameCondition
) -> Callable[[Params, Float[Array, ""]], Gaussians]:
    """Return a function of parameters and a time near `condition` for losses.

    Args:
      effects: Records of the components.
      condition: Frame, step and key of the training step.

    Returns:
      A function that returns the Gaussians at a time in [0, 1].
    """

    def at_time(params, time):
        gaussians = splats.activate(params.rows["splats"])
        at_condition = condition._replace(time=time)
        return deform_in_training(effects, params, gaussians, at_condition)

    return at_time
