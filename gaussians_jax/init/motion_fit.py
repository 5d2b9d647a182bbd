"""Fit of a motion to known 3D paths of points, before training on images.

Gradient descent on images does not find motion of more than a few pixels. Paths from
tracks do (`nerfies_jax.preprocessing`). Every motion can be fitted: its shared and
per-Gaussian parameters and the canonical positions of the points are optimized together
to minimize the distance between the moved points and their paths.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import Number
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params, Splats
from nerfies_jax.preprocessing import rigid_groups
from nerfies_jax.training import programs
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.updates import minimize

PyTree = Any
# Number of frames in each step. Built-in scene, seconds on one busy core and the final
# mean error of the points in 1e-3 scene units, for SE(3) bases, a KAN, an MLP and a
# spatially varying basis:
#   12 frames, 1500 steps     4.7 1.74     94 2.11    107 4.67    124 4.65
#    4 frames, 1500 steps     4.5 1.99     34 2.59     40 4.83     39 4.89
#    4 frames, 3000 steps     5.6 1.80     59 2.05     77 4.49     78 4.56
FRAMES_AT_ONCE = 4
SOFT = 1e-3  # of the unit: smaller distances count quadratically
# Weights of squared second and first differences between frames in closed-form fits,
# relative to squared distances from the path. Where a path is not known, its velocity
# stays almost constant and decays slowly.
BEND, DRIFT = 0.1, 1e-3
BODIES = 8  # number of rigid bodies that move paths to the middle of the video
REST = 1.0  # weight of the motion of static points, in scene units
RESTING = 256  # number of static points in the loss
# Relative deviation of the depths from which distances along rays have full weight, and
# their smallest weight. Medians of three seeds, held-out PSNR, PSNR in moving regions,
# and endpoint error (EPE), full weight -> this weight: built-in scene (deviations of
# 0.02) 32.02 / 28.95 dB and 0.0085 -> 32.35 / 29.39 and 0.0081. A bag that is handled
# (0.15) 27.04 / 21.68 -> 26.97 / 21.23, within their spread. For networks, which do not
# bind points rigidly, 0.03 increases the EPE of the fit from 0.0102 to 0.0140, and 0.3
# has no effect.
ALL_TRACKS, LEAST_ALONG = 0.15, 0.03
RIDGE = 1e-9  # of the trace, for directions of a basis that have no effect


class Resting(NamedTuple):
    """Points that are known to be static, with the motion's parameters for each."""

    position: Float[Array, "static 3"]  # scene units
    rows: PyTree  # per-Gaussian parameters of the motion, or None


class Points(NamedTuple):
    """Points to fit, with the parameters of the motion."""

    canonical: Float[Array, "points 3"]  # scene units
    rows: PyTree  # per-Gaussian parameters of the motion, or None
    nets: PyTree  # shared parameters of the motion, or None
    resting: Resting | None = None  # static points, on which motion is penalized


class Paths(NamedTuple):
    """Paths of points over a video, on the host."""

    times: Float[np.ndarray, " frames"]  # in [0, 1]
    position: Float[np.ndarray, "points frames 3"]  # scene units
    known: Bool[np.ndarray, "points frames"]
    unit: float  # a typical distance in the scene, scene units
    static: Float[np.ndarray, "static 3"] | None = None  # static points, scene units
    depth: "Depth | None" = None  # None: equally accurate in all directions


class Depth(NamedTuple):
    """Uncertainty of the depth of points, compared with their image position."""

    ray: Float[np.ndarray, "points frames 3"]  # unit vectors from the camera
    deviation: Float[np.ndarray, " points"]  # as a share of the depth


class Guess(NamedTuple):
    """Initialization of a fit, as returned by `Motion.fit`."""

    points: Points
    rates: Points  # a prefix of `points`, in units of `StartSpec.fit_rate`
    # Loss of the points at the times of a step.
    penalty: Callable[[Points, Array], Float[Array, ""]] | None = None
    rigid: bool = False  # True if points move rigidly together, and so do their depths


class PathFit(NamedTuple):
    """The fitted points, and their mean distance from the paths before and after."""

    points: Points
    first: float  # scene units
    last: float


def _mean_positions(paths: Paths) -> Float[np.ndarray, "points 3"]:
    """Compute the mean of the known positions of each point."""
    weight = paths.known[..., None].astype(float)
    total = np.sum(np.where(weight > 0, paths.position, 0), axis=1)
    return total / np.maximum(np.sum(weight, axis=1), 1)


def positions_at_middle(paths: Paths) -> Float[np.ndarray, "points 3"]:
    """Compute the positions of points in the middle of the video, by rigid bodies.

    Means over a path would be too close together for a rotating body. Host side.

    Args:
      paths: The paths.

    Returns:
      [points, 3] positions.
    """
    label = rigid_groups.labels(paths.position, paths.known, BODIES)
    middle = len(paths.times) // 2
    bodies = rigid_groups.motion(paths.position, paths.known, label, middle)
    return rigid_groups.centers(paths.position, paths.known, bodies)[0]


def along(deviation: Float[np.ndarray, " points"]) -> Float[np.ndarray, " points"]:
    """Compute the weight of distances along the ray for rigid points.

    The weight depends on the relative deviation of a point's depth. If the video
    determines depth, the size and rotation of an object determine its depth better than
    each of its tracks. If it does not, only the tracks keep the object at its distance.
    Host side.

    Args:
      deviation: Deviation of the depth as a share of the depth.

    Returns:
      Weights relative to 1 for distances across the ray.
    """
    return np.clip((deviation / ALL_TRACKS) ** 2, LEAST_ALONG, 1.0)


def resting(paths: Paths) -> Float[Array, "static 3"] | None:
    """Sample static points in scene units. None if none are known.

    Args:
      paths: Paths of tracks, with static points.

    Returns:
      At most `RESTING` points, in units of the capture.
    """
    if paths.static is None or not len(paths.static):
        return None
    sample = np.random.default_rng(0).permutation(len(paths.static))[:RESTING]
    return captured(paths.static[sample])


def rest_loss(
    motion: Callable[[Float[Array, ""]], tuple[Array, Array]],
    unit: Number,
    times: Float[Array, " times"],
) -> Float[Array, ""]:
    """Compute a penalty on the motion of static points, the mean over the times.

    It is smooth near zero like the distances of `fit`.

    Args:
      motion: Function of a time that returns rotations [points, any], as the vector
        of a quaternion or a rotation vector, and translations [points, 3] in scene
        units.
      unit: Unit of the translations in scene units.
      times: Normalized times.

    Returns:
      The penalty.
    """

    def at_time(time):
        turn, shift = motion(time)
        total = jnp.sum(turn**2, axis=1) + jnp.sum((shift / unit) ** 2, axis=1)
        return jnp.mean(jnp.sqrt(total + SOFT**2))

    return REST * jnp.mean(jax.vmap(at_time)(times))


def combination(
    basis: Float[np.ndarray, "frames count"], paths: Paths
) -> Float[np.ndarray, "points count 3"]:
    """Fit coefficients of functions of time to each path, on the host.

    The fit is a closed-form weighted least squares for each path: squared distances
    where it is known, plus `BEND` and `DRIFT` times squared differences everywhere.

    Args:
      basis: Values of the functions. Their span must contain the constant.
      paths: The paths.

    Returns:
      The coefficients.
    """
    bend, drift = np.diff(basis, 2, axis=0), np.diff(basis, axis=0)
    stiff = BEND * bend.T @ bend + DRIFT * drift.T @ drift
    stiff += RIDGE * np.eye(basis.shape[1]) * np.trace(basis.T @ basis)
    weight = paths.known.astype(float)
    middle = _mean_positions(paths)[:, None]
    # Relative to the mean position, so that the ridge does not pull to the origin.
    offset = np.where(paths.known[..., None], paths.position - middle, 0)
    normal = np.einsum("tk,nt,tl->nkl", basis, weight, basis, optimize=True) + stiff
    projection = np.einsum("tk,ntc->nkc", basis, offset)
    constant = np.linalg.lstsq(basis, np.ones(len(basis)), rcond=None)[0]
    return np.linalg.solve(normal, projection) + constant[:, None] * middle


def _guess(effect: SplatRecord, paths: Paths, key: Key[Array, ""]) -> Guess:
    """Return the motion's own initialization, or points in the middle of the video.

    If the motion has shared parameters, motion of static points is penalized. Otherwise
    they would move as well, and the scene would deform to compensate.
    """
    if effect.fit_to_paths is not None:
        return effect.fit_to_paths(paths, key)
    canonical = captured(positions_at_middle(paths))
    params = _initialize(effect, canonical, key)
    static, static_rows = None, None
    if params.shared is not None:
        static = resting(paths)
    if static is not None:
        # Parameters of all points from one initialization, static ones last.
        all_points = jnp.concatenate([canonical, static])
        params, count = _initialize(effect, all_points, key), len(canonical)
        static_rows = jax.tree.map(lambda leaf: leaf[count:], params.per_gaussian)
        rows = jax.tree.map(lambda leaf: leaf[:count], params.per_gaussian)
        params = params._replace(per_gaussian=rows)
    rows, nets = params
    row_rate = None if rows is None else 1.0
    points = Points(canonical, rows, nets)
    rates = Points._make((paths.unit, row_rate, None if nets is None else 0.4, None))
    if static is None:
        return Guess(points, rates)
    return Guess(
        points._replace(resting=Resting(static, static_rows)),
        rates._replace(resting=Resting._make((0.0, row_rate))),
        _unrest_of(effect, captured(paths.unit)),
    )


def captured(values: Any) -> Array:
    """Move numbers of a capture to the device, for functions that capture them.

    Fits take captured arrays as arguments (`programs.with_captured`).

    Args:
      values: Numbers or an array on the host.

    Returns:
      The array, in float32 like the points of a fit.
    """
    return jax.device_put(np.asarray(values, np.float32))


def _initialize(effect, positions, key):
    """Initialize the parameters of a motion for Gaussians at these positions."""
    blank = scene_of(effect, Points(positions, None, None))
    return effect.init(key, blank.rows["splats"])


def _unrest_of(effect, unit):
    """Return the penalty (points, times) on the motion of static points."""

    def penalty(points, times):
        static, rows = points.resting
        deform = _deformer(effect, Points(static, rows, points.nets))

        def motion(time):
            gaussians = deform(time)
            return gaussians.quaternion[:, 1:], gaussians.mean - static

        return rest_loss(motion, unit, times)

    return penalty


def scene_of(effect: SplatRecord, points: Points) -> Params:
    """Return a scene with the points as Gaussians and this motion only.

    Args:
      effect: The motion.
      points: The points, with parameters of the motion.

    Returns:
      Parameters of the scene.
    """
    count, dtype = len(points.canonical), points.canonical.dtype
    rows = Splats(
        mean=points.canonical,
        log_scale=jnp.zeros((count, 3), dtype),
        quaternion=jnp.tile(jnp.asarray([1, 0, 0, 0], dtype), (count, 1)),
        opacity_logit=jnp.zeros(count, dtype),
        sh_dc=jnp.zeros((count, 1, 3), dtype),
        sh_rest=jnp.zeros((count, 0, 3), dtype),
    )
    params = {} if points.rows is None else {effect.name: points.rows}
    nets = {} if points.nets is None else {effect.name: points.nets}
    return Params({"splats": rows, **params}, nets)


def positions_at(
    effect: SplatRecord, points: Points, time: Float[Array, ""]
) -> Float[Array, "points 3"]:
    """Compute the positions of the moved points at a time.

    Args:
      effect: The motion.
      points: The points, with parameters of the motion.
      time: Normalized time.

    Returns:
      Positions in scene units.
    """
    return _deformer(effect, points)(time).mean


def _deformer(effect, points):
    """Return a function from time to the moved points, as unrotated Gaussians."""
    params = scene_of(effect, points)
    cache = None if effect.prepare is None else effect.prepare(params)
    canonical = splats.activate(params.rows["splats"])
    return lambda time: effect.deform(params, canonical, FrameCondition(time), cache)


def fit(
    effect: SplatRecord,
    paths: Paths,
    key: Key[Array, ""],
    *,
    rate: float = 5e-3,
    steps: int = 3000,
) -> PathFit:
    """Minimize the distance to the known parts of paths, from an initialization.

    The distance is smooth near zero and not squared, so that single wrong paths have
    little influence. If points move rigidly, distances along rays have a lower weight
    (`along`). The penalty of the initialization is added to the mean distance, in
    `unit`s. Points are padded to a bucket (`splats.capacity_for`).

    Args:
      effect: The motion.
      paths: The paths.
      key: PRNG key.
      rate: Learning rate.
      steps: Number of Adam steps.

    Returns:
      The fit.

    Raises:
      ValueError: If no position is known.
    """
    effect = programs.with_numbers(effect, jax.tree.map(captured, effect.numbers))
    times, position, valid, _, _, depth = paths
    if not valid.any():
        raise ValueError("no path has a known position; a motion cannot be fitted")
    start, rates, penalty, rigid = _guess(effect, paths, key)
    rates = jax.tree.map(lambda relative: rate * relative, rates)
    size = len(position)
    start = padded(start)

    def by_frame(values):
        masked_values = np.where(valid[..., None], values, 0)
        padding = len(start.canonical) - size
        return captured(
            np.moveaxis(np.pad(masked_values, [(0, padding), (0, 0), (0, 0)]), 1, 0)
        )

    target, weight = by_frame(position), by_frame(valid[..., None])[..., 0]
    # Component along the rays to remove from the distances.
    along_ray = np.zeros(position.shape)
    if rigid and depth is not None:
        along_ray = np.sqrt(1 - along(depth.deviation))[:, None, None] * depth.ray
    ray_part, frame_times = by_frame(along_ray), captured(times)
    unit = captured(paths.unit)
    count = min(FRAMES_AT_ONCE, len(times))

    def distance(points, frames):
        def frame_distance(time, target, weight, ray_part):
            offset = positions_at(effect, points, time) - target
            offset = (
                offset - jnp.sum(offset * ray_part, axis=-1, keepdims=True) * ray_part
            )
            length = jnp.sqrt(jnp.sum(offset**2, axis=-1) + (SOFT * unit) ** 2)
            return jnp.sum(length * weight)

        observations = target[frames], weight[frames], ray_part[frames]
        total = jnp.sum(jax.vmap(frame_distance)(frame_times[frames], *observations))
        return total / jnp.maximum(jnp.sum(weight[frames]), 1)

    def loss(points, key):
        frames = jax.random.choice(key, len(times), (count,), replace=False)
        value = distance(points, frames) / unit
        return (
            value if penalty is None else value + penalty(points, frame_times[frames])
        )

    all_frames = np.arange(len(times))
    separate, arrays = programs.with_captured(lambda p: distance(p, all_frames), start)
    mean_distance = jax.jit(separate)
    solution = minimize(loss, start, rates, key, steps)
    first, last = (float(mean_distance(arrays, p)) for p in (start, solution))
    return PathFit(_take(solution, slice(size)), first, last)


def padded(points: Points) -> Points:
    """Repeat the last point up to a bucket, so that captures share programs.

    Args:
      points: The points, at least one.

    Returns:
      The points, as many as `splats.capacity_for` says.
    """
    count = len(points.canonical)
    return _take(points, np.minimum(np.arange(splats.capacity_for(count)), count - 1))


def _take(points, selection):
    """Select points with their parameters, in NumPy, which compiles nothing."""

    def take(leaf):
        return jax.device_put(np.asarray(leaf)[selection])

    rows = None if points.rows is None else jax.tree.map(take, points.rows)
    return points._replace(canonical=take(points.canonical), rows=rows)
