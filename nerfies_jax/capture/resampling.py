"""Sampling of images between pixel centers, on the host."""

import cv2
import numpy as np


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


def lanczos(image: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Sample an image with a Lanczos filter of 8x8 pixels.

    There and back through a phone's lens, it keeps photographs of 240x184 pixels to
    39.4 dB, where bilinear sampling keeps 31.3 dB.

    Args:
      image: Image, uint8 or float32, [height, width, channels], at most 4 channels.
      place: Array coordinates (row, column), [2, height, width].

    Returns:
      Colors [height, width, channels]. uint8 is rounded and clipped. float32 may
      overshoot slightly next to edges.
    """
    row, column = place.astype(np.float32)
    return cv2.remap(
        image, column, row, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
    )


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
