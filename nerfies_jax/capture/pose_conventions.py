"""Conventions of poses, recognized by the share of points that fall into the images."""

import numpy as np

from nerfies_jax.capture import frames
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.geometry import camera
from nerfies_jax.geometry.camera import Camera

# Share of the points in an image, averaged over cameras. Below `DOUBTFUL`, another
# convention is suggested if its share is at least `CONVINCING`.
DOUBTFUL, CONVINCING = 0.05, 0.3
MOST_CAMERAS, MOST_POINTS = 16, 2000
_FLIP = np.diag([1.0, -1.0, -1.0])  # between OpenGL and OpenCV axes of a camera


def check(
    cameras: Camera, position: np.ndarray, size: tuple[int, int], where: str
) -> tuple[str, ...]:
    """Compare poses, read as camera to world with OpenGL axes, with the scene points.

    Args:
      cameras: The cameras as read, [frames], in world units.
      position: Scene points, [points, 3], in world units.
      size: Width and height of the images.
      where: Names the file in errors.

    Returns:
      A note where the images show next to none of the points and no other convention
      shows more.

    Raises:
      CaptureError: The poses show next to none of the points, and under another
        convention many of them.
    """
    count = len(cameras.focal_px)
    rows = np.unique(np.linspace(0, count - 1, min(count, MOST_CAMERAS)).astype(int))
    some = np.linspace(0, len(position) - 1, min(len(position), MOST_POINTS))
    cameras, points = camera.take(cameras, rows), position[some.astype(int)]
    share = _share(cameras, points, size)
    if share >= DOUBTFUL:
        return ()
    shares = {
        name: _share(other, points, size) for name, other in _others(cameras).items()
    }
    likely = max(shares, key=shares.__getitem__)
    if shares[likely] >= CONVINCING:
        raise CaptureError(
            f"{where}: {share:.0%} of the points fall into the images, and "
            f"{shares[likely]:.0%} if transform_matrix is {likely}; convert the poses "
            "to camera to world with axes right, up, back (OpenGL)"
        )
    return (
        f"{share:.1%} of the points fall into an image: they or the poses may be of "
        "another world",
    )


def _others(cameras):
    """Cameras under the other conventions that are common."""
    read = cameras.camera_from_world.astype(np.float64)
    position = cameras.position.astype(np.float64)
    matrix = (_FLIP @ read).swapaxes(1, 2)  # as it stands in the file
    inverse = -np.einsum("nji,nj->ni", matrix, position)
    poses = {
        "camera to world with axes right, down, forward (OpenCV)": (
            _FLIP @ read,
            position,
        ),
        "world to camera with axes right, down, forward (OpenCV)": (matrix, inverse),
        "world to camera with axes right, up, back (OpenGL)": (_FLIP @ matrix, inverse),
    }
    return {
        name: cameras._replace(
            camera_from_world=rotation.astype(np.float32), position=place
        )
        for name, (rotation, place) in poses.items()
    }


def _share(cameras, points, size):
    """Mean share of the points that fall into an image."""
    cameras, points = frames.near_origin(cameras, points)
    seen = [
        frames.pixels_of(cameras, row, points, size)[2].mean()
        for row in range(len(cameras.focal_px))
    ]
    return float(np.mean(seen))
