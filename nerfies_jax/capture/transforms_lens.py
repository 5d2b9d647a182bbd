"""Intrinsics of transforms*.json, which may be set per file, per frame, or both."""

import math
from typing import NamedTuple

from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.transforms import (
    CENTER,
    DISTORTION,
    FOCAL,
    MODEL,
    Frame,
    Lens,
    Transforms,
)

PINHOLES = {
    *("", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"),
    "PERSPECTIVE",
}
FISHEYE = "OPENCV_FISHEYE"
# Without a stated size, the ratio n of the sizes of the calibrated images and of these
# images is that of the principal point to the image center, within this share. The
# principal point of real lenses lies a few percent off the center.
CENTERED = 0.1
# Share within which the horizontal and vertical ratio agree if they are not integers.
ALIKE = 0.03


class Intrinsics(NamedTuple):
    """Intrinsics of one frame, in pixels of its image."""

    focal_px: tuple[float, float]  # horizontal and vertical
    principal_point_px: tuple[float, float]
    radial: tuple[float, float, float]
    tangential: tuple[float, float]
    fisheye: tuple[float, float, float, float] | None  # replaces the other two
    size: tuple[float, float]  # of the images that the file's intrinsics refer to
    larger: bool  # True if that size was derived from the principal point


def resolve(
    entry: Frame, transforms: Transforms, size: tuple[int, int], label: str
) -> Intrinsics:
    """Resolve the intrinsics of a frame.

    Size, focal lengths, principal point, camera model and distortion are one group
    each. If the frame has any key of a group, the group is taken from the frame, else
    from the file.

    Args:
      entry: The frame.
      transforms: The file.
      size: Width and height of the frame's image in pixels.
      label: Name of the frame in error messages.

    Returns:
      The intrinsics.

    Raises:
      CaptureError: If a focal length is missing or invalid, the camera model is not
        supported, or its size does not match the image.
    """
    distortion = _distortion(entry, transforms, label)
    stated_size = _stated_size(entry) or _stated_size(transforms) or (None, None)
    width, height = (
        side if side is not None else image_side
        for side, image_side in zip(stated_size, size, strict=True)
    )
    if min(width, height) <= 0 or abs(size[0] * height / width - size[1]) > 1:
        raise CaptureError(
            f"{label} is {size[0]}x{size[1]} pixels but its camera says "
            f"{width:g}x{height:g}; correct w and h or the image"
        )
    level = _level(entry, transforms, CENTER)
    # A frame and its file may refer to different sizes. Each group has its level's.
    center_size = _size_of(level, (width, height), size)
    center = (
        center_size[0] / 2 if level.cx is None else level.cx,
        center_size[1] / 2 if level.cy is None else level.cy,
    )
    times = 1
    if stated_size == (None, None) and None not in (level.cx, level.cy):
        times = _times_as_large(center, size, label)
    level = _level(entry, transforms, FOCAL)
    focal_size = _size_of(level, (width, height), size)
    focal = _focal(level, [times * side for side in focal_size], label)
    return Intrinsics(
        focal_px=tuple(f * size[0] / (times * focal_size[0]) for f in focal),
        principal_point_px=tuple(
            c * size[0] / (times * center_size[0]) for c in center
        ),
        **distortion,
        size=(times * width, times * height),
        larger=times != 1,
    )


def _level(entry, transforms, keys) -> Lens:
    """Return the frame if it has any of these keys, else the file."""
    return transforms if all(getattr(entry, key) is None for key in keys) else entry


def _stated_size(level):
    return None if level.w is None and level.h is None else (level.w, level.h)


def _size_of(level, default_size, size):
    """The image size that the intrinsics of a level refer to."""
    width, height = _stated_size(level) or (None, None)
    if width is None or height is None or width <= 0:
        return default_size
    same_shape = abs(size[0] * height / width - size[1]) <= 1
    return (width, height) if same_shape else default_size


def _times_as_large(center, size, label):
    """Ratio of the calibrated image size to `size`, by the principal point."""
    ratios = [2 * c / side for c, side in zip(center, size, strict=True)]
    times = round(sum(ratios) / 2)
    if times >= 1 and all(abs(each - times) <= CENTERED * times for each in ratios):
        return times
    # The ratios of a crop are usually different horizontally and vertically.
    if abs(ratios[0] - ratios[1]) <= ALIKE * max(map(abs, ratios)):
        raise CaptureError(
            f"{label} has its principal point at {center[0]:g}, {center[1]:g} in an "
            f"image of {size[0]:g}x{size[1]:g}: the intrinsics seem to be of images "
            f"{sum(ratios) / 2:.3g} times as large; state the size they refer to as w "
            "and h"
        )
    return 1


def _focal(level, size, label):
    """Horizontal and vertical focal length of one level, in pixels of `size`."""
    focal_x = _axis_focal(level, "x", size[0], label)
    focal_y = _axis_focal(level, "y", size[1], label)
    if focal_x is None and focal_y is None:
        raise CaptureError(
            f"{label} has no fl_x and no camera_angle_x; give a focal length in pixels "
            "or a field of view in radians"
        )
    focal_x = focal_y if focal_x is None else focal_x
    focal_y = focal_x if focal_y is None else focal_y
    for name, focal in (("fl_x", focal_x), ("fl_y", focal_y)):
        if not 0 < focal < math.inf:
            raise CaptureError(f"{label} has {name} = {focal:g}; it must be positive")
    return focal_x, focal_y


def _axis_focal(level, axis, side, label):
    """The focal length along one axis, from the first key that is set."""
    focal, angle = getattr(level, f"fl_{axis}"), getattr(level, f"camera_angle_{axis}")
    degrees = getattr(level, f"{axis}_fov")
    if focal is not None:
        return focal
    if angle is None and degrees is not None:
        angle = math.radians(degrees)
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise CaptureError(
            f"{label} has no fl_{axis} and camera_angle_{axis} = {angle:g}; expected "
            "a field of view between 0 and pi"
        )
    return 0.5 * side / math.tan(0.5 * angle)


def _distortion(entry, transforms, label):
    """Fields of `Intrinsics` for OpenCV's lens models."""
    level = _level(entry, transforms, MODEL)
    model = (level.camera_model or "").upper()
    fisheye = model == FISHEYE or bool(level.is_fisheye)
    if model not in PINHOLES | {FISHEYE}:
        raise CaptureError(
            f"{label}: camera_model {level.camera_model} is not supported; undistort "
            "the images to OPENCV or PINHOLE first (ns-process-data or COLMAP do it)"
        )
    has_other_model = entry.camera_model not in (None, transforms.camera_model)
    # The file's coefficients belong to the file's model.
    level = entry if has_other_model else _level(entry, transforms, DISTORTION)
    values = {key: getattr(level, key) or 0.0 for key in DISTORTION}
    for key in ("k5", "k6") if fisheye else ("k4", "k5", "k6"):
        if values[key] != 0:
            raise CaptureError(
                f"{label} has {key} = {values[key]}; undistort the images first"
            )
    if fisheye:
        return {
            "radial": (0.0, 0.0, 0.0),
            "tangential": (0.0, 0.0),
            "fisheye": tuple(values[key] for key in ("k1", "k2", "k3", "k4")),
        }
    return {
        "radial": tuple(values[key] for key in ("k1", "k2", "k3")),
        "tangential": tuple(values[key] for key in ("p1", "p2")),
        "fisheye": None,
    }


def notes(intrinsics: list[Intrinsics], size: tuple[int, int]) -> tuple[str, ...]:
    """Describe the assumptions made about intrinsics.

    Args:
      intrinsics: Intrinsics of all frames.
      size: Width and height of the images in pixels.

    Returns:
      Notes.
    """
    lines: tuple[str, ...] = ()
    sizes = {
        camera.size
        for camera in intrinsics
        if camera.size != size and not camera.larger
    }
    if sizes:
        width, height = min(sizes)
        lines += (
            f"cameras for {width:g}x{height:g} scaled to images of {size[0]}x{size[1]}",
        )
    larger = {camera.size for camera in intrinsics if camera.larger}
    if larger:
        width, height = min(larger)
        lines += (
            f"principal point far from the center of images of {size[0]}x{size[1]}: "
            f"intrinsics taken to be of {width:g}x{height:g} and scaled",
        )
    return lines
