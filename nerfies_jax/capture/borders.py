"""Detection of black wedges at the border of stabilized or undistorted video."""

import numpy as np
import skimage.measure
import skimage.morphology

# Largest value of a black pixel, of 255. In a downscaled image the edge of a wedge is
# brighter than this, and its interior is not.
BLACK = 2
# Largest mean value of a wedge. Wedges have 0.04 to 0.73 (26 frames of a phone video),
# black cloth at the border of a dark video has 1.29 to 1.86 (44 frames).
EMPTY = 1.0
SMALLEST = 1e-3  # share of the image; smaller regions are shadows at the border
LARGEST = 0.25  # share of the image; larger regions are a dark scene


def _black_borders(images):
    """Black regions that touch the border, [frames, height, width], None without any.

    They are dilated by two pixels, since resampling mixed their edges with black.
    """
    borders = None
    for row, image in enumerate(images):  # one at a time, to save memory
        brightest = image.max(-1)
        dark = brightest <= BLACK
        if not _outermost(dark).any():
            continue
        labels = skimage.measure.label(dark, connectivity=1)
        outer_labels = _outermost(labels)
        border = np.zeros(dark.shape, bool)
        for label in np.unique(outer_labels[outer_labels > 0]):
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
    borders = _black_borders(images)
    if borders is None:
        return valid, ()
    count = int(borders.any((1, 2)).sum())
    notes = (f"{count} frames have black borders: taken as not observed",)
    return ~borders if valid is None else valid & ~borders, notes


def _outermost(image):
    """The outermost pixels of [height, width] in one array."""
    sides = (image[0], image[-1], image[:, 0], image[:, -1])
    return np.concatenate(sides)
