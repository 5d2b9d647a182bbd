"""Alignment of external depth to scene units by static points.

Networks predict depth or inverse depth with an unknown scale and offset for each image.
The kind that fits the static points better is chosen. If a plane fills the image,
neither the kind nor the offset can be determined, and depth without an offset is
assumed.
"""

import numpy as np

from nerfies_jax.preprocessing.rest_points import RestPoints
from nerfies_jax.preprocessing.tracks import Tracks, pixel_of

FEWEST = 12  # static points in an image
ROUNDS = 8  # of reweighting
USABLE = 0.1  # maximum of the median relative error
SAME = 0.002  # by which the relative error of inverse depth must be smaller
# Penalty on the offset relative to squared depth, so that an undetermined one is zero.
OFFSET_PENALTY = 1e-3
LEAST_TOLD = 0.1  # minimum share of the aligned depth that is not due to the offset


def aligned(
    depth: np.ndarray, tracks: Tracks, rest: RestPoints
) -> tuple[np.ndarray, float]:
    """Align depth to static points.

    Args:
      depth: External depth or inverse depth, [frames, height, width].
      tracks: Tracks of static points, in the pixels of `depth`.
      rest: Static points of the tracks.

    Returns:
      z-depth in scene units [frames, height, width], NaN where unknown and in frames
      with too few static points, and its median relative error.
    """
    placements, misses = [], []
    for inverse in (False, True):
        placed = np.full(depth.shape, np.nan, np.float32)
        off = []
        for frame, given in enumerate(depth):
            here = tracks.seen[:, frame] & (rest.depth[:, frame] > 0)
            place = pixel_of(tracks.pixel[here, frame], given.shape)
            own, true = given[place].astype(np.float64), rest.depth[here, frame]
            known = np.isfinite(own)
            if known.sum() < FEWEST:
                continue
            wanted = 1 / true[known] if inverse else true[known]
            scale, shift = _line(own[known], wanted)
            if scale * np.median(own[known]) < LEAST_TOLD * np.median(wanted):
                continue
            mapped = scale * given + shift
            with np.errstate(divide="ignore", invalid="ignore"):
                placed[frame] = 1 / mapped if inverse else mapped
                off.append(abs(placed[frame][place][known] / true[known] - 1))
            placed[frame][~(mapped > 0)] = np.nan
        placements.append(placed)
        misses.append(np.nanmedian(np.concatenate(off)) if off else np.inf)
    best = int(misses[1] + SAME < misses[0])
    return placements[best], float(misses[best])


def _line(own, wanted):
    """Fit scale and offset from one to the other by robust least squares."""
    size = np.median(np.abs(own)) + 1e-30
    columns = np.stack([own / size, np.ones_like(own)], axis=1)
    weight = np.ones(len(own))
    for _ in range(ROUNDS):
        matrix = (columns * weight[:, None]).T @ columns
        matrix[1, 1] += OFFSET_PENALTY * weight.sum()
        fit = np.linalg.solve(matrix, (columns * weight[:, None]).T @ wanted)
        miss = np.abs(columns @ fit - wanted)
        weight = 1 / (1 + (miss / (np.median(miss) + 1e-12)) ** 2)
    return fit[0] / size, fit[1]
