"""A pinhole camera with Brown-Conrady distortion: project and unproject.

Frames and axes (docs/conventions.md): camera x points right, y down, z forward; pixel
centres lie at +0.5, so the centre of the top-left pixel is (0.5, 0.5).
"""

from typing import NamedTuple

from jaxtyping import Array, Float


class Camera(NamedTuple):
    """One camera, or a batch of them along leading axes. NumPy or JAX leaves.

    The image size is not part of it: it is the shape of the picture asked for.
    """

    camera_from_world: Float[Array, "*batch 3 3"]  # rotation; rows right, down, forward
    position: Float[Array, "*batch 3"]  # of the centre, in world scene units
    focal_px: Float[Array, "*batch"]  # horizontal focal length
    principal_point_px: Float[Array, "*batch 2"]
    skew_px: Float[Array, "*batch"]
    pixel_aspect: Float[Array, "*batch"]  # vertical over horizontal focal length
    radial: Float[Array, "*batch 3"]  # k1 k2 k3
    tangential: Float[Array, "*batch 2"]  # p1 p2
