"""Take the lens out of the pictures, for renderers that draw pinholes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage

from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import distortion, rays


def undistorted(capture: Capture) -> Capture:
    """The same capture as pinholes would have filmed it; itself where they did.

    Focal length, principal point and size stay, so that nothing else changes; pixels
    that the lens did not film are marked in `valid`. Colour is sampled bilinearly,
    masks and depth from the nearest pixel. Z-depth needs no change: a ray keeps its
    points.
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
    maps: dict[bytes, np.ndarray] = {}
    for row in range(len(images)):
        camera = cameras.take(capture.cameras, row)
        # Frames of one physical camera share one map; the pose does not enter it.
        key = b"".join(np.asarray(leaf).tobytes() for leaf in camera[2:])
        if key not in maps:
            maps[key] = _source_pixels(camera, capture.size)
        places = maps[key]
        inside = _inside(places, capture.size)
        images[row] = _bilinear(capture.images[row], places)
        valid = None if capture.valid is None else capture.valid[row]
        filmed[row] = inside if valid is None else inside & _nearest(valid, places)
        images[row][~inside] = 0
        for name, array in masks.items():
            if array is not None:
                array[row] = _nearest(getattr(capture, name)[row], places)
                array[row][~inside] = 0
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
        notes=(*capture.notes, note),
        **masks,
    )


def _source_pixels(camera, size):
    """Where each pinhole pixel lies in the filmed picture: [height, width, 2], px.

    NaN where the lens model folds back, which is no pixel at all.
    """
    centre = np.asarray(camera.principal_point_px)
    focal = float(camera.focal_px)
    aspect, skew = float(camera.pixel_aspect), float(camera.skew_px)
    offset = np.asarray(rays.pixel_centres(size)) - centre
    y = offset[..., 1] / (focal * aspect)
    x = (offset[..., 0] - skew * y) / focal
    slopes = jnp.asarray(np.stack([x, y], axis=-1).reshape(-1, 2), jnp.float32)
    radial, tangential = jnp.asarray(camera.radial), jnp.asarray(camera.tangential)
    bent = jax.vmap(lambda slope: distortion.distort(radial, tangential, slope))(slopes)
    single = jax.vmap(lambda slope: distortion.one_to_one(radial, tangential, slope))(
        slopes
    )
    bent = np.where(np.asarray(single)[:, None], np.asarray(bent), np.nan)
    bent = bent.reshape(size[1], size[0], 2)
    across = focal * bent[..., 0] + skew * bent[..., 1]
    down = focal * aspect * bent[..., 1]
    return np.stack([across, down], axis=-1) + centre


def _inside(places, size):
    width, height = size
    across, down = places[..., 0], places[..., 1]
    # Half a pixel short of the border: bilinear sampling needs four neighbours.
    return (
        (across >= 0.5)
        & (across <= width - 0.5)
        & (down >= 0.5)
        & (down <= height - 0.5)
    )


def _bilinear(picture, places):
    rows_columns = np.nan_to_num(np.moveaxis(places[..., ::-1] - 0.5, -1, 0), nan=-1e6)
    sampled = [
        scipy.ndimage.map_coordinates(
            picture[..., channel].astype(np.float32),
            rows_columns,
            order=1,
            mode="nearest",
        )
        for channel in range(picture.shape[-1])
    ]
    return np.round(np.stack(sampled, axis=-1)).astype(picture.dtype)


def _nearest(picture, places):
    height, width = picture.shape
    column, row = (np.nan_to_num(places[..., i], nan=0.0).astype(int) for i in (0, 1))
    return picture[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
