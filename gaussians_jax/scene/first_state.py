"""Initial state of a scene: parameters, moments and statistics, on the host."""

import dataclasses
import math

import jax
import numpy as np
import optax
from jaxtyping import Array, Key

from gaussians_jax.core import components, splats
from gaussians_jax.core.protocols import Strategy
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params
from gaussians_jax.init import points as initialization
from gaussians_jax.init import tracks as track_start
from gaussians_jax.motion import deformation
from gaussians_jax.scene.growth import AuxState, states_of
from gaussians_jax.scene.spec import SplatScene, carried_count, refuse_what_cannot_train
from nerfies_jax.capture.capture import Capture, PointCloud
from nerfies_jax.capture.frame_memory import frame_bytes
from nerfies_jax.preprocessing import hidden_points, record, usable_paths, view_set
from nerfies_jax.runtime import data_parallel
from nerfies_jax.training.model import TrainState, in_default_precision

# Opacity logit of Gaussians that no camera sees and no gradient will make opaque: 88 %.
HIDDEN_LOGIT = 2.0


def estimate_memory_bytes(spec: SplatScene, capture: Capture) -> int:
    """Estimate the memory of the initial state and a step, without allocating it.

    Args:
      spec: Settings.
      capture: The capture, whose own memory is included.

    Returns:
      Memory in bytes.
    """
    uses_tracks = spec.start.motion == "tracks"
    init = initialization.of_start(spec.init, uses_tracks)
    count = initialization.initial_count(init, capture)
    count += spec.start.moving_points if uses_tracks else 0
    count *= 1 + (carried_count(spec) or 0)
    harmonics = 3 * (spec.sh_degree + 1) ** 2
    # Parameters, two moments, gradient, update, and the tables of one projection.
    numbers = count * (5 * (11 + harmonics) + 60)
    # A chunk holds keys, rows and blending inputs of every Gaussian-tile pair.
    numbers += 16 * (spec.raster.capacity or 0)
    devices = data_parallel.device_count(spec.batch_size, divisible=True)
    return 4 * numbers + frame_bytes(capture, devices)


def first_state(
    spec: SplatScene,
    strategy: Strategy | None,
    effects: tuple[SplatRecord, ...],
    optimizer: optax.GradientTransformation,
    capture: Capture,
    key: Key[Array, ""],
) -> TrainState:
    """Initialize parameters, moments and statistics, on the host.

    Args:
      spec: Settings.
      strategy: Strategy of the scene, or None.
      effects: Components of the scene.
      optimizer: The optimizer.
      capture: The capture.
      key: PRNG key. A split of it becomes the key of the run.

    Returns:
      The state, padded to a capacity (`splats.capacity_for`).

    Raises:
      ValueError: If settings contradict each other or the capture.
    """
    refuse_what_cannot_train(spec)
    start_key, run_key = jax.random.split(key)
    seed = int(jax.random.randint(start_key, (), 0, np.iinfo(np.int32).max))
    seeds, occluded_points, capture = _from_tracks(spec, effects, capture, start_key)
    most = None if strategy is None else strategy.cap_max
    init = initialization.of_start(spec.init, seeds is not None, most)
    position, color = initialization.initial_points(init, capture, seed)
    if occluded_points is not None and most is not None:
        occluded_points = _thin(
            occluded_points, most - len(position) - len(seeds.position)
        )
    hidden_rows = slice(len(position), len(position))
    if occluded_points is not None:
        position = np.concatenate([position, occluded_points.position])
        color = np.concatenate([color, occluded_points.color / 255])
        hidden_rows = slice(hidden_rows.start, len(position))
    if seeds is not None:
        position = np.concatenate([position, seeds.position])
        color = np.concatenate([color, seeds.color])
    rows = splats.from_points(
        position,
        color,
        degree=spec.sh_degree,
        opacity=spec.init.opacity,
        scale=spec.init.scale,
    )
    # In NumPy up to the padded rows. JAX would compile a program for each operation and
    # number of points, which differs between captures.
    opaque = np.array(rows.opacity_logit)
    opaque[hidden_rows] = HIDDEN_LOGIT
    rows = rows._replace(opacity_logit=jax.device_put(opaque))
    if seeds is not None:
        rows = track_start.flattened(rows, seeds.position, spec.start.thickness)
    rows = jax.tree.map(np.asarray, rows)
    rows = initialization.clamp_scales(rows, capture, spec.init.max_scale)
    count = len(position)
    params = Params({"splats": jax.device_put(rows)}, {})
    params = components.initialized(effects, start_key, params)
    if seeds is not None:
        params = track_start.put_in(params, effects, seeds)
    params = params._replace(rows=jax.tree.map(np.asarray, params.rows))
    params = splats.pad_rows(params, splats.capacity_for(count, most))
    params = in_default_precision(params)
    stats = () if strategy is None else strategy.init(params.rows["splats"])
    aux_state = AuxState(stats, states_of(effects, params))
    moments, step = jax.jit(optimizer.init)(params), jax.device_put(np.int32(0))
    return TrainState(params, moments, aux_state, step, run_key)


def _from_tracks(spec, effects, capture, key):
    """Return Gaussians from tracks, points hidden behind them, and the capture.

    The capture gets the static points of preprocessing if there are more of them than
    its own. The first two are None without an initialization from tracks.
    """
    tracking = usable_paths.evidence_to_start_from(capture, spec.start)
    if tracking is None:
        return None, None, capture
    seeds = track_start.start(spec.start, effects[0], tracking, capture, key)
    if len(tracking.static_cloud.position) > initialization.point_count(capture):
        capture = dataclasses.replace(capture, points=tracking.static_cloud)
    occluded_points = None
    if spec.start.fill_hidden and initialization.point_count(capture):
        views = view_set.in_time_order(record.downscale(capture, tracking.factor))
        occluded_points = hidden_points.behind(views, capture.points, tracking.moving)
    return seeds, occluded_points, capture


def _thin(points, most):
    """Select at most `most` points, evenly over their order."""
    count = min(max(most, 0), len(points.position))
    indices = np.linspace(0, len(points.position) - 1, count).round().astype(int)
    return PointCloud(points.position[indices], points.color[indices])


def count_rows(effects: tuple[SplatRecord, ...], state: TrainState) -> dict[str, int]:
    """Count active Gaussians and trained parameters.

    Args:
      effects: Components of the scene.
      state: State of the training.

    Returns:
      "gaussians", the number of rendered Gaussians, and "parameters", the number of
      scalars. With child Gaussians also "rows", the number of parents.
    """
    params = state.params
    active = splats.active_count(params.rows["splats"])
    each = sum(math.prod(leaf.shape[1:]) for leaf in jax.tree.leaves(params.rows))
    nets = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(params.nets))
    counts = {
        "gaussians": active * deformation.children_per_gaussian(effects, params),
        "parameters": active * each + nets,
    }
    if deformation.child_component(effects) is not None:
        counts["rows"] = active
    return counts
