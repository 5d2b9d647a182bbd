"""External preprocessing results, resampled to the frames of preprocessing."""

import cv2
import numpy as np

from nerfies_jax.capture.external import ExternalResults
from nerfies_jax.preprocessing import dense_flow
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.view_set import Views


def flow(external: ExternalResults, views: Views) -> NeighborFlow | None:
    """Resample external flow, with the same consistency check as computed flow.

    Args:
      external: External results.
      views: The frames.

    Returns:
      The flow, None if there is none.
    """
    if external.forward is None or external.backward is None:
        return None
    forward, backward = (
        np.stack([_resize_flow(shift, views.size) for shift in side[views.row]])
        for side in (external.forward, external.backward)
    )
    return dense_flow.checked(forward, backward)


def tracks(external: ExternalResults, views: Views) -> Tracks | None:
    """Resample external tracks, and select long ones.

    Args:
      external: External results.
      views: The frames.

    Returns:
      The tracks, each starting where it is first visible. None if there are none.
    """
    if external.track_pixel is None:
        return None
    return tracking.long_enough(_resample_tracks(external, views))


def _resample_tracks(external, views):
    scale = np.divide(views.size, external.size, dtype=np.float32)
    pixel = np.moveaxis(external.track_pixel[views.row], 0, 1) * scale
    visible = np.moveaxis(external.track_seen[views.row], 0, 1)
    return Tracks(visible.argmax(1), np.where(visible[..., None], pixel, 0), visible)


def moving(external: ExternalResults, views: Views) -> np.ndarray | None:
    """Resample external masks.

    Args:
      external: External results.
      views: The frames.

    Returns:
      Booleans [frames, height, width], None if there are none.
    """
    if external.moving is None:
        return None
    masks = [
        _resize(np.float32(mask), views.size) for mask in external.moving[views.row]
    ]
    return np.stack(masks) > 0.5


def depth(external: ExternalResults, views: Views) -> np.ndarray | None:
    """Resample external depth.

    Args:
      external: External results.
      views: The frames.

    Returns:
      Depth at its original scale [frames, height, width], NaN if unknown. None if there
      is none.
    """
    if external.depth is None:
        return None
    nearest = cv2.INTER_NEAREST
    return np.stack(
        [_resize(frame, views.size, nearest) for frame in external.depth[views.row]]
    )


def _resize(image, size, interpolation=cv2.INTER_AREA):
    if image.shape[1::-1] == size:
        return image
    return cv2.resize(image, size, interpolation=interpolation)


def _resize_flow(shift, size):
    scale = np.divide(size, shift.shape[1::-1], dtype=np.float32)
    return _resize(shift, size) * scale
