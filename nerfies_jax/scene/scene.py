"""Models of radiance fields for the training loop, built from a spec."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from nerfies_jax.capture import scene_metadata
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.frame_memory import frame_bytes
from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.fields import occupied_rays
from nerfies_jax.fields.effects import moving_mask
from nerfies_jax.fields.effects.protocols import NetworkTemplate, Template
from nerfies_jax.fields.effects.records import FieldRecord
from nerfies_jax.fields.field import Codes, Field, field
from nerfies_jax.fields.spec import RadianceScene, optimizer_of
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.nn import codes
from nerfies_jax.nn.adapters import Network
from nerfies_jax.nn.planes import PlanesSpec
from nerfies_jax.preprocessing import usable_paths
from nerfies_jax.runtime import data_parallel
from nerfies_jax.scene import steps, warp_fit
from nerfies_jax.training import programs
from nerfies_jax.training.model import (
    Model,
    Surveyed,
    TrainState,
    View,
    in_default_precision,
)

__all__ = ["Field", "RadianceScene", "SceneMetadata", "build", "field", "metadata_of"]

PyTree = Any


def metadata_of(capture: Capture, spec: RadianceScene) -> SceneMetadata:
    """Compute the scene metadata of a capture, on the host.

    Args:
      capture: The capture.
      spec: The scene.

    Returns:
      The metadata.
    """
    return scene_metadata.metadata_of(capture, spec.extent, spec.volume)


def build(
    spec: RadianceScene,
    metadata: SceneMetadata,
    effects: tuple[FieldRecord, ...] = (),
    *,
    template: Template | Network | None = None,
) -> Model:
    """Build the model of a radiance field.

    Args:
      spec: The scene.
      metadata: Scene metadata, as of `metadata_of`.
      effects: Internal records of further effects, after those of the spec.
      template: Template that replaces that of the spec: an object of the protocol
        `Template`, or a network of `nn.adapters` that reads [point, features] and
        [direction, condition] of a sample and returns its density and color.

    Returns:
      The model for the training loop and the renderer.

    Raises:
      ValueError: If a component needs data that the capture does not have, or a
        per-point code that no component provides.
    """
    if isinstance(template, Network):
        template = NetworkTemplate(template)
    if template is not None:
        spec = dataclasses.replace(spec, template=template, coarse=None)
    radiance = field(spec, metadata, effects=effects)

    def build_with(numbers):
        return _model(programs.with_numbers(radiance, numbers), effects)

    return programs.taking(_model(radiance, effects), metadata.numbers, build_with)


def _model(radiance, more):
    """Return the model of a field, `more` of whose effects are not of its spec.

    The numbers of the capture are compiled in.
    """
    spec, metadata = radiance.spec, radiance.metadata
    _check_guides(spec, radiance.effects)
    codes_at = radiance.codes_at
    if spec.background is not None and "points" not in metadata.available_data:
        raise ValueError(
            "the background effect holds static points still, and this capture has "
            "none; leave it out (background=none)"
        )

    devices = data_parallel.device_count(spec.micro_batches)

    def init(capture, key):
        codes.check_ids(
            capture.appearance_ids, len(metadata.exposures), "appearance_ids"
        )
        start_key, run_key = jax.random.split(key)
        params = radiance.init(start_key)
        evidence = usable_paths.evidence_to_start_from(capture, spec.start)
        if evidence is not None:
            paths = warp_fit.point_paths(radiance, capture, evidence)
            fit = warp_fit.fit_flow if spec.warp is None else warp_fit.fit
            params = fit(radiance, params, paths, start_key, spec.start)
        return first_state(params, run_key)

    def example(_, key):
        return first_state(radiance.init(key), key)

    optimizer = optimizer_of(spec)

    def first_state(params, key):
        params = in_default_precision(params)
        cells = occupied_rays.first(radiance)
        return TrainState(
            params, optimizer.init(params), cells, jnp.zeros((), jnp.int32), key
        )

    read = frozenset().union(*(effect.required_data for effect in radiance.effects))
    return Model(
        # Further effects are stored by name. A run with others is a different run.
        spec=(spec, metadata, *(effect.name for effect in more)),
        init=init,
        step=steps.stepper(spec, radiance, devices),
        events=occupied_rays.events(radiance),
        **drawing(radiance, lambda params, view: (view, codes_at(params, view))),
        counts=count_parameters,
        required_data=read,
        example=example,
        devices=devices,
        reads=steps.reader(spec, read),
    )


def _check_guides(spec, effects):
    """Raise ValueError for guides that no effect provides, before tracing."""
    guides = tuple(effect.name for effect in effects if effect.point_codes is not None)
    for part in ("warp", "ambient"):
        for guide in getattr(getattr(spec, part), "guides", ()):
            if guide not in guides:
                raise ValueError(
                    f"{part}.guides names {guide!r}, and there is "
                    f"{' and '.join(guides) or 'none'}; leave it out, set mask for "
                    f"{moving_mask.NAME!r}, or add a conditioning of that name whose "
                    'target is "warp"'
                )


def drawing(
    radiance: Field, observe: Callable[..., tuple[View, Codes]]
) -> dict[str, Any]:
    """Return the `render` and `surveyed` functions of a field's model.

    Args:
      radiance: The field.
      observe: Function `observe(params, inputs)` that returns a view and the codes of
        its frame, given the input of `render`.

    Returns:
      The fields of `Model` by name.
    """

    def render(params, inputs, size, step):
        view, frame_codes = observe(params, inputs)
        return radiance.render(params, view.camera, view.time, frame_codes, size, step)

    def draw(params, occupied_cells, inputs, size, step):
        view, frame_codes = observe(params, inputs)
        return radiance.render_occupied(
            params, occupied_cells, view.camera, view.time, frame_codes, size, step
        )

    survey = None if radiance.survey is None else Surveyed(radiance.survey, draw)
    return {"render": render, "surveyed": survey}


def estimate_memory_bytes(spec: RadianceScene, capture: Capture) -> int:
    """Estimate the memory of the frames, the first state and a step.

    Nothing is allocated. The memory of the capture is included.

    Args:
      spec: The scene.
      capture: The capture.

    Returns:
      Number of bytes.
    """
    plan = spec.sampling
    last = plan.coarse if plan.fine == 0 else plan.union * plan.coarse + plan.fine
    samples = last if plan.fine == 0 else plan.coarse + last
    widths = samples * _width_of(spec.template)
    # Components from other packages are not estimated.
    for net in (spec.warp, spec.ambient, spec.mask):
        widths += samples * getattr(net, "depth", 0) * getattr(net, "width", 0)
    fog = spec.transient
    widths += last * getattr(fog, "depth", 0) * getattr(fog, "width", 0)
    if spec.scene_flow is not None:
        medium = spec.scene_flow.network
        trunk = spec.scene_flow.flow_trunk * medium.depth * medium.width
        # Evaluated at this timestamp and at the two neighboring ones.
        widths += 3 * last * (_width_of(medium) + trunk)
    # The output of every layer is stored for the backward pass, in addition to its
    # gradient. For steps of 256 rays with the small presets, XLA's temporary memory is
    # 0.57 to 1.02 times this estimate.
    rays_at_once = spec.rays // spec.micro_batches
    activations = 3 * rays_at_once * widths
    devices = data_parallel.device_count(spec.micro_batches)
    return 4 * activations + frame_bytes(capture, devices)


def _width_of(one: object) -> int:
    """Count the floats stored per sample: outputs of layers, and values of planes."""
    if not isinstance(one, TemplateSpec):
        return 0  # unknown
    width, position = one.depth * one.width + one.color_width, one.position
    if not isinstance(position, PlanesSpec):
        return width  # grids add little: 0.77 to 1.02 times the estimate
    corners = 4 * (3 if position.timestamps is None else 6)
    return width + corners * position.levels * position.features


def count_parameters(state: TrainState) -> dict[str, int]:
    """Count the parameters of all networks and codes.

    Args:
      state: Training state.

    Returns:
      The number, under "parameters".
    """
    leaves = jax.tree.leaves(state.params)
    return {"parameters": sum(math.prod(leaf.shape) for leaf in leaves)}
