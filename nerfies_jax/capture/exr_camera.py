"""Camera of an image as attributes of an OpenEXR header."""

from typing import Any

import numpy as np

from nerfies_jax.geometry.camera import Camera

AXES = "x right, y down, z forward"


def attributes(camera: Camera, size: tuple[int, int], time: float) -> dict[str, Any]:
    """Return the attributes that describe camera and time of an image.

    `worldToCamera` and `worldToNDC` are standard attributes of OpenEXR. They act on row
    vectors: (x, y, z, 1) M is divided by its fourth component. NDC runs from (0, 0) at
    the upper left to (1, 1). They do not include the lens distortion.

    Args:
      camera: The camera, in scene units.
      size: Width and height of the image in pixels.
      time: Time in [0, 1].

    Returns:
      Attributes by name.
    """
    rotation = np.asarray(camera.camera_from_world, np.float64)
    focal, aspect = float(camera.focal_px), float(camera.pixel_aspect)
    center = np.asarray(camera.principal_point_px, np.float64)
    from_world = np.eye(4)
    from_world[:3, :3] = rotation
    from_world[:3, 3] = -rotation @ np.asarray(camera.position, np.float64)
    # Rows: x and y in shares of the image size, z, and z as the divisor.
    ndc = np.zeros((4, 4))
    ndc[0, :3] = np.array([focal, float(camera.skew_px), center[0]]) / size[0]
    ndc[1, 1:3] = np.array([focal * aspect, center[1]]) / size[1]
    ndc[2:, 2] = 1

    def row_vector_matrix(matrix):
        # Contiguous, since OpenEXR reads the memory without regard to strides.
        return np.ascontiguousarray(matrix.T, np.float32)

    fisheye = {}
    if camera.fisheye is not None:
        fisheye = {"fisheyeDistortion": np.asarray(camera.fisheye, np.float32)}
    return {
        "worldToCamera": row_vector_matrix(from_world),
        "worldToNDC": row_vector_matrix(ndc @ from_world),
        "cameraAxes": AXES,
        "sceneTime": float(time),
        "focalLengthPx": np.array([focal, focal * aspect], np.float32),
        "principalPointPx": center.astype(np.float32),
        "skewPx": float(camera.skew_px),
        "radialDistortion": np.asarray(camera.radial, np.float32),
        "tangentialDistortion": np.asarray(camera.tangential, np.float32),
        **fisheye,
    }
