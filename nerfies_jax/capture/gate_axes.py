"""Check of camera poses by their viewing directions, for captures without points."""

from typing import NamedTuple

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.gate_finding import Finding
from nerfies_jax.geometry.rays import across_ray

LEAST_FRAMES = 4
# Cameras look at a common point if at least this share of them has it in front, their
# axes pass it within this share of its distance, and they converge by at least this.
AHEAD, PASSES, CROSSES = 0.95, 0.15, 0.02
# They do not if at most this share has it in front, or axes pass it farther away.
BEHIND, FAR_OFF = 0.1, 0.3
TURNS = 0.1  # smallest range of rotation matrix entries of a camera that rotates
_FLIP = np.diag([1.0, -1.0, -1.0])  # between OpenGL and OpenCV axes of a camera


class Look(NamedTuple):
    """Measures of how cameras look at the point nearest to all their axes."""

    ahead: float  # share of the cameras that have it in front
    passes: float  # distance of the axes from it over the distance of the cameras
    crosses: float  # convergence: 0 for parallel axes, up to 2/3


def findings(capture: Capture) -> list[Finding]:
    """Check if the cameras look at one point, or would under another convention.

    Args:
      capture: The capture, without points.

    Returns:
      The findings.
    """
    rotation = np.asarray(capture.cameras.camera_from_world, np.float64)
    position = np.asarray(capture.cameras.position, np.float64) / capture.scale
    position = position + np.array(capture.center)
    is_fixed = len(np.unique(capture.cameras.position, axis=0)) < LEAST_FRAMES
    rotates = len(position) >= LEAST_FRAMES and np.ptp(rotation, axis=0).max() > TURNS
    if is_fixed and not rotates:
        return []
    look = _look_of(rotation[:, 2], position)
    subject = "common point"
    value = f"{look.ahead:.0%} of the cameras look toward it"
    if look.crosses < CROSSES:
        value = "none, the axes of the cameras are nearly parallel"
    if look.ahead > BEHIND and look.passes <= FAR_OFF:
        return [Finding(subject, value)]
    readings = _other_conventions(capture, rotation, position)
    for reason, (other_rotation, other_position) in readings.items():
        other = _look_of(other_rotation[:, 2], other_position)
        if other.ahead >= AHEAD and other.passes <= PASSES and other.crosses >= CROSSES:
            problem = (
                f"{look.ahead:.0%} of the cameras look toward a common point, and "
                f"{other.ahead:.0%} if {reason}; convert the poses, unless the camera "
                "rotates in place or the cameras look outward"
            )
            return [Finding(subject, value, problem)]
    return [Finding(subject, value)]


def _look_of(axes: np.ndarray, position: np.ndarray) -> Look:
    """Measure how cameras look at the point nearest to all their axes."""
    across = across_ray(axes)
    matrix, origin = across.sum(0), position.mean(0)
    right = np.einsum("nij,nj->i", across, position - origin)
    crosses = float(np.linalg.svd(matrix, compute_uv=False)[-1] / len(axes))
    if crosses < 1e-6:
        return Look(0.0, np.inf, crosses)
    offset = np.linalg.solve(matrix, right) + origin - position
    distance = float(np.linalg.norm(offset, axis=1).mean())
    misses = np.linalg.norm(np.einsum("nij,nj->ni", across, offset), axis=1)
    passes = float(np.sqrt((misses**2).mean()) / distance) if distance > 0 else np.inf
    # All cameras at the point itself, as with inverted rotations, are no evidence.
    if distance <= 1e-6 * np.abs(position).max(initial=1.0):
        passes = np.inf
    ahead = float(((axes * offset).sum(1) > 0).mean())
    return Look(ahead, passes, crosses)


def _other_conventions(capture, rotation, position):
    """Rotations from the world and positions under other conventions, by reason."""
    back = rotation.swapaxes(1, 2)
    if capture.source != "blender":
        inverse = -np.einsum("nij,nj->ni", rotation, position)
        return {
            "the camera's axes are right, up, back (OpenGL)": (
                _FLIP @ rotation,
                position,
            ),
            "the poses are the inverse": (back, inverse),
        }
    return transforms_conventions(rotation, position)


def transforms_conventions(rotation: np.ndarray, position: np.ndarray) -> dict:
    """Interpret poses of transforms.json under other conventions.

    Args:
      rotation: Rotations from world to camera, as they were read, [frames, 3, 3].
      position: Positions of the cameras, as they were read, [frames, 3].

    Returns:
      Rotations and positions under each convention, by its description.
    """
    matrix = rotation.swapaxes(1, 2) @ _FLIP  # as in the file
    inverse = -np.einsum("nij,nj->ni", matrix.swapaxes(1, 2), position)
    return {
        "transform_matrix is camera to world with axes right, down, forward (OpenCV)": (
            _FLIP @ rotation,
            position,
        ),
        "transform_matrix is world to camera with axes right, down, forward (OpenCV)": (
            matrix,
            inverse,
        ),
        "transform_matrix is world to camera with axes right, up, back (OpenGL)": (
            _FLIP @ matrix,
            inverse,
        ),
    }
