"""External preprocessing results of distorted images, mapped to undistorted ones."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from nerfies_jax.capture import resampling
from nerfies_jax.capture.external import ExternalResults

NOWHERE = 1e5  # px, flow of pixels that the lens did not observe

# Positions of the undistorted pixels in the distorted image of a frame, as array
# coordinates [2, height, width], and booleans of those inside [height, width].
Sources = Callable[[int], tuple[np.ndarray, np.ndarray]]
# Undistorted positions of distorted ones in pixels of a frame, [points, 2], and
# booleans of those that exist.
Straight = Callable[[int, np.ndarray], tuple[np.ndarray, np.ndarray]]


def undistorted(
    external: ExternalResults,
    size: tuple[int, int],
    in_time: np.ndarray,
    sources: Sources,
    straight: Straight,
) -> ExternalResults:
    """Map external results from images as they were captured to undistorted images.

    Masks, depth and flow are sampled at the nearest pixel, because they have edges.
    z-depth needs no change, since a ray keeps its points.

    Args:
      external: External results in pixels of the captured images.
      size: Width and height of the undistorted images in pixels.
      in_time: Indices of the training frames in temporal order, between which flow is.
      sources: Positions of undistorted pixels in the captured image of a frame.
      straight: Undistorted positions of pixels of a captured image of a frame.

    Returns:
      The results in pixels of the undistorted images. Unobserved pixels are static,
      have unknown depth, and inconsistent flow.
    """
    parts: dict[str, Any] = {}
    if external.track_pixel is not None and external.track_seen is not None:
        pixel, is_visible = (
            np.zeros_like(external.track_pixel),
            external.track_seen.copy(),
        )
        for frame, visible in enumerate(is_visible):
            place, exists = straight(frame, external.track_pixel[frame])
            visible &= exists & ((place > 0) & (place < size)).all(-1)
            pixel[frame] = np.where(visible[:, None], place, 0)
        parts |= {"track_pixel": pixel, "track_seen": is_visible}
    unknown = {"moving": False, "depth": np.nan}
    for name, outside in unknown.items():
        array = getattr(external, name)
        if array is None:
            continue
        parts[name] = np.empty((len(array), *size[::-1]), array.dtype)
        for frame, image in enumerate(array):
            place, inside = sources(frame)
            values = resampling.nearest(image, place)
            parts[name][frame] = np.where(inside, values, outside)
    pairs = {
        "forward": itertools.pairwise(in_time),
        "backward": itertools.pairwise(in_time[::-1]),
    }
    for name, frames in pairs.items():
        array = getattr(external, name)
        if array is None:
            continue
        parts[name] = np.full((len(array), *size[::-1], 2), NOWHERE, np.float32)
        for row, other in frames:
            parts[name][row] = _flow(array[row], sources(row), other, straight)
    return external._replace(size=size, **parts)


def _flow(flow, sources, other, straight):
    """Undistort both ends of the flow from a frame to another one."""
    place, inside = sources
    start = np.moveaxis(place[::-1], 0, -1) + 0.5
    end = (start + resampling.nearest(flow, place)).reshape(-1, 2)
    end, exists = straight(other, end.astype(np.float32))
    height, width = inside.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    shift = end.reshape(height, width, 2) - np.stack([x, y], -1)
    valid = inside & exists.reshape(height, width)
    return np.where(valid[..., None], shift, NOWHERE).astype(np.float32)
