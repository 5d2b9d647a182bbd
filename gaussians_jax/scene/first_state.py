"""Initial state of a scene: parameters, moments and statistics, on the host."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Key

from gaussians_jax.core import protocols, splats
from gaussians_jax.core.protocols import Strategy
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params
from gaussians_jax.init import points as initialization
from gaussians_jax.init import tracks as track_start
from gaussians_jax.motion import deformation
from gaussians_jax.scene.growth import AuxState, states_of
from gaussians_jax.scene.spec import SplatScene, carried_count, refuse_what_cannot_train
from gaussians_jax.splatting import rendering
from nerfies_jax.capture.capture import Capture, PointCloud
from nerfies_jax.capture.frame_memory import frame_bytes
from nerfies_jax.preprocessing import hidden_points, record, usable_paths, view_set
from nerfies_jax.runtime import data_parallel
from nerfies_jax.training.model import TrainState, in_default_precision

# Nothing else will ever make opaque what no camera sees: 88 %.
HIDDEN_LOGIT = 2.0


def estimate_memory_bytes(spec: SplatScene, capture: Capture) -> int:
    """Estimate the memory of the initial state and a step, without allocating it.

    Nothing is allocated. The capture's own memory is counted, too.
    """
    tracked = spec.start.motion == "tracks"
    init = initialization.of_start(spec.init, tracked)
    count = initialization.initial_count(init, capture)
    count += spec.start.moving_points if tracked else 0
    count *= 1 + (carried_count(spec) or 0)
    harmonics = 3 * (spec.sh_degree + 1) ** 2
    # Parameters, two moments, gradient, update; the tables of one projection.
    numbers = count * (5 * (11 + harmonics) + 60)
    # A chunk holds keys, rows and blending inputs of every pair.
    numbers += 16 * (spec.raster.capacity or 0)
    devices = data_parallel.device_count(spec.batch_size)
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

    Rows are padded to a capacity that `splats.capacity_for` says. `key` also becomes
    the run's own, by a split.
    """
    refuse_what_cannot_train(spec)
    rendering.refuse_distortion(capture.cameras)
    start_key, run_key = jax.random.split(key)
    seed = int(jax.random.randint(start_key, (), 0, np.iinfo(np.int32).max))
    tracked, hidden, capture = _from_tracks(spec, effects, capture, start_key)
    most = None if strategy is None else strategy.cap_max
    init = initialization.of_start(spec.init, tracked is not None, most)
    position, color = initialization.initial_points(init, capture, seed)
    if hidden is not None and most is not None:
        hidden = _thinned(hidden, most - len(position) - len(tracked.position))
    guessed = slice(len(position), len(position))
    if hidden is not None:
        position = np.concatenate([position, hidden.position])
        color = np.concatenate([color, hidden.color / 255])
        guessed = slice(guessed.start, len(position))
    if tracked is not None:
        position = np.concatenate([position, tracked.position])
        color = np.concatenate([color, tracked.color])
    rows = splats.from_points(
        position,
        color,
        degree=spec.sh_degree,
        opacity=spec.init.opacity,
        scale=spec.init.scale,
    )
    opaque = rows.opacity_logit.at[guessed].set(HIDDEN_LOGIT)
    rows = rows._replace(opacity_logit=opaque)
    rows = initialization.clamp_scales(rows, capture, spec.init.max_scale)
    count = len(position)
    params = Params({"splats": rows}, {})
    params = protocols.initialized(effects, start_key, params)
    if tracked is not None:
        params = track_start.put_in(params, effects, tracked)
    params = splats.pad_rows(params, splats.capacity_for(count, most))
    params = in_default_precision(params)
    stats = () if strategy is None else strategy.init(params.rows["splats"])
    aux_state = AuxState(stats, states_of(effects, params))
    return TrainState(
        params, optimizer.init(params), aux_state, jnp.zeros((), jnp.int32), run_key
    )


def _from_tracks(spec, effects, capture, key):
    """The start from tracks, what stands hidden, and the capture with what stands.

    Nothing of the two, and the capture as it is, where there is no such start.
    """
    evidence = usable_paths.evidence_to_start_from(capture, spec.start)
    if evidence is None:
        return None, None, capture
    seeds = track_start.start(spec.start, effects[0], evidence, capture, key)
    if len(evidence.still.position) > initialization.point_count(capture):
        capture = dataclasses.replace(capture, points=evidence.still)
    hidden = None
    if spec.start.fill_hidden and initialization.point_count(capture):
        views = view_set.in_time_order(record.looked_at(capture, evidence.factor))
        hidden = hidden_points.behind(views, capture.points, evidence.moving)
    return seeds, hidden, capture


def _thinned(points, most):
    """At most so many of them, evenly over their order."""
    count = min(max(most, 0), len(points.position))
    kept = np.linspace(0, len(points.position) - 1, count).round().astype(int)
    return PointCloud(points.position[kept], points.color[kept])


def count_rows(effects: tuple[SplatRecord, ...], state: TrainState) -> dict[str, int]:
    """Active Gaussians, and `parameters`: the numbers of rows and the networks.

    Where rows carry what is drawn, `gaussians` are those that are drawn and `rows`
    those that carry.
    """
    params = state.params
    active = int(splats.active_mask(params.rows["splats"]).sum())
    each = sum(math.prod(leaf.shape[1:]) for leaf in jax.tree.leaves(params.rows))
    nets = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(params.nets))
    counts = {
        "gaussians": active * deformation.carried_by_each(effects, params),
        "parameters": active * each + nets,
    }
    if deformation.derives(effects) is not None:
        counts["rows"] = active
    return counts
