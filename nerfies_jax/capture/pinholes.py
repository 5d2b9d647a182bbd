"""Undistortion of captures for renderers that support only pinhole cameras."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from nerfies_jax.capture import resampling
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import distortion, rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.runtime import events


def as_pinholes(capture: Capture) -> Capture:
    """Undistort a capture to pinhole cameras.

    Focal lengths, principal points and image sizes are unchanged. Pixels outside of the
    distorted image are marked in `valid`. Color is sampled with a Lanczos filter, masks
    and depth at the nearest pixel. The z-depth of a point does not depend on the lens.
    Flow is dropped, since both of its ends would have to be resampled.

    Args:
      capture: The capture.

    Returns:
      The undistorted capture, or the same one if it has no distortion.
    """
    if not has_lens(capture.cameras):
        return capture
    images = np.empty_like(capture.images)
    valid = np.empty(images.shape[:3], bool)
    masks: dict[str, Any] = {
        name: None if array is None else np.empty_like(array)
        for name, array in (("moving", capture.moving), ("depths", capture.depths))
    }
    maps = Maps(_source_pixels, capture.size)
    with events.stage("undistorting images", len(images)) as stage:
        for row in range(len(images)):
            index, inside = maps.of(cameras.take(capture.cameras, row))
            images[row] = resampling.lanczos(capture.images[row], index)
            images[row][~inside] = 0
            valid[row] = inside
            if capture.valid is not None:
                valid[row] &= resampling.nearest(capture.valid[row], index)
            for name, array in masks.items():
                if array is not None:
                    source = getattr(capture, name)[row]
                    array[row] = np.where(inside, resampling.nearest(source, index), 0)
            stage.advance()
    note = f"images undistorted; {1 - valid.mean():.1%} of their pixels are unobserved"
    return dataclasses.replace(
        capture,
        images=images,
        valid=None if valid.all() else valid,
        cameras=pinhole(capture.cameras),
        flow=None,
        notes=(*capture.notes, note),
        **masks,
    )


def scorable(capture: Capture, traced: bool) -> Capture:
    """Restrict the masks of a distorted capture to pixels that can be evaluated.

    Images stay distorted. Pixels without a prediction are no longer `valid`, and their
    depth becomes unknown. These are pixels for which the lens model has no ray and,
    unless rays are traced through the lens, pixels outside of the rendered pinhole
    image, which has the same focal length and size.

    Args:
      capture: The capture with its original images.
      traced: True if the renderer traces rays through the lens.

    Returns:
      The capture with its masks and depth restricted, or the same one if it has no
      distortion.
    """
    if not has_lens(capture.cameras):
        return capture
    maps = Maps(_rays_exist if traced else pinhole_places, capture.size)
    predicted = np.stack(
        [
            maps.of(cameras.take(capture.cameras, row))[1]
            for row in range(len(capture.ids))
        ]
    )
    depths = capture.depths
    valid = predicted if capture.valid is None else capture.valid & predicted
    share_before = 1.0 if capture.valid is None else capture.valid.mean()
    if valid.mean() == share_before:
        return capture
    reason = "have no ray" if traced else "lie outside of the rendered pinhole image"
    note = f"{share_before - valid.mean():.2%} of the pixels {reason}: not evaluated"
    return dataclasses.replace(
        capture,
        valid=valid,
        notes=(*capture.notes, note),
        depths=None if depths is None else np.where(predicted, depths, np.float32(0)),
    )


def has_lens(camera: Camera) -> bool:
    """Test if a camera, or any of a batch, has lens distortion.

    Args:
      camera: A camera or a batch.

    Returns:
      True if a coefficient is not zero.
    """
    return bool(np.any(camera.radial) or np.any(camera.tangential))


def pinhole(camera: Camera) -> Camera:
    """Remove the distortion coefficients of cameras.

    Args:
      camera: A camera or a batch.

    Returns:
      The cameras without distortion.
    """
    return camera._replace(radial=0 * camera.radial, tangential=0 * camera.tangential)


class Maps:
    """Resampling maps for cameras of one image size, cached by intrinsics.

    Frames of one physical camera share a map, since it does not depend on the pose.

    Args:
      places: Function that computes the map of a camera and an image size.
      size: Width and height of the images in pixels.
    """

    def __init__(self, places: Callable, size: tuple[int, int]):
        self._places, self._size = places, size
        self._cache: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def of(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the map of a camera.

        Args:
          camera: One camera.

        Returns:
          Array coordinates [2, height, width], and booleans of the pixels that have one
          [height, width].
        """
        key = b"".join(np.asarray(leaf).tobytes() for leaf in camera[2:])
        if key not in self._cache:
            self._cache[key] = self._places(camera, self._size)
        return self._cache[key]


def pinhole_places(
    camera: Camera, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Locate each pixel of a distorted image in the undistorted image.

    The pinhole has the focal length, principal point and size of the distorted image.

    Args:
      camera: One camera with its distortion.
      size: Width and height of the image in pixels.

    Returns:
      Array coordinates [2, height, width] as in `resampling.array_places`, and booleans
      of the pixels inside the undistorted image [height, width].
    """
    plane, is_unique = _undistort(*_lens(camera), _pixel_grid(camera, size))
    plane = np.where(np.asarray(is_unique)[:, None], np.asarray(plane), np.nan)
    return resampling.array_places(_pixels(camera, plane, size), size)


def _rays_exist(camera, size):
    """The identity map, and booleans of the pixels for which the lens has a ray."""
    _, is_unique = _undistort(*_lens(camera), _pixel_grid(camera, size))
    index = np.indices(size[::-1], np.float32)
    return index, np.asarray(is_unique).reshape(size[::-1])


def _lens(camera):
    return (np.asarray(part, np.float32) for part in (camera.radial, camera.tangential))


@jax.jit
def _undistort(radial, tangential, distorted):
    """Undistorted image-plane positions, and booleans of those that exist."""
    each = (None, None, 0)
    return jax.vmap(distortion.undistort, each)(radial, tangential, distorted)


@jax.jit
def _distort(radial, tangential, plane):
    """Distorted image-plane positions, and booleans where the lens is one-to-one."""
    each = (None, None, 0)
    distorted = jax.vmap(distortion.distort, each)(radial, tangential, plane)
    return distorted, jax.vmap(distortion.one_to_one, each)(radial, tangential, plane)


def _source_pixels(camera, size):
    """Locate each undistorted pixel in the distorted image, with booleans of success.

    There is no such pixel where the lens model is not one-to-one.
    """
    plane, is_unique = _distort(*_lens(camera), _pixel_grid(camera, size))
    plane = np.where(np.asarray(is_unique)[:, None], np.asarray(plane), np.nan)
    return resampling.array_places(_pixels(camera, plane, size), size)


def _pixel_grid(camera, size):
    """Image-plane positions [pixels, 2] of the pixel centers, without distortion."""
    focal, skew = float(camera.focal_px), float(camera.skew_px)
    offset = np.asarray(rays.pixel_centers(size)) - np.asarray(
        camera.principal_point_px
    )
    y = offset[..., 1] / (focal * float(camera.pixel_aspect))
    x = (offset[..., 0] - skew * y) / focal
    return np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32)


def _pixels(camera, plane, size):
    """Pixel positions [height, width, 2] of image-plane positions [pixels, 2]."""
    focal, skew = float(camera.focal_px), float(camera.skew_px)
    plane = plane.reshape(size[1], size[0], 2)
    x = focal * plane[..., 0] + skew * plane[..., 1]
    y = focal * float(camera.pixel_aspect) * plane[..., 1]
    return np.stack([x, y], axis=-1) + np.asarray(camera.principal_point_px)
