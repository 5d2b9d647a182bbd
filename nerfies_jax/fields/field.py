"""A radiance field as pure functions: rendering, displacement and latent codes."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.fields import frustum_grid, skipping, template
from nerfies_jax.fields import spec as specs
from nerfies_jax.fields.effects.effect import RayOutput
from nerfies_jax.fields.effects.records import FieldRecord
from nerfies_jax.fields.field_ray import Ray, field_ray_through
from nerfies_jax.fields.render_ray import Bound, displacement, is_moved, render_ray
from nerfies_jax.fields.spec import RadianceScene
from nerfies_jax.geometry import rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.nn import codes
from nerfies_jax.training.effects import (
    TIMESTAMP,
    FrameCondition,
    Table,
    join,
    stream,
)
from nerfies_jax.training.model import Rendering, View

PyTree = Any
Vector = Float[Array, "3"]
Scalar = Float[Array, ""]
Occupancy = skipping.Occupancy
Codes = dict[str, Float[Array, " code"]]


class Field(NamedTuple):
    """Pure functions of a field, whose `params` are those that `init` returns."""

    spec: RadianceScene
    metadata: SceneMetadata
    effects: tuple[FieldRecord, ...]
    init: Callable[[Key[Array, ""]], PyTree]
    codes_at: Callable[[PyTree, View], Codes]  # codes of a view by table
    # (params, ray, condition, key, guide) -> outputs of the levels, coarse to fine.
    # Without a key nothing is random. Without a guide (occupied cells) the first
    # samples are evenly spaced.
    render_ray: Callable[..., tuple[RayOutput, ...]]
    # (params, point, condition) -> template point minus observed point, field units
    displace: Callable[[PyTree, Vector, FrameCondition], Vector]
    # (params, camera, time, codes, size, step) -> whole frame
    render: Callable[..., Rendering]
    # (params, step) -> `skipping.Occupancy` for all times, for fields with warps in the
    # coordinates of the template. It is empty if each frame has to be surveyed by
    # itself. None if empty space cannot be skipped.
    survey: Callable[..., Occupancy] | None
    # (params, occupancy, ...) -> the same frame as `render`, not differentiable
    render_occupied: Callable[..., Rendering]
    # (field, numbers) -> the field with these numbers, which may be traced
    with_numbers: Callable[["Field", PyTree], "Field"]

    @property
    def numbers(self) -> PyTree:
        """Numbers of the capture (`training.programs`)."""
        return self.metadata.numbers


def field(
    spec: RadianceScene,
    metadata: SceneMetadata,
    without: tuple[str, ...] = (),
    effects: tuple[FieldRecord, ...] = (),
) -> Field:
    """Make the field of a spec and further effects, optionally without some of them.

    Without "warp" it renders the template, and without "transient" or "scene_flow" only
    the static scene. The parameters are always those of the complete field.

    Args:
      spec: The scene.
      metadata: Scene metadata.
      without: Names of effects to leave out.
      effects: Effects in addition to those of the spec.

    Returns:
      The field.
    """
    built_in = specs.effects_of(spec, metadata)
    all_effects = join(built_in, effects, reserved_names=("template", "codes"))
    tables = specs.tables_of(all_effects)
    active = _active(all_effects, without)
    bind = functools.partial(Bound, spec, metadata, active)

    def init(key):
        return _init(spec, metadata, all_effects, key)

    def codes_at(params, view):
        return _look_up(tables, metadata, params, view.time, view.appearance)

    def displace(params, point, condition):
        return displacement(bind(params), point, condition)

    def levels_of(params, ray: Ray, condition, key=None, guide=None):
        return render_ray(bind(params), ray, condition, key, guide)

    def render(params, camera, time, codes, size, step):
        return draw(bind(params), camera, FrameCondition(time, codes, step), size)

    moves = is_moved(active)
    static_effects = tuple(
        dataclasses.replace(effect, displace=None) for effect in active
    )

    def surveyed_once():
        # With displacements on a grid, the template is surveyed, which is the same at
        # all times.
        return not moves or frustum_grid.resolves(bind({}))

    def survey(params, step):
        if not surveyed_once():
            return {}
        kind = jax.tree.leaves(params["template"])[0].dtype
        time = jnp.asarray(metadata.times[0], kind)
        frame_codes = _look_up(tables, metadata, params, time, jnp.int32(0))
        condition = FrameCondition(time, frame_codes, step)
        return skipping.survey(Bound(spec, metadata, static_effects, params), condition)

    def render_occupied(params, occupied_cells, camera, time, codes, size, step):
        bound, condition = bind(params), FrameCondition(time, codes, step)
        if not surveyed_once():
            visible_cells = skipping.shown_cells(bound, camera, size)
            occupied_cells = skipping.survey(bound, condition, visible_cells)
        return skipping.draw(bound, occupied_cells, camera, condition, size)

    return Field(
        spec,
        metadata,
        active,
        init,
        codes_at,
        levels_of,
        displace,
        render,
        survey if skipping.usable(spec, active) else None,
        render_occupied,
        lambda original, numbers: field(
            spec, original.metadata.with_numbers(numbers), without, effects
        ),
    )


def draw(
    bound: Bound, camera: Camera, condition: FrameCondition, size: tuple[int, int]
) -> Rendering:
    """Render a whole frame by the full quadrature. Differentiable, unlike
    `skipping.draw`.

    Args:
      bound: The field with its parameters.
      camera: The camera.
      condition: Conditioning of the frame.
      size: Width and height of the image in pixels.

    Returns:
      The rendered image.
    """
    guide = None
    if bound.spec.sampling.occupancy is not None:
        guide = skipping.survey(bound, condition)[skipping.GUIDE]

    def pixel(position):
        ray, cosine = field_ray_through(bound.metadata, camera, position)
        level = render_ray(bound, ray, condition, None, guide)[-1]
        depth = level.distance * cosine / bound.metadata.scale
        return Rendering(level.color, level.alpha, depth)

    width, height = size
    centers = rays.pixel_centers(size, camera.position.dtype).reshape(-1, 2)
    # A slope, as of the camera, is found block by block: all samples of a frame at once
    # would need as much memory as a training step over all its pixels.
    flat = jax.lax.map(
        jax.checkpoint(pixel),
        centers,
        batch_size=min(bound.spec.sampling.block, width * height),
    )
    return jax.tree.map(lambda x: x.reshape(height, width, *x.shape[1:]), flat)


def feeds_networks(effect: FieldRecord) -> bool:
    """Return whether the template or a warp reads the output of an effect.

    Args:
      effect: The effect.

    Returns:
      True if it does.
    """
    hooks = (
        effect.trunk_features,
        effect.condition,
        effect.point_codes,
        effect.surface,
    )
    return any(hook is not None for hook in hooks)


def _active(effects, without):
    names = [effect.name for effect in effects]
    for name in without:
        if name not in names:
            raise ValueError(
                f"there is no effect {name!r} to leave out; the field has "
                f"{', '.join(names) or 'none'}"
            )
        if feeds_networks(effects[names.index(name)]):
            raise ValueError(
                f"{name!r} feeds the template or a warp and cannot be left out of a "
                "trained field; train one without it"
            )
    return tuple(effect for effect in effects if effect.name not in without)


def _init(spec, metadata, effects, key):
    ambient_width = sum(effect.trunk_width for effect in effects)
    condition = sum(e.condition_width + e.surface_width for e in effects)
    nets = {}
    keys = jax.random.split(key, 3)
    for number, (name, net_spec) in enumerate(specs.templates_of(spec).items()):
        component_key = jax.random.fold_in(keys[0], number)
        if not isinstance(net_spec, template.TemplateSpec):
            nets[name] = net_spec.init(component_key, ambient_width, condition)
            continue
        extras = 0 if net_spec.direction is None else net_spec.direction.width(3)
        nets[name] = template.init(
            net_spec,
            component_key,
            net_spec.encoded_width + ambient_width,
            condition + extras,
        )
    rows = {TIMESTAMP: len(metadata.times)}
    appearances = 1 + max((max(left, right) for left, right, _ in metadata.exposures))
    params = {"template": nets, "codes": {}}
    for table in specs.tables_of(effects):
        count = rows.get(table.by, appearances)
        params["codes"][table.name] = codes.init(
            jax.random.fold_in(keys[1], stream(table.name)), count, table.width
        )
    for effect in effects:
        if effect.init is not None:
            component_key = jax.random.fold_in(keys[2], stream(effect.name))
            params[effect.name] = effect.init(component_key)
    return params


def _look_up(
    tables: tuple[Table, ...],
    metadata: SceneMetadata,
    params: PyTree,
    time: Scalar,
    appearance: Int[Array, ""],
) -> Codes:
    """Look up the codes of one frame, interpolated between the training times."""
    frame_codes = {}
    for table in tables:
        rows = params["codes"][table.name]
        place = (
            _place_in_time(metadata, time)
            if table.by == TIMESTAMP
            else codes.place_of(metadata.exposures, appearance, rows.dtype)
        )
        frame_codes[table.name] = codes.blend(rows, *place)
    return frame_codes


def _place_in_time(metadata, time):
    """Return the rows before and after a time, and the position in between."""
    times = jnp.asarray(metadata.times, time.dtype)
    last = max(len(metadata.times) - 2, 0)
    left = jnp.clip(jnp.searchsorted(times, time, side="right") - 1, 0, last)
    right = jnp.minimum(left + 1, len(metadata.times) - 1)
    gap = times[right] - times[left]
    progress = (time - times[left]) / jnp.where(gap > 0, gap, 1)
    return left, right, jnp.clip(progress, 0, 1)
