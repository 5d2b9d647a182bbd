"""What a trained scene is measured by; one protocol for all.

Pictures of held-out frames; where the truth is known also their depth, what moves in
them, and points followed through time by the learned motion. Everything that is
reported is in scene units.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial

from experiments import evaluate
from experiments.evaluate import Renderer, Scored
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.synthetic import SceneTruth
from nerfies_jax.measure import geometry_quality, image_quality
from nerfies_jax.training.model import TrainState, in_default_precision

CORRECT_WITHIN = 0.01  # scene units: a quarter of the default cube's half-side
STILL_POINTS = 500  # of the capture's static points, to see whether they drift
LEAST_STRETCH = 1e-6  # a collapsed direction has a logarithm, too
NEIGHBOURS = 8  # Gaussians that carry a point
LEAST_OPACITY = 0.05  # of a Gaussian that can carry one; fainter ones are not seen


# What only a truth can score.
EXACT = (
    "moving_psnr",
    "moving_ssim",
    "depth_median",
    "depth_rmse",
    "moving_depth_median",
    "moving_depth_rmse",
)


class Known(NamedTuple):
    """What all arms are held against; NumPy. Without a truth there are no tracks."""

    rows: np.ndarray  # held-out frames of the capture that are rendered
    moments: np.ndarray  # frames learnt from, in time: when points are looked for
    path: np.ndarray  # [tracks, moments, 3] where they are, scene units
    seen: np.ndarray  # [tracks, moments] whether the camera that is learnt from sees it
    # The moment from which points are followed: the middle one. D-NeRF's template is
    # what it sees at time 0, and its warp jumps there.
    start: int
    exact: bool = True  # whether depth and what moves are known, too

    @property
    def start_points(self) -> np.ndarray:
        """[tracks, 3] where the points are known to be, scene units."""
        return self.path[:, self.start]


class Followed(NamedTuple):
    """Points as a learned warp moves them."""

    path: np.ndarray  # [tracks, moments, 3] scene units; the start where not found
    found: np.ndarray  # [tracks, moments] bool
    # Mean distance of static points in the template from where they are on average;
    # where that is does not matter: a template may lie anywhere. Gaussians have no
    # template: the distance is that of the points themselves. Scene units.
    drift: float
    # Root mean square of ||log Σ|| of the Jacobian at the true points; NaN where there
    # is no Jacobian.
    strain: float


def known(capture: Capture, truth: SceneTruth, frames: int, tracks: int) -> Known:
    """At most `frames` held-out frames and `tracks` points seen at the start.

    Raises ValueError where the truth is not that of the capture.
    """
    if truth.ids != capture.ids:
        raise ValueError(
            f"{capture.name}: the truth has other frames than the capture; make the "
            "scene again"
        )
    moments = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    last = truth.track_world.shape[1] - 1
    instants = np.round(capture.times[moments] * last).astype(int)
    if np.abs(instants - capture.times[moments] * last).max() > 1e-3:
        raise ValueError(
            f"{capture.name}: its frames lie between the {last + 1} instants of the "
            "truth; make the scene again"
        )
    start = len(moments) // 2
    chosen = np.flatnonzero(truth.track_seen[:, moments[start]])
    if len(chosen):
        chosen = evaluate.spread(chosen, tracks)
    world = (truth.track_world[chosen] - np.float32(capture.centre)) * capture.scale
    return Known(
        rows=evaluate.spread(capture.heldout, frames),
        moments=moments,
        path=world[:, instants].astype(np.float32),
        seen=truth.track_seen[chosen][:, moments],
        start=start,
    )


def filmed(capture: Capture, frames: int) -> Known:
    """What is known of a real capture: how at most `frames` held-out frames look.

    Its depths and masks, if it has any, are estimates, and nothing is judged by them.
    """
    if not len(capture.heldout):
        raise ValueError(
            f"{capture.name}: no held-out frames to judge by; choose some with "
            "--heldout, as --heldout 8 for every eighth"
        )
    moments = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    return Known(
        rows=evaluate.spread(capture.heldout, frames),
        moments=moments,
        path=np.zeros((0, len(moments), 3), np.float32),
        seen=np.zeros((0, len(moments)), bool),
        start=len(moments) // 2,
        exact=False,
    )


def score_pictures(
    renderer: Renderer, state: TrainState, capture: Capture, known: Known
) -> tuple[Scored, dict[str, float]]:
    """The held-out frames as rendered, and their scores, also of what moves alone.

    What is not known is NaN.
    """
    scored = evaluate.score(renderer, state, capture, known.rows)
    numbers = {"psnr": float(scored.psnr.mean()), "ssim": float(scored.ssim.mean())}
    if known.exact:
        return scored, numbers | _score_truth(scored, capture, known)
    return scored, numbers | dict.fromkeys(EXACT, float("nan"))


def _score_truth(scored, capture, known):
    truth, moving = capture.depths[known.rows], capture.moving[known.rows]
    parts = [
        jax.device_get(_score_moving(colour, capture.images[row], capture.moving[row]))
        for row, colour in zip(known.rows, scored.colour, strict=True)
        if capture.moving[row].any()
    ]
    psnr, ssim = np.mean(parts, axis=0) if parts else (np.nan, np.nan)
    numbers = {"moving_psnr": psnr, "moving_ssim": ssim}
    depth, truth = jnp.asarray(scored.depth), jnp.asarray(truth)
    for name, mask in (("", np.ones_like(moving)), ("moving_", moving)):
        mask = jnp.asarray(mask)
        compared = geometry_quality.known_depth(depth, truth, mask)
        error = np.abs(np.asarray(depth - truth))[np.asarray(compared)]
        numbers[f"{name}depth_median"] = np.median(error) if error.size else np.nan
        errors = geometry_quality.depth_errors(depth, truth, mask)
        numbers[f"{name}depth_rmse"] = errors.rmse
    return {name: float(value) for name, value in numbers.items()}


@jax.jit
def _score_moving(colour, truth, moving):
    picture = image_quality.quantise(colour)
    truth = truth.astype(colour.dtype) / 255
    return (
        image_quality.masked_psnr(picture, truth, moving),
        image_quality.masked_ssim(picture, truth, moving),
    )


def score_tracks(known: Known, followed: Followed | None) -> dict[str, float]:
    """End-point errors over the seen points of all moments but the start.

    Without anything followed, or anything to follow, all are NaN.
    """
    names = ("track_error", "track_correct", "track_lost", "drift", "strain")
    if followed is None or not len(known.path):
        return dict.fromkeys(names, float("nan"))
    errors = _endpoints(followed.path, known)
    lost = 1 - followed.found[_scored(known)].mean()
    values = (errors.endpoint, errors.correct, lost, followed.drift, followed.strain)
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def still_error(known: Known) -> float:
    """The end-point error of points that are said not to move; NaN without any."""
    if not len(known.path):
        return float("nan")
    return float(
        _endpoints(
            np.broadcast_to(known.start_points[:, None], known.path.shape), known
        )[0]
    )


def _scored(known):
    """Seen, and not given."""
    scored = known.seen.copy()
    scored[:, known.start] = False
    return scored


def _endpoints(path, known):
    return geometry_quality.track_errors(
        jnp.asarray(path),
        jnp.asarray(known.path),
        jnp.asarray(_scored(known)),
        CORRECT_WITHIN,
    )


# (spec, facts, state, capture, known) -> None where nothing is warped
Follow = Callable[[Any, Any, TrainState, Capture, Known], Followed | None]


def follow_fields(spec, facts, state, capture, known) -> Followed | None:
    """Points of the start at all other moments, through the template of a field.

    A point goes to the template by the warp of the start, and from there by the inverse
    warp of every other moment.
    """
    from nerfies_jax import scene
    from nerfies_jax.effects.effect import Moment
    from nerfies_jax.training import tracks

    made = scene.field(spec, facts)
    if all(effect.displace is None for effect in made.effects) or not len(known.path):
        return None
    views = [evaluate.view_of(capture, int(row)) for row in known.moments]
    views = jax.tree.map(lambda *leaves: jnp.stack(leaves), *views)
    centre = np.asarray(facts.centre, np.float32)

    def to_field(points):
        return in_default_precision((points - centre) * np.float32(facts.scale))

    still = np.zeros((0, 3), np.float32)
    if capture.points is not None:
        still = capture.points.position[:STILL_POINTS]

    @jax.jit
    def solve(params, step, start, true, still):
        def moment_of(view):
            return Moment(view.time, made.codes_at(params, view), step)

        moments = jax.vmap(moment_of)(views)
        followed = tracks.point_tracks(
            made.displace, params, start, moments, known.start
        )
        each = jax.vmap(made.displace, (None, 0, None))  # point
        moved = jax.vmap(each, (None, None, 0))(params, still, moments)
        slope = jax.vmap(jax.jacfwd(made.displace, 1), (None, 0, None))
        slopes = jax.vmap(slope, (None, 1, 0))(params, true, moments)
        apart = jnp.linalg.norm(moved - jnp.mean(moved, axis=0), axis=-1)
        return followed, apart, slopes

    followed, apart, slopes = jax.device_get(
        solve(
            state.params,
            state.step,
            to_field(known.start_points),
            to_field(known.path),
            to_field(still),
        )
    )
    path = followed.points / np.float32(facts.scale) + centre
    still_path = known.start_points[:, None]
    path = np.where(followed.converged[..., None], path, still_path)
    stretch = np.linalg.svd(np.eye(3) + slopes.astype(float), compute_uv=False)
    strain = np.log(np.maximum(stretch, LEAST_STRETCH))
    return Followed(
        path=path.astype(np.float32),
        found=followed.converged,
        drift=float(apart.mean() / facts.scale) if apart.size else float("nan"),
        strain=float(np.sqrt(np.mean(np.sum(strain**2, axis=-1)))),
    )


def follow_splats(spec, facts, state, capture, known) -> Followed | None:
    """Points of the start at all other moments, carried by the Gaussians around them.

    A point moves as the `NEIGHBOURS` nearest Gaussians that can be seen do on average,
    where they are at the start; `neighbour_weights` says how much each counts. This
    tells where what is drawn at a point goes. It cannot tell whether these Gaussians
    stand for the point: beside a silhouette some belong to what is behind it, and where
    Gaussians fade in and out instead of moving, a point stays. The average of a turn is
    exact at the mean of the neighbours, and off by the turn of the way from there.
    Every point is carried by something, so none is lost; between Gaussians there is no
    Jacobian, so no strain.
    """
    from gaussians_jax import scene, splats

    effects = scene.effects_of(spec, facts)
    if all(effect.deform is None for effect in effects) or not len(known.path):
        return None
    stages = scene.build(spec, facts).stages
    prepared = jax.jit(stages.prepare)(state.params)
    pose = jax.jit(lambda params, ready, time: stages.pose(params, ready, time))
    times = in_default_precision(capture.times[known.moments])
    # [moments, gaussians, 3]
    means = np.stack(
        [np.asarray(pose(state.params, prepared, time).mean) for time in times]
    )
    first = pose(state.params, prepared, times[known.start])
    active = np.asarray(splats.active_mask(state.params.rows["splats"]))
    opacity = np.where(active, np.asarray(first.opacity), 0.0)
    path = carried(known.start_points, means, opacity, known.start)
    drift = float("nan")
    if capture.points is not None:
        still = capture.points.position[:STILL_POINTS]
        still = carried(still, means, opacity, known.start)
        apart = still - still.mean(axis=1, keepdims=True)
        drift = float(np.linalg.norm(apart, axis=-1).mean())
    return Followed(
        path=path.astype(np.float32),
        found=np.ones(path.shape[:2], bool),
        drift=drift,
        strain=float("nan"),
    )


def carried(
    points: np.ndarray, means: np.ndarray, opacity: np.ndarray, start: int
) -> np.ndarray:
    """Where Gaussians carry points [points, 3] to: [points, moments, 3].

    `means` [moments, gaussians, 3] are theirs; the points are given at moment `start`.
    Where no Gaussian can be seen, points stay.
    """
    rows = np.flatnonzero(opacity > LEAST_OPACITY)
    path = np.repeat(points[:, None].astype(float), len(means), axis=1)
    if not len(rows):
        return path
    tree = scipy.spatial.cKDTree(means[start, rows])
    count = min(NEIGHBOURS, len(rows))
    distance, nearest = tree.query(points, np.arange(1, count + 1))
    nearest = rows[nearest]
    weight = neighbour_weights(distance, opacity[nearest])
    for moment, mean in enumerate(means):
        moved = mean[nearest].astype(float) - means[start][nearest]
        path[:, moment] += np.einsum("pk,pkd->pd", weight, moved)
    return path


def neighbour_weights(distance: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Weights [points, neighbours] that sum to one, nearest neighbour first.

    Opacity times a Gaussian of the distance, as wide as half the way to the farthest
    of the neighbours: not their own extents, which are thin across a surface and would
    leave a point beside it to a single one.
    """
    # Where all lie at the point itself, no distance differs, whatever the width.
    width = np.where(distance[:, -1:] > 0, distance[:, -1:], 1.0) / 2
    weight = opacity * np.exp(-0.5 * (distance / width) ** 2)
    return weight / weight.sum(axis=1, keepdims=True)


# By the name of the representation; what is not here is not followed.
FOLLOW: dict[str, Follow] = {"radiance": follow_fields, "gaussians": follow_splats}
