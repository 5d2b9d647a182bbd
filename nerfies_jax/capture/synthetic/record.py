"""Synthetic scenes as a `Capture`, in memory, as a directory, or from a cache."""

import dataclasses
import hashlib
import pathlib
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from nerfies_jax.capture import cache_files, nerfies_format
from nerfies_jax.capture.capture import Capture, CaptureError, PointCloud
from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.capture.json_files import AnyPath, new_folder
from nerfies_jax.capture.synthetic import film, trace, truth
from nerfies_jax.capture.synthetic.spec import SceneSpec
from nerfies_jax.capture.synthetic.truth import SceneTruth
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.runtime import data_parallel, events

VERSION = 3  # raise it when the same spec gives other pictures: caches then renew
TRUTH_FILE = "truth.npz"  # beside the Nerfies files, which other readers pass over


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
    plan = film.schedule(spec, seed)
    programs = truth.programs(spec, plan)
    images, depths, hits = _film(spec, plan)
    moves = np.array([thing.moves() for thing in spec.all_things()] + [False])
    moving = moves[hits.thing]  # nothing is id -1: the last row
    ids = tuple(
        f"{camera}_{instant:05d}"  # readers sort names: the rows stay in order
        for instant, camera in zip(plan.instant, plan.camera_id, strict=True)
    )
    answers = _truth(spec, plan, hits, ids, programs, seed)
    capture = Capture(
        name=f"synthetic {spec.name}",
        source="synthetic",
        ids=ids,
        images=images,
        cameras=film.noted_cameras(spec, plan, seed),
        times=plan.time,
        train=np.flatnonzero(plan.learn),
        heldout=np.flatnonzero(~plan.learn),
        near=float(0.9 * depths[depths > 0].min()),
        far=float(1.1 * depths.max()),
        warp_ids=plan.instant,
        appearance_ids=plan.instant,
        camera_ids=plan.camera_id,
        moving=moving,
        depths=depths,
        flow=_flow(plan, answers),
        points=_points(spec, plan, images, hits, moving, seed),
        background=spec.background,
        up=(0.0, 1.0, 0.0),
    )
    return capture, answers


def write(spec: SceneSpec, path: AnyPath, seed: int = 0):
    """Render a scene into a Nerfies directory with `truth.npz`, atomically.

    Args:
      spec: The scene.
      path: The directory, which may be absent or empty.
      seed: As for `make`.

    Raises:
      CaptureError: If the directory cannot be written.
    """
    with new_folder(path) as folder:  # refuses a path in use before it films
        _write_into(folder, spec, seed)


def _write_into(folder, spec, seed):
    capture, answers = make(spec, seed)
    with ThreadPoolExecutor(1) as beside:  # zlib needs no lock of Python
        saved = beside.submit(truth.save, answers, folder / TRUTH_FILE)
        with events.stage("writing the scene"):
            nerfies_format.write(capture, folder / "capture")
        for part in (folder / "capture").iterdir():
            part.rename(folder / part.name)
        (folder / "capture").rmdir()
        saved.result()


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

    kept = cache_files.read(path, load)
    if kept is None:
        try:
            with cache_files.replaced_entry(path, identity) as partial:
                _write_into(partial, spec, seed)
        except CaptureError:
            # Another process may have been quicker: then its files are as good.
            kept = cache_files.read(path, load)
            if kept is None:
                raise
        else:
            kept = load(path)
    capture, answers = kept
    name = f"synthetic {spec.name}"
    return dataclasses.replace(capture, name=name, source="synthetic"), answers


def digest(spec: SceneSpec, seed: int = 0) -> str:
    """Return the identity of a scene in a cache.

    Args:
      spec: The scene.
      seed: As for `make`.

    Returns:
      Twelve hex digits of a hash of the spec, the seed and the version of the renderer.
    """
    text = f"{VERSION} {seed} {spec!r}"
    if spec.pose_error is not None:
        text += f" {spec.pose_error!r}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _film(spec, plan):
    rows = plan.cameras, plan.time, plan.light_gain, plan.transient_shown
    images, depths, hits = [], [], []
    with events.stage("rendering the built-in scene", len(plan.time)) as stage:
        for taken in data_parallel.rows_on_devices(film.picture, spec, rows):
            images.append(np.round(taken.image * 255).astype(np.uint8))
            depths.append(taken.depth)
            hits.append(taken.hit)
            stage.advance()
    hits = jax.tree.map(lambda *leaves: np.stack(leaves), *hits)
    return np.stack(images), np.stack(depths), hits


def _points(spec, plan, images, hits, moving, seed):
    """Static points that the first camera sees, as structure from motion finds them.

    A little off, with the color of a pixel, evenly over its pictures.
    """
    rng = np.random.default_rng([seed, 4])
    still = (hits.thing != trace.NOTHING) & ~moving
    candidates = np.flatnonzero(still & plan.learn[:, None, None])
    chosen = rng.choice(candidates, min(spec.points, len(candidates)), replace=False)
    row = chosen // still[0].size
    directions = jax.vmap(film.view_direction)(
        cameras.take(plan.cameras, row), _centers_of(chosen, spec.size)
    )
    distance = hits.distance.reshape(-1)[chosen]
    exact = plan.cameras.position[row] + distance[:, None] * np.asarray(directions)
    noise = spec.point_noise * rng.normal(size=exact.shape)
    position = (exact + noise).astype(np.float32)
    return PointCloud(position, images.reshape(-1, 3)[chosen])


def _centers_of(flat, size):
    """Pixel centers of flat indices into [frames, height, width]."""
    width, height = size
    return np.stack([flat % width, flat // width % height], -1).astype(np.float32) + 0.5


def _flow(plan, answers):
    """The exact flow, row by row as in `truth.flows`."""
    rows = np.arange(len(plan.time))
    leaves = []
    for step, shift, seen in (
        (1, answers.flow_forward, answers.forward_seen),
        (-1, answers.flow_backward, answers.backward_seen),
    ):
        other = np.clip(rows + step, 0, len(rows) - 1)
        same = plan.camera_id[other] == plan.camera_id[rows]
        leaves += [shift, seen, np.where(same, other, rows).astype(np.int32)]
    return FrameFlow(*leaves)


@events.stage("computing the scene's ground truth")
def _truth(spec, plan, hits, ids, programs, seed):
    forward, backward = truth.flows(spec, plan, hits, programs)
    return SceneTruth(
        ids,
        hits.thing.astype(np.int8),
        tuple(thing.name for thing in spec.all_things()),
        hits.thing == spec.transient_id,
        forward.pixel,
        forward.seen,
        backward.pixel,
        backward.seen,
        plan.light_gain,
        *truth.tracks(spec, plan, hits, programs, seed),
    )
