"""Alignment of external depth to scene units by static points.

Networks predict depth or inverse depth with an unknown scale and offset for each image,
and their errors vary slowly over it. Each image is corrected by a scale, an offset and
a tilt, which are fitted to its static points. The kind that fits better is chosen. If a
plane fills the image, neither the kind nor the offset can be determined, and depth
without an offset is assumed.
"""

from typing import NamedTuple

import numpy as np

from nerfies_jax.preprocessing.static_points import StaticPoints
from nerfies_jax.preprocessing.tracks import Tracks, pixel_of

FEWEST = 12  # static points in an image
ROUNDS = 8  # of reweighting
# Median relative errors above which a warning is given, and depth is refused.
DOUBTFUL, USABLE = 0.1, 0.3
SAME = 0.002  # by which the relative error of inverse depth must be smaller
# Penalties on the offset and the tilt relative to squared depth, so that undetermined
# ones are zero. Points that cover a part of an image do not tilt the rest of it.
OFFSET_PENALTY, TILT_PENALTY = 1e-3, 1e-2
LEAST_TOLD = 0.1  # minimum share of the aligned depth that is not due to the offset
# Standard deviation of normal errors in units of their median.
PER_MEDIAN = 1.4826
# Factor on the deviation of depth along a path, because the errors of neighboring
# frames and points are alike. In the built-in scene `fast` with noisy depth, the median
# error of paths is 1.16 % with 1, and 0.97 % with 3 and with 6.
CORRELATION = 4.0


class AlignedDepth(NamedTuple):
    """External depth in scene units, and how well it fits the static points."""

    # [frames, height, width] z-depth, NaN where unknown, and in frames with too few
    # static points or too large errors
    depth: np.ndarray
    miss: np.ndarray  # [frames] median relative error, NaN without static points
    total_miss: float  # median relative error of all frames, inf if none fits

    def deviation(self, least: float) -> np.ndarray:
        """Convert the errors to relative standard deviations of independent depths.

        Args:
          least: Least deviation.

        Returns:
          Deviations, [frames].
        """
        return np.maximum(CORRELATION * PER_MEDIAN * np.nan_to_num(self.miss), least)


def aligned(
    depth: np.ndarray,
    tracks: Tracks,
    static_fit: StaticPoints,
    inverse: bool | None = None,
) -> AlignedDepth:
    """Align depth to static points.

    Args:
      depth: External depth or inverse depth, [frames, height, width].
      tracks: Tracks of static points, in the pixels of `depth`.
      static_fit: Static points of the tracks.
      inverse: True for inverse depth, False for depth. None for the one that fits.

    Returns:
      The aligned depth.
    """
    kinds = (False, True) if inverse is None else (inverse,)
    results = [_align(depth, tracks, static_fit, kind) for kind in kinds]
    best = results[0]
    for other in results[1:]:
        if other.total_miss + SAME < best.total_miss:
            best = other
    return best


def _align(depth, tracks, static_fit, inverse):
    result = np.full(depth.shape, np.nan, np.float32)
    misses = np.full(len(depth), np.nan)
    fits = []
    tilt = _tilt(depth.shape[1:])
    for frame, external in enumerate(depth):
        usable = tracks.visible[:, frame] & (static_fit.depth[:, frame] > 0)
        place = pixel_of(tracks.pixel[usable, frame], external.shape)
        own, true = external[place].astype(np.float64), static_fit.depth[usable, frame]
        finite = np.isfinite(own)
        if finite.sum() < FEWEST:
            continue
        own, true = own[finite], true[finite]
        place = tuple(axis[finite] for axis in place)
        target = 1 / true if inverse else true
        # Errors of inverse depth in units of depth, because tracks measure parallax.
        precision = np.ones_like(true) if inverse else (np.median(true) / true) ** 2
        fit = _fit(own, tilt[:, *place], target, precision)
        if fit[0] * np.median(own) < LEAST_TOLD * np.median(target):
            # Points of one plane, or no relation at all, which the error then shows.
            fit = np.median(target / own), 0.0, np.zeros(2)
            if not (np.isfinite(fit[0]) and fit[0] > 0):
                continue
        scale, offset, slope = fit
        prediction = scale * external + offset + np.tensordot(slope, tilt, 1)
        prediction = np.where(prediction > 0, prediction, np.nan)
        result[frame] = 1 / prediction if inverse else prediction
        error = abs(result[frame][place] / true - 1)
        error = np.where(np.isnan(error), 1.0, error)
        fits.append(error)
        misses[frame] = np.median(error)
        if misses[frame] > USABLE:
            result[frame] = np.nan
    total = float(np.median(np.concatenate(fits))) if fits else np.inf
    return AlignedDepth(result, misses, total)


def _tilt(shape):
    """Positions in an image from -1 to 1, [2, height, width]."""
    height, width = shape
    rows, columns = np.meshgrid(
        np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij"
    )
    return np.stack([columns, rows])


def _fit(own, tilt, target, precision):
    """Fit scale, offset and tilt from one to the other by robust least squares."""
    size = np.median(np.abs(own)) + 1e-30
    columns = np.stack([own / size, np.ones_like(own), *tilt], axis=1)
    penalty = np.array([0, OFFSET_PENALTY, TILT_PENALTY, TILT_PENALTY])
    weight = np.ones(len(own))
    for _ in range(ROUNDS):
        weighted_columns = columns * (weight * precision**2)[:, None]
        matrix = weighted_columns.T @ columns + np.diag(penalty * weight.sum())
        fit = np.linalg.solve(matrix, weighted_columns.T @ target)
        miss = precision * np.abs(columns @ fit - target)
        weight = 1 / (1 + (miss / (np.median(miss) + 1e-12)) ** 2)
    return fit[0] / size, fit[1], fit[2:]
