"""A picture read at other places than its pixel centers. Host side."""

import numpy as np
import scipy.ndimage


def array_places(
    pixels: np.ndarray, source_size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Array coordinates of pixel positions, and whether they lie in the picture.

    `pixels` [height, width, 2] are positions in px, NaN where there is none; the source
    is `source_size` (width, height). Returns row and column [2, height, width], zero
    where the position is not between the outermost pixel centers, and that mask.
    """
    place = np.moveaxis(pixels[..., ::-1], -1, 0) - 0.5  # centers lie at +0.5
    last = np.array(source_size[::-1])[:, None, None] - 1
    inside = np.isfinite(place).all(0)
    place = np.where(inside, place, 0)
    inside &= (place >= 0).all(0) & (place <= last).all(0)
    return np.where(inside, place, 0), inside


def bilinear(picture: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Color [height, width, channels] at array coordinates; uint8 is rounded."""
    channels = [
        scipy.ndimage.map_coordinates(
            picture[..., channel].astype(np.float32), place, order=1, mode="nearest"
        )
        for channel in range(picture.shape[-1])
    ]
    blended = np.stack(channels, axis=-1)
    return np.round(blended).astype(np.uint8) if picture.dtype == np.uint8 else blended


def nearest(picture: np.ndarray, place: np.ndarray) -> np.ndarray:
    """A mask or a depth map [height, width] at the nearest pixel to array coordinates.

    `place` [2, ...] is row and column, as of `array_places`; the result is [...].
    """
    row, column = np.round(place).astype(int)
    return picture[row, column]
