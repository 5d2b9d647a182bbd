"""Smooth camera paths through keyframes."""

from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from nerfies_jax.capture.camera_paths import CameraPath
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera

MAX_FRAMES = 100_000  # an hour of video; larger requests are mistakes
MOST_KEYFRAMES = 24  # of a path that is edited by hand


class Keyframe(NamedTuple):
    """A camera and a scene time, in NumPy."""

    camera: Camera  # pinhole, scene units
    time: float  # in [0, 1]


def through(keyframes: list[Keyframe], size: tuple[int, int], count: int) -> CameraPath:
    """Interpolate a camera path through keyframes.

    All segments between keyframes have the same duration. Positions, log focal lengths
    and times are interpolated with monotone cubic splines (PCHIP), which do not
    overshoot. Time thus never runs backward between keyframes with ascending times, and
    is constant between two of equal time. Orientations are interpolated with a spline
    of continuous angular velocity.

    Args:
      keyframes: At least two keyframes.
      size: Width and height of the images in pixels.
      count: Number of cameras, including the first and the last keyframe.

    Returns:
      The path.

    Raises:
      ValueError: If there are fewer than two keyframes, or `count` is out of range.
    """
    if len(keyframes) < 2:
        raise ValueError(
            f"{len(keyframes)} keyframe(s); a camera path needs at least two"
        )
    if not len(keyframes) <= count <= MAX_FRAMES:
        raise ValueError(
            f"{count} images through {len(keyframes)} keyframes; expected "
            f"{len(keyframes)} to {MAX_FRAMES} images"
        )
    knots = np.arange(len(keyframes), dtype=np.float64)
    positions = np.linspace(0, knots[-1], count)
    key_cameras = cameras.stack([keyframe.camera for keyframe in keyframes])
    rotations = Rotation.from_matrix(key_cameras.camera_from_world.astype(np.float64))
    curve = np.column_stack(
        [
            key_cameras.position,
            np.log(key_cameras.focal_px),
            [keyframe.time for keyframe in keyframes],
        ]
    )
    x, y, z, log_focal, time = PchipInterpolator(knots, curve)(positions).T
    lens = cameras.take(key_cameras, np.zeros(count, int))
    matrices = RotationSpline(knots, rotations)(positions).as_matrix()
    leaves: dict[str, Any] = dict(
        camera_from_world=matrices.astype(np.float32),
        position=np.stack([x, y, z], axis=1).astype(np.float32),
        focal_px=np.exp(log_focal).astype(np.float32),
    )
    path = lens._replace(**leaves)
    return CameraPath(path, size, np.clip(time, 0, 1).astype(np.float32))
