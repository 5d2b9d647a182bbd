"""Undistortion of captures for preprocessing, and pixels with and without a lens."""

import dataclasses
import math
import weakref
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from nerfies_jax.capture import external_lens, frame_memory, resampling
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import lens, rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.runtime import events

# Share of each side by which undistorted images grow at most, on both sides together.
# Corners of a fisheye lie at any distance.
MOST_GROWTH = 0.5
MOST_KEPT_BYTES = 256_000_000  # of undistorted images that are kept for the next use


class Canvas(NamedTuple):
    """Undistorted images of a capture, in which all pinholes have the same size."""

    size: tuple[int, int]  # width and height in pixels
    left: int  # columns that are added at the left
    top: int  # rows that are added at the top


def as_pinholes(capture: Capture) -> Capture:
    """Undistort a capture to pinhole cameras.

    Focal lengths are unchanged. Images grow until they contain all observed pixels, at
    most by `MOST_GROWTH` of their sides. Pixels that the lens did not observe are
    marked in `valid`. Color is sampled with a Lanczos filter, masks and depth at the
    nearest pixel. z-depth needs no change, since a ray keeps its points. External
    preprocessing results (`external`) are mapped too. Flow of the capture is dropped,
    since both of its ends would move.

    Args:
      capture: The capture.

    Returns:
      The undistorted capture, or the same one if it has no distortion.
    """
    if not has_lens(capture.cameras):
        return capture
    wide = canvas(capture)
    arrays = _last.arrays(capture)
    if arrays is None:
        arrays = _undistort(capture, wide)
        if arrays["images"].nbytes <= MOST_KEPT_BYTES:
            _last.keep(capture, arrays)
    valid = arrays["valid"]
    note = f"images undistorted; {1 - valid.mean():.1%} of their pixels are unobserved"
    return dataclasses.replace(
        capture,
        **arrays | {"valid": None if valid.all() else valid},
        cameras=cameras.crop(pinhole(capture.cameras), -wide.left, -wide.top),
        flow=None,
        external=None if capture.external is None else _last.external(capture, wide),
        notes=(*capture.notes, note),
    )


class _Last:
    """Undistorted arrays of the last capture, for as long as its images exist.

    A run undistorts its capture for each part of preprocessing.
    """

    def __init__(self):
        self._forget()

    def _forget(self, _=None):
        self._images: Any = lambda: None
        self._others, self._arrays = (), None
        # External results, and undistorted.
        self._external: tuple[Any, Any] = (None, None)

    def arrays(self, capture):
        others = _others(capture)
        is_same = self._images() is capture.images and len(others) == len(self._others)
        if is_same and all(a is b for a, b in zip(others, self._others, strict=True)):
            return self._arrays
        return None

    def keep(self, capture, arrays):
        self._forget()
        self._images = weakref.ref(capture.images, self._forget)
        self._others, self._arrays = _others(capture), arrays

    def external(self, capture, wide):
        if self.arrays(capture) is None:  # too large to be kept
            return _undistort_external(capture, capture.external, wide)
        if self._external[0] is not capture.external:
            external = _undistort_external(capture, capture.external, wide)
            self._external = capture.external, external
        return self._external[1]


def _others(capture):
    leaves = jax.tree.leaves(capture.cameras)
    return (capture.valid, capture.moving, capture.depths, *leaves)


_last = _Last()


def _undistort(capture, wide):
    """Images, masks and depths by name, with booleans of the observed pixels."""
    shape = (len(capture.images), *wide.size[::-1])
    images = frame_memory.allocate((*shape, 3), capture.images.dtype)
    valid = frame_memory.allocate(shape, np.bool_)
    masks: dict[str, Any] = {
        name: None if array is None else frame_memory.allocate(shape, array.dtype)
        for name, array in (("moving", capture.moving), ("depths", capture.depths))
    }

    maps = _source_maps(capture, wide)
    with events.stage("undistorting images", len(images)) as stage:
        for row in range(len(images)):
            place, inside = maps.of(cameras.take(capture.cameras, row))
            images[row] = resampling.lanczos(capture.images[row], place)
            images[row][~inside] = 0
            valid[row] = inside
            if capture.valid is not None:
                valid[row] &= resampling.nearest(capture.valid[row], place)
            for name, array in masks.items():
                if array is not None:
                    source = getattr(capture, name)[row]
                    array[row] = np.where(inside, resampling.nearest(source, place), 0)
            stage.advance()
    return {"images": images, "valid": valid, **masks}


def _undistort_external(capture, external, wide):
    camera_of = [cameras.take(capture.cameras, row) for row in range(len(capture.ids))]
    maps = _source_maps(capture, wide)
    order = np.argsort(capture.times[capture.train], kind="stable")

    def straight(row, pixel):
        camera = camera_of[row]
        slopes, exists = _straight(_float32(camera), _slopes_at(camera, pixel))
        positions = _pixels_at(camera, np.asarray(slopes))
        return positions + np.array([wide.left, wide.top]), np.asarray(exists)

    return external_lens.undistorted(
        external,
        wide.size,
        capture.train[order],
        lambda row: maps.of(camera_of[row]),
        straight,
    )


def canvas(capture: Capture) -> Canvas:
    """Find the size of the undistorted images of a capture.

    Args:
      capture: The capture.

    Returns:
      The size, and the columns and rows that are added. Those of the capture itself if
      it has no distortion.
    """
    width, height = capture.size
    if not has_lens(capture.cameras):
        return Canvas(capture.size, 0, 0)
    low, high = np.zeros(2), np.array([width, height], float)
    maps = Maps(_straight_pixels, capture.size)
    for row in range(len(capture.ids)):
        pixels, single = maps.of(cameras.take(capture.cameras, row))
        if single.any():
            low = np.minimum(low, pixels[single].min(axis=0) - 0.5)
            high = np.maximum(high, pixels[single].max(axis=0) + 0.5)
    # Equal growth on both sides, so that a strong lens loses as much on either.
    most = np.floor(MOST_GROWTH / 2 * np.array([width, height]))
    left, top = (math.ceil(x) for x in np.minimum(-low, most))
    right, bottom = (math.ceil(x) for x in np.minimum(high - (width, height), most))
    return Canvas((width + left + right, height + top + bottom), left, top)


def as_observed(
    image: np.ndarray, camera: Camera, wide: Canvas, size: tuple[int, int]
) -> np.ndarray:
    """Distort a mask of undistorted pixels to those of a captured image.

    Args:
      image: Mask in an undistorted image, [canvas height, canvas width].
      camera: One camera with its distortion.
      wide: The canvas of its capture.
      size: Width and height of the captured image in pixels.

    Returns:
      The mask [height, width], False where the undistorted image ends.
    """
    if not has_lens(camera):
        return image
    pixels, single = _straight_pixels(camera, size)
    pixels = np.where(single[..., None], pixels, np.nan)
    pixels = pixels + np.array([wide.left, wide.top])
    place, inside = resampling.array_places(pixels, wide.size)
    return inside & resampling.nearest(image, place)


def scorable(observed: Capture) -> Capture:
    """Mark the pixels of a distorted capture for which its lens model has a ray.

    The other pixels are no longer `valid`, and their depth is unknown.

    Args:
      observed: The capture.

    Returns:
      The capture with its masks and depth restricted, or the same one if the lens model
      has a ray for every pixel.
    """
    if not has_lens(observed.cameras):
        return observed
    maps = Maps(_straight_pixels, observed.size)
    each = [
        maps.of(cameras.take(observed.cameras, row))[1]
        for row in range(len(observed.ids))
    ]
    if all(pixels.all() for pixels in each):
        return observed
    scorable_pixels = frame_memory.allocate(observed.images.shape[:3], np.bool_)
    np.stack(each, out=scorable_pixels)
    valid = scorable_pixels
    if observed.valid is not None:
        valid = frame_memory.allocate(scorable_pixels.shape, np.bool_)
        np.logical_and(observed.valid, scorable_pixels, out=valid)
    depths = observed.depths
    before = 1.0 if observed.valid is None else observed.valid.mean()
    if valid.mean() == before:
        return observed
    note = f"{before - valid.mean():.2%} of the pixels have no ray, and are not scored"
    return dataclasses.replace(
        observed,
        valid=valid,
        notes=(*observed.notes, note),
        depths=None
        if depths is None
        else np.where(scorable_pixels, depths, np.float32(0)),
    )


def has_lens(camera: Camera) -> bool:
    """Test if a camera, or any of a batch, has lens distortion.

    Args:
      camera: A camera or a batch.

    Returns:
      True if a coefficient is not zero, or for a fisheye.
    """
    if camera.fisheye is not None:
        return True
    return bool(np.any(camera.radial) or np.any(camera.tangential))


def pinhole(camera: Camera) -> Camera:
    """Remove the distortion coefficients of cameras.

    Args:
      camera: A camera or a batch.

    Returns:
      The cameras without distortion.
    """
    return camera._replace(
        radial=0 * camera.radial, tangential=0 * camera.tangential, fisheye=None
    )


class Maps:
    """Positions of pixels for cameras of one image size, cached by intrinsics.

    Frames of one physical camera share them, since they do not depend on the pose.
    """

    def __init__(self, places: Callable, size: tuple[int, int]):
        self._places, self._size = places, size
        self._kept: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def of(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of one camera, and booleans of those that exist.

        Args:
          camera: The camera.

        Returns:
          Positions [height, width, 2] in pixels, and booleans [height, width].
        """
        leaves = jax.tree.leaves(camera[2:])
        key = b"".join(np.asarray(leaf).tobytes() for leaf in leaves)
        if key not in self._kept:
            self._kept[key] = self._places(camera, self._size)
        return self._kept[key]


def _source_maps(capture, wide):
    return Maps(lambda camera, size: _source_pixels(camera, size, wide), capture.size)


def _straight_pixels(camera, size):
    """Undistorted positions [height, width, 2] of pixels, and whether they have any."""
    slopes, single = _straight(_float32(camera), _slopes(camera, size))
    single = np.asarray(single).reshape(size[::-1])
    return _pixels(camera, np.asarray(slopes), size), single


def _source_pixels(camera, size, wide):
    """Locate each undistorted pixel in the distorted image, with booleans of success.

    Where the lens model folds back there is no pixel at all.
    """
    straight = cameras.crop(pinhole(camera), -wide.left, -wide.top)
    positions, single = _distort(_float32(camera), _slopes(straight, wide.size))
    positions = np.where(np.asarray(single)[:, None], np.asarray(positions), np.nan)
    return resampling.array_places(_pixels(camera, positions, wide.size), size)


def _float32(camera):
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), camera)


@jax.jit
def _straight(camera, positions):
    """Undistorted slopes of distorted positions, and booleans where they exist."""
    return jax.vmap(lens.undistort, (None, 0))(camera, positions)


@jax.jit
def _distort(camera, slopes):
    """Distorted image-plane positions, and booleans where the lens is one-to-one."""
    positions = jax.vmap(lens.distort, (None, 0))(camera, slopes)
    return positions, jax.vmap(lens.one_to_one, (None, 0))(camera, slopes)


def _slopes(camera, size):
    """Image-plane positions [pixels, 2] of the pixel centers, without distortion."""
    return _slopes_at(camera, np.asarray(rays.pixel_centers(size)).reshape(-1, 2))


def _slopes_at(camera, pixels):
    """Image-plane positions [points, 2] of pixel positions, without distortion."""
    focal, skew = float(camera.focal_px), float(camera.skew_px)
    offset = pixels - np.asarray(camera.principal_point_px)
    y = offset[..., 1] / (focal * float(camera.pixel_aspect))
    x = (offset[..., 0] - skew * y) / focal
    return np.stack([x, y], axis=-1).astype(np.float32)


def _pixels(camera, slopes, size):
    """Pixel positions [height, width, 2] of image-plane positions [pixels, 2]."""
    return _pixels_at(camera, slopes).reshape(size[1], size[0], 2)


def _pixels_at(camera, slopes):
    """Pixel positions [points, 2] of image-plane positions."""
    focal, skew = float(camera.focal_px), float(camera.skew_px)
    across = focal * slopes[..., 0] + skew * slopes[..., 1]
    down = focal * float(camera.pixel_aspect) * slopes[..., 1]
    return np.stack([across, down], axis=-1) + np.asarray(camera.principal_point_px)
