"""Whether frames far apart in time agree on what is where.

What moves slowly looks at rest in a few frames, at some depth. Another time's frame
then looks through the place where it was: it sees something behind. At rest nothing
can be looked through, whatever hides it.
"""

import numpy as np
import scipy.ndimage as nd

from nerfies_jax.evidence import view_set
from nerfies_jax.evidence.optical_flow import StillFit
from nerfies_jax.evidence.view_set import Views

DEVIATIONS = 5.0  # of both depths
AT_LEAST = 0.1  # share of the inverse depth: flow is smooth across rims of things
AROUND = 2  # pixels about the place in the other frame that must all lie behind
MIN_SEERS = 2  # frames that look through a pixel, and more than see it in place


def looked_through(
    views: Views, fits: list[tuple[int, StillFit, np.ndarray, float]]
) -> list[np.ndarray]:
    """For each frame (view, fit, usable, noise in px) the pixels others look through.

    Pixels are judged against the frames at hand alone; [height, width] bool each.
    """
    nearest = []  # of each frame: the largest inverse depth around, and the least sure
    for _, fit, usable, noise in fits:
        deviation = np.where(fit.parallax_px > 0, noise, np.inf) / np.where(
            fit.parallax_px > 0, fit.parallax_px, 1
        )
        size = 2 * AROUND + 1
        known = nd.minimum_filter(usable, size)
        closest = nd.maximum_filter(np.where(usable, fit.inverse_depth, -np.inf), size)
        unsure = nd.maximum_filter(np.where(usable, deviation, np.inf), size)
        nearest.append((known, closest, unsure, deviation))
    return [_through(views, fits, nearest, at) for at in range(len(fits))]


def _through(views, fits, nearest, at):
    index, fit, usable, _ = fits[at]
    width, height = views.size
    solid = usable & (fit.inverse_depth > 0)
    line, column = np.nonzero(solid)
    inverse = fit.inverse_depth[solid]
    points = (
        views.position[index] + view_set.rays(views, index)[solid] / (inverse[:, None])
    )
    deviation = nearest[at][3][solid]
    through, agree = np.zeros(len(points), int), np.zeros(len(points), int)
    for other, (view, *_) in enumerate(fits):
        if other == at:
            continue
        pixel, depth = view_set.project(views, view, points)
        inside = view_set.in_picture(views, pixel, depth)
        place = np.where(inside[:, None], pixel, 0).astype(int)
        known, closest, unsure, _ = (
            array[
                np.minimum(place[:, 1], height - 1), np.minimum(place[:, 0], width - 1)
            ]
            for array in nearest[other]
        )
        # The point's own uncertainty as inverse depth in the other frame.
        here = 1 / np.where(inside, depth, 1)
        moved = deviation * (here / inverse) ** 2 * _slant(views, index, view)
        bound = np.maximum(DEVIATIONS * np.hypot(moved, unsure), AT_LEAST * here)
        seen = inside & known
        through += seen & (here - closest > bound)
        agree += seen & (np.abs(here - closest) <= bound)
    passed = np.zeros((height, width), bool)
    passed[line, column] = (through >= MIN_SEERS) & (through > agree)
    return passed


def _slant(views, index, view):
    """How much of a shift along one viewing axis is along another's."""
    return abs(float(views.rotation[index, 2] @ views.rotation[view, 2]))
