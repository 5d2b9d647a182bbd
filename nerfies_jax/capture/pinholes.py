"""Undistortion of captures for pinhole renderers, and distortion of renders."""

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

    Focal lengths, principal points and image sizes are unchanged. Pixels that the lens
    did not observe are marked in `valid`. Color is sampled with a Lanczos filter, masks
    and depth at the nearest pixel. z-depth needs no change, since a ray keeps its
    points. Flow is dropped, since both of its ends would move.

    Args:
      capture: The capture.

    Returns:
      The undistorted capture, or the same one if it has no distortion.
    """
    if not has_lens(capture.cameras):
        return capture
    images = np.empty_like(capture.images)
    filmed = np.empty(images.shape[:3], bool)
    masks: dict[str, Any] = {
        name: None if array is None else np.empty_like(array)
        for name, array in (("moving", capture.moving), ("depths", capture.depths))
    }
    maps = Maps(_source_pixels, capture.size)
    with events.stage("undistorting images", len(images)) as stage:
        for row in range(len(images)):
            place, inside = maps.of(cameras.take(capture.cameras, row))
            images[row] = resampling.lanczos(capture.images[row], place)
            images[row][~inside] = 0
            filmed[row] = inside
            if capture.valid is not None:
                filmed[row] &= resampling.nearest(capture.valid[row], place)
            for name, array in masks.items():
                if array is not None:
                    source = getattr(capture, name)[row]
                    array[row] = np.where(inside, resampling.nearest(source, place), 0)
            stage.advance()
    note = (
        f"lens distortion taken out; {1 - filmed.mean():.1%} of the pixels are unseen"
    )
    return dataclasses.replace(
        capture,
        images=images,
        valid=None if filmed.all() else filmed,
        cameras=pinhole(capture.cameras),
        flow=None,
        notes=(*capture.notes, note),
        **masks,
    )


def scorable(filmed: Capture, traced: bool) -> Capture:
    """Mark the pixels of a distorted capture that renders can be compared with.

    Images stay distorted. Pixels that no renderer can predict are no longer `valid`,
    and their depth is unknown: those for which the lens model has no ray and, unless
    rays are traced through the lens, those outside the pinhole image of the same focal
    length and size that is rendered instead.

    Args:
      filmed: The capture with its original images.
      traced: True if the renderer traces rays through the lens.

    Returns:
      The capture with its masks and depth restricted, or the same one if it has no
      distortion.
    """
    if not has_lens(filmed.cameras):
        return filmed
    maps = Maps(_rays_exist if traced else pinhole_places, filmed.size)
    drawn = np.stack(
        [
            maps.of(cameras.take(filmed.cameras, row))[1]
            for row in range(len(filmed.ids))
        ]
    )
    depths = filmed.depths
    valid = drawn if filmed.valid is None else filmed.valid & drawn
    before = 1.0 if filmed.valid is None else filmed.valid.mean()
    if valid.mean() == before:
        return filmed
    what = "have no ray" if traced else "lie beyond the pinhole that is drawn"
    note = f"{before - valid.mean():.2%} of the pixels {what}, and are not scored"
    return dataclasses.replace(
        filmed,
        valid=valid,
        notes=(*filmed.notes, note),
        depths=None if depths is None else np.where(drawn, depths, np.float32(0)),
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
    """

    def __init__(self, places: Callable, size: tuple[int, int]):
        self._places, self._size = places, size
        self._kept: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def of(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the map of a camera.

        Args:
          camera: One camera.

        Returns:
          Array coordinates [2, height, width], and booleans of the pixels that have one
          [height, width].
        """
        key = b"".join(np.asarray(leaf).tobytes() for leaf in camera[2:])
        if key not in self._kept:
            self._kept[key] = self._places(camera, self._size)
        return self._kept[key]


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
    slopes, single = _straight(*_lens(camera), _slopes(camera, size))
    slopes = np.where(np.asarray(single)[:, None], np.asarray(slopes), np.nan)
    return resampling.array_places(_pixels(camera, slopes, size), size)


def _rays_exist(camera, size):
    """The pixels themselves, and whether the lens model has a ray for each."""
    _, single = _straight(*_lens(camera), _slopes(camera, size))
    place = np.indices(size[::-1], np.float32)
    return place, np.asarray(single).reshape(size[::-1])


def _lens(camera):
    return (np.asarray(part, np.float32) for part in (camera.radial, camera.tangential))


@jax.jit
def _straight(radial, tangential, bent):
    """Slopes of the rays that the lens bends to these, and whether there are any."""
    return jax.vmap(distortion.undistort, (None, None, 0))(radial, tangential, bent)


@jax.jit
def _bent(radial, tangential, slopes):
    """Distorted image-plane positions, and booleans where the lens is one-to-one."""
    each = (None, None, 0)
    bent = jax.vmap(distortion.distort, each)(radial, tangential, slopes)
    return bent, jax.vmap(distortion.one_to_one, each)(radial, tangential, slopes)


def _source_pixels(camera, size):
    """Locate each undistorted pixel in the distorted image, with booleans of success.

    Where the lens model folds back there is no pixel at all.
    """
    bent, single = _bent(*_lens(camera), _slopes(camera, size))
    bent = np.where(np.asarray(single)[:, None], np.asarray(bent), np.nan)
    return resampling.array_places(_pixels(camera, bent, size), size)


def _slopes(camera, size):
    """Image-plane positions [pixels, 2] of the pixel centers, without distortion."""
    focal, skew = float(camera.focal_px), float(camera.skew_px)
    offset = np.asarray(rays.pixel_centers(size)) - np.asarray(
        camera.principal_point_px
    )
    y = offset[..., 1] / (focal * float(camera.pixel_aspect))
    x = (offset[..., 0] - skew * y) / focal
    return np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32)


def _pixels(camera, slopes, size):
    """Pixel positions [height, width, 2] of image-plane positions [pixels, 2]."""
    focal, skew = float(camera.focal_px), float(camera.skew_px)
    slopes = slopes.reshape(size[1], size[0], 2)
    across = focal * slopes[..., 0] + skew * slopes[..., 1]
    down = focal * float(camera.pixel_aspect) * slopes[..., 1]
    return np.stack([across, down], axis=-1) + np.asarray(camera.principal_point_px)
