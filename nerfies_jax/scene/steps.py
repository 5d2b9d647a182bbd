"""Training steps of radiance fields: batches of rays, losses and updates."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from nerfies_jax.fields import field_ray, occupied_rays, render_ray
from nerfies_jax.fields.effects import scene_flow, transient
from nerfies_jax.fields.effects.effect import Batch, Box, RayOutput
from nerfies_jax.fields.effects.records import FieldRecord
from nerfies_jax.fields.field import Field
from nerfies_jax.fields.occupancy import Cells
from nerfies_jax.fields.spec import RadianceScene, optimizer_of
from nerfies_jax.geometry import rays
from nerfies_jax.runtime import data_parallel
from nerfies_jax.training import loop, losses, schedules
from nerfies_jax.training.effects import (
    FrameCondition,
    PenaltyContext,
    Term,
    penalty_terms,
    values,
    weighted_sum,
)
from nerfies_jax.training.model import Frames, TrainState, View
from nerfies_jax.training.updates import apply_updates

PyTree = Any
# A ray misses moving objects that cover 5 % of the images with a probability of 0.19.
CANDIDATES = 32


def stepper(
    spec: RadianceScene, radiance: Field, devices: int
) -> Callable[[TrainState, Frames], tuple[TrainState, dict[str, Any]]]:
    """Make the function of a training step.

    Args:
      spec: The scene.
      radiance: The field.
      devices: Number of devices that share the micro-batches.

    Returns:
      A function of state and frames, which returns the new state and the metrics.
    """

    def part(index, state, frames):
        batch_key, field_key = _part_keys(spec, loop.step_key(state), index)
        own = frames.of_part(state.step, index)
        batch, guide = micro_batch(radiance, state, own, batch_key)

        def loss(params):
            terms = loss_terms(
                radiance, params, frames, batch, state.step, field_key, guide
            )
            return weighted_sum(terms), values(terms)

        return jax.value_and_grad(loss, has_aux=True)(state.params)

    def step(state: TrainState, frames: Frames):
        if spec.micro_batches == 1:
            (value, term_values), grads = part(0, state, frames)
        else:
            each = data_parallel.on_devices(
                part, spec.micro_batches, devices, state, frames
            )
            (value, term_values), grads = jax.tree.map(lambda leaf: leaf.mean(0), each)
        params, moments = descend(spec, radiance.effects, state, grads)
        metrics = {"loss": value, "mse": term_values["fine"], **term_values}
        state = TrainState(params, moments, state.aux_state, state.step + 1, state.key)
        return state, metrics

    return step


def _part_keys(spec, key, part):
    """Return the keys of the rays and of the field, of a part of a step with a key."""
    if spec.micro_batches > 1:
        key = jax.random.fold_in(key, part)
    return jax.random.split(key)


def reader(
    spec: RadianceScene, required_data: frozenset[str]
) -> Callable[[Any, Any, Frames], tuple[Any, ...]] | None:
    """Return the function `Model.reads` of a field.

    Args:
      spec: The scene.
      required_data: Names of the data that the field reads.

    Returns:
      The function, of the key, the number of completed steps and the frames. None for
      fields that read masks of motion or depths.
    """
    if required_data & {"moving", "depths"}:
        return None

    def read(key, step, frames):
        step_key = jax.random.fold_in(key, step)
        count, choice = _candidates(spec), _choice(spec, frames, step)

        def one(part):
            batch_key, _ = _part_keys(spec, step_key, part)
            return random_pixels(frames, (count,), batch_key, choice)

        return jax.vmap(one)(np.arange(spec.micro_batches, dtype=np.int32))

    return read


def _candidates(spec):
    """Return the number of random rays of a micro-batch, before their selection."""
    plan, count = spec.sampling.occupancy, spec.rays // spec.micro_batches
    return count if plan is None else plan.candidates * count


def _choice(spec, frames, step):
    if spec.curriculum_steps is None:
        return None
    return curriculum(frames.times, step, spec.curriculum_steps)


def micro_batch(
    radiance: Field, state: TrainState, frames: Frames, key: Key[Array, ""]
) -> tuple[Batch, Cells | None]:
    """Sample the rays of a micro-batch.

    Args:
      radiance: The field.
      state: Training state.
      frames: Training frames.
      key: PRNG key.

    Returns:
      The rays, and the occupied cells that guide their samples (`OccupancySpec`) or
      None.
    """
    spec = radiance.spec
    count, plan = spec.rays // spec.micro_batches, spec.sampling.occupancy
    choice, on_moving = _choice(spec, frames, state.step), None
    flow = spec.scene_flow
    if flow is not None and flow.moving_rays is not None and frames.moving is not None:
        first = jnp.arange(count) < round(flow.moving_rays * count)
        on_moving = first & (state.step < flow.decay_steps)
    if plan is None:
        return draw_batch(frames, count, key, choice, on_moving), None
    batch = draw_batch(frames, _candidates(spec), key, choice)
    cells = state.aux_state
    return occupied_rays.learned_from(radiance, cells, batch), cells


def descend(
    spec: RadianceScene,
    effects: tuple[FieldRecord, ...],
    state: TrainState,
    grads: PyTree,
) -> tuple[PyTree, optax.OptState]:
    """Return the parameters and the optimizer state after one update.

    Args:
      spec: The scene.
      effects: Records of its components.
      state: State before the update.
      grads: Gradients of the loss, with the structure of the parameters.

    Returns:
      The parameters, and the state of the optimizer.
    """
    # optax counts in int32 and multiplies float32 by it.
    with jax.numpy_dtype_promotion("standard"):
        updates, moments = optimizer_of(spec).update(
            grads, state.optimizer, state.params
        )
    rates = learning_rates(spec, effects, state.params, state.step)
    return apply_updates(state.params, updates, rates), moments


def learning_rates(
    spec: RadianceScene, effects: tuple[FieldRecord, ...], params: PyTree, step: Array
) -> dict[str, PyTree]:
    """Compute the learning rate of each part of the parameters.

    It is that of the effect, or else the common schedule. For a warp that is
    initialized from tracks and the codes that it reads, the rate is reduced at the
    beginning (`FieldStartSpec`), as for a scene flow with its own trunk if there is no
    warp. A medium with tables has the rate of the template.

    Args:
      spec: The scene.
      effects: Its effects.
      params: Its parameters.
      step: Number of completed steps.

    Returns:
      Rates, a prefix of the parameters.
    """
    effect_rates = {
        e.name: e.learning_rate for e in effects if e.learning_rate is not None
    }
    common = schedules.log_linear(
        spec.learning_rate, spec.learning_rate_end, spec.steps
    )(step)
    rates: dict[str, PyTree]
    rates = {
        name: effect_rates[name](step) if name in effect_rates else common
        for name in params
    }
    if "codes" in rates:
        rates["codes"] = spec.code_rate * common
    factor: Array | float = 1.0
    if spec.start.motion == "tracks":
        factor = schedules.log_linear(spec.start.first_rate, 1.0, spec.steps)(step)
        warps = [effect for effect in effects if effect.displace is not None]
        tables = {table.name for effect in warps for table in effect.tables}
        rates |= {e.name: factor * rates[e.name] for e in warps if e.name in params}
        rates["codes"] = {
            name: factor * rates["codes"] if name in tables else rates["codes"]
            for name in params["codes"]
        }
    flow = params.get(scene_flow.NAME)
    if isinstance(flow, scene_flow.SceneFlow):
        rate, apart = rates[scene_flow.NAME], flow.flow_trunk is not None
        on_tables = flow.network.tables is not None
        # With a warp, the flow is not initialized from tracks (`build`).
        of_flow = factor * rate if apart and spec.warp is None else rate
        flow_rates: dict[str, PyTree] = dict(
            network=spec.template_rate * rate if on_tables else rate,
            flow=of_flow,
            disocclusion=rate,
            blend=rate,
            flow_trunk=of_flow if apart else None,
        )
        rates[scene_flow.NAME] = scene_flow.SceneFlow(**flow_rates)
    rate = spec.template_rate * common
    template: PyTree = rate
    if spec.table_rate != 1:
        table_rate = spec.table_rate * rate
        template = {
            name: net._replace(trunk=rate, color=rate, tables=table_rate)
            for name, net in params["template"].items()
        }
    return rates | {"template": template}


class Choice(NamedTuple):
    """Frames to sample rays from: the first ones of an order."""

    order: Int[Array, " frames"]
    number: Int[Array, ""]


def curriculum(
    times: Float[Array, " frames"], step: Int[Array, ""], steps: int
) -> Choice:
    """Choose the frames of the curriculum of D-NeRF at a step.

    Args:
      times: Times of the training frames.
      step: Number of completed steps.
      steps: Number of steps until all frames are chosen.

    Returns:
      The frames in the order of their times, and the number of them to use. It is that
      of the published code: the share of the steps, rounded down, and at least three.
    """
    frames = len(times)
    added_at = np.ceil(np.arange(1, frames + 1) * steps / frames).astype(np.int32)
    number = jnp.maximum(jnp.sum(step >= added_at), min(3, frames))
    return Choice(jnp.argsort(times), number)


def random_pixels(
    frames: Frames,
    shape: tuple[int, ...],
    key: Key[Array, ""],
    choice: Choice | None = None,
) -> tuple[Int[Array, "..."], Int[Array, "..."], Int[Array, "..."]]:
    """Sample pixels uniformly.

    Args:
      frames: Training frames.
      shape: Shape of the results.
      key: PRNG key.
      choice: Frames to use, None for all.

    Returns:
      Frame, line and column of each pixel.
    """
    row_key, column_key, line_key = jax.random.split(key, 3)
    number, (height, width) = len(frames.times), frames.images.shape[1:3]
    if choice is None:
        row = jax.random.randint(row_key, shape, 0, number)
    else:
        row = choice.order[jax.random.randint(row_key, shape, 0, choice.number)]
    column = jax.random.randint(column_key, shape, 0, width)
    line = jax.random.randint(line_key, shape, 0, height)
    return row, line, column


def draw_batch(
    frames: Frames,
    count: int,
    key: Key[Array, ""],
    choice: Choice | None = None,
    on_moving: Bool[Array, " count"] | None = None,
) -> Batch:
    """Sample rays through random pixels, uniformly.

    Args:
      frames: Training frames.
      count: Number of rays.
      key: PRNG key.
      choice: Frames to use, None for all.
      on_moving: True for rays through moving objects, [count]. Each is the first such
        one of `CANDIDATES` random rays, if there is any.

    Returns:
      The rays and their observed colors.
    """
    row, line, column = random_pixels(frames, (count,), key, choice)
    if on_moving is not None:
        candidates = random_pixels(
            frames, (CANDIDATES, count), jax.random.fold_in(key, 0), choice
        )
        moves = frames.moving[
            frames.image_row(candidates[0]), candidates[1], candidates[2]
        ]
        place = jnp.argmax(moves, axis=0), jnp.arange(count)
        is_replaced = on_moving & moves[place]
        row, line, column = (
            jnp.where(is_replaced, other[place], one)
            for one, other in zip((row, line, column), candidates, strict=True)
        )
    camera = jax.tree.map(lambda leaf: leaf[row], frames.cameras)
    pixel = jnp.stack([column, line], axis=1).astype(camera.position.dtype) + 0.5
    ray = jax.vmap(rays.pixel_ray)(camera, pixel)
    color, is_observed = frames.colors(row, line, column)
    color = color.astype(pixel.dtype) / 255
    valid = ray.valid if is_observed is None else ray.valid & is_observed
    # Masked here for all losses, because unobserved pixels may be NaN, which a weight
    # of zero does not remove.
    color = jnp.where(valid[:, None], color, 0)
    cosine = jax.vmap(rays.depth_per_distance)(camera, ray.direction)
    return Batch(row, pixel, ray.origin, ray.direction, cosine, color, valid)


def loss_terms(
    radiance: Field,
    params: PyTree,
    frames: Frames,
    batch: Batch,
    step: Array,
    key: Key[Array, ""],
    guide: Cells | None = None,
) -> dict[str, Term]:
    """Compute every term of the loss of one batch.

    "coarse" and "fine" are mean squared errors of color. "color" is NeRF-W's negative
    log-likelihood, if a transient medium provides the uncertainty.

    Args:
      radiance: The field.
      params: Its parameters.
      frames: Training frames.
      batch: Rays.
      step: Number of completed steps.
      key: PRNG key.
      guide: Occupied cells, as in `render_ray`, or None.

    Returns:
      Terms by name.
    """
    ray_key, penalty_key = jax.random.split(key)
    metadata = radiance.metadata

    def condition_of(row):
        view = View(
            jax.tree.map(lambda leaf: leaf[row], frames.cameras),
            frames.times[row],
            frames.appearance[row],
        )
        return FrameCondition(view.time, radiance.codes_at(params, view), step)

    conditions = jax.vmap(condition_of)(batch.row)
    lines = jax.vmap(lambda *ray: field_ray.field_ray(metadata, *ray))(
        batch.origin, batch.direction, batch.cosine
    )
    keys = jax.random.split(ray_key, len(batch.row))
    levels = jax.vmap(lambda *ray: radiance.render_ray(params, *ray, guide))(
        lines, conditions, keys
    )
    center = jnp.asarray(metadata.center, batch.origin.dtype)
    context = PenaltyContext(
        condition=conditions,
        step=step,
        key=penalty_key,
        params=params,
        displace=functools.partial(radiance.displace, params),
        condition_of=condition_of,
        batch=batch,
        levels=levels,
        frames=frames,
        box=Box(center, jnp.asarray(metadata.scale, batch.origin.dtype)),
    )
    terms = _color_terms(radiance.effects, levels, batch)
    return terms | penalty_terms(radiance.effects, params, context, {})


def _color_terms(
    effects: tuple[FieldRecord, ...], levels: tuple[RayOutput, ...], batch: Batch
) -> dict[str, Term]:
    last = levels[-1]
    mse = losses.mse(last.color, batch.color, batch.valid)
    terms = {"fine": Term(mse, 1.0)}
    coarse_weight = 1.0
    uncertain = render_ray.uncertainty_effect(effects, last.media)
    if uncertain is not None:
        assert last.beta is not None
        likelihood = transient.photometric(
            last.color, batch.color, last.beta, batch.valid, uncertain.beta_power
        )
        terms = {"fine": Term(mse, None), "color": Term(likelihood, 1.0)}
        coarse_weight = 1.5  # as in NeRF-W: half of the sum over channels
    if len(levels) > 1:
        coarse = losses.mse(levels[0].color, batch.color, batch.valid)
        terms["coarse"] = Term(coarse, coarse_weight)
    return terms
