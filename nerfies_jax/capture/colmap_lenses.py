"""Undistortion of images with unsupported lens models to a pinhole camera."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerfies_jax.capture import resampling
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.colmap_library import library


def undistort(
    images: np.ndarray,
    masks: Sequence[np.ndarray | None],
    lenses: Sequence[Any],
    where: str,
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray | None], Any]:
    """Resample images to one pinhole camera.

    The pinhole is the one that COLMAP's undistorter chooses for the first lens. Images
    are sampled with a Lanczos filter, masks at the nearest pixel. Pixels outside of the
    outermost pixel centers of the source image do not exist and are black.

    Args:
      images: uint8 images, [frames, height, width, 3].
      masks: Masks [frames, height, width], or None.
      lenses: One pycolmap.Camera per frame.
      where: Name of the capture in error messages.

    Returns:
      uint8 images, booleans of existing pixels [frames, height, width], the masks, and
      the pinhole as a pycolmap.Camera.
    """
    pycolmap = library()
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lenses[0])
    width, height = pinhole.width, pinhole.height
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack(
        [
            (x.ravel() - pinhole.principal_point_x) / pinhole.focal_length_x,
            (y.ravel() - pinhole.principal_point_y) / pinhole.focal_length_y,
            np.ones(x.size),
        ],
        axis=1,
    )
    out = np.zeros((len(images), height, width, 3), np.uint8)
    exists = np.zeros(out.shape[:3], bool)
    out_masks = [
        None if mask is None else np.zeros(out.shape[:3], bool) for mask in masks
    ]
    maps = {}
    for row, lens in enumerate(lenses):
        key = (lens.model_name, *lens.params)
        if key not in maps:
            maps[key] = _source_pixels(lens, rays, images.shape[1:3], (height, width))
        index, inside = maps[key]
        if not inside.any():
            raise CaptureError(
                f"{where}: the {lens.model_name} lens of frame {row} covers no pixel "
                "of its undistorted image; calibrate it again"
            )
        exists[row] = inside
        out[row] = resampling.lanczos(images[row], index) * inside[..., None]
        for target, mask in zip(out_masks, masks, strict=True):
            if target is not None and mask is not None:
                target[row] = resampling.nearest(mask[row], index) & inside
    return out, exists, out_masks, pinhole


def _source_pixels(lens, rays, source_shape, target_shape):
    """Array coordinates [2, height, width] in the source, and a mask of valid ones."""
    pixel = lens.img_from_cam(rays).reshape(*target_shape, 2)
    return resampling.array_places(pixel, source_shape[::-1])
