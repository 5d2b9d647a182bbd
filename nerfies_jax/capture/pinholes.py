"""Take the lens out of the pictures, for renderers that draw pinholes."""

import dataclasses

import jax
import numpy as np

from nerfies_jax.capture import resampling
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import distortion, rays


def as_pinholes(capture: Capture) -> Capture:
    """The same capture as pinholes would have filmed it; itself where they did.

    Focal length, principal point and size stay, so that nothing else changes; pixels
    that the lens did not film are marked in `valid`. Colour is sampled bilinearly,
    masks and depth from the nearest pixel. Z-depth needs no change: a ray keeps its
    points. Flow is left out: both its ends would move.
    """
    lens = np.concatenate([capture.cameras.radial, capture.cameras.tangential], axis=1)
    if not lens.any():
        return capture
    images = np.empty_like(capture.images)
    filmed = np.empty(images.shape[:3], bool)
    masks = {
        name: None if array is None else np.empty_like(array)
        for name, array in (("moving", capture.moving), ("depths", capture.depths))
    }
    maps: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
    for row in range(len(images)):
        camera = cameras.take(capture.cameras, row)
        # Frames of one physical camera share one map; the pose does not enter it.
        key = b"".join(np.asarray(leaf).tobytes() for leaf in camera[2:])
        if key not in maps:
            maps[key] = _source_pixels(camera, capture.size)
        place, inside = maps[key]
        images[row] = resampling.bilinear(capture.images[row], place)
        images[row][~inside] = 0
        filmed[row] = inside
        if capture.valid is not None:
            filmed[row] &= resampling.nearest(capture.valid[row], place)
        for name, array in masks.items():
            if array is not None:
                source = getattr(capture, name)[row]
                array[row] = np.where(inside, resampling.nearest(source, place), 0)
    note = (
        f"lens distortion taken out; {1 - filmed.mean():.1%} of the pixels are unseen"
    )
    return dataclasses.replace(
        capture,
        images=images,
        valid=None if filmed.all() else filmed,
        cameras=capture.cameras._replace(
            radial=np.zeros_like(capture.cameras.radial),
            tangential=np.zeros_like(capture.cameras.tangential),
        ),
        flow=None,
        notes=(*capture.notes, note),
        **masks,
    )


@jax.jit
def _bent(radial, tangential, slopes):
    """Distorted slopes, and whether the lens has them once."""
    each = (None, None, 0)
    bent = jax.vmap(distortion.distort, each)(radial, tangential, slopes)
    return bent, jax.vmap(distortion.one_to_one, each)(radial, tangential, slopes)


def _source_pixels(camera, size):
    """Where each pinhole pixel lies in the filmed picture, and whether it does.

    Where the lens model folds back there is no pixel at all.
    """
    centre = np.asarray(camera.principal_point_px)
    focal = float(camera.focal_px)
    aspect, skew = float(camera.pixel_aspect), float(camera.skew_px)
    offset = np.asarray(rays.pixel_centres(size)) - centre
    y = offset[..., 1] / (focal * aspect)
    x = (offset[..., 0] - skew * y) / focal
    slopes = np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32)
    bent, single = _bent(camera.radial, camera.tangential, slopes)
    bent = np.where(np.asarray(single)[:, None], np.asarray(bent), np.nan)
    bent = bent.reshape(size[1], size[0], 2)
    across = focal * bent[..., 0] + skew * bent[..., 1]
    down = focal * aspect * bent[..., 1]
    return resampling.array_places(np.stack([across, down], axis=-1) + centre, size)
