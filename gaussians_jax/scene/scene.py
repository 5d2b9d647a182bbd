"""Compile the settings of a scene of Gaussians to a `Model` that the loop trains."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from gaussians_jax.core import splats
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params
from gaussians_jax.init import points as initialization
from gaussians_jax.init.points import StartSpec
from gaussians_jax.losses import transients
from gaussians_jax.motion import deformation
from gaussians_jax.optim import phases
from gaussians_jax.scene import drawing, growth, update, view_order
from gaussians_jax.scene.first_state import count_rows, first_state
from gaussians_jax.scene.spec import (
    SceneMetadata,
    SplatScene,
    effects_of,
    optimizer_of,
    strategy_of,
)
from gaussians_jax.scene.update import ViewStatistics
from nerfies_jax.capture import pinholes
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.scene_metadata import exposures
from nerfies_jax.runtime import compiler, data_parallel
from nerfies_jax.training import loop, losses, programs
from nerfies_jax.training.effects import (
    FrameCondition,
    Observation,
    PenaltyContext,
    join,
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

# Near plane relative to the nearest point of structure from motion. Moving objects may
# be nearer than that.
NEAREST = 0.2


def metadata_of(capture: Capture) -> SceneMetadata:
    """Compute the metadata of a capture, on the host.

    Args:
      capture: The capture.

    Returns:
      Bounds, scale and numbers of frames and cameras.
    """
    positions = np.asarray(capture.cameras.position)[capture.train]
    halfway = 2 / (1 / capture.near + 1 / capture.far)
    span = initialization.observed_depths(capture)
    return SceneMetadata(
        extent=splats.scene_extent(positions, static=halfway),
        background=capture.background or (0.0, 0.0, 0.0),
        frames=len(capture.train),
        exposures=exposures(capture),
        box=initialization.observed_box(capture, span),
        near=NEAREST * span[0],
        depth=2 / (1 / span[0] + 1 / span[1]),
        times=len(np.unique(capture.times[capture.train])),
        distorted=pinholes.has_lens(capture.cameras),
    )


def all_effects(
    spec: SplatScene, metadata: SceneMetadata, more: tuple[SplatRecord, ...] = ()
) -> tuple[SplatRecord, ...]:
    """Compile all components of a scene, each with its learning rates.

    Args:
      spec: Settings.
      metadata: Metadata of the capture.
      more: Records of further components, which act after those of the settings.

    Returns:
      The records, in the order in which they act.

    Raises:
      ValueError: If a component has parameters but no learning rate, a name is taken,
        or more than one component has child Gaussians or changes colors.
    """
    built_in = effects_of(spec, metadata)
    effects = join(built_in, more, reserved_names=("splats",))
    for effect in effects:
        if effect.init and not effect.learning_rate:
            raise ValueError(
                f"the component {effect.name!r} has `init` but no `learning_rate`, so "
                "its parameters would not train; give it a learning rate, a function "
                "of the step"
            )
    deformation.check_derived(effects)
    drawing.check_one_appearance(effects)
    return effects


def build(
    spec: SplatScene, metadata: SceneMetadata, effects: tuple[SplatRecord, ...] = ()
) -> Model:
    """Compile settings to the functions of training, rendering and evaluation.

    Args:
      spec: Settings.
      metadata: Metadata of the capture.
      effects: Records of further components, which act after those of the settings.

    Returns:
      The model.

    Raises:
      ValueError: If settings contradict each other or the capture.
    """

    def build_with(numbers):
        return _model(spec, dataclasses.replace(metadata, **numbers), effects)

    model = _model(spec, metadata, effects)
    return programs.taking(model, metadata.numbers, build_with)


def _model(spec, metadata, effects):
    """Return the model with the numbers of the capture compiled in."""
    names = tuple(effect.name for effect in effects)
    effects = all_effects(spec, metadata, effects)
    # Its update counts per Gaussian do not change the updates of shared parameters.
    optimizer = optimizer_of(spec)
    stages = _stages(spec, metadata, effects)
    devices = data_parallel.device_count(spec.batch_size, divisible=True)

    def whole_frame(params, view, size, step):
        gaussians = stages.deform(params, stages.prepare(params), view.time)
        return stages.draw(params, gaussians, view, size, step)

    def init(capture, key, spec=spec):
        strategy = strategy_of(spec, metadata)
        return first_state(spec, strategy, effects, optimizer, capture, key)

    def example(capture, key):
        at_rest = dataclasses.replace(spec, start=StartSpec(motion="none"))
        return init(capture, key, at_rest)

    return Model(
        # Further components are identified by name: other names make another run.
        spec=(spec, metadata, *names),
        init=init,
        step=_stepper(spec, metadata, effects, optimizer, devices),
        render=whole_frame,
        events=growth.events(spec, metadata, effects, optimizer),
        counts=lambda state: count_rows(effects, state),
        required_data=frozenset().union(*(effect.required_data for effect in effects)),
        stages=stages,
        example=example,
        devices=devices,
        apply_to_capture=_camera_refiner(effects),
        reads=view_order.reader(spec.batch_size),
        compiler_options=compiler.UNDIVIDED,
    )


def _camera_refiner(effects):
    """Return `Model.apply_to_capture` for these components."""
    refining = [effect for effect in effects if effect.apply_to_capture is not None]

    def refine(params, capture):
        for effect in refining:
            capture = effect.apply_to_capture(params.nets.get(effect.name), capture)
        return capture

    return refine if refining else None


def _stages(spec, metadata, effects):
    """Return the stages of rendering a trained scene."""

    def prepare(params):
        return deformation.prepare(effects, params)

    def deform(params, cache, time):
        return deformation.deform(effects, params, cache, time)

    def rows(params):
        return deformation.rendered_rows(effects, params)

    def draw(params, gaussians, view, size, step):
        degree = splats.active_degree(step, spec.sh_every, spec.sh_degree)
        frame = drawing.draw(
            spec, metadata, effects, params, rows(params), gaussians, view, size, degree
        )
        return drawing.exposed(effects, params, frame.rendering, view)

    return Stages(prepare, deform, draw, rows)


def _refine_cameras(effects, params, frames):
    """Return the training frames with their refined cameras."""
    for effect in effects:
        if effect.pose is not None:
            own_params = params.nets.get(effect.name)
            frames = frames._replace(cameras=effect.pose(own_params, frames.cameras))
    return frames


def _stepper(spec, metadata, effects, optimizer, devices):
    """Return the pure function (state, frames) -> (state, metrics) of one step."""
    strategy = strategy_of(spec, metadata)
    bands = devices if spec.batch_size == 1 else 1

    def one_view(index, state, frames):
        frame = _condition(spec, state, frames, index)
        return _gradients(spec, metadata, effects, state, frames, *frame, bands)

    def step(state: TrainState, frames: Frames):
        size = frames.images.shape[2], frames.images.shape[1]
        if spec.batch_size == 1:
            each = [one_view(0, state, frames)]
            means = each[0][:2]
        else:
            per_view = data_parallel.on_devices(
                one_view, spec.batch_size, devices, state, frames
            )
            means = jax.tree.map(lambda leaf: leaf.mean(0), per_view[:2])
            each = [
                jax.tree.map(lambda leaf, index=index: leaf[index], per_view)
                for index in range(spec.batch_size)
            ]
        metrics, grads = means
        new_state = update.descend(spec, metadata, effects, optimizer, state, grads)
        aux_state = state.aux_state
        for _, _, statistics in each:
            aux_state = update.observe(strategy, aux_state, statistics, size)
        state = TrainState(*new_state, aux_state, state.step + 1, state.key)
        return state, metrics

    return step


def _condition(spec, state, frames, index):
    """Select a frame of a step's batch, and return its row and condition."""
    row = view_order.row_of_view(
        state.key, state.step, index, spec.batch_size, len(frames.times)
    )
    key = loop.step_key(state)
    if spec.batch_size > 1:
        key = jax.random.fold_in(key, index)
    return row, FrameCondition(frames.times[row], step=state.step, key=key)


def _gradients(spec, metadata, effects, state, frames, row, condition, bands):
    """Compute metrics, gradients and the render of one frame, in bands of its image."""
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
        gaussians = deform(params, canonical)
        rows, rendered_gaussians = deformation.rendered(
            effects, params, gaussians, condition
        )
        posed_frames = _refine_cameras(effects, params, frames)
        view = _view(posed_frames, row)
        frame = drawing.draw(
            spec,
            metadata,
            effects,
            params,
            rows,
            rendered_gaussians,
            view,
            size,
            degree,
            mean2d_offset=probe,
            depth=depth,
            devices=bands,
        )
        exposed_rendering = drawing.exposed(effects, params, frame.rendering, view)
        observation = observe(posed_frames, row, exposed_rendering)
        states = state.aux_state.effects
        value, metrics = loss_of(spec, effects, params, observation, condition, states)
        weight = deformation.significance(effects, rendered_gaussians)
        return value, (metrics, frame.footprints, canonical, gaussians, weight)

    probe = deformation.probe(effects, state.params)
    (value, (metrics, *statistics)), (grads, mean2d_grad) = jax.value_and_grad(
        loss, argnums=(0, 1), has_aux=True
    )(state.params, probe)
    return {"loss": value, **metrics}, grads, ViewStatistics(mean2d_grad, *statistics)


def draws_depth(effects: tuple[SplatRecord, ...], frames: Frames) -> bool:
    """Test if a step renders depth. An unused depth channel would cost 4 % of a step.

    Args:
      effects: Effects of the scene.
      frames: Training frames.

    Returns:
      True if depth is rendered.
    """
    if any(effect.reads_depth for effect in effects):
        return True
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
    """Compute the loss of one frame with the terms of all components.

    Args:
      spec: Settings.
      effects: Components of the scene.
      params: Parameters of the scene.
      observation: The render and the observed frame.
      condition: Conditioning of the frame, with step and key.
      states: State of each component, by name.

    Returns:
      The loss and metrics to log.
    """
    truth, valid = observation.truth, observation.valid
    assert observation.rendering is not None
    assert condition.step is not None
    assert condition.key is not None
    color, extra_metrics = observation.rendering.color, {}
    if spec.transients is not None:
        valid, share = transients.static_pixels(
            spec.transients, color, truth, valid, condition.step
        )
        extra_metrics = {transients.SHARE: share}
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
    metrics = {"mse": losses.mse(color, truth, valid)} | extra_metrics | values(terms)
    return weighted_sum(terms, photometric), metrics


def observe(
    frames: Frames, row: Int[Array, ""] | int, rendering: Rendering | None
) -> Observation:
    """Assemble the input of the losses: a render and the observed frame.

    Args:
      frames: Training frames.
      row: Index of the frame.
      rendering: The render, or None.

    Returns:
      The observation, with the frame as floats in [0, 1].
    """
    image_row = frames.image_row(row)
    return Observation(
        rendering,
        frames.images[image_row].astype(frames.times.dtype) / 255,
        None if frames.valid is None else frames.valid[image_row],
        None if frames.depths is None else frames.depths[image_row],
        frames,
        row,
    )


def _view(frames, row):
    camera = jax.tree.map(lambda leaf: leaf[row], frames.cameras)
    return View(camera, frames.times[row], frames.appearance[row])
