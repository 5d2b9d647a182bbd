"""Outlines before a plain background, to test for one static object.

If neighboring times are far apart there is no flow, but a static object has one visual
hull (Laurentini 1994): the volume inside all of its outlines fills each of them. Moving
parts are cut away by the outlines of other times.
"""

import numpy as np
import scipy.ndimage as nd

from nerfies_jax.geometry.rays import across_ray
from nerfies_jax.preprocessing import view_set
from nerfies_jax.preprocessing.findings import LIKELY, Finding, cannot_tell, judge
from nerfies_jax.preprocessing.findings import MOTION as EFFECT
from nerfies_jax.preprocessing.view_set import Views

MIN_VIEWS = 8  # fewer cut little away, at rest or not
PLAIN_SHARE = 0.2  # of the pixels in the median view
SIDE = 96  # cells along the longest side of the box
# Pixels that an outline is widened by: rims are half background, and a cell of the grid
# is about a pixel wide.
SLACK_PX = 1
# Share of the outlines' pixels that no cell fills. At rest it is none: 0.00 % of Lego's
# in 50 views of 200x200 and of 100x100, before white and before black; a part of a
# hundredth of the thing that moves is the least that is worth a motion.
BARE_SHARE = 0.01


def outlines(views: Views) -> np.ndarray | None:
    """Segment the object before a plain background, with holes filled.

    Args:
      views: The frames.

    Returns:
      Booleans [frames, height, width], or None if some view has no plain background.
    """
    shares = 1 - views.valid.mean((1, 2))
    if len(views.row) < MIN_VIEWS or np.median(shares) < PLAIN_SHARE:
        return None
    if shares.min() < PLAIN_SHARE / 4:
        return None  # some view is filled by the scene: no outline there
    return np.stack([nd.binary_fill_holes(one) for one in views.valid])


def motion(views: Views, shapes: np.ndarray) -> Finding:
    """Decide whether anything moves, by the parts of outlines outside the visual hull.

    Args:
      views: The frames.
      shapes: Outlines, [frames, height, width].

    Returns:
      The finding.
    """
    threshold = f"{BARE_SHARE:.0%} of the outlines' pixels that no still thing fills"
    box = _box(views, shapes)
    bare = np.array([]) if box is None else uncovered(views, shapes, box)
    if not bare.size:
        return cannot_tell(EFFECT, "the views' outlines have no room in common", "")
    value = float(bare.mean())
    error = float(bare.std() / np.sqrt(len(bare)))
    wanted, confidence = judge(value, BARE_SHARE, error)
    if wanted is False:
        confidence = LIKELY  # what moves inside the outlines does not show
    evidence = (
        f"{value:.1%} of the outlines before the plain background (up to "
        f"{bare.max():.1%} in a view) are filled by nothing that fits all views"
    )
    numbers = {"bare_share": value, "bare_share_most": float(bare.max())}
    return Finding(EFFECT, evidence, threshold, wanted, confidence, numbers)


def uncovered(
    views: Views, shapes: np.ndarray, box: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Compute the share of each outline that the visual hull does not fill.

    The hull is made of outlines widened by `SLACK_PX`. The outlines that it must fill
    are narrowed by as much. Cells outside of an image are not cut by it.

    Args:
      views: The frames.
      shapes: Outlines, [frames, height, width].
      box: Lower and upper corner of the volume in scene units.

    Returns:
      Shares, [frames].
    """
    low, high = box
    side = (high - low).max() / SIDE
    counts = np.maximum(np.ceil((high - low) / side).astype(int), 1)
    axes = [low[i] + (np.arange(counts[i]) + 0.5) * side for i in range(3)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    wide = [nd.binary_dilation(one, iterations=SLACK_PX) for one in shapes]
    for index, shape in enumerate(wide):
        place, inside = _pixels(views, index, cells)
        hit = shape[tuple(place[:, ::-1].T)]
        cells = cells[hit | ~inside]
    shares = []
    for index, shape in enumerate(shapes):
        needed = nd.binary_erosion(shape, iterations=SLACK_PX)
        place, inside = _pixels(views, index, cells)
        filled = np.zeros_like(shape)
        filled[tuple(place[inside, ::-1].T)] = True
        # A cell covers its neighbors: it is as wide as that in the nearest view.
        depth = np.linalg.norm(views.position[index] - (low + high) / 2)
        width = side * views.intrinsics[index][0, 0] / depth
        filled = nd.binary_dilation(
            filled, np.ones((3, 3)), iterations=max(1, int(np.ceil(width / 2)))
        )
        if needed.any():
            shares.append((needed & ~filled).sum() / needed.sum())
    return np.array(shares)


def _pixels(views, index, points):
    pixel, depth = view_set.project(views, index, points)
    inside = view_set.in_picture(views, pixel, depth, 0)
    place = np.where(inside[:, None], pixel, 0).astype(int)
    return np.minimum(place, np.array(views.size) - 1), inside


def _box(views, shapes):
    """The box that all outlines leave: a sphere about the point all cameras look at.

    A coarse grid is cut first; None where nothing is left.
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
