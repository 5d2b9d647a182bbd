"""Sampling of images between pixel centers, on the host."""

import numpy as np
import scipy.ndimage


def array_places(
    pixels: np.ndarray, source_size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Convert pixel positions to array coordinates.

    Args:
      pixels: Positions (x, y) in pixels with centers at +0.5, [height, width, 2], NaN
        where there is none.
      source_size: Width and height of the image in pixels.

    Returns:
      Rows and columns [2, height, width], zero for positions outside of the outermost
      pixel centers, and booleans of those inside [height, width].
    """
    place = np.moveaxis(pixels[..., ::-1], -1, 0) - 0.5  # centers lie at +0.5
    last = np.array(source_size[::-1])[:, None, None] - 1
    inside = np.all(np.isfinite(place), axis=0)
    place = np.where(inside, place, 0)
    inside &= np.all((place >= 0) & (place <= last), axis=0)
    return np.where(inside, place, 0), inside


def bilinear(picture: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Sample an image bilinearly.

    Args:
      picture: Image, [height, width, channels].
      place: Array coordinates (row, column), [2, ...].

    Returns:
      Colors [..., channels], rounded if the image is uint8.
    """
    channels = [
        scipy.ndimage.map_coordinates(
            picture[..., channel].astype(np.float32), place, order=1, mode="nearest"
        )
        for channel in range(picture.shape[-1])
    ]
    blended = np.stack(channels, axis=-1)
    return np.round(blended).astype(np.uint8) if picture.dtype == np.uint8 else blended


def nearest(picture: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Sample a mask or depth map at the nearest pixel.

    Args:
      picture: Mask or depth map, [height, width].
      place: Array coordinates (row, column), [2, ...].

    Returns:
      Values, [...].
    """
    row, column = np.round(place).astype(int)
    return picture[row, column]
