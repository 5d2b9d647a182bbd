"""A second opinion on what seems to move: can a still point explain the picture itself?

Flow goes astray on repeating texture and at the rims of pictures, and then seems to
move. A pixel is only believed to move where no depth at all makes its surroundings in
the other frames look as they do at the end of its path.
"""

import numpy as np
import scipy.ndimage as nd

from nerfies_jax.evidence import optical_flow, view_set
from nerfies_jax.evidence.optical_flow import Paths
from nerfies_jax.evidence.view_set import Views

PATCH = 3  # pixels to each side
STEP_PX = 1.0  # between two depths, in the frame where they differ most
MOST_STEPS = 160
MOST_PIXELS = 400  # of a frame that are tried
OTHERS = 8  # frames that are looked into
# How much worse than its path the best still point must look: by half, and by half of
# what paths of pixels at rest leave.
WORSE, WORSE_FLOOR = 1.5, 0.5


def confirmed(
    views: Views,
    index: int,
    paths: Paths,
    strays: np.ndarray,
    static: np.ndarray,
    spans: tuple[float, float],
) -> np.ndarray:
    """`strays` [height, width] without the parts that a still scene explains as well.

    Connected parts are judged as wholes, by what most of their pixels say. `static` are
    pixels that do not stray, from which the noise of a path is taken; `spans` are the
    nearest and farthest z-depth.
    """
    parts, count = nd.label(strays)
    if not count:
        return strays
    rng = np.random.default_rng(index)
    tried = _some(rng, strays, MOST_PIXELS)
    rest = _some(rng, static & ~strays, MOST_PIXELS // 2)
    pixels = np.concatenate([tried, rest])
    chosen = np.linspace(0, len(paths.views) - 1, OTHERS).round().astype(int)
    chosen = np.unique(chosen)
    along, lowest = _costs(views, index, paths, chosen, pixels, spans)
    floor = np.nanmedian(along[len(tried) :]) if len(rest) else 0.0
    worse = lowest > WORSE * along + WORSE_FLOOR * floor
    part = parts[tuple(tried.T)]
    votes = np.bincount(part, worse[: len(tried)], minlength=count + 1)
    total = np.bincount(part, minlength=count + 1)
    kept = votes > 0.5 * total
    kept[0] = False
    return kept[parts]


def _costs(views, index, paths, chosen, pixels, spans):
    """Mean difference of patches along the paths, and for the best still point."""
    line, column = pixels.T
    ray = view_set.rays(views, index)[line, column]
    points = [views.position[index] + depth * ray for depth in spans]
    steps = 1
    for at in chosen:
        ends = [view_set.project(views, paths.views[at], point)[0] for point in points]
        far = np.linalg.norm(ends[0] - ends[1], axis=-1)
        steps = max(steps, int(np.nanmedian(far) / STEP_PX) + 1)
    steps = min(steps, MOST_STEPS)
    inverse = np.linspace(1 / spans[1], 1 / spans[0], steps)
    offsets = np.mgrid[-PATCH : PATCH + 1, -PATCH : PATCH + 1].reshape(2, -1).T[:, ::-1]
    here = np.stack([column, line], -1).astype(float)
    own = _patches(optical_flow.levelled(views.grey[index]), here, offsets)
    along, static = [], []
    for at in chosen:
        other = paths.views[at]
        picture = optical_flow.levelled(views.grey[other])
        seen = paths.followed[at][line, column]
        end = paths.place[at][line, column] - 0.5
        cost = np.abs(_patches(picture, end, offsets) - own).mean(-1)
        along.append(np.where(seen, cost, np.nan))
        each = []
        for one in inverse:
            pixel, depth = view_set.project(
                views, other, views.position[index] + ray / one
            )
            inside = view_set.in_picture(views, pixel, depth, PATCH)
            place = np.where(inside[:, None], pixel, 0) - 0.5
            cost = np.abs(_patches(picture, place, offsets) - own).mean(-1)
            each.append(np.where(inside, cost, np.nan))
        static.append(np.where(seen, np.array(each), np.nan))
    # The better half of the frames: a point at rest may be hidden in the others.
    return _better_half(np.array(along)), _lowest(_better_half(np.array(static)))


def _patches(picture, place, offsets):
    around = place[:, None, :] + offsets
    return optical_flow.sample(picture[..., None], around)[..., 0]


def _better_half(cost):
    """Mean of the lesser half of what is known along the first axis; NaN for none."""
    ordered = np.sort(cost, axis=0)  # NaN last
    known = np.isfinite(ordered).sum(0)
    rank = np.arange(len(cost)).reshape(-1, *([1] * (cost.ndim - 1)))
    taken = rank < np.maximum((known + 1) // 2, 1)
    total = np.where(taken, np.nan_to_num(ordered), 0).sum(0)
    return np.where(known > 0, total / taken.sum(0), np.nan)


def _lowest(cost):
    """The least over the depths; NaN (never worse than anything) where none is seen."""
    least = np.where(np.isfinite(cost), cost, np.inf).min(0)
    return np.where(np.isfinite(least), least, np.nan)


def _some(rng, mask, most):
    pixels = np.argwhere(mask)
    if len(pixels) > most:
        pixels = pixels[np.sort(rng.choice(len(pixels), most, replace=False))]
    return pixels
