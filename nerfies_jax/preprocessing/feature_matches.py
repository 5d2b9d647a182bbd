"""Motion of a scene from image features, for photographs without an order.

Optical flow needs neighboring frames that are alike. Features are matched between any
views that overlap. A feature is static if one point on its ray explains its matches in
most other views. It moves if no such point exists, as for most features around it.
Wrong matches on repeated patterns have no neighbors of their kind.
"""

from typing import NamedTuple

import cv2
import numpy as np
from scipy import stats

from nerfies_jax.preprocessing import view_set
from nerfies_jax.preprocessing.view_set import Views

LONGEST_PX = 640  # of the images
MOST_FEATURES, CONTRAST = 800, 0.02  # of an image, and half of OpenCV's minimum
MOST_VIEWS = 60
OTHERS = 10  # views that each view is compared with
# Lowe 2004: distance to the nearest descriptor, relative to the nearest one elsewhere.
RATIO = 0.7
# Other places with a descriptor almost as near may be the right one.
CANDIDATES, ALMOST = 8, 1.6
PLACED = 2  # candidates of each view whose depths are tried
MISS_PX = 2.5  # maximum distance of a match from the projected point
LEAST_MATCHES = 3  # of a feature
EXPLAINED = 0.75  # minimum share of the matches of a static feature
AROUND = 6  # features, with itself, of which half or more move around a moving one
CONFIDENCE = 0.95


class Census(NamedTuple):
    """Numbers of scene points, each counted once over all views that observe it."""

    points: float  # whose matches were tested
    moving: float  # that no static point explains

    @property
    def most_moving(self) -> float:
        """Upper bound of the moving share, three divided by `points` if none moves.

        It is the 95 % bound of a Poisson rate, 1 without points.
        """
        if not self.points > 0:
            return 1.0
        bound = stats.chi2.ppf(CONFIDENCE, 2 * self.moving + 2) / 2
        return min(1.0, float(bound / self.points))


class _Features(NamedTuple):
    pixel: np.ndarray  # [features, 2]
    descriptor: np.ndarray  # [features, 128] float32, of unit length


def census(views: Views) -> Census:
    """Match features between overlapping views and test them against static points.

    Args:
      views: The frames, with cameras.

    Returns:
      The numbers of points.
    """
    views = view_set.smaller(views, -(-max(views.size) // LONGEST_PX))
    count = len(views.row)
    rows = np.linspace(0, count - 1, min(MOST_VIEWS, count)).round().astype(int)
    features = [_features(views, row) for row in rows]
    points = moving = 0.0
    for here, others in enumerate(_near(views, rows)):
        matches, moves = _match_features(views, rows, features, here, others)
        # A point is tested again in each view that it is matched in.
        weight = 1 / (1 + matches)
        points += float(weight.sum())
        moving += float(weight[moves].sum())
    return Census(points, moving)


def _features(views, row):
    sift = cv2.SIFT_create(nfeatures=MOST_FEATURES, contrastThreshold=CONTRAST)
    gray, mask = np.uint8(255 * views.gray[row]), np.uint8(255 * views.valid[row])
    points, descriptor = sift.detectAndCompute(gray, mask)
    if not points:
        return _Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    pixel = np.array([point.pt for point in points]) + 0.5
    # Arandjelovic and Zisserman 2012 (RootSIFT).
    root = np.sqrt(descriptor / np.maximum(descriptor.sum(1, keepdims=True), 1e-9))
    return _Features(pixel, root)


def _near(views, rows):
    """Indices of the views that are nearest in place and direction to each view."""
    axis, position = views.rotation[rows, 2], views.position[rows]
    away = np.linalg.norm(position[:, None] - position, axis=-1)
    turn = np.linalg.norm(axis[:, None] - axis, axis=-1)
    cost = away / max(float(np.median(away)), 1e-9) + turn
    np.fill_diagonal(cost, -1)
    return np.argsort(cost, axis=1, kind="stable")[:, 1 : OTHERS + 1]


def _match_features(views, rows, features, here, others):
    """Return match counts of features with enough matches, and which of them move."""
    pixel = features[here].pixel
    if not len(pixel) or not len(others):
        return np.zeros(0), np.zeros(0, bool)
    each = [_matches(features[here], features[other]) for other in others]
    place, strong = (np.stack(parts, axis=1) for parts in zip(*each, strict=True))
    has_matches = strong.sum(1) >= LEAST_MATCHES
    if not has_matches.any():
        return np.zeros(0), np.zeros(0, bool)
    pixel, place, strong = pixel[has_matches], place[has_matches], strong[has_matches]
    start, along = _lines(views, rows[here], rows[others], pixel)
    most = _most_explained(start, along, place, strong)
    alone = most < EXPLAINED * strong.sum(1)
    away = np.linalg.norm(pixel[:, None] - pixel, axis=-1)
    around = np.argsort(away, axis=1, kind="stable")[:, :AROUND]
    return strong.sum(1), alone & (alone[around].mean(1) >= 0.5)


def _matches(here, there):
    """Candidates of each feature [n, CANDIDATES, 2], and if the first is unambiguous.

    Places of candidates that are too different are NaN.
    """
    if len(there.pixel) <= CANDIDATES:
        nowhere = np.full((len(here.pixel), CANDIDATES, 2), np.nan)
        return nowhere, np.zeros(len(here.pixel), bool)
    away = np.sqrt(np.maximum(2 - 2 * here.descriptor @ there.descriptor.T, 0))
    order = np.argpartition(away, CANDIDATES, axis=1)[:, : CANDIDATES + 1]
    rank = np.argsort(np.take_along_axis(away, order, 1), axis=1, kind="stable")
    order = np.take_along_axis(order, rank, 1)
    value = np.take_along_axis(away, order, 1)
    pixel = there.pixel[order]
    near = value <= ALMOST * value[:, :1]
    place = np.where(near[..., None], pixel, np.nan)[:, :CANDIDATES]
    # One place may have features of several orientations.
    elsewhere = np.linalg.norm(pixel - pixel[:, :1], axis=-1) > MISS_PX
    second = np.where(elsewhere, value, np.inf).min(1)
    back = here.pixel[away.argmin(0)[order[:, 0]]]
    mutual = np.linalg.norm(back - here.pixel, axis=1) < 1
    return place, mutual & np.isfinite(second) & (value[:, 0] < RATIO * second)


def _lines(views, row, others, pixel):
    """Lines of pixels in other views: `start + depth * along`, homogeneous."""
    ray = np.c_[pixel, np.ones(len(pixel))] @ np.linalg.inv(views.intrinsics[row]).T
    ray = ray @ views.rotation[row]
    turn = views.intrinsics[others] @ views.rotation[others]
    shift = views.position[row] - views.position[others]
    start = np.einsum("oij,oj->oi", turn, shift)
    return start, np.einsum("oij,nj->noi", turn, ray)


def _most_explained(start, along, place, strong):
    """Largest number of matched views that one point on the ray of a feature explains.

    A point explains a view if it projects to a candidate. Points are tried at the
    depths that are nearest to the first candidates of each view.
    """
    nearest = place[:, :, :PLACED]
    factor = nearest * along[:, :, None, 2:] - along[:, :, None, :2]
    value = start[None, :, None, :2] - nearest * start[None, :, None, 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (factor * value).sum(-1) / (factor**2).sum(-1)
    # Without parallax the depth is arbitrary.
    far = 1e4 * (1 + np.abs(start).max())
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, far)
    depth = depth.reshape(len(depth), -1, 1, 1)
    point = start + depth * along[:, None]  # [n, depths, others, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = point[..., :2] / point[..., 2:]
        miss = np.linalg.norm(pixel[..., None, :] - place[:, None], axis=-1)
        fits = (miss < MISS_PX).any(-1) & (point[..., 2] > 0)
    return (fits & strong[:, None]).sum(-1).max(1, initial=0)
