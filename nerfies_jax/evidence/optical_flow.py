"""Paths of pixels through a film, and how badly a still scene explains them.

A pixel's path through the neighbouring frames is held against the one-parameter family
of paths that a point at rest could take under the given cameras: its inverse depth is
fitted to all of them at once, and what is left over is motion of its own (or noise).
"""

import itertools
import warnings
from typing import NamedTuple

import numpy as np
import scipy.ndimage as nd
import skimage.registration

from nerfies_jax.evidence import view_set
from nerfies_jax.evidence.view_set import Views

# Zach et al. 2007, TV-L1, as in scikit-image with a third of its iterations: 0.08 s a
# pair of 176x132, a third of the default's time, and as near to the true flow of the
# built-in scene (0.05 px where it moves by 1, 0.19 px where it moves by 6).
FLOW = {"num_warp": 3, "num_iter": 5, "attachment": 20}
# Forward and back must meet: within half a pixel and a twentieth of the way.
CLOSED_PX, CLOSED_SHARE = 0.5, 0.05
ROUNDS = 6  # of reweighting; the fit of the median moves by less than 1 % afterwards
SOFT_PX = 0.3  # residual below which all weigh alike


class Step(NamedTuple):
    """Flow between two frames that follow each other in a sequence."""

    forward: np.ndarray  # [height, width, 2] px, right and down
    backward: np.ndarray


class Paths(NamedTuple):
    """Where the pixels of one frame lie in others."""

    views: list[int]  # which
    place: np.ndarray  # [others, height, width, 2] pixel coordinates, centres at +0.5
    followed: np.ndarray  # [others, height, width] bool: without losing it on the way


class StillFit(NamedTuple):
    """How well a point at rest explains the paths from one frame."""

    residual: (
        np.ndarray
    )  # [height, width] px: median over the frames it was followed to
    count: np.ndarray  # [height, width] frames it was followed to
    inverse_depth: np.ndarray  # [height, width] per scene unit
    parallax_px: np.ndarray  # [height, width] px for one unit of inverse depth


def between(views: Views, first: int | np.integer, second: int | np.integer) -> Step:
    """Dense flow between two frames, both ways; differences of exposure taken out."""
    one, other = (levelled(views.grey[index]) for index in (first, second))
    return Step(_flow(one, other), _flow(other, one))


def levelled(grey: np.ndarray) -> np.ndarray:
    """The picture less its local mean, over its contrast: flow assumes equal light."""
    detail = grey - nd.gaussian_filter(grey, 12)
    spread = np.sqrt(np.mean(detail**2))
    return detail / (5 * spread) if spread > 0 else detail


def _flow(one, other):
    down, across = skimage.registration.optical_flow_tvl1(one, other, **FLOW)
    return np.stack([across, down], axis=-1)


def steps(views: Views, sequence: np.ndarray) -> list[Step]:
    """Flow between all neighbours of a sequence."""
    pairs = itertools.pairwise(sequence)
    return [between(views, first, second) for first, second in pairs]


def follow(
    flows: list[Step], sequence: np.ndarray, at: int | np.integer, reach: int
) -> Paths:
    """Paths from frame `at` of a sequence to `reach` frames before and after it."""
    height, width = flows[0].forward.shape[:2]
    bound = np.array([width - 1, height - 1])
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
    others, place, followed = [], [], []
    for direction in (-1, 1):
        here, kept = grid, np.ones((height, width), bool)
        for other in range(at + direction, at + direction * (reach + 1), direction):
            if not 0 <= other < len(sequence):
                break
            flow = flows[min(other, other - direction)]
            there, back = flow.forward, flow.backward
            if direction < 0:
                there, back = back, there
            move = sample(there, here)
            here = here + move
            gap = np.linalg.norm(move + sample(back, here), axis=-1)
            closed = gap < CLOSED_PX + CLOSED_SHARE * np.linalg.norm(move, axis=-1)
            kept = kept & closed & ((here >= 0) & (here <= bound)).all(-1)
            others.append(int(sequence[other]))
            place.append(here + 0.5)
            followed.append(kept)
    return Paths(others, np.array(place), np.array(followed))


def sample(picture: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Bilinear values of [height, width, channels] at array places [..., 2] (x, y)."""
    at = np.moveaxis(place[..., ::-1], -1, 0)
    channels = [
        nd.map_coordinates(channel, at, order=1, mode="nearest")
        for channel in np.moveaxis(picture, -1, 0)
    ]
    return np.stack(channels, axis=-1)


def fit_still(views: Views, index: int, paths: Paths, near: float) -> StillFit:
    """The inverse depth of every pixel of a view that best explains its paths.

    The L1 fit over the frames, by reweighting: where a path is lost to another surface
    half-way, the rest still counts. A camera that stays in place tells no depth; then
    the residual is the motion in the picture. `near` is the least z-depth, scene units.
    """
    ray = view_set.rays(views, index)
    # In another camera the point is `start + inverse_depth * shift` up to scale.
    starts, shifts = [], []
    for other in paths.views:
        to_pixel = views.intrinsics[other] @ views.rotation[other]
        starts.append(ray @ to_pixel.T)
        shifts.append(to_pixel @ (views.position[index] - views.position[other]))
    start, shift = np.array(starts), np.array(shifts)[:, None, None, :]
    place, followed = paths.place, paths.followed.astype(float)
    # Both linear in the inverse depth, and divided by its depth at each round.
    slope = shift[..., :2] - place * shift[..., 2:]
    offset = place * start[..., 2:] - start[..., :2]
    inverse, weight = np.zeros(ray.shape[:2]), followed
    most = 1 / near
    for _ in range(ROUNDS):
        depth = np.maximum(start[..., 2] + inverse * shift[..., 2], 1e-6)
        scaled = weight / depth**2
        above = (scaled[..., None] * slope * offset).sum((0, -1))
        below = (scaled[..., None] * slope**2).sum((0, -1))
        # Without parallax there is no depth; 0 leaves the far plane, and the residual.
        inverse = np.where(below > 0, above / np.where(below > 0, below, 1), 0)
        inverse = np.clip(inverse, 0, most)
        depth = np.maximum(start[..., 2] + inverse * shift[..., 2], 1e-6)
        miss = np.linalg.norm(inverse[..., None] * slope - offset, axis=-1) / depth
        weight = followed / np.maximum(miss, SOFT_PX)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels followed nowhere
        middle = np.nanmedian(np.where(paths.followed, miss, np.nan), axis=0)
    moved = (slope / depth[..., None]) ** 2 * paths.followed[..., None]
    # Root mean square: errors of one path are alike in all its frames.
    count = paths.followed.sum(0)
    parallax = np.sqrt(moved.sum((0, -1)) / np.maximum(count, 1))
    return StillFit(np.nan_to_num(middle), count, inverse, parallax)
