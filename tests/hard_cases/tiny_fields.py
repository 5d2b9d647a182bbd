"""The papers' radiance fields shrunk to a few numbers, and whole runs of them.

A field is compiled once. What a hostile start changes, down to the box of the scene and
the rate of the optimizer, travels as arrays in `TrainState.aux_state`.
"""

import copy
import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import numpy as np

from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.fields.spec import RadianceScene
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.scene import presets, scene
from nerfies_jax.training.model import Frames, Model, Rendering, TrainState
from tests import bare_scenes, scenes
from tests.hard_cases import hostile

# Without NeRF, which is a part of NeRF-W, and T-NeRF and HyperNeRF, whose networks have
# more inputs: a time, as NSFF's has, and ambient coordinates.
PAPERS = ("nerf-w", "d-nerf", "nerfies", "nsff")
# What those have not: voxels under a warp, a mask and a surface that a template asks.
SYSTEMS = ("tineuvox", "nerf-ds")
RENDERED = ("d-nerf",)  # its scenes are, before a plain background
STEPS = 100
IMAGE_SIZE = (8, 6)


class Place(NamedTuple):
    """What is otherwise static: where the scene is, and how fast it is learned."""

    near: Any
    far: Any
    center: Any
    scale: Any
    speed: Any  # times what the optimizer would have moved


class Run(NamedTuple):
    """One field, ready to be trained from anywhere."""

    spec: RadianceScene
    capture: Capture
    model: Model
    state: TrainState
    image: Any  # (state, camera, time) -> Rendering, compiled


def tiny(name: str) -> RadianceScene:
    """A paper's field with networks of eight, over `STEPS` steps of 32 rays."""
    if name in SYSTEMS:
        return dataclasses.replace(bare_scenes.tiny_field(name), rays=32)
    spec = presets.with_steps(presets.PRESETS[name], STEPS)
    few = EncodingSpec(2)
    changes = {
        "warp": {"position": few, "time": few, "depth": 2, "width": 8, "skips": (1,)},
        "transient": {"depth": 1, "width": 8, "code_width": 4},
        "appearance": {"width": 4},
        "time": {"encoding": few},
        "elastic": {"points": 2},
        "background": {"points": 16},
    }
    if spec.scene_flow is not None:
        network = small_template(spec.scene_flow.network)
        changes["scene_flow"] = {"network": network, "time": few}
    effects = {
        effect: dataclasses.replace(getattr(spec, effect), **change)
        for effect, change in changes.items()
        if getattr(spec, effect) is not None
    }
    fine = 8 if spec.sampling.fine else 0
    sampling = dataclasses.replace(spec.sampling, coarse=8, fine=fine)
    return dataclasses.replace(
        spec,
        template=small_template(spec.template),
        sampling=sampling,
        rays=32,
        **effects,
    )


def small_template(spec: TemplateSpec) -> TemplateSpec:
    """The same kind of network, two layers of eight."""
    return dataclasses.replace(
        spec,
        position=EncodingSpec(3),
        direction=EncodingSpec(1),
        depth=2,
        width=8,
        skips=(1,),
        color_width=8,
    )


def moved(metadata: SceneMetadata, place: Place) -> SceneMetadata:
    """The metadata with traced numbers, which their constructor would refuse."""
    metadata = copy.copy(metadata)
    for name in ("near", "far", "center", "scale"):
        object.__setattr__(metadata, name, getattr(place, name))
    return metadata


def place_of(metadata: SceneMetadata, speed: float = 1.0) -> Place:
    """As arrays."""
    numbers = (metadata.near, metadata.far, metadata.center, metadata.scale, speed)
    return Place(*(np.asarray(number, np.float32) for number in numbers))


def frames_of(capture: Capture, required_data: frozenset[str]) -> Frames:
    """Frames whose images can hold any number, with a mask in any case."""
    frames = hostile.frames_of(capture, required_data)
    return frames._replace(images=frames.images.astype(np.float32))


@functools.cache
def started(name: str) -> Run:
    """The field of one paper on the tiny capture.

    Behind the samples of a paper with rendered scenes is the known color, behind those
    of the others an interval of 1e10.
    """
    capture = scenes.tiny_capture()
    if name not in RENDERED:
        capture = dataclasses.replace(capture, background=None)
    return start(tiny(name), capture)


def start(spec: RadianceScene, capture: Capture) -> Run:
    """Nothing is compiled before it runs."""
    metadata = scene.metadata_of(capture, spec)
    model = scene.build(spec, metadata)

    def step(state, frames):
        here = scene.build(spec, moved(metadata, state.aux_state))
        new, metrics = here.step(state, frames)
        params = hostile.sped_up(state.params, new.params, state.aux_state.speed)
        return new._replace(params=params), metrics

    view = evaluation.view_of(capture, int(capture.train[0]))

    @jax.jit
    def image(state, camera, time) -> Rendering:
        here = scene.build(spec, moved(metadata, state.aux_state))
        seen = view._replace(camera=camera, time=time)
        return here.render(state.params, seen, IMAGE_SIZE, state.step)

    state = model.init(capture, jax.random.key(0))
    state = state._replace(aux_state=place_of(metadata))
    return Run(spec, capture, model._replace(step=step), state, image)
