"""Range of the player's camera: the captured viewpoints, with a margin."""

import numpy as np

from nerfies_jax.geometry.camera import Camera

# Margins beyond the cameras of the capture. Gaussians that no camera saw from the side
# are long and thin, which shows there.
AZIMUTH_MARGIN, ELEVATION_MARGIN = np.radians(30), np.radians(20)
# A capture whose largest gap is smaller than this counts as a full circle.
OPEN_ARC = np.radians(90)
WIDEST = np.pi - 0.2  # of the azimuth, because the page counts from -pi to pi
STEEPEST = np.radians(88)  # of the elevation, because the azimuth is undefined above
NEAREST, FARTHEST = 0.25, 2.5  # factors of the smallest and largest camera distance


def camera_limits(
    train: Camera, target: np.ndarray, up: np.ndarray, half_diagonal: float
) -> dict:
    """Compute the range of a player's camera from the cameras of a capture.

    Args:
      train: Training cameras, starting with the first view.
      target: Center of rotation of the first view, scene units.
      up: Upward direction of the scene, unit length.
      half_diagonal: Half the diagonal of the image over the focal length.

    Returns:
      Lists and floats. `axes` are two directions in the ground plane, the first toward
      the first camera, and `up`. `azimuth` (None if the capture surrounds the target)
      and `elevation` are ranges of the direction from the target to the camera in
      radians. `distance` is a range in scene units, and `pan` is the largest
      displacement of the target.
    """
    offset = train.position.astype(np.float64) - target
    distance = np.linalg.norm(offset, axis=1)
    height = np.arcsin(np.clip(offset @ up / np.maximum(distance, 1e-12), -1, 1))
    flat = offset[0] - (offset[0] @ up) * up
    if np.linalg.norm(flat) < 1e-3 * distance[0]:  # the first view is from above
        image_up = -train.camera_from_world[0, 1].astype(np.float64)
        flat = -(image_up - (image_up @ up) * up)
    side = flat / np.linalg.norm(flat)
    ahead = np.cross(up, side)
    # Includes the first view, even if it is steeper than the limit.
    elevation = [
        min(max(height.min() - ELEVATION_MARGIN, -STEEPEST), height[0]),
        max(min(height.max() + ELEVATION_MARGIN, STEEPEST), height[0]),
    ]
    return {
        "axes": [side.tolist(), ahead.tolist(), up.tolist()],
        "target": target.tolist(),
        "azimuth": _azimuth(np.arctan2(offset @ ahead, offset @ side)),
        "elevation": [float(angle) for angle in elevation],
        "distance": [
            float(NEAREST * distance.min()),
            float(FARTHEST * distance.max()),
        ],
        "pan": float(half_diagonal * distance[0]),
    }


def _azimuth(angles):
    """Return the arc of all angles with a margin, or None if it is a full circle."""
    angles = np.sort(np.append(angles, 0.0))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    if gaps[widest] < OPEN_ARC + 2 * AZIMUTH_MARGIN:
        return None
    # The arc begins after the widest gap. It contains zero, so it begins at most there.
    low = angles[(widest + 1) % len(angles)]
    low = low if low <= 0 else low - 2 * np.pi
    high = low + 2 * np.pi - gaps[widest]
    low, high = low - AZIMUTH_MARGIN, high + AZIMUTH_MARGIN
    if max(-low, high) > WIDEST:
        return None
    return [float(low), float(high)]
