"""Gaussians and effects put together: a spec becomes a `Model` the loop can train."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax import (
    densification,
    initialisation,
    learning_rates,
    mcmc,
    phases,
    render,
    splats,
)
from gaussians_jax.densification import DefaultStrategySpec
from gaussians_jax.effects import deformation
from gaussians_jax.effects.effect import Around, Effect, Moment, Shot
from gaussians_jax.mcmc import MCMCStrategySpec
from gaussians_jax.phases import Trained
from gaussians_jax.spec import (
    OPTIMISERS,
    Facts,
    SplatScene,
    effects_of,
    refuse_what_cannot_train,
)
from gaussians_jax.splats import Params
from nerfies_jax.capture.capture import Capture
from nerfies_jax.training import loop, losses
from nerfies_jax.training.model import (
    Event,
    Frames,
    Model,
    Rendering,
    Stages,
    TrainState,
    View,
    in_default_precision,
)

PyTree = Any

# Streams of the run's key beside those of the steps, which are its 0, 1, 2, ...
ORDER, EVENT, NOISE = 2**32 - 1, 2**32 - 2, 2**32 - 3


def facts_of(capture: Capture) -> Facts:
    """The facts of a capture; host side."""
    positions = np.asarray(capture.cameras.position)[capture.train]
    halfway = 2 / (1 / capture.near + 1 / capture.far)
    return Facts(
        extent=splats.scene_extent(positions, still=halfway),
        background=capture.background or (0.0, 0.0, 0.0),
        frames=len(capture.train),
    )


class Extra(NamedTuple):
    """What a scene carries beside its parameters; everything in it has rows."""

    stats: PyTree  # densification.RowStats, or () where no strategy keeps them
    carried: dict[str, PyTree]  # by the name of the effect


def carried_by(effects: tuple[Effect, ...], params: Params) -> dict[str, PyTree]:
    """What each effect carries from this change of the rows to the next; host side."""
    return {
        effect.name: effect.carry(params)
        for effect in effects
        if effect.carry is not None
    }


def build(spec: SplatScene, facts: Facts) -> Model:
    """Everything the loop, the renderer and the report need of this scene."""
    effects = effects_of(spec, facts)
    # Counts updates per row; for the networks, whose rows are never born, it is plain.
    optimiser = OPTIMISERS[spec.optimiser]()
    stages = _stages(spec, facts, effects)

    def whole_frame(params, view, size, step):
        posed = stages.pose(params, stages.prepare(params), view.time)
        return stages.draw(params, posed, view, size, step)

    return Model(
        spec=(spec, facts),
        init=lambda capture, key: first_state(spec, effects, optimiser, capture, key),
        step=_stepper(spec, facts, effects, optimiser),
        render=whole_frame,
        events=_events(spec, facts, effects, optimiser),
        counts=count_rows,
        wants=frozenset().union(*(effect.wants for effect in effects)),
        stages=stages,
    )


def _stages(spec, facts, effects):
    """Rendering of trained parameters in parts."""

    def prepare(params):
        return deformation.prepare(effects, params)

    def pose(params, prepared, time):
        return deformation.pose(effects, params, prepared, time)

    def draw(params, posed, view, size, step):
        degree = splats.active_degree(step, spec.sh_every, spec.sh_degree)
        return _draw(spec, facts, params, posed, view, size, degree).rendering

    return Stages(prepare, pose, draw)


def _draw(spec, facts, params, gaussians, view, size, degree, probe=None, depth=True):
    return render.render_harmonics(
        gaussians,
        splats.active_harmonics(params.rows["splats"], degree),
        view.camera,
        size,
        spec.raster,
        jnp.asarray(facts.background, gaussians.mean.dtype),
        mean2d_offset=probe,
        depth=depth,
    )


def _stepper(spec, facts, effects, optimiser):
    """One update from one frame: (state, frames) -> (state, metrics), pure."""

    def step(state: TrainState, frames: Frames):
        row = shuffled_row(state.key, state.step, len(frames.times))
        view = _view(frames, row)
        size = frames.images.shape[2], frames.images.shape[1]
        degree = splats.active_degree(state.step, spec.sh_every, spec.sh_degree)
        moment = Moment(view.time, state.step, loop.step_key(state))
        mask = phases.update_mask(spec.alternation, state.step)

        def posed(params, gaussians):
            return deformation.pose_in_training(effects, params, gaussians, moment)

        if spec.alternation is not None:
            posed = phases.stop_frozen_gradients(mask, posed)
        # A channel that nothing reads is still blended: 4 % of a step.
        read = any("depths" in effect.wants for effect in effects)
        depth = read and frames.depths is not None

        def loss(params, probe):
            canonical = splats.activate(params.rows["splats"])
            moved = posed(params, canonical)
            frame = _draw(spec, facts, params, moved, view, size, degree, probe, depth)
            seen = shot(frames, row, frame.rendering)
            carried = state.extra.carried
            value, metrics = loss_of(spec, effects, params, seen, moment, carried)
            return value, (metrics, frame.footprints, canonical, moved)

        probe = jnp.zeros_like(state.params.rows["splats"].mean[:, :2])
        (value, (metrics, footprints, *poses)), (slopes, probe_slope) = (
            jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(state.params, probe)
        )
        directions, moments = optimiser.update(slopes, state.optimiser, state.params)
        rate = _rates(spec, facts, effects, state.step)
        trained = Trained(
            learning_rates.descend(state.params, directions, rate), moments
        )
        if isinstance(spec.densification, MCMCStrategySpec):
            key, speed = _stream(state, NOISE), rate.rows["splats"].mean
            shaken = mcmc.shake(key, trained.params, speed, spec.densification)
            trained = trained._replace(params=shaken)
        if spec.alternation is not None:
            before = Trained(state.params, state.optimiser)
            trained = phases.freeze(optimiser, mask, before, trained)
        stats, carried = state.extra
        if isinstance(spec.densification, DefaultStrategySpec):
            radius_px = jnp.max(footprints.extent_px, axis=1)
            stats = densification.observe(
                stats, probe_slope, footprints.visible, radius_px, size
            )
        for effect in effects:
            if effect.observe is not None:
                own = effect.observe(carried[effect.name], *poses, moment)
                carried = carried | {effect.name: own}
        state = TrainState(*trained, Extra(stats, carried), state.step + 1, state.key)
        return state, {"loss": value, **metrics}

    return step


def loss_of(
    spec: SplatScene,
    effects: tuple[Effect, ...],
    params: Params,
    seen: Shot,
    moment: Moment,
    carried: dict[str, PyTree],
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The loss of one frame with what every effect adds, and numbers to log."""
    colour = seen.rendering.colour
    value = losses.photometric(
        colour, seen.truth, seen.valid, dssim_weight=spec.dssim_weight
    )
    metrics = {"mse": losses.mse(colour, seen.truth, seen.valid)}
    if isinstance(spec.densification, MCMCStrategySpec):
        cost = mcmc.penalty(params.rows["splats"], spec.densification)
        value, metrics = value + cost, metrics | {"mcmc": cost}

    at_time = deformation.poser(effects, moment)
    for effect in effects:
        terms = []
        if effect.image_loss is not None:
            terms.append(effect.image_loss(params, seen, moment))
        if effect.penalty is not None:
            own = carried.get(effect.name)
            terms.append(effect.penalty(Around(params, at_time, moment, own)))
        for term in terms:
            value = value + term.value
            named = {f"{effect.name}.{key}": x for key, x in term.metrics.items()}
            metrics |= {effect.name: term.value} | named
    return value, metrics


def shot(
    frames: Frames, row: Int[Array, ""] | int, rendering: Rendering | None
) -> Shot:
    """What the losses compare: a frame that was drawn with the one that was filmed."""
    return Shot(
        rendering,
        frames.images[row].astype(frames.times.dtype) / 255,
        None if frames.valid is None else frames.valid[row],
        None if frames.depths is None else frames.depths[row],
    )


def _view(frames, row):
    camera = jax.tree.map(lambda leaf: leaf[row], frames.cameras)
    return View(camera, frames.times[row], frames.warp[row], frames.appearance[row])


def _rates(spec, facts, effects, step):
    """A prefix of `Params` with the learning rate of everything below each leaf."""
    rows = {
        "splats": learning_rates.at_step(
            spec.learning_rates, facts.extent, spec.steps, step, spec.annealing
        )
    }
    nets = {}
    for effect in effects:
        if effect.init_rows is not None:
            rows[effect.name] = effect.row_rate(step)
        if effect.init_nets is not None:
            nets[effect.name] = effect.net_rate(step)
    return Params(rows, nets)


def shuffled_row(
    key: Key[Array, ""], step: Int[Array, ""], frames: int
) -> Int[Array, ""]:
    """The frame of a step: every epoch visits each frame once, in a new order."""
    epoch = jax.random.fold_in(jax.random.fold_in(key, ORDER), step // frames)
    return jax.random.permutation(epoch, frames)[step % frames]


def estimate_memory_bytes(spec: SplatScene, capture: Capture) -> int:
    """Roughly the memory of the first state and step; host side, nothing allocated."""
    count = initialisation.initial_count(spec.init, capture)
    harmonics = 3 * (spec.sh_degree + 1) ** 2
    # Parameters, two moments, gradient, update; the tables of one projection.
    numbers = count * (5 * (11 + harmonics) + 60)
    # A chunk holds keys, rows and blending inputs of every pair.
    numbers += 16 * (spec.raster.capacity or 0)
    return 4 * numbers + capture.images.nbytes


def first_state(spec, effects, optimiser, capture, key) -> TrainState:
    """Parameters, moments and statistics before the first step; host side."""
    refuse_what_cannot_train(spec)
    render.refuse_distortion(capture.cameras)
    start_key, run_key = jax.random.split(key)
    seed = int(jax.random.randint(start_key, (), 0, np.iinfo(np.int32).max))
    position, colour = initialisation.initial_points(spec.init, capture, seed)
    rows = splats.from_points(
        position,
        colour,
        degree=spec.sh_degree,
        opacity=spec.init.opacity,
        scale=spec.init.scale,
    )
    rows = initialisation.clamp_scales(rows, capture, spec.init.max_scale)
    count = len(position)
    most = None if spec.densification is None else spec.densification.cap_max
    params = Params({"splats": rows}, {})
    for number, effect in enumerate(effects):
        effect_key = jax.random.fold_in(start_key, number)
        rows_key, nets_key = jax.random.split(effect_key)
        if effect.init_rows is not None:
            params.rows[effect.name] = effect.init_rows(rows_key, rows)
        if effect.init_nets is not None:
            params.nets[effect.name] = effect.init_nets(nets_key)
    params = splats.pad_rows(params, splats.capacity_for(count, most))
    params = in_default_precision(params)
    stats = ()
    if isinstance(spec.densification, DefaultStrategySpec):
        stats = densification.empty_stats(params.rows["splats"])
    extra = Extra(stats, carried_by(effects, params))
    return TrainState(
        params, optimiser.init(params), extra, jnp.zeros((), jnp.int32), run_key
    )


def _stream(state, name):
    """A key of this step for something beside `loop.step_key`."""
    return jax.random.fold_in(jax.random.fold_in(state.key, name), state.step)


def _events(spec, facts, effects, optimiser):
    if spec.densification is None:
        return ()
    plan = spec.densification
    if isinstance(plan, MCMCStrategySpec):
        return _mcmc_events(plan, spec.steps, effects, optimiser)
    last = min(plan.refine_stop_iter, spec.steps)

    def densify(state, frames):
        del frames
        stats, carried = state.extra
        step = int(state.step)
        for effect in effects:
            if effect.grow_score is not None:
                factor = effect.grow_score(carried[effect.name], step)
                stats = stats._replace(grad2d=stats.grad2d * jnp.asarray(factor))
        changed = densification.densify(
            optimiser,
            state.params,
            state.optimiser,
            stats,
            _stream(state, EVENT),
            plan,
            step=step,
            extent=facts.extent,
        )
        extra = Extra(changed.stats, carried_by(effects, changed.params))
        return state._replace(
            params=changed.params, optimiser=changed.moments, extra=extra
        )

    def reset(state, frames):
        del frames
        params, moments = densification.reset_opacity(
            optimiser, state.params, state.optimiser, plan
        )
        return state._replace(params=params, optimiser=moments)

    grow = tuple(range(plan.refine_start_iter, last, plan.refine_every))
    return (
        Event("densify", grow, densify),
        Event(
            "reset opacity",
            tuple(range(plan.reset_every, last, plan.reset_every)),
            reset,
        ),
    )


def _mcmc_events(plan, steps, effects, optimiser):
    def refine(state, frames):
        del frames
        params, moments, _ = mcmc.refine(
            optimiser, state.params, state.optimiser, _stream(state, EVENT), plan
        )
        extra = Extra((), carried_by(effects, params))
        return state._replace(params=params, optimiser=moments, extra=extra)

    last = min(plan.refine_stop_iter, steps)
    when = tuple(range(plan.refine_start_iter, last, plan.refine_every))
    return (Event("relocate and add", when, refine),)


def count_rows(state: TrainState) -> dict[str, int]:
    """Active Gaussians, and `parameters`: the numbers of them and the networks."""
    counts = {"gaussians": int(splats.active_mask(state.params.rows["splats"]).sum())}
    rows = jax.tree.leaves(state.params.rows)
    nets = jax.tree.leaves(state.params.nets)
    each = sum(math.prod(leaf.shape[1:]) for leaf in rows)
    counts["parameters"] = counts["gaussians"] * each
    counts["parameters"] += sum(math.prod(leaf.shape) for leaf in nets)
    return counts
