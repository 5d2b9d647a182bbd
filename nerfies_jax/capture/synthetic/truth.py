"""Ground truth of a synthetic scene beyond its images: ids, flow, point tracks."""

import functools
import pathlib
from concurrent.futures import Future
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nerfies_jax.capture import npz_files
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.synthetic import trace
from nerfies_jax.capture.synthetic.rendering import Schedule
from nerfies_jax.capture.synthetic.spec import SceneSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import rays
from nerfies_jax.runtime import compiler, data_parallel


class SceneTruth(NamedTuple):
    """Exact ground truth by frame, in NumPy.

    Flow leads from the center of a pixel to the position of its point in the next
    (previous) frame of the same camera, in pixels. It is also defined where that point
    is occluded or outside of the image. `forward_valid` and `backward_valid` are True
    where the point is visible in both frames. The last (first) frame of a camera has
    zero flow that is nowhere visible.
    """

    ids: tuple[str, ...]  # of the capture's frames, one for each row
    things: np.ndarray  # [frames, height, width] int8 ids of objects; -1 for none
    thing_names: tuple[str, ...]  # by id
    transient: np.ndarray  # [frames, height, width] bool
    flow_forward: np.ndarray  # [frames, height, width, 2] float32, right and down
    forward_valid: np.ndarray  # [frames, height, width] bool
    flow_backward: np.ndarray
    backward_valid: np.ndarray
    light_gain: np.ndarray  # [frames, 3] float32: exposure as a gain of linear light
    track_thing: np.ndarray  # [tracks] int32
    track_canonical: np.ndarray  # [tracks, 3] float32: the point at time 0, world
    track_world: np.ndarray  # [tracks, times, 3] float32
    track_pixel: np.ndarray  # [tracks, frames, 2] float32
    track_seen: np.ndarray  # [tracks, frames] bool


def track_places(capture: Capture, truth: SceneTruth, rows: np.ndarray) -> np.ndarray:
    """Return the positions of the tracked points in some frames.

    Args:
      capture: The capture.
      truth: Its ground truth.
      rows: Indices of the frames.

    Returns:
      float32 positions in scene units, [tracks, rows, 3].

    Raises:
      ValueError: If the truth is not that of the capture.
    """
    if truth.ids != capture.ids:
        raise ValueError(
            f"{capture.name}: the ground truth has other frames than the capture; "
            "create the scene again"
        )
    last = truth.track_world.shape[1] - 1
    indices = np.round(capture.times[rows] * last).astype(int)
    if np.abs(indices - capture.times[rows] * last).max() > 1e-3:
        raise ValueError(
            f"{capture.name}: its frames lie between the {last + 1} timestamps of the "
            "ground truth; create the scene again"
        )
    world = truth.track_world[:, indices] - np.array(capture.center, np.float32)
    return (world * capture.scale).astype(np.float32)


class Flow(NamedTuple):
    """Flow of one frame to another frame, and its visibility there."""

    pixel: Float[Array, "height width 2"]
    visible: Bool[Array, "height width"]


def flow(spec: SceneSpec, thing, material, camera, time, transient_shown) -> Flow:
    """Compute the flow of the pixels of one frame to another frame.

    Args:
      spec: The scene.
      thing: Ids of the objects that the pixel centers of the first frame hit, [height,
        width].
      material: Material points that they hit, [height, width, 3].
      camera: Camera of the other frame.
      time: Time of the other frame.
      transient_shown: True if the other frame shows the transient object.

    Returns:
      The flow, zero for the background.
    """

    def project(thing, material):
        point = trace.place(spec, thing, material, time)
        return trace.visible(spec, camera, thing, point, time, transient_shown)

    pixel, visible = jax.lax.map(lambda row: jax.vmap(project)(*row), (thing, material))
    hit = thing != trace.NOTHING
    centers = rays.pixel_centers(spec.size, pixel.dtype)
    shift = jnp.where(hit[..., None], pixel - centers, 0)
    return Flow(shift, visible & hit)


class Programs(NamedTuple):
    """Programs of `flows` and `tracks`, compiled in the background."""

    flow: Future[jax.stages.Compiled] | None  # None for photographs
    follow: Future[jax.stages.Compiled] | None = None  # None for a static scene
    watch: Future[jax.stages.Compiled] | None = None


def programs(spec: SceneSpec, plan: Schedule) -> Programs:
    """Compile the programs of the ground truth in the background.

    For the default scene this takes 6 s of one core, and the program that renders
    images 5 s.

    Args:
      spec: The scene.
      plan: The schedule.

    Returns:
      Futures of the compiled programs.
    """
    shape = jax.ShapeDtypeStruct
    frames, (width, height), points = len(plan.time), spec.size, spec.tracks
    frame_index = (
        shape((frames, height, width), np.int32),
        shape((frames, height, width, 3), np.float32),
        plan.cameras,
        plan.time,
        plan.transient_shown,
    )
    if spec.photographed:  # consecutive photographs are not neighbors
        return Programs(None)
    lowerings = [data_parallel.lower_rows(flow, spec, frame_index)]
    if points and any(thing.moves() for thing in spec.things):
        thing, times = shape((points,), np.int32), shape((spec.frames,), np.float32)
        material = shape((points, 3), np.float32)
        places = shape((points, frames, 3), np.float32)
        lowerings.append(_follow.lower(spec, thing, material, times))
        lowerings.append(_watch.lower(spec, thing, places, plan))
    return Programs(*(compiler.begun(lowering.compile) for lowering in lowerings))


def flows(
    spec: SceneSpec, plan: Schedule, hits: trace.Hit, programs: Programs
) -> tuple[Flow, Flow]:
    """Compute the flow of every frame to the next and the previous one of its camera.

    Args:
      spec: The scene.
      plan: The schedule.
      hits: First hits of all pixel centers, [frames, height, width].
      programs: Compiled programs.

    Returns:
      Forward and backward flow, [frames, height, width].
    """
    count = len(plan.time)
    width, height = spec.size
    row = np.tile(np.arange(count), 2)
    other = row + np.repeat([1, -1], count)
    exists = (other >= 0) & (other < count)
    exists[exists] = plan.camera_id[other[exists]] == plan.camera_id[row[exists]]
    source, target = row[exists], other[exists]
    pairs = (
        hits.thing[source],
        hits.material[source],
        cameras.take(plan.cameras, target),
        plan.time[target],
        plan.transient_shown[target],
    )
    shift = np.zeros((2 * count, height, width, 2), np.float32)
    visible = np.zeros((2 * count, height, width), bool)
    if programs.flow is not None:
        program = programs.flow.result()
        results = data_parallel.rows_on_devices(flow, spec, pairs, program)
        for index, result in zip(np.flatnonzero(exists), results, strict=True):
            shift[index], visible[index] = result
    forward = Flow._make((shift[:count], visible[:count]))
    return forward, Flow._make((shift[count:], visible[count:]))


def tracks(
    spec: SceneSpec, plan: Schedule, hits: trace.Hit, programs: Programs, seed: int
):
    """Track random points of moving objects that training frames show.

    The transient object is not tracked.

    Args:
      spec: The scene.
      plan: The schedule.
      hits: First hits of all pixel centers, [frames, height, width].
      programs: Compiled programs.
      seed: Seed of the selection.

    Returns:
      Object ids [tracks], canonical points [tracks, 3], world points [tracks, times,
      3], pixels [tracks, frames, 2] and visibility [tracks, frames].
    """
    rng = np.random.default_rng([seed, 3])
    moving = np.array([thing.moves() for thing in spec.things])
    eligible = np.isin(hits.thing, np.flatnonzero(moving)) & plan.learn[:, None, None]
    candidates = np.flatnonzero(eligible)
    # Tracks are distinct, so there may be fewer than `spec.tracks`.
    sample = rng.choice(candidates, min(spec.tracks, len(candidates)), replace=False)
    thing = hits.thing.reshape(-1)[sample].astype(np.int32)
    material = hits.material.reshape(-1, 3)[sample]
    times = np.linspace(0, 1, spec.frames).astype(np.float32)
    # Programs for an empty batch cannot be compiled.
    if not len(sample) or programs.follow is None or programs.watch is None:
        frames = len(plan.time)
        return (
            thing,
            material,
            np.zeros((0, spec.frames, 3), np.float32),
            np.zeros((0, frames, 2), np.float32),
            np.zeros((0, frames), bool),
        )
    # The programs expect `spec.tracks` points, so the last one is repeated.
    rows = np.minimum(np.arange(spec.tracks), len(sample) - 1)
    world = np.asarray(programs.follow.result()(thing[rows], material[rows], times))
    positions = world[:, plan.time_index]
    pixel, visible = programs.watch.result()(thing[rows], positions, plan)
    world, pixel, visible = (
        np.asarray(x)[: len(sample)] for x in (world, pixel, visible)
    )
    return thing, world[:, 0], world, pixel, visible


@functools.partial(jax.jit, static_argnums=0)
def _follow(spec, thing, material, times):
    over_time = jax.vmap(
        lambda thing, material, time: trace.place(spec, thing, material, time),
        (None, None, 0),
    )
    return jax.vmap(over_time, (0, 0, None))(thing, material, times)


@functools.partial(jax.jit, static_argnums=0)
def _watch(spec, thing, points, plan):
    def frame(row):
        points, camera, time, has_transient = row
        return jax.vmap(
            lambda thing, point: trace.visible(
                spec, camera, thing, point, time, has_transient
            )
        )(thing, points)

    rows = (jnp.swapaxes(points, 0, 1), plan.cameras, plan.time, plan.transient_shown)
    pixel, visible = jax.lax.map(frame, rows)
    return jnp.swapaxes(pixel, 0, 1), jnp.swapaxes(visible, 0, 1)


def save(truth: SceneTruth, path: pathlib.Path):
    """Write ground truth as one .npz file.

    Args:
      truth: The ground truth.
      path: The file.
    """
    fields = truth._asdict()
    for name in ("ids", "thing_names"):
        fields[name] = np.array(fields[name])
    with open(path, "wb") as file:
        np.savez_compressed(file, **fields)


def load(path: pathlib.Path) -> SceneTruth:
    """Read a file written by `save`.

    Args:
      path: The file.

    Returns:
      The ground truth.

    Raises:
      ValueError: If it is not such a file.
    """
    try:
        arrays = npz_files.read_arrays(path)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{path}: not a readable ground truth ({error}); delete it and create the "
            "scene again"
        ) from error
    absent = set(SceneTruth._fields) - set(arrays)
    if absent:
        raise ValueError(
            f"{path} holds no {sorted(absent)[0]!r}, so it is not a ground truth of "
            "this version; delete it and create the scene again"
        )
    fields: dict[str, Any] = {name: arrays[name] for name in SceneTruth._fields}
    for name in ("ids", "thing_names"):
        fields[name] = tuple(str(word) for word in fields[name])
    return SceneTruth(**fields)
