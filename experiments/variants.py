"""A trained scene drawn otherwise: effects left out, appearances blended, faster."""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from nerfies_jax.capture.capture import Capture
from nerfies_jax.training.model import Model, Stages, TrainState, View

INSTANTS = 33  # at which rows are looked for that move


class Between(NamedTuple):
    """A view whose appearance lies between those of two frames."""

    view: View  # its own appearance is the one at share 0
    towards: Int[Array, ""]  # appearance id at share 1
    share: Float[Array, ""]  # in [0, 1]


def of_splats(spec, facts, without: tuple[str, ...], blended: bool) -> Model:
    """The model with some effects left out."""
    from gaussians_jax import scene

    if blended:
        raise ValueError(
            "--appearance: splats have no appearance codes; reconstruct with a preset "
            "that has them, as nerf-w or nerfies"
        )
    there = [name for name in ("motion",) if getattr(spec, name) is not None]
    _check_there(without, there)
    left = dataclasses.replace(spec, **dict.fromkeys(without))
    return scene.build(left, facts)


def of_fields(spec, facts, without: tuple[str, ...], blended: bool) -> Model:
    """The model with some effects left out of its pictures, or drawing a `Between`."""
    from nerfies_jax import scene
    from nerfies_jax.effects.effect import APPEARANCE

    whole = scene.field(spec, facts)
    # What feeds the network's inputs is part of it; a penalty draws nothing.
    drawn = [
        effect.name
        for effect in whole.effects
        if (effect.displace is not None or effect.medium is not None)
        and effect.condition is None
        and effect.lift is None
    ]
    _check_there(without, drawn)
    made = scene.field(spec, facts, without)
    tables = [table for effect in made.effects for table in effect.tables]
    if blended and all(table.by != APPEARANCE for table in tables):
        raise ValueError(
            "--appearance: this field has no appearance codes; reconstruct with a "
            "preset that has them, as nerf-w or nerfies"
        )

    def plain(params, view, size, step):
        codes = made.codes_at(params, view)
        return made.render(params, view.camera, view.time, codes, size, step)

    def blend(params, between, size, step):
        view, share = between.view, between.share
        start = made.codes_at(params, view)
        end = made.codes_at(params, view._replace(appearance=between.towards))
        # Codes of the moment are the same at both ends and stay as they are.
        codes = {name: (1 - share) * start[name] + share * end[name] for name in start}
        return made.render(params, view.camera, view.time, codes, size, step)

    render = blend if blended else plain
    return scene.build(spec, facts)._replace(render=render, stages=None)


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
    """The model with its motion read from a table of `knots` instants; host side."""
    from gaussians_jax import time_knots

    stages = _stages(model, "--knots")
    time_knots.check(knots, interpolation)
    params = state.params
    prepared = jax.jit(stages.prepare)(params)
    pose = jax.jit(stages.pose)
    table = time_knots.bake(
        lambda time: pose(params, prepared, time), knots, static_threshold
    )
    summary = (
        f"{knots} knots, {interpolation}, of {_moving(table.index, static_threshold)}: "
        f"{table.bytes / 1e6:.1f} MB"
    )
    return _with(
        model,
        state,
        table,
        Stages(
            prepare=lambda both: (),
            pose=lambda both, prepared, time: time_knots.at(
                both[1], time, interpolation
            ),
            draw=lambda both, *rest: stages.draw(both[0], *rest),
        ),
        summary,
    )


def without_static(model: Model, state: TrainState, static_threshold: float) -> Faster:
    """The model with the deformation evaluated for moving Gaussians alone; host side.

    Those are the ones that move farther than `static_threshold` (scene units) over
    `INSTANTS` instants of [0, 1].
    """
    from gaussians_jax import static_rows

    stages = _stages(model, "--static-threshold")

    def pose_rows(params, time):
        return stages.pose(params, stages.prepare(params), time)

    times = np.linspace(0, 1, INSTANTS)
    parts = static_rows.split(state.params, pose_rows, times, static_threshold)

    def pose(both, prepared, time):
        return static_rows.pose(
            both[1], lambda rows, time: stages.pose(rows, prepared, time), time
        )

    return _with(
        model,
        state,
        parts,
        Stages(
            prepare=lambda both: stages.prepare(both[1].dynamic),
            pose=pose,
            draw=lambda both, *rest: stages.draw(both[0], *rest),
        ),
        f"the deformation of {_moving(parts.index, static_threshold)}",
    )


def without_moving(
    model: Model, state: TrainState, farther_than: float
) -> tuple[TrainState, str]:
    """The state without the Gaussians that move, and what was left out; host side.

    Those are the ones of which a point moves farther than `farther_than` (scene units)
    over `INSTANTS` instants of [0, 1]: what is left is the static scene, with holes
    where nothing was ever filmed behind what moves.
    """
    from gaussians_jax import splats, static_rows

    stages = _stages(model, "--hide-moving")

    def pose_rows(params, time):
        return stages.pose(params, stages.prepare(params), time)

    times = np.linspace(0, 1, INSTANTS)
    parts = static_rows.split(state.params, pose_rows, times, farther_than)
    moves = parts.index.moves
    rows = state.params.rows
    active = int(splats.active_mask(rows["splats"]).sum())
    if int(moves.sum()) == active:
        raise ValueError(
            f"--hide-moving {farther_than:g}: all {active} Gaussians move farther than "
            "that, and nothing would be left; give a longer distance"
        )
    shown = rows | {"splats": splats.deactivate(rows["splats"], moves)}
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


def _with(model: Model, state: TrainState, beside: Any, stages: Stages, summary: str):
    """The model on `(params, beside)`: what is beside is an argument, no constant."""

    def render(both, view, size, step):
        posed = stages.pose(both, stages.prepare(both), view.time)
        return stages.draw(both, posed, view, size, step)

    return Faster(
        model._replace(render=render, stages=stages),
        state._replace(params=(state.params, beside)),
        summary,
    )


def appearance_id(capture: Capture, name: str) -> int:
    """The appearance of a frame, by its name, or an appearance id itself."""
    if name in capture.ids:
        return int(capture.appearance_ids[capture.ids.index(name)])
    known = np.unique(capture.appearance_ids)
    if name.isdigit() and int(name) in known:
        return int(name)
    raise ValueError(
        f"--appearance {name}: neither a frame of {capture.name}, as "
        f"{capture.ids[0]!r}, nor one of its appearance ids, {known[0]} to {known[-1]}"
    )


def _check_there(without, there):
    for name in without:
        if name not in there:
            raise ValueError(
                f"--without {name}: no effect that this run can be drawn without; "
                f"those are: {', '.join(there) or 'none'}"
            )
