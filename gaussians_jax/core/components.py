"""Components of a scene: bound to a run, and compiled to the records of a scene."""

import dataclasses
import functools
from typing import Any

import jax
from jaxtyping import Array, Key

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import (
    Appearance,
    CameraOptimizer,
    GaussianAppearance,
    Motion,
    MotionParams,
)
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params
from nerfies_jax.training import programs
from nerfies_jax.training.effects import stream
from nerfies_jax.training.protocols import (
    Regularizer,
    as_terms,
    name_of,
    rate_at,
    regularizer_hooks,
)


def bound(part: Any, steps: int, metadata: SceneMetadata) -> Any:
    """Return the object that implements a component of a scene.

    Args:
      part: An object that implements a protocol, or settings with `bind`.
      steps: Number of training steps.
      metadata: Metadata of the capture.

    Args:
      part: An object that implements a protocol, or settings with `bind`.
      steps: Number of training steps.
      metadata: Metadata of the capture.

    Returns:
      The object.
    """
    return part.bind(steps, metadata) if hasattr(part, "bind") else part


def moving_at_once(motion: Any) -> Any:
    """Return a motion, or its settings, without warm-up.

    Args:
      motion: The motion, or its settings.

    Returns:
      The same with `warm_up=0`.
    """
    if not getattr(motion, "warm_up", 0):
        return motion
    return dataclasses.replace(motion, warm_up=0)


# Optional members of built-in motions that have child Gaussians or temporal opacity.
_HOOKS = ("derive_rows", "derive", "significance", "lifted_rows")


def compile_motion(motion: Motion) -> SplatRecord:
    """Compile a motion to the internal record that a scene is built from.

    Args:
      motion: The motion, bound to a run.

    Returns:
      The record.
    """
    name = name_of(motion)

    def own_params(scene):
        return MotionParams(scene.rows.get(name), scene.nets.get(name))

    hooks = {hook: getattr(motion, hook) for hook in _HOOKS if hasattr(motion, hook)}
    if getattr(motion, "moves", True):
        hooks["deform"] = lambda scene, gaussians, frame, cache: motion.apply(
            own_params(scene), cache, gaussians, frame
        )
    if hasattr(motion, "precompute"):
        hooks["prepare"] = lambda scene: motion.precompute(
            own_params(scene), scene.rows["splats"]
        )
    if hasattr(motion, "refresh"):
        hooks["state"] = lambda scene: motion.refresh(
            own_params(scene), scene.rows["splats"]
        )
        hooks["ready_by_state"] = True
    if hasattr(motion, "loss"):
        hooks["penalty"] = lambda _, context: as_terms(
            motion.loss(own_params(context.params), context)
        )
    if hasattr(motion, "project"):
        hooks["revise"] = motion.project
        hooks["revise_at"] = getattr(motion, "project_steps", ())
    return SplatRecord(
        name,
        init=motion.init,
        learning_rate=functools.partial(rate_at, motion.learning_rate),
        warm_up=getattr(motion, "warm_up", 0),
        fit_to_paths=getattr(motion, "fit", None),
        **hooks,
    )


def motion_of_capture(motion: Any, steps: int, metadata: SceneMetadata) -> SplatRecord:
    """Bind a motion to a run on a capture and compile it.

    Args:
      motion: The motion, or its settings.
      steps: Number of training steps.
      metadata: Metadata of the capture.

    Returns:
      The record, whose programs take the numbers of the capture as arguments.
    """

    def build_with(numbers):
        new_metadata = dataclasses.replace(metadata, **numbers)
        return compile_motion(bound(motion, steps, new_metadata))

    record = compile_motion(bound(motion, steps, metadata))
    return programs.taking(record, metadata.numbers, build_with)


def compile_appearance(appearance: Appearance) -> SplatRecord:
    """Compile an appearance model to the internal record.

    Args:
      appearance: The appearance model, bound to a run.

    Returns:
      The record.
    """
    return SplatRecord(**_hooks(appearance), expose=appearance.apply)


def compile_gaussian_appearance(appearance: GaussianAppearance) -> SplatRecord:
    """Compile an appearance model of Gaussians to the internal record.

    Args:
      appearance: The appearance model, bound to a run.

    Returns:
      The record.
    """
    name = name_of(appearance)

    def own_params(scene):
        return MotionParams(scene.rows.get(name), scene.nets.get(name))

    backdrop = None
    if getattr(appearance, "background", None) is not None:

        def backdrop(scene, direction, code):
            return appearance.background(own_params(scene), direction, code)

    return SplatRecord(
        name,
        init=appearance.init,
        learning_rate=functools.partial(rate_at, appearance.learning_rate),
        code=lambda scene, id_: appearance.code(own_params(scene), id_),
        recolor=lambda scene, colors, code: appearance.apply(
            own_params(scene), colors, code
        ),
        backdrop=backdrop,
    )


def compile_camera_optimizer(optimizer: CameraOptimizer) -> SplatRecord:
    """Compile a camera optimizer to the internal record.

    Args:
      optimizer: The camera optimizer, bound to a run.

    Returns:
      The record.
    """
    apply_to_capture = getattr(optimizer, "apply_to_capture", None)
    return SplatRecord(
        **_hooks(optimizer), pose=optimizer.apply, apply_to_capture=apply_to_capture
    )


def compile_regularizer(regularizer: Regularizer) -> SplatRecord:
    """Compile a regularizer to the internal record.

    A regularizer may have parameters, from its `init(key)` and `learning_rate`. Its
    loss finds them in `params.nets`.

    Args:
      regularizer: The regularizer, bound to a run.

    Returns:
      The record.
    """
    hooks = regularizer_hooks(regularizer)
    if hasattr(regularizer, "init"):
        hooks |= _hooks(regularizer)
    return SplatRecord(
        **hooks,
        state=getattr(regularizer, "state", None),
        reads_depth=getattr(regularizer, "reads_depth", False),
    )


def _hooks(part):
    """Return the hooks of a component that has only shared parameters."""
    return {
        "name": name_of(part),
        "init": lambda key, gaussians: MotionParams(shared=part.init(key)),
        "learning_rate": lambda step: MotionParams(
            shared=rate_at(part.learning_rate, step)
        ),
    }


def initialized(
    parts: tuple[SplatRecord, ...], key: Key[Array, ""], scene: Params
) -> Params:
    """Add the initial parameters of all components to a scene, on the host.

    The PRNG key of a component depends on its name only, not on the other components.

    Args:
      parts: Records of the components.
      key: PRNG key of the scene.
      scene: Parameters, with the Gaussians in `rows["splats"]`.

    Returns:
      The parameters with those of the components, under their names.
    """
    rows, nets = dict(scene.rows), dict(scene.nets)
    for part in parts:
        if part.init is None:
            continue
        own_params = part.init(
            jax.random.fold_in(key, stream(part.name)), rows["splats"]
        )
        if own_params.per_gaussian is not None:
            rows[part.name] = own_params.per_gaussian
        if own_params.shared is not None:
            nets[part.name] = own_params.shared
    return Params(rows, nets)
