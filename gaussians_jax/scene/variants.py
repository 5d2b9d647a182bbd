"""Variants of a trained scene: without components, faster, or without moving parts."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gaussians_jax.core import splats, static_rows, time_knots
from gaussians_jax.motion.anchors import AnchorMotionSpec
from gaussians_jax.scene import scene
from nerfies_jax.evaluation.representation import Parts, check_there
from nerfies_jax.training import programs
from nerfies_jax.training.model import Model, Stages, TrainState

# Components that affect a render
REMOVABLE = ("motion", "carried", "exposure", "appearance")
INSTANTS = 33  # frame times at which moving Gaussians are detected


def parts(spec, metadata) -> Parts:
    """Return the components that can be left out: those that affect a render.

    Args:
      spec: The scene.
      metadata: Scene metadata, which is not used.

    Returns:
      Names of the fields, and whether the appearance depends on the frame.
    """
    del metadata
    present = tuple(name for name in REMOVABLE if getattr(spec, name) is not None)
    per_image = spec.exposure is not None or spec.appearance is not None
    return Parts(present, appearance=per_image)


def without_effects(spec, metadata, without: tuple[str, ...], blended: bool) -> Model:
    """Build the model without some of its components.

    Args:
      spec: The scene.
      metadata: Scene metadata.
      without: Names of the components to leave out.
      blended: Blend the appearance of frames, which splats cannot.

    Returns:
      The model.

    Raises:
      ValueError: If `blended`, or if a component cannot be left out.
    """
    if blended:
        raise ValueError(
            "splats have no appearance codes to blend; reconstruct with a preset that "
            "has them, such as nerf-w or nerfies"
        )
    return scene.build(reduced(spec, metadata, without), metadata)


def reduced(spec, metadata, without: tuple[str, ...]):
    """Remove components from the settings of a scene.

    Args:
      spec: The scene.
      metadata: Scene metadata.
      without: Names of the components to leave out.

    Returns:
      The settings without them.

    Raises:
      ValueError: If the scene cannot be rendered without one of them.
    """
    check_there(without, parts(spec, metadata).removable)
    changes: dict[str, Any] = {name: None for name in REMOVABLE if name in without}
    if "motion" in changes and isinstance(spec.motion, AnchorMotionSpec):
        # Static children of anchors are computed from the same features as the motion.
        changes["motion"] = dataclasses.replace(spec.motion, moves=False)
    return dataclasses.replace(spec, **changes)


class Faster(NamedTuple):
    """A model that renders faster, the state that it needs, and a summary."""

    model: Model
    state: TrainState
    summary: str


def from_knots(
    model: Model,
    state: TrainState,
    knots: int,
    interpolation: str = "linear",
    static_threshold: float = 0.0,
) -> Faster:
    """Return the model with its motion interpolated from a table of knots.

    Args:
      model: The model.
      state: State of the trained scene.
      knots: Number of knots in time.
      interpolation: "linear" or "cubic".
      static_threshold: Gaussians that move less than this (scene units) are static.

    Returns:
      The faster model.

    Raises:
      ValueError: If the model has no motion that can be tabulated.
    """
    stages = _stages(model, "a table of knots")
    time_knots.check(knots, interpolation)
    params = state.params
    table = time_knots.bake(
        programs.deformer(model)(params),
        knots,
        static_threshold,
        stages.rows(params).mean.dtype,
    )
    moving = _moving(table.row_index, static_threshold)
    summary = f"{knots} knots, {interpolation}, of {moving}: {table.bytes / 1e6:.1f} MB"
    return _with(
        model,
        state,
        table,
        Stages(
            prepare=lambda inputs: (),
            deform=lambda inputs, cache, time: time_knots.at(
                inputs[1], time, interpolation
            ),
            draw=lambda inputs, *others: stages.draw(inputs[0], *others),
            rows=lambda inputs: stages.rows(inputs[0]),
        ),
        summary,
    )


def without_static(model: Model, state: TrainState, static_threshold: float) -> Faster:
    """Return the model with the deformation evaluated for moving Gaussians only.

    Args:
      model: The model.
      state: State of the trained scene.
      static_threshold: Gaussians are static if they move less than this (scene units)
        and keep their opacity at `INSTANTS` times in [0, 1].

    Returns:
      The faster model.

    Raises:
      ValueError: If the model has no motion, or nothing moves.
    """
    stages = _stages(model, "the separation of static Gaussians")

    def deform_rows(params, time):
        return stages.deform(params, stages.prepare(params), time)

    times = np.linspace(0, 1, INSTANTS)
    parts = static_rows.split(state.params, deform_rows, times, static_threshold)

    def deform(inputs, cache, time):
        return static_rows.deform(
            inputs[1], lambda rows, time: stages.deform(rows, cache, time), time
        )

    return _with(
        model,
        state,
        parts,
        Stages(
            prepare=lambda inputs: stages.prepare(inputs[1].dynamic),
            deform=deform,
            draw=lambda inputs, *others: stages.draw(inputs[0], *others),
            rows=lambda inputs: stages.rows(inputs[0]),
        ),
        f"the deformation of {_moving(parts.row_index, static_threshold)}",
    )


def without_moving(
    model: Model, state: TrainState, farther_than: float
) -> tuple[TrainState, str]:
    """Deactivate moving Gaussians, on the host.

    A background that was never observed behind moving objects is a guess
    (`StartSpec.fill_hidden`) or a hole.

    Args:
      model: The model.
      state: State of the trained scene.
      farther_than: Gaussians are removed if any of their points moves farther than this
        (scene units) at `INSTANTS` times in [0, 1].

    Returns:
      The static scene, and a summary.

    Raises:
      ValueError: If the model has no motion, or nothing would be left.
    """
    stages = _stages(model, "the removal of moving Gaussians")

    def deform_rows(params, time):
        return stages.deform(params, stages.prepare(params), time)

    times = np.linspace(0, 1, INSTANTS)
    parts = static_rows.split(
        state.params, deform_rows, times, farther_than, fading=False
    )
    moves = static_rows.of_rows(state.params, np.asarray(parts.row_index.moves))
    rows = state.params.rows
    active = splats.active_count(rows["splats"])
    if int(moves.sum()) == active:
        raise ValueError(
            f"all {active} Gaussians move farther than {farther_than:g} scene units, "
            "so nothing would be left; pass a longer distance"
        )
    static = rows | {"splats": splats.deactivate(rows["splats"], jnp.asarray(moves))}
    params = state.params._replace(rows=static)
    summary = f"{int(moves.sum())} of {active} Gaussians move and are left out"
    return state._replace(params=params), summary


def _stages(model, feature):
    if model.stages is None:
        raise ValueError(
            f"{feature} needs a run of Gaussians; a radiance field does not store the "
            "motion of its points"
        )
    return model.stages


def _moving(row_index, static_threshold):
    moving, rows = int(row_index.moves.sum()), len(row_index.moves)
    if not moving:
        raise ValueError(
            f"nothing in this run moves farther than {static_threshold:g} scene units; "
            "render without knots and static_threshold, or lower the latter"
        )
    return f"{moving} of {rows} moving Gaussians"


def _with(model: Model, state: TrainState, extras: Any, stages: Stages, summary: str):
    """Return the model on `(params, extras)`. Extras are inputs, not constants."""

    def render(inputs, view, size, step):
        gaussians = stages.deform(inputs, stages.prepare(inputs), view.time)
        return stages.draw(inputs, gaussians, view, size, step)

    return Faster(
        model._replace(render=render, stages=stages),
        state._replace(params=(state.params, extras)),
        summary,
    )
