"""Trained Gaussians drawn otherwise: effects left out, faster, without what moves."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gaussians_jax.core import splats, static_rows, time_knots
from gaussians_jax.motion.anchors import AnchorMotionSpec
from gaussians_jax.scene import scene
from nerfies_jax.evaluation.representation import Parts, check_there
from nerfies_jax.training.model import Model, Stages, TrainState

REMOVABLE = ("motion", "carried", "exposure")  # what shows in a picture
INSTANTS = 33  # at which rows are looked for that move


def parts(spec, metadata) -> Parts:
    """Return the parts of a scene that can be left out: those that show in an image."""
    del metadata
    there = tuple(name for name in REMOVABLE if getattr(spec, name) is not None)
    return Parts(there, appearance=spec.exposure is not None)


def without_effects(spec, metadata, without: tuple[str, ...], blended: bool) -> Model:
    """The model with some effects left out."""
    if blended:
        raise ValueError(
            "--appearance: splats have no appearance codes; reconstruct with a preset "
            "that has them, as nerf-w or nerfies"
        )
    return scene.build(reduced(spec, metadata, without), metadata)


def reduced(spec, metadata, without: tuple[str, ...]):
    """Remove parts from the settings of a scene.

    Raises:
      ValueError: If the scene cannot be rendered without one of them.
    """
    check_there(without, parts(spec, metadata).removable)
    left: dict[str, Any] = {name: None for name in REMOVABLE if name in without}
    if "motion" in left and isinstance(spec.motion, AnchorMotionSpec):
        # Of the same features as the motion is what anchors carry at rest.
        left["motion"] = dataclasses.replace(spec.motion, moves=False)
    return dataclasses.replace(spec, **left)


class Faster(NamedTuple):
    """A model that is drawn faster, the state that it needs, and what was gained."""

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
    """Return the model with its motion read from a table of `knots` times."""
    stages = _stages(model, "--knots")
    time_knots.check(knots, interpolation)
    params = state.params
    prepared = jax.jit(stages.prepare)(params)
    deform = jax.jit(stages.deform)
    table = time_knots.bake(
        lambda time: deform(params, prepared, time),
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
            prepare=lambda both: (),
            deform=lambda both, prepared, time: time_knots.at(
                both[1], time, interpolation
            ),
            draw=lambda both, *rest: stages.draw(both[0], *rest),
            rows=lambda both: stages.rows(both[0]),
        ),
        summary,
    )


def without_static(model: Model, state: TrainState, static_threshold: float) -> Faster:
    """Return the model with the deformation evaluated for moving Gaussians only.

    Those are the ones that move farther than `static_threshold` (scene units), or come
    and go, over `INSTANTS` instants of [0, 1].
    """
    stages = _stages(model, "--static-threshold")

    def deform_rows(params, time):
        return stages.deform(params, stages.prepare(params), time)

    times = np.linspace(0, 1, INSTANTS)
    parts = static_rows.split(state.params, deform_rows, times, static_threshold)

    def deform(both, prepared, time):
        return static_rows.deform(
            both[1], lambda rows, time: stages.deform(rows, prepared, time), time
        )

    return _with(
        model,
        state,
        parts,
        Stages(
            prepare=lambda both: stages.prepare(both[1].dynamic),
            deform=deform,
            draw=lambda both, *rest: stages.draw(both[0], *rest),
            rows=lambda both: stages.rows(both[0]),
        ),
        f"the deformation of {_moving(parts.row_index, static_threshold)}",
    )


def without_moving(
    model: Model, state: TrainState, farther_than: float
) -> tuple[TrainState, str]:
    """Return the state without moving Gaussians, and a summary, on the host.

    Those are the ones of which a point moves farther than `farther_than` (scene units)
    over `INSTANTS` instants of [0, 1]: what is left is the static scene. What was
    never filmed behind what moves is a guess (`StartSpec.fill_hidden`) or a hole.
    """
    stages = _stages(model, "--hide-moving")

    def deform_rows(params, time):
        return stages.deform(params, stages.prepare(params), time)

    times = np.linspace(0, 1, INSTANTS)
    parts = static_rows.split(
        state.params, deform_rows, times, farther_than, fading=False
    )
    moves = static_rows.of_rows(state.params, np.asarray(parts.row_index.moves))
    rows = state.params.rows
    active = int(splats.active_mask(rows["splats"]).sum())
    if int(moves.sum()) == active:
        raise ValueError(
            f"--hide-moving {farther_than:g}: all {active} Gaussians move farther than "
            "that, and nothing would be left; give a longer distance"
        )
    shown = rows | {"splats": splats.deactivate(rows["splats"], jnp.asarray(moves))}
    params = state.params._replace(rows=shown)
    summary = f"{int(moves.sum())} of {active} Gaussians move and are left out"
    return state._replace(params=params), summary


def _stages(model, option):
    if model.stages is None:
        raise ValueError(
            f"{option} is for runs of Gaussians; a radiance field has no table of "
            "where its points are"
        )
    return model.stages


def _moving(where, static_threshold):
    moving, rows = int(where.moves.sum()), len(where.moves)
    if not moving:
        raise ValueError(
            f"nothing in this run moves farther than {static_threshold:g} scene units; "
            "leave --knots and --static-threshold out, or lower the latter"
        )
    return f"{moving} of {rows} rows that move"


def _with(model: Model, state: TrainState, extras: Any, stages: Stages, summary: str):
    """The model on `(params, beside)`: what is beside is an argument, no constant."""

    def render(both, view, size, step):
        deformed = stages.deform(both, stages.prepare(both), view.time)
        return stages.draw(both, deformed, view, size, step)

    return Faster(
        model._replace(render=render, stages=stages),
        state._replace(params=(state.params, extras)),
        summary,
    )
