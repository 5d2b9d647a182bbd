"""Fit of a motion to known 3D paths of points, before training on images.

Gradient descent on images does not find motion of more than a few pixels. Paths from
tracks do (`nerfies_jax.preprocessing`). Every motion can be fitted: its networks, its
per-Gaussian parameters and the canonical positions of the points are optimized together
on the distance between the moved points and their paths.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from gaussians_jax.core import splats
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params, Splats
from nerfies_jax.preprocessing import rigid_groups
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.updates import descended

PyTree = Any
# Of the film in each step. Built-in scene, seconds of one busy core and how far points
# are off at the end, in thousandths of the unit: of SE(3) bases, a KAN, an MLP and a
# spatially varying basis.
#   12 frames, 1500 steps     4.7 1.74     94 2.11    107 4.67    124 4.65
#    4 frames, 1500 steps     4.5 1.99     34 2.59     40 4.83     39 4.89
#    4 frames, 3000 steps     5.6 1.80     59 2.05     77 4.49     78 4.56
FRAMES_AT_ONCE = 4
SOFT = 1e-3  # of the unit: distances below it count squared
# What second and first differences from frame to frame cost in a fit in closed form, a
# path that is off by as much costing one: what is not known goes on straight and slows.
BEND, DRIFT = 0.1, 1e-3
BODIES = 8  # by which paths are brought to one moment
REST = 1.0  # what the motion of what is at rest costs, one length of the scene one
RESTING = 256  # points at rest that are looked at
# Deviation of depths from which those of the tracks are all there is, and the least
# that distances along rays count. Medians of three seeds, held out, where it moves, and
# EPE, counting alike -> so: built-in scene (deviations of 0.02) 32.02 / 28.95 dB and
# 0.0085 -> 32.35 / 29.39 and 0.0081; a bag that is handled (0.15) 27.04 / 21.68 ->
# 26.97 / 21.23, within their spread. For networks, which bind no points, 0.03 takes the
# EPE of the fit from 0.0102 to 0.0140, and 0.3 does nothing.
ALL_TRACKS, LEAST_ALONG = 0.15, 0.03
RIDGE = 1e-9  # of the trace: a basis may have a direction that changes nothing


class Resting(NamedTuple):
    """Points that are known to be at rest, with what the motion keeps for each."""

    position: Float[Array, "still 3"]  # scene units
    rows: PyTree  # of the effect; None where it keeps none


class Points(NamedTuple):
    """Points to fit, with their per-Gaussian parameters, and the networks of the
    motion.
    """

    canonical: Float[Array, "points 3"]  # scene units
    rows: PyTree  # of the effect, a row for each point; None where it keeps none
    nets: PyTree  # of the effect; None where it has none
    resting: Resting | None = None  # what the networks are to hold still


class Paths(NamedTuple):
    """Paths of points over a video, on the host."""

    times: Float[np.ndarray, " frames"]  # in [0, 1]
    position: Float[np.ndarray, "points frames 3"]  # scene units
    known: Bool[np.ndarray, "points frames"]
    unit: float  # a typical distance of the scene, scene units
    still: Float[np.ndarray, "still 3"] | None = None  # points at rest, scene units
    depth: "Depth | None" = None  # None: places are known alike in all directions


class Depth(NamedTuple):
    """Uncertainty of the points' depth relative to that of their image position."""

    ray: Float[np.ndarray, "points frames 3"]  # of length one, from the camera
    deviation: Float[np.ndarray, " points"]  # as a share of it


class Guess(NamedTuple):
    """Initialization of a fit, as `Motion.fit` of a motion returns it."""

    points: Points
    rates: Points  # a prefix of `points`, in units of `StartSpec.fit_rate`
    # Of the points, and of the times that the fit looks at just now.
    penalty: Callable[[Points, Array], Float[Array, ""]] | None = None
    rigid: bool = False  # whether points are bound to others, and so are their depths


class PathFit(NamedTuple):
    """The fitted points, and the mean distance they are off before and after."""

    points: Points
    first: float  # scene units
    last: float


def mean_places(paths: Paths) -> Float[np.ndarray, "points 3"]:
    """The mean of the places where each point is known."""
    weight = paths.known[..., None].astype(float)
    total = np.sum(np.where(weight > 0, paths.position, 0), axis=1)
    return total / np.maximum(np.sum(weight, axis=1), 1)


def places_at_one_moment(paths: Paths) -> Float[np.ndarray, "points 3"]:
    """Compute the position of each point in the middle of the video, as part of a rigid
    body.

    Means over a path lie together where a body turns; these are as far apart as the
    points are. Host side.
    """
    label = rigid_groups.labels(paths.position, paths.known, BODIES)
    middle = len(paths.times) // 2
    bodies = rigid_groups.motion(paths.position, paths.known, label, middle)
    return rigid_groups.centers(paths.position, paths.known, bodies)[0]


def along(deviation: Float[np.ndarray, " points"]) -> Float[np.ndarray, " points"]:
    """Weight distances along the ray, relative to 1 for those across, of rigid points.

    By the deviation of a point's depth. Where the film tells depth, a thing's own size
    and turn tell it better than each track of it by itself; where it does not, nothing
    but the tracks holds the thing at its distance. Host side.
    """
    return np.clip((deviation / ALL_TRACKS) ** 2, LEAST_ALONG, 1.0)


def resting(paths: Paths) -> Float[Array, "still 3"] | None:
    """Sample static points in scene units; None if none are known."""
    if paths.still is None or not len(paths.still):
        return None
    chosen = np.random.default_rng(0).permutation(len(paths.still))[:RESTING]
    return jnp.asarray(paths.still[chosen], jnp.float32)


def rest_loss(
    moved: Callable[[Float[Array, ""]], tuple[Array, Array]],
    unit: float,
    times: Float[Array, " times"],
) -> Float[Array, ""]:
    """Penalize the motion of static points, as a mean over the times.

    `moved(time)` gives what is zero where they do not turn [points, any], the vector of
    a quaternion or of a rotation, and shifts [points, 3]; the latter count in units.
    Softened near zero as the distances of `fit` are.
    """

    def one(time):
        turn, shift = moved(time)
        total = jnp.sum(turn**2, axis=1) + jnp.sum((shift / unit) ** 2, axis=1)
        return jnp.mean(jnp.sqrt(total + SOFT**2))

    return REST * jnp.mean(jax.vmap(one)(times))


def combination(
    basis: Float[np.ndarray, "frames count"], paths: Paths
) -> Float[np.ndarray, "points count 3"]:
    """Fit coefficients of functions of time to each path, on the host.

    Weighted least squares of each path by itself, in closed form: the squared distances
    where it is known, `BEND` and `DRIFT` times the squared differences everywhere. The
    constant must be among what the functions combine to.
    """
    bend, drift = np.diff(basis, 2, axis=0), np.diff(basis, axis=0)
    stiff = BEND * bend.T @ bend + DRIFT * drift.T @ drift
    stiff += RIDGE * np.eye(basis.shape[1]) * np.trace(basis.T @ basis)
    weight = paths.known.astype(float)
    middle = mean_places(paths)[:, None]
    # About the mean place: the ridge pulls there and not to the origin.
    toward = np.where(paths.known[..., None], paths.position - middle, 0)
    normal = np.einsum("tk,nt,tl->nkl", basis, weight, basis, optimize=True) + stiff
    right = np.einsum("tk,ntc->nkc", basis, toward)
    constant = np.linalg.lstsq(basis, np.ones(len(basis)), rcond=None)[0]
    return np.linalg.solve(normal, right) + constant[:, None] * middle


def guess(effect: SplatRecord, paths: Paths, key: Key[Array, ""]) -> Guess:
    """Return the motion's own guess, or points in the middle of the video.

    What is known to be at rest is held there where networks move all alike: else they
    would move that as well, and the scene bend to follow.
    """
    if effect.fit_to_paths is not None:
        return effect.fit_to_paths(paths, key)
    canonical = jnp.asarray(places_at_one_moment(paths), jnp.float32)
    own = _initialized(effect, canonical, key)
    still, still_rows = None, None
    if own.shared is not None:
        still = resting(paths)
    if still is not None:
        # All from one draw, those at rest behind.
        both = jnp.concatenate([canonical, still])
        own, count = _initialized(effect, both, key), len(canonical)
        still_rows = jax.tree.map(lambda leaf: leaf[count:], own.per_gaussian)
        rows = jax.tree.map(lambda leaf: leaf[:count], own.per_gaussian)
        own = own._replace(per_gaussian=rows)
    rows, nets = own
    row_rate = None if rows is None else 1.0
    points = Points(canonical, rows, nets)
    rates = Points._make((paths.unit, row_rate, None if nets is None else 0.4, None))
    if still is None:
        return Guess(points, rates)
    return Guess(
        points._replace(resting=Resting(still, still_rows)),
        rates._replace(resting=Resting._make((0.0, row_rate))),
        _unrest_of(effect, paths.unit),
    )


def _initialized(effect, places, key):
    """The first parameters of a motion whose Gaussians are at these places."""
    blank = scene_of(effect, Points(places, None, None))
    return effect.init(key, blank.rows["splats"])


def _unrest_of(effect, unit):
    """(points, times) -> how far their networks move what is at rest."""

    def penalty(points, times):
        still, rows = points.resting
        deformed = _deformer(effect, Points(still, rows, points.nets))

        def moved(time):
            now = deformed(time)
            return now.quaternion[:, 1:], now.mean - still

        return rest_loss(moved, unit, times)

    return penalty


def scene_of(effect: SplatRecord, points: Points) -> Params:
    """The points as Gaussians of a scene that has this effect alone."""
    count, kind = len(points.canonical), points.canonical.dtype
    rows = Splats(
        mean=points.canonical,
        log_scale=jnp.zeros((count, 3), kind),
        quaternion=jnp.tile(jnp.asarray([1, 0, 0, 0], kind), (count, 1)),
        opacity_logit=jnp.zeros(count, kind),
        sh_dc=jnp.zeros((count, 1, 3), kind),
        sh_rest=jnp.zeros((count, 0, 3), kind),
    )
    own = {} if points.rows is None else {effect.name: points.rows}
    nets = {} if points.nets is None else {effect.name: points.nets}
    return Params({"splats": rows, **own}, nets)


def places(
    effect: SplatRecord, points: Points, time: Float[Array, ""]
) -> Float[Array, "points 3"]:
    """Compute the positions to which the motion carries the points at a time."""
    return _deformer(effect, points)(time).mean


def _deformer(effect, points):
    """Return a function from time to the points as moved Gaussians, initially
    unrotated.
    """
    params = scene_of(effect, points)
    ready = None if effect.prepare is None else effect.prepare(params)
    still = splats.activate(params.rows["splats"])
    return lambda time: effect.deform(params, still, FrameCondition(time), ready)


def fit(
    effect: SplatRecord,
    paths: Paths,
    key: Key[Array, ""],
    *,
    rate: float = 5e-3,
    steps: int = 3000,
) -> PathFit:
    """Optimize the distance to the known parts of paths, from a guess.

    The distance is softened near zero and not squared, so that single wrong paths bend
    nothing; a rigid guess counts less of it along the rays (`along`). The guess's
    penalty is added to the mean distance over the unit. ValueError where no place is
    known.
    """
    times, position, known, unit, _, depth = paths
    if not known.any():
        raise ValueError("no path is known anywhere: nothing to fit a motion to")
    start, rates, penalty, rigid = guess(effect, paths, key)
    rates = jax.tree.map(lambda share: rate * share, rates)
    target = jnp.asarray(np.moveaxis(np.where(known[..., None], position, 0), 1, 0))
    target = target.astype(start.canonical.dtype)
    weight = jnp.asarray(known.T, target.dtype)
    # How much less than across the rays a distance along them counts.
    loose = jnp.zeros_like(target)
    if rigid and depth is not None:
        less = np.sqrt(1 - along(depth.deviation))[:, None, None] * depth.ray
        less = np.moveaxis(np.where(known[..., None], less, 0), 1, 0)
        loose = jnp.asarray(less, target.dtype)
    moments = jnp.asarray(times, target.dtype)
    together = min(FRAMES_AT_ONCE, len(times))

    def distance(points, frames):
        def one(time, target, weight, loose):
            off = places(effect, points, time) - target
            off = off - jnp.sum(off * loose, axis=-1, keepdims=True) * loose
            length = jnp.sqrt(jnp.sum(off**2, axis=-1) + (SOFT * unit) ** 2)
            return jnp.sum(length * weight)

        seen = target[frames], weight[frames], loose[frames]
        total = jnp.sum(jax.vmap(one)(moments[frames], *seen))
        return total / jnp.maximum(jnp.sum(weight[frames]), 1)

    def loss(points, key):
        frames = jax.random.choice(key, len(times), (together,), replace=False)
        value = distance(points, frames) / unit
        return value if penalty is None else value + penalty(points, moments[frames])

    every = jnp.arange(len(times))
    mean_distance = jax.jit(lambda points: distance(points, every))
    fitted = descended(loss, start, rates, key, steps)
    return PathFit(fitted, float(mean_distance(start)), float(mean_distance(fitted)))
