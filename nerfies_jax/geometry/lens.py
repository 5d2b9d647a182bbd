"""Lens distortion of a camera, of whichever model it has.

Cameras are annotated as `Any`, since their module imports this one.
"""

from typing import Any

from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry import distortion, fisheye

# As in gsplat. "pinhole" includes radial and tangential distortion.
CAMERA_MODELS = ("pinhole", "fisheye")
# Numbers of coefficients in OpenCV's order: k1 k2 p1 p2 [k3], and k1 k2 k3 k4.
COEFFICIENTS = {"pinhole": (4, 5), "fisheye": (4,)}


def distort(camera: Any, slopes: Float[Array, "2"]) -> Float[Array, "2"]:
    """Apply the distortion of one camera to a point of the image plane.

    Args:
      camera: The camera, a `camera.Camera`.
      slopes: Undistorted image-plane position (X/Z, Y/Z), [2].

    Returns:
      The distorted position, [2].
    """
    if camera.fisheye is not None:
        return fisheye.distort(camera.fisheye, slopes)
    return distortion.distort(camera.radial, camera.tangential, slopes)


def undistort(
    camera: Any, bent: Float[Array, "2"]
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """Invert `distort`.

    Args:
      camera: The camera, a `camera.Camera`.
      bent: Distorted position in the image plane, [2].

    Returns:
      The undistorted position [2], and a boolean that is False if there is none.
    """
    if camera.fisheye is not None:
        return fisheye.undistort(camera.fisheye, bent)
    return distortion.undistort(camera.radial, camera.tangential, bent)


def one_to_one(camera: Any, slopes: Float[Array, "2"]) -> Bool[Array, ""]:
    """Test if the lens has not folded anywhere between the axis and a point.

    Args:
      camera: The camera, a `camera.Camera`.
      slopes: Undistorted image-plane position (X/Z, Y/Z), [2].

    Returns:
      A boolean scalar.
    """
    if camera.fisheye is not None:
        return fisheye.one_to_one(camera.fisheye, slopes)
    return distortion.one_to_one(camera.radial, camera.tangential, slopes)
