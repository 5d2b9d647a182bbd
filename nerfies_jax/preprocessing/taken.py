"""External preprocessing results, resampled to the frames of preprocessing."""

import cv2
import numpy as np

from nerfies_jax.capture.given import Given
from nerfies_jax.preprocessing import dense_flow
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.view_set import Views


def flow(given: Given, views: Views) -> NeighborFlow | None:
    """Resample external flow, with the same consistency check as computed flow.

    Args:
      given: External results.
      views: The frames.

    Returns:
      The flow, None if there is none.
    """
    if given.forward is None or given.backward is None:
        return None
    forward, backward = (
        np.stack([_resized_flow(one, views.size) for one in side[views.row]])
        for side in (given.forward, given.backward)
    )
    return dense_flow.checked(forward, backward)


def tracks(given: Given, views: Views) -> Tracks | None:
    """Resample external tracks, and select long ones.

    Args:
      given: External results.
      views: The frames.

    Returns:
      The tracks, each starting where it is first visible. None if there are none.
    """
    if given.track_pixel is None:
        return None
    return tracking.long_enough(_followed(given, views))


def _followed(given, views):
    scale = np.divide(views.size, given.size, dtype=np.float32)
    pixel = np.moveaxis(given.track_pixel[views.row], 0, 1) * scale
    visible = np.moveaxis(given.track_seen[views.row], 0, 1)
    return Tracks(visible.argmax(1), np.where(visible[..., None], pixel, 0), visible)


def moving(given: Given, views: Views) -> np.ndarray | None:
    """Resample external masks.

    Args:
      given: External results.
      views: The frames.

    Returns:
      Booleans [frames, height, width], None if there are none.
    """
    if given.moving is None:
        return None
    masks = [_resized(np.float32(one), views.size) for one in given.moving[views.row]]
    return np.stack(masks) > 0.5


def depth(given: Given, views: Views) -> np.ndarray | None:
    """Resample external depth.

    Args:
      given: External results.
      views: The frames.

    Returns:
      Depth at its original scale [frames, height, width], NaN if unknown. None if there
      is none.
    """
    if given.depth is None:
        return None
    nearest = cv2.INTER_NEAREST
    return np.stack(
        [_resized(one, views.size, nearest) for one in given.depth[views.row]]
    )


def _resized(image, size, how=cv2.INTER_AREA):
    if image.shape[1::-1] == size:
        return image
    return cv2.resize(image, size, interpolation=how)


def _resized_flow(shift, size):
    scale = np.divide(size, shift.shape[1::-1], dtype=np.float32)
    return _resized(shift, size) * scale
