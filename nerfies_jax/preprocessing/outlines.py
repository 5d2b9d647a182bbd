"""Silhouettes in front of a plain background, to test if an object is static.

If consecutive images differ too much, there is no flow, but a static object has one
visual hull (Laurentini 1994): the volume inside all of its silhouettes fills each of
them. Moving parts are cut away by silhouettes at other times.
"""

import numpy as np
import scipy.ndimage as nd

from nerfies_jax.geometry.rays import across_ray
from nerfies_jax.preprocessing import view_set
from nerfies_jax.preprocessing.findings import LIKELY, Finding, cannot_tell, judge
from nerfies_jax.preprocessing.findings import MOTION as EFFECT
from nerfies_jax.preprocessing.view_set import Views

MIN_VIEWS = 8  # a visual hull of fewer views is too large
PLAIN_SHARE = 0.2  # of the pixels in the median view
SIDE = 96  # cells along the longest side of the box
# Pixels by which a silhouette is widened: edge pixels are half background, and a cell
# of the grid is about a pixel wide.
SLACK_PX = 1
# Share of the pixels of silhouettes that the hull does not fill. For static objects it
# is zero: 0.00 % for Lego in 50 views of 200x200 and of 100x100, in front of white and
# black. Smaller moving parts are not worth a motion model.
BARE_SHARE = 0.01


def outlines(views: Views) -> np.ndarray | None:
    """Segment the object in front of a plain background, with holes filled.

    Args:
      views: The frames.

    Returns:
      Booleans [frames, height, width], or None if some view has no plain background.
    """
    shares = 1 - views.valid.mean((1, 2))
    if len(views.row) < MIN_VIEWS or np.median(shares) < PLAIN_SHARE:
        return None
    if shares.min() < PLAIN_SHARE / 4:
        return None  # some view has no background
    return np.stack([nd.binary_fill_holes(one) for one in views.valid])


def motion(views: Views, shapes: np.ndarray) -> Finding:
    """Decide if anything moves, by the parts of silhouettes outside the visual hull.

    Args:
      views: The frames.
      shapes: Silhouettes, [frames, height, width].

    Returns:
      The finding.
    """
    threshold = f"{BARE_SHARE:.0%} of the outlines not explained by a static object"
    box = _box(views, shapes)
    bare = np.array([]) if box is None else _measure_uncovered(views, shapes, box)
    if not bare.size:
        return cannot_tell(EFFECT, "the outlines have no common volume", "")
    value = float(bare.mean())
    error = float(bare.std() / np.sqrt(len(bare)))
    moves, confidence = judge(value, BARE_SHARE, error)
    if moves is False:
        confidence = LIKELY  # motion inside the silhouettes is not visible
    evidence = (
        f"{value:.1%} of the outlines in front of the plain background (up to "
        f"{bare.max():.1%} in a view) are not explained by an object that fits all "
        "views"
    )
    numbers = {"bare_share": value, "bare_share_most": float(bare.max())}
    return Finding(EFFECT, evidence, threshold, moves, confidence, numbers)


def _measure_uncovered(
    views: Views, shapes: np.ndarray, box: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Compute the share of each silhouette that the visual hull does not fill.

    The hull is computed from silhouettes dilated by `SLACK_PX`, and must fill those
    eroded by `SLACK_PX`. Cells outside of an image are not cut by it.
    """
    low, high = box
    side = (high - low).max() / SIDE
    counts = np.maximum(np.ceil((high - low) / side).astype(int), 1)
    axes = [low[i] + (np.arange(counts[i]) + 0.5) * side for i in range(3)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    wide = [nd.binary_dilation(mask, iterations=SLACK_PX) for mask in shapes]
    for index, shape in enumerate(wide):
        place, inside = _pixels(views, index, cells)
        hit = shape[tuple(place[:, ::-1].T)]
        cells = cells[hit | ~inside]
    shares = []
    for index, shape in enumerate(shapes):
        eroded_shape = nd.binary_erosion(shape, iterations=SLACK_PX)
        place, inside = _pixels(views, index, cells)
        hull_mask = np.zeros_like(shape)
        hull_mask[tuple(place[inside, ::-1].T)] = True
        # Dilated by the width of a cell in pixels.
        depth = np.linalg.norm(views.position[index] - (low + high) / 2)
        width = side * views.intrinsics[index][0, 0] / depth
        hull_mask = nd.binary_dilation(
            hull_mask, np.ones((3, 3)), iterations=max(1, int(np.ceil(width / 2)))
        )
        if eroded_shape.any():
            shares.append((eroded_shape & ~hull_mask).sum() / eroded_shape.sum())
    return np.array(shares)


def _pixels(views, index, points):
    pixel, depth = view_set.project(views, index, points)
    inside = view_set.in_image(views, pixel, depth, 0)
    place = np.where(inside[:, None], pixel, 0).astype(int)
    return np.minimum(place, np.array(views.size) - 1), inside


def _box(views, shapes):
    """Return the bounding box of the visual hull of a coarse grid, None if it is empty.

    The grid is centered at the point that all cameras look at.
    """
    axes = views.rotation[:, 2]
    across = across_ray(axes)
    pull = np.einsum("nij,nj->i", across, views.position)
    aim = np.linalg.lstsq(across.sum(0), pull, rcond=None)[0]
    reach = np.median(np.linalg.norm(views.position - aim, axis=1))
    line = np.linspace(-reach, reach, 64)
    cells = aim + np.stack(np.meshgrid(line, line, line), -1).reshape(-1, 3)
    step = line[1] - line[0]
    for index, shape in enumerate(shapes):
        width = step * views.intrinsics[index][0, 0] / max(reach, 1e-9)
        wide = nd.binary_dilation(shape, iterations=max(1, int(np.ceil(width))))
        place, inside = _pixels(views, index, cells)
        cells = cells[inside & wide[tuple(place[:, ::-1].T)]]
        if not len(cells):
            return None
    return cells.min(0) - step, cells.max(0) + step
