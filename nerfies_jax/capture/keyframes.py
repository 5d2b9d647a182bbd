"""Smooth camera paths through keyframes."""

from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from nerfies_jax.capture.camera_paths import CameraPath
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera

MAX_PICTURES = 100_000  # an hour of film, which nobody asks for on purpose
MOST_KEYFRAMES = 24  # of a path that is to be edited by hand


class Keyframe(NamedTuple):
    """A camera and the time of the scene that it shows, in NumPy."""

    camera: Camera  # pinhole, scene units
    time: float  # in [0, 1]


def through(keyframes: list[Keyframe], size: tuple[int, int], count: int) -> CameraPath:
    """Interpolate a camera path through keyframes.

    The path takes equally long between all keyframes. Positions, log focal lengths and
    times follow monotone cubic curves, which do not overshoot, so time never runs
    backward between two keyframes, and stays constant between two of the same time.
    Orientations follow a spline with smooth angular velocity.

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
            f"{len(keyframes)} keyframe(s) are no path; add at least two, each where "
            "the camera is to pass"
        )
    if not len(keyframes) <= count <= MAX_PICTURES:
        raise ValueError(
            f"{count} pictures through {len(keyframes)} keyframes; choose "
            f"{len(keyframes)} to {MAX_PICTURES}"
        )
    knots = np.arange(len(keyframes), dtype=np.float64)
    at = np.linspace(0, knots[-1], count)
    chosen = cameras.stack([keyframe.camera for keyframe in keyframes])
    turns = Rotation.from_matrix(chosen.camera_from_world.astype(np.float64))
    curve = np.column_stack(
        [
            chosen.position,
            np.log(chosen.focal_px),
            [keyframe.time for keyframe in keyframes],
        ]
    )
    x, y, z, log_focal, time = PchipInterpolator(knots, curve)(at).T
    lens = cameras.take(chosen, np.zeros(count, int))
    turned = RotationSpline(knots, turns)(at).as_matrix()
    leaves: dict[str, Any] = dict(
        camera_from_world=turned.astype(np.float32),
        position=np.stack([x, y, z], axis=1).astype(np.float32),
        focal_px=np.exp(log_focal).astype(np.float32),
    )
    path = lens._replace(**leaves)
    return CameraPath(path, size, np.clip(time, 0, 1).astype(np.float32))
