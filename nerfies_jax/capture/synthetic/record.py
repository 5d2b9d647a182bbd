"""Synthetic scenes as a `Capture`, in memory, as a directory, or from a cache."""

import dataclasses
import functools
import hashlib
import pathlib
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from nerfies_jax.capture import cache_files, nerfies_format
from nerfies_jax.capture.capture import Capture, CaptureError, PointCloud
from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.capture.json_files import AnyPath, new_folder
from nerfies_jax.capture.synthetic import collection, rendering, trace, truth
from nerfies_jax.capture.synthetic.spec import SceneSpec
from nerfies_jax.capture.synthetic.truth import SceneTruth
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.runtime import data_parallel, events

VERSION = 4  # increase it when images or files of a spec change, to invalidate caches
TRUTH_FILE = "truth.npz"  # next to the Nerfies files; other readers ignore it


def make(spec: SceneSpec, seed: int = 0) -> tuple[Capture, SceneTruth]:
    """Render a scene as a capture with its ground truth.

    The first camera's frames are for training, the second's for evaluation. The same
    spec and seed give the same bits on the same machine and number of cores.

    Args:
      spec: The scene.
      seed: Seed of the hand-held motion, the exposure and the selection of points. It
        does not affect the objects.

    Returns:
      The capture and its ground truth.
    """
    plan = rendering.schedule(spec, seed)
    programs = truth.programs(spec, plan)
    images, depths, hits = _render_frames(spec, plan)
    moves = np.array([thing.moves() for thing in spec.all_things()] + [False])
    moving = moves[hits.thing]  # id -1, for no object, indexes the last entry
    ids = tuple(
        f"{camera}_{place_in_time:05d}"  # sorted by name, frames stay in this order
        for place_in_time, camera in zip(plan.time_index, plan.camera_id, strict=True)
    )
    scene_truth = _truth(spec, plan, hits, ids, programs, seed)
    visible = depths[(depths > 0) & (hits.thing != spec.transient_id)]
    capture = Capture(
        name=f"synthetic {spec.name}",
        source="synthetic",
        ids=ids,
        images=images,
        cameras=rendering.recorded_cameras(spec, plan, seed),
        times=plan.time,
        train=np.flatnonzero(plan.learn),
        heldout=np.flatnonzero(~plan.learn),
        near=float(0.9 * visible.min()),
        far=float(1.1 * depths.max()),
        warp_ids=plan.time_index,
        appearance_ids=plan.time_index,
        camera_ids=plan.camera_id,
        valid=collection.observed(spec, hits.thing),
        moving=None if spec.photographed else moving,
        depths=depths,
        flow=None if spec.photographed else _flow(plan, scene_truth),
        points=_points(spec, plan, images, hits, moving, seed),
        background=None if spec.photographed else spec.background,
        up=(0.0, 1.0, 0.0),
    )
    return capture, scene_truth


def write(spec: SceneSpec, path: AnyPath, seed: int = 0):
    """Render a scene into a Nerfies directory with `truth.npz`, atomically.

    Args:
      spec: The scene.
      path: The directory, which may be absent or empty.
      seed: As for `make`.

    Raises:
      CaptureError: If the directory cannot be written.
    """
    with new_folder(path) as folder:  # fails before rendering if the path exists
        _write_into(folder, spec, seed)


def _write_into(folder, spec, seed):
    capture, scene_truth = make(spec, seed)
    # In a thread, since zlib releases the GIL.
    with ThreadPoolExecutor(1) as pool:
        saving = pool.submit(truth.save, scene_truth, folder / TRUTH_FILE)
        with events.stage("writing the scene"):
            nerfies_format.write(capture, folder / "capture")
        for part in (folder / "capture").iterdir():
            part.rename(folder / part.name)
        (folder / "capture").rmdir()
        saving.result()


def cached(
    spec: SceneSpec, folder: AnyPath, seed: int = 0
) -> tuple[Capture, SceneTruth]:
    """Read a scene from a cache folder, and render it first if needed.

    Args:
      spec: The scene.
      folder: The cache folder.
      seed: As for `make`.

    Returns:
      The capture and its ground truth.
    """
    identity = f"scene {digest(spec, seed)}"
    path = pathlib.Path(folder) / f"{spec.name.replace(' ', '-')}-{digest(spec, seed)}"

    def load(path):
        cache_files.check_entry(path, identity)
        return nerfies_format.read(path), truth.load(path / TRUTH_FILE)

    scene = cache_files.read(path, load)
    if scene is None:
        try:
            with cache_files.replaced_entry(path, identity) as partial:
                _write_into(partial, spec, seed)
        except CaptureError:
            # Another process may have written the same scene first.
            scene = cache_files.read(path, load)
            if scene is None:
                raise
        else:
            scene = load(path)
    capture, scene_truth = scene
    name = f"synthetic {spec.name}"
    return dataclasses.replace(capture, name=name, source="synthetic"), scene_truth


def digest(spec: SceneSpec, seed: int = 0) -> str:
    """Return the identity of a scene in a cache.

    Args:
      spec: The scene.
      seed: As for `make`.

    Returns:
      Twelve hex digits of a hash of the spec, the seed and the version of the renderer.
    """
    text = f"{VERSION} {seed} {spec!r}"
    effects = (spec.pose_error, spec.lens, spec.rig, spec.collection, spec.snapshots)
    for effect in effects:
        if effect is not None:
            text += f" {effect!r}"
    if spec.cameras.pan_rad:
        text += f" pan_rad={spec.cameras.pan_rad!r}"
    if spec.cameras.zoom != 1:
        text += f" zoom={spec.cameras.zoom!r}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _render_frames(spec, plan):
    rows = plan.cameras, plan.time, plan.light_gain, plan.transient_shown
    if plan.photo is not None:
        rows = (*rows, plan.photo)
    images, depths, hits = [], [], []
    with events.stage("rendering the built-in scene", len(plan.time)) as stage:
        for frame in data_parallel.rows_on_devices(rendering.render, spec, rows):
            images.append(np.round(frame.image * 255).astype(np.uint8))
            depths.append(frame.depth)
            hits.append(frame.hit)
            stage.advance()
    hits = jax.tree.map(lambda *leaves: np.stack(leaves), *hits)
    return np.stack(images), np.stack(depths), hits


def _points(spec, plan, images, hits, moving, seed):
    """Static points in the training frames, as from structure from motion.

    They are uniformly distributed over the pixels, with noise, and have the color of a
    pixel.
    """
    rng = np.random.default_rng([seed, 4])
    static = (hits.thing != trace.NOTHING) & ~moving
    static &= hits.thing != spec.transient_id
    candidates = np.flatnonzero(static & plan.learn[:, None, None])
    sample = rng.choice(candidates, min(spec.points, len(candidates)), replace=False)
    row = sample // static[0].size
    # One program, because its operations take longer to compile separately.
    direction = jax.jit(jax.vmap(functools.partial(rendering.view_direction, spec)))
    directions = direction(
        cameras.take(plan.cameras, row), _pixel_centers(sample, spec.size)
    )
    distance = hits.distance.reshape(-1)[sample]
    exact = plan.cameras.position[row] + distance[:, None] * np.asarray(directions)
    noise = spec.point_noise * rng.normal(size=exact.shape)
    position = (exact + noise).astype(np.float32)
    return PointCloud(position, images.reshape(-1, 3)[sample])


def _pixel_centers(flat, size):
    """Pixel centers of flat indices into [frames, height, width]."""
    width, height = size
    return np.stack([flat % width, flat // width % height], -1).astype(np.float32) + 0.5


def _flow(plan, scene_truth):
    """The true flow as the flow of a capture."""
    rows = np.arange(len(plan.time))
    leaves = []
    for step, shift, valid in (
        (1, scene_truth.flow_forward, scene_truth.forward_valid),
        (-1, scene_truth.flow_backward, scene_truth.backward_valid),
    ):
        neighbor = np.clip(rows + step, 0, len(rows) - 1)
        same_camera = plan.camera_id[neighbor] == plan.camera_id[rows]
        leaves += [shift, valid, np.where(same_camera, neighbor, rows).astype(np.int32)]
    return FrameFlow(*leaves)


@events.stage("computing the scene's ground truth")
def _truth(spec, plan, hits, ids, programs, seed):
    forward, backward = truth.flows(spec, plan, hits, programs)
    names = tuple(thing.name for thing in spec.all_things())
    if spec.collection is not None:
        names = (*names, "board")
    return SceneTruth(
        ids,
        hits.thing.astype(np.int8),
        names,
        hits.thing == spec.transient_id,
        forward.pixel,
        forward.visible,
        backward.pixel,
        backward.visible,
        plan.light_gain,
        *truth.tracks(spec, plan, hits, programs, seed),
    )
