"""World axes of other programs: which way is up."""

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.world_points import mean_up
from nerfies_jax.geometry import camera

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
# Length of the mean of unit vectors, below which they have no common direction.
LEAST_AGREEMENT = 0.2


def _up_of(capture: Capture) -> np.ndarray:
    """Estimate the direction that is up, as the mean of what is up in the images."""
    mean = mean_up(camera.take(capture.cameras, capture.train))
    length = np.linalg.norm(mean)
    if length < LEAST_AGREEMENT:
        raise ValueError(
            f"the cameras of the capture are turned in all directions (their mean up "
            f"has a length of {length:.2f}, at least {LEAST_AGREEMENT} is needed); "
            "export with the axes of the capture and turn the scene in the other "
            "program"
        )
    return mean / length


def rotation_to(capture: Capture, axis: Axis) -> np.ndarray:
    """Return the smallest rotation after which an axis points up.

    Args:
      capture: The capture, whose cameras say what is up.
      axis: Axis of the other program that points up, such as "z".

    Returns:
      Rotation matrix [3, 3] from scene axes.

    Raises:
      ValueError: If the training cameras have no common upward direction.
    """
    target = np.zeros(3)
    target["xyz".index(axis[-1])] = -1 if axis.startswith("-") else 1
    rotation, _ = Rotation.align_vectors(target[None], _up_of(capture)[None])
    return rotation.as_matrix()
