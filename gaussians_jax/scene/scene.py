"""Gaussians and effects put together: a spec becomes a `Model` the loop can train."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.init import points as initialization
from gaussians_jax.init.points import StartSpec
from gaussians_jax.motion import deformation
from gaussians_jax.optim import phases
from gaussians_jax.scene import growth, update
from gaussians_jax.scene.first_state import count_rows, first_state
from gaussians_jax.scene.spec import (
    SceneMetadata,
    SplatScene,
    effects_of,
    optimizer_of,
    raster_of,
    strategy_of,
)
from gaussians_jax.scene.update import Drawn
from gaussians_jax.splatting import rendering
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.scene_metadata import exposures
from nerfies_jax.runtime import compiler, data_parallel
from nerfies_jax.training import loop, losses
from nerfies_jax.training.effects import (
    FrameCondition,
    Observation,
    PenaltyContext,
    joined,
    penalty_terms,
    values,
    weighted_sum,
)
from nerfies_jax.training.model import (
    Frames,
    Model,
    Rendering,
    Stages,
    TrainState,
    View,
)
from nerfies_jax.training.protocols import as_terms, name_of

PyTree = Any

# Of the nearest that structure from motion finds: what moves stands before that.
NEAREST = 0.2

ORDER = 2**32 - 1  # stream of the run's key, as those in `growth`


def metadata_of(capture: Capture) -> SceneMetadata:
    """Compute the metadata of a capture, on the host.

    Args:
      capture: The capture.

    Returns:
      Bounds, scale and numbers of frames and cameras.
    """
    positions = np.asarray(capture.cameras.position)[capture.train]
    halfway = 2 / (1 / capture.near + 1 / capture.far)
    span = initialization.filmed_depths(capture)
    return SceneMetadata(
        extent=splats.scene_extent(positions, static=halfway),
        background=capture.background or (0.0, 0.0, 0.0),
        frames=len(capture.train),
        exposures=exposures(capture),
        box=initialization.filmed_box(capture, span),
        near=NEAREST * span[0],
        depth=2 / (1 / span[0] + 1 / span[1]),
        times=len(np.unique(capture.times[capture.train])),
    )


def all_effects(
    spec: SplatScene, metadata: SceneMetadata, more: tuple[SplatRecord, ...] = ()
) -> tuple[SplatRecord, ...]:
    """The effects of a spec and then `more`, each with the learning rates it needs."""
    own = effects_of(spec, metadata)
    every = joined(own, more, reserved=("splats",))
    for effect in every:
        if effect.init and not effect.learning_rate:
            raise ValueError(
                f"the effect {effect.name!r} has init and no learning_rate, so its "
                "parameters would not train; give it a learning_rate, a function of "
                "the step"
            )
    deformation.check_derived(every)
    return every


def build(
    spec: SplatScene, metadata: SceneMetadata, effects: tuple[SplatRecord, ...] = ()
) -> Model:
    """Compile settings to the functions that training, rendering and the report use.

    Args:
      spec: Settings.
      metadata: Metadata of the capture.
      effects: Records of further parts, which act after those of the settings.

    Returns:
      The model.

    Raises:
      ValueError: If settings contradict each other or the capture.
    """
    more = tuple(effect.name for effect in effects)
    effects = all_effects(spec, metadata, effects)
    # Counts updates per row; for the networks, whose rows are never born, it is plain.
    optimizer = optimizer_of(spec)
    stages = _stages(spec, metadata, effects)
    devices = data_parallel.device_count(spec.batch_size)

    def whole_frame(params, view, size, step):
        deformed = stages.deform(params, stages.prepare(params), view.time)
        return stages.draw(params, deformed, view, size, step)

    def init(capture, key, spec=spec):
        strategy = strategy_of(spec, metadata)
        return first_state(spec, strategy, effects, optimizer, capture, key)

    def example(capture, key):
        at_rest = dataclasses.replace(spec, start=StartSpec(motion="none"))
        return init(capture, key, at_rest)

    return Model(
        # By name alone: a run with other effects of one's own is another run.
        spec=(spec, metadata, *more),
        init=init,
        step=_stepper(spec, metadata, effects, optimizer, devices),
        render=whole_frame,
        events=growth.events(spec, metadata, effects, optimizer),
        counts=lambda state: count_rows(effects, state),
        required_data=frozenset().union(*(effect.required_data for effect in effects)),
        stages=stages,
        example=example,
        devices=devices,
        found=_finder(effects),
        compiler_options=compiler.UNDIVIDED,
    )


def _finder(effects):
    """`Model.found` of these effects."""
    finding = [effect for effect in effects if effect.found is not None]

    def found(params, capture):
        for effect in finding:
            capture = effect.found(params.nets.get(effect.name), capture)
        return capture

    return found if finding else None


def _stages(spec, metadata, effects):
    """Rendering of trained parameters in parts."""

    def prepare(params):
        return deformation.prepare(effects, params)

    def deform(params, prepared, time):
        return deformation.deform(effects, params, prepared, time)

    def rows(params):
        return deformation.drawn_rows(effects, params)

    def draw(params, deformed, view, size, step):
        degree = splats.active_degree(step, spec.sh_every, spec.sh_degree)
        drawn = _draw(spec, metadata, rows(params), deformed, view, size, degree)
        return _exposed(effects, params, drawn.rendering, view)

    return Stages(prepare, deform, draw, rows)


def _draw(
    spec,
    metadata,
    rows: Splats,
    gaussians,
    view,
    size,
    degree,
    probe=None,
    depth=True,
):
    return rendering.render_harmonics(
        gaussians,
        splats.active_harmonics(rows, degree),
        view.camera,
        size,
        raster_of(spec, metadata),
        jnp.asarray(metadata.background, gaussians.mean.dtype),
        mean2d_offset=probe,
        depth=depth,
    )


def _exposed(effects, params, drawn, view):
    """Apply the exposure model of the view to a render."""
    for effect in effects:
        if effect.expose is not None:
            own = params.nets.get(effect.name)
            color = effect.expose(own, drawn.color, view.appearance)
            drawn = drawn._replace(color=color)
    return drawn


def _posed(effects, params, frames):
    """Return the training frames with their refined cameras."""
    for effect in effects:
        if effect.pose is not None:
            own = params.nets.get(effect.name)
            frames = frames._replace(cameras=effect.pose(own, frames.cameras))
    return frames


def _stepper(spec, metadata, effects, optimizer, devices):
    """One update from a batch of frames: (state, frames) -> (state, metrics), pure."""
    strategy = strategy_of(spec, metadata)

    def one_view(index, state, frames):
        seen = _condition(spec, state, frames, index)
        return _gradients(spec, metadata, effects, state, frames, *seen)

    def step(state: TrainState, frames: Frames):
        size = frames.images.shape[2], frames.images.shape[1]
        if spec.batch_size == 1:
            each = [one_view(0, state, frames)]
            means = each[0][:2]
        else:
            stacked = data_parallel.on_devices(
                one_view, spec.batch_size, devices, state, frames
            )
            means = jax.tree.map(lambda leaf: leaf.mean(0), stacked[:2])
            each = [
                jax.tree.map(lambda leaf, index=index: leaf[index], stacked)
                for index in range(spec.batch_size)
            ]
        metrics, grads = means
        trained = update.descend(spec, metadata, effects, optimizer, state, grads)
        aux_state = state.aux_state
        for _, _, drawn in each:
            aux_state = update.observed(strategy, aux_state, drawn, size)
        state = TrainState(*trained, aux_state, state.step + 1, state.key)
        return state, metrics

    return step


def _condition(spec, state, frames, index):
    """The frame that is the `index`-th of a step's batch, and its condition."""
    visit = state.step * spec.batch_size + index
    row = shuffled_row(state.key, visit, len(frames.times))
    key = loop.step_key(state)
    if spec.batch_size > 1:
        key = jax.random.fold_in(key, index)
    return row, FrameCondition(frames.times[row], step=state.step, key=key)


def _gradients(spec, metadata, effects, state, frames, row, condition):
    """Metrics, slopes and what was drawn of one frame."""
    size = frames.images.shape[2], frames.images.shape[1]
    degree = splats.active_degree(state.step, spec.sh_every, spec.sh_degree)

    def deform(params, gaussians):
        return deformation.deform_in_training(
            effects, params, gaussians, condition, state.aux_state.effects
        )

    if spec.alternation is not None:
        mask = phases.update_mask(spec.alternation, state.step)
        deform = phases.stop_frozen_gradients(mask, deform)
    depth = draws_depth(effects, frames)

    def loss(params, probe):
        canonical = splats.activate(params.rows["splats"])
        moved = deform(params, canonical)
        rows, drawn = deformation.drawn(effects, params, moved, condition)
        posed = _posed(effects, params, frames)
        view = _view(posed, row)
        frame = _draw(spec, metadata, rows, drawn, view, size, degree, probe, depth)
        exposed = _exposed(effects, params, frame.rendering, view)
        seen = observe(posed, row, exposed)
        states = state.aux_state.effects
        value, metrics = loss_of(spec, effects, params, seen, condition, states)
        weight = deformation.significance(effects, drawn)
        return value, (metrics, frame.footprints, canonical, moved, weight)

    probe = deformation.probe(effects, state.params)
    (value, (metrics, *drawn)), (grads, mean2d_grad) = jax.value_and_grad(
        loss, argnums=(0, 1), has_aux=True
    )(state.params, probe)
    return {"loss": value, **metrics}, grads, Drawn(mean2d_grad, *drawn)


def draws_depth(effects: tuple[SplatRecord, ...], frames: Frames) -> bool:
    """Test if a step renders depth, an unused channel of which would cost 4 %.

    Args:
      effects: Effects of the scene.
      frames: Training frames.

    Returns:
      True if depth is rendered.
    """
    read = any("depths" in effect.required_data for effect in effects)
    return read and frames.depths is not None


def loss_of(
    spec: SplatScene,
    effects: tuple[SplatRecord, ...],
    params: Params,
    observation: Observation,
    condition: FrameCondition,
    states: dict[str, PyTree],
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The loss of one frame with what every effect adds, and numbers to log."""
    truth, valid = observation.truth, observation.valid
    assert observation.rendering is not None
    assert condition.step is not None
    assert condition.key is not None
    color = observation.rendering.color
    photometric = losses.photometric(
        color, truth, valid, dssim_weight=spec.dssim_weight
    )
    context = PenaltyContext(
        condition=condition,
        step=condition.step,
        key=condition.key,
        params=params,
        observation=observation,
        at_time=deformation.deformer(effects, condition),
    )
    terms = penalty_terms(effects, params.nets, context, states)
    strategy = spec.strategy
    if strategy is not None and hasattr(strategy, "loss"):
        for name, term in as_terms(strategy.loss(params, context)).items():
            terms[f"{name_of(strategy)}/{name}"] = term
    metrics = {"mse": losses.mse(color, truth, valid)} | values(terms)
    return weighted_sum(terms, photometric), metrics


def observe(
    frames: Frames, row: Int[Array, ""] | int, rendering: Rendering | None
) -> Observation:
    """Assemble the input of the losses: a render and the observed frame."""
    return Observation(
        rendering,
        frames.images[frames.image_row(row)].astype(frames.times.dtype) / 255,
        None if frames.valid is None else frames.valid[row],
        None if frames.depths is None else frames.depths[row],
        frames,
        row,
    )


def _view(frames, row):
    camera = jax.tree.map(lambda leaf: leaf[row], frames.cameras)
    return View(camera, frames.times[row], frames.appearance[row])


def shuffled_row(
    key: Key[Array, ""], step: Int[Array, ""], frames: int
) -> Int[Array, ""]:
    """The frame of a step: every epoch visits each frame once, in a new order."""
    epoch = jax.random.fold_in(jax.random.fold_in(key, ORDER), step // frames)
    return jax.random.permutation(epoch, frames)[step % frames]
