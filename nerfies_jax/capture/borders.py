"""Detection of black wedges at the border of stabilized or undistorted video."""

import numpy as np
import skimage.measure
import skimage.morphology

BLACK = 2  # of 255; a reduced picture ramps at the wedge's edge, its inside stays below
# The mean inside: wedges have 0.04 to 0.73 (26 frames of a phone clip), black cloth at
# the rim of a dark film has 1.29 to 1.86 (44 frames).
EMPTY = 1.0
SMALLEST = 1e-3  # share of the picture; less is a shadow at the rim
LARGEST = 0.25  # more is a dark scene


def black_borders(images: np.ndarray) -> np.ndarray | None:
    """Find black regions that touch the border of an image.

    The regions are grown by two pixels, since their edge was mixed with black when the
    image was resampled.

    Args:
      images: uint8 images, [frames, height, width, 3].

    Returns:
      Booleans [frames, height, width], or None if there are no such regions.
    """
    borders = None
    for row, image in enumerate(images):  # one at a time, to spare memory
        brightest = image.max(-1)
        dark = brightest <= BLACK
        if not _rim(dark).any():
            continue
        labels = skimage.measure.label(dark, connectivity=1)
        border = np.zeros(dark.shape, bool)
        for label in np.unique(_rim(labels)[_rim(labels) > 0]):
            region = labels == label
            empty = brightest[region].mean() <= EMPTY
            if empty and SMALLEST <= region.mean() <= LARGEST:
                border |= region
        if border.any():
            if borders is None:
                borders = np.zeros(images.shape[:3], bool)
            borders[row] = skimage.morphology.dilation(border, np.ones((5, 5), bool))
    return borders


def without_black_borders(
    images: np.ndarray, valid: np.ndarray | None
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Remove black borders from the mask of observed pixels.

    Args:
      images: uint8 images, [frames, height, width, 3].
      valid: True for observed pixels, [frames, height, width]. None for all.

    Returns:
      The mask, None if all pixels are observed, and a note if there are borders.
    """
    blacked = black_borders(images)
    if blacked is None:
        return valid, ()
    touched = int(blacked.any((1, 2)).sum())
    notes = (f"{touched} frames have black borders: taken as not filmed",)
    return ~blacked if valid is None else valid & ~blacked, notes


def _rim(pictures):
    """The outermost pixels of [..., height, width] along one axis."""
    sides = (
        pictures[..., 0, :],
        pictures[..., -1, :],
        pictures[..., 0],
        pictures[..., -1],
    )
    return np.concatenate(sides, axis=-1)
