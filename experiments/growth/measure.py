"""Compiled training steps of growing scenes, timed one after another."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.growth.axes import AXES
from gaussians_jax.core import splats
from gaussians_jax.init.points import InitSpec, StartSpec
from gaussians_jax.scene import view_order
from gaussians_jax.scene.spec import raster_of
from gaussians_jax.splatting import binning, projection
from nerfies_jax import evaluation, runs
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.metrics import clock
from nerfies_jax.runs import representations
from nerfies_jax.runtime.compiler import UNDIVIDED

SMALL, LARGE = (176, 132), (352, 264)
FEW = 8  # frames
GAUSSIANS = 10_000
MOTION_GAUSSIANS = 5_000
# Repetitions of steps that take less than SHORT seconds, and of longer ones.
REPEATS, FEW_REPEATS, SHORT = 7, 3, 0.5


class Scene(NamedTuple):
    """A model with its state and frames."""

    spec: Any
    metadata: Any
    model: Any
    state: Any
    frames: Any


def point(axis: str, size: int) -> dict[str, float]:
    """Measure one size of an axis.

    Args:
      axis: Name in `AXES`.
      size: The size.

    Returns:
      Processor and wall-clock seconds of a step, and what the compiler reports: flops
      and bytes accessed with the body of each loop counted once, and the bytes of
      inputs and temporary arrays. For splats also pairs of Gaussians and tiles.
    """
    scene = BUILDERS[axis](size)
    step = jax.jit(scene.model.step, compiler_options=scene.model.compiler_options)
    cost = clock.cost_of(step.lower(scene.state, scene.frames).compile(), 0.0)

    def call():
        return step(scene.state, scene.frames)

    first = clock.measure(call, repeats=1, warm_up=1)
    repeats = REPEATS if first.median < SHORT else FEW_REPEATS
    timing = clock.measure(call, repeats=repeats, warm_up=0)
    record = {
        "cpu_seconds": timing.median_cpu,
        "seconds": timing.median,
        "flops": cost.flops,
        "bytes_accessed": cost.bytes_accessed,
        "temporary_bytes": cost.temporary_bytes,
        "input_bytes": cost.argument_bytes,
    }
    return record | ({"pairs": _pairs(scene)} if AXES[axis].splats else {})


def _preset(name):
    return representations.of_preset(name).presets[name]


@functools.cache
def _capture():
    return runs.built_in_scene("default")


def _scene(preset, size=SMALL, frames=FEW, **fields):
    """Build a scene of a preset, with frames that are resampled and repeated."""
    capture = _capture()
    representation = representations.of_preset(preset)
    spec = dataclasses.replace(_preset(preset), **fields)
    metadata = representation.metadata_of(capture, spec)
    model = representation.build(spec, metadata)
    state = (model.example or model.init)(capture, jax.random.key(0))
    capture_frames = evaluation.frames_of(capture, model.required_data)
    take = np.arange(frames) % len(capture_frames.times)
    images = np.asarray(capture_frames.images)
    rows = np.arange(size[1]) * images.shape[1] // size[1]
    columns = np.arange(size[0]) * images.shape[2] // size[0]
    images = images[take][:, rows][:, :, columns]
    resized_cameras = cameras.resize(capture_frames.cameras, capture.size, size)
    capture_frames = capture_frames._replace(
        images=jnp.asarray(images),
        cameras=cameras.take(resized_cameras, take),
        times=jnp.linspace(0, 1, frames, dtype=capture_frames.times.dtype),
        appearance=jnp.asarray(take.astype(np.int32)),
        valid=None,
    )
    return Scene(spec, metadata, model, state, capture_frames)


def _splats(count, **options):
    """Build a static scene of random Gaussians, whose size falls with their number."""
    strategy = _preset("splats-static-small").strategy
    return _scene(
        "splats-static-small",
        batch_size=1,
        init=InitSpec(source="random", random=count),
        strategy=dataclasses.replace(strategy, cap_max=count),
        **options,
    )


def _moving(**motion):
    """Build a scene whose motion has other numbers of bases or knots."""
    preset = _preset("splats-tracked-small")
    return _scene(
        "splats-tracked-small",
        batch_size=1,
        init=InitSpec(source="random", random=MOTION_GAUSSIANS),
        start=StartSpec(motion="none"),
        motion=dataclasses.replace(preset.motion, **motion),
    )


def _of_pixels(count, pixels):
    return _splats(count, size=IMAGES[pixels])


# By the number of pixels.
IMAGES = {
    width * height: (width, height)
    for width, height in ((176, 132), (704, 528), (1280, 720), (1920, 1080))
}
BUILDERS: dict[str, Callable[[int], Scene]] = {
    "Gaussians": lambda size: _splats(size, size=LARGE),
    "pixels, 1,500 Gaussians": functools.partial(_of_pixels, 1_500),
    "pixels, 10,000 Gaussians": functools.partial(_of_pixels, GAUSSIANS),
    "frames": lambda size: _splats(GAUSSIANS, frames=size),
    "bases": lambda size: _moving(bases=size),
    "knots": lambda size: _moving(knots=size),
    "rays": lambda size: _scene("nerf-small", rays=size, micro_batches=1),
}


def _pairs(scene):
    """Count the pairs of Gaussians and tiles in the frame of the first step."""
    frames = scene.frames
    row = view_order.shuffled_row(scene.state.key, scene.state.step, len(frames.times))
    camera = jax.tree.map(lambda leaf: leaf[row], frames.cameras)
    size = frames.images.shape[2], frames.images.shape[1]
    raster = raster_of(scene.spec, scene.metadata)

    def count(rows):
        gaussians = splats.activate(rows)
        footprints = projection.project(gaussians, camera, size, raster)
        grid = binning.Grid(*size, raster.tile)
        rects = binning.tile_rects(footprints.mean_px, footprints.extent_px, grid)
        return jnp.sum(rects.tiles)

    program = jax.jit(count, compiler_options=UNDIVIDED)
    return int(program(scene.state.params.rows["splats"]))
