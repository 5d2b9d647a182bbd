"""A pinhole camera with Brown-Conrady distortion: project and unproject.

Frames and axes (docs/conventions.md): camera x points right, y down, z forward; pixel
centers lie at +0.5, so the center of the top-left pixel is (0.5, 0.5).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nerfies_jax.contract import checked
from nerfies_jax.geometry import distortion, lie, matrices
from nerfies_jax.geometry.precision import exact_product, refuse_half

# Both keep what is at or behind the camera finite in float32, where 1/z² overflows
# below 1e-19 and the seventh power of a slope above 1e5.
MAX_SLOPE = 1e4  # lateral offset over depth: 0.006 degrees short of sideways
MIN_DEPTH = 1e-12  # scene units
Real = int | float | np.number


class Camera(NamedTuple):
    """One camera, or a batch of them along leading axes. NumPy or JAX leaves.

    The image size is not part of it: it is the shape of the picture asked for.
    """

    camera_from_world: Float[Array, "*batch 3 3"]  # rotation; rows right, down, forward
    position: Float[Array, "*batch 3"]  # of the center, in world scene units
    focal_px: Float[Array, "*batch"]  # horizontal focal length
    principal_point_px: Float[Array, "*batch 2"]
    skew_px: Float[Array, "*batch"]
    pixel_aspect: Float[Array, "*batch"]  # vertical over horizontal focal length
    radial: Float[Array, "*batch 3"]  # k1 k2 k3
    tangential: Float[Array, "*batch 2"]  # p1 p2

    @classmethod
    def from_K(
        cls,
        K: Any,
        camera_from_world: Any,
        width: int,
        height: int,
        distortion: Any = None,
        dtype: Any = np.float32,
    ) -> "Camera":
        """Make a camera from an intrinsic matrix and a world-to-camera pose.

        The pose is the `viewmat` of gsplat. Pixel centers lie at +0.5, as in COLMAP and
        gsplat; add 0.5 to the principal point of a calibration by OpenCV, whose centers
        lie at whole numbers.

        Args:
          K: Intrinsics in pixels, [..., 3, 3], with focal lengths and skew in the upper
            triangle, the principal point in the last column and last row (0, 0, 1).
          camera_from_world: World-to-camera transforms, [..., 4, 4] or [..., 3, 4], for
            a camera that looks along +z with x to the right and y down.
          width: Image width in pixels.
          height: Image height in pixels.
          distortion: Coefficients (k1, k2, p1, p2) or (k1, k2, p1, p2, k3) in OpenCV's
            order, [..., 4] or [..., 5]. None for a pinhole.
          dtype: Floating-point type of the result; conversions are made in float64.

        Returns:
          A camera with NumPy leaves, or a batch of them with the leading axes of the
          arguments, which broadcast.

        Raises:
          ValueError: Where a shape is wrong, K is not an intrinsic matrix, the pose is
            not rigid, or the principal point lies far outside the image.
        """
        fields = matrices.camera_fields(K, camera_from_world, distortion)
        camera = cls(**{name: value.astype(dtype) for name, value in fields.items()})
        validate(camera, (width, height), "Camera.from_K")
        return camera


@checked(broadcast=True)
def project(
    camera: Camera, point: Float[Array, "3"]
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """The pixel of one world point, and its z-depth in scene units.

    A depth that is not positive means that the camera cannot see the point; its pixel
    and its derivatives are then finite, and mean nothing: beside the axis it is far
    outside the picture, on the axis in its middle. See `projectable` for points beyond
    the lens's own range.
    """
    lateral, depth = _in_camera(camera, point)
    # A maximum, not a division under `where`: the quotient that is not wanted is never
    # formed, so no 0 * inf reaches the gradient.
    reach = jnp.max(jnp.abs(lateral))
    divisor = jnp.maximum(depth, jnp.maximum(reach / MAX_SLOPE, MIN_DEPTH))
    bent = distortion.distort(camera.radial, camera.tangential, lateral / divisor)
    pixel = jnp.stack(
        [
            camera.focal_px * bent[0] + camera.skew_px * bent[1],
            camera.focal_px * camera.pixel_aspect * bent[1],
        ]
    )
    return pixel + camera.principal_point_px, depth


@checked(broadcast=True)
def projectable(camera: Camera, point: Float[Array, "3"]) -> Bool[Array, ""]:
    """Whether one world point is in front and where the lens model is one-to-one.

    Beyond that a polynomial distortion folds back: a point far outside the field of
    view would land inside the picture.
    """
    lateral, depth = _in_camera(camera, point)
    in_front = depth > jnp.maximum(jnp.max(jnp.abs(lateral)) / MAX_SLOPE, MIN_DEPTH)
    slopes = lateral / jnp.where(in_front, depth, 1)
    return in_front & distortion.one_to_one(camera.radial, camera.tangential, slopes)


@checked(broadcast=True)
def unproject(
    camera: Camera, pixel: Float[Array, "2"]
) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """The unit world direction that one pixel looks along, and whether it exists.

    Where the lens model has no one-to-one solution the flag is False, and the direction
    is finite, has zero gradient with respect to the pixel, and means nothing.
    """
    refuse_half("the camera or the pixel", camera.position, pixel)
    offset = pixel - camera.principal_point_px
    bent_y = offset[1] / (camera.focal_px * camera.pixel_aspect)
    bent_x = (offset[0] - camera.skew_px * bent_y) / camera.focal_px
    slopes, converged = distortion.undistort(
        camera.radial, camera.tangential, jnp.stack([bent_x, bent_y])
    )
    in_camera = jnp.concatenate([slopes, jnp.ones_like(slopes[:1])])
    in_camera = in_camera / jnp.sqrt(jnp.sum(in_camera**2))  # at least 1: no zero here
    return exact_product(in_camera, camera.camera_from_world), converged


def forward_axis(camera: Camera) -> Float[Array, "*batch 3"]:
    """The unit viewing axis in the world; z-depth is measured along it."""
    return jnp.asarray(camera.camera_from_world)[..., 2, :]


def camera_matrix(camera: Camera) -> Float[Array, "*batch 3 3"]:
    """K of `pixel ~ K @ point_in_camera`; it does not contain the distortion."""
    zero, one = jnp.zeros_like(camera.focal_px), jnp.ones_like(camera.focal_px)
    center = camera.principal_point_px
    rows = [
        [camera.focal_px, camera.skew_px, center[..., 0]],
        [zero, camera.focal_px * camera.pixel_aspect, center[..., 1]],
        [zero, zero, one],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def world_from_camera(camera: Camera) -> Float[Array, "*batch 4 4"]:
    """The pose as a 4×4 matrix; its last column is the camera's position."""
    rotation = jnp.swapaxes(camera.camera_from_world, -1, -2)
    upper = jnp.concatenate([rotation, camera.position[..., None]], axis=-1)
    last = jnp.zeros_like(upper[..., :1, :]).at[..., 0, 3].set(1)
    return jnp.concatenate([upper, last], axis=-2)


def move(
    camera: Camera, angular: Float[Array, "3"], linear: Float[Array, "3"]
) -> Camera:
    """One camera with exp(angular, linear) applied on the left of camera_from_world.

    A screw in the camera's own frame: `angular` in rad, `linear` in scene units.
    """
    rotation, shift = lie.exp_se3(angular, linear)
    turned = exact_product(rotation, camera.camera_from_world)
    # t' = R t + V v with t = -R c; the center moves by -R'ᵀ V v, and nothing cancels.
    moved = camera.position - exact_product(shift, turned)
    return camera._replace(camera_from_world=turned, position=moved)


def resize(
    camera: Camera, old_size: tuple[int, int], new_size: tuple[int, int]
) -> Camera:
    """The same camera for its picture resampled from one (width, height) to another."""
    for name, size in (("old_size", old_size), ("new_size", new_size)):
        if min(size) < 1:
            raise ValueError(
                f"{name}={size} must be at least 1x1 pixels (width, height)"
            )
    across, down = new_size[0] / old_size[0], new_size[1] / old_size[1]
    both = np.asarray([across, down], dtype=camera.principal_point_px.dtype)
    return camera._replace(
        focal_px=camera.focal_px * across,
        principal_point_px=camera.principal_point_px * both,
        skew_px=camera.skew_px * across,
        pixel_aspect=camera.pixel_aspect * (down / across),
    )


def crop(camera: Camera, left_px: Real, top_px: Real) -> Camera:
    """The same camera for its picture with columns and rows cut off left and top."""
    corner = np.asarray([left_px, top_px], dtype=camera.principal_point_px.dtype)
    return camera._replace(principal_point_px=camera.principal_point_px - corner)


def pinhole(
    camera_from_world: Any,
    position: Any,
    focal_px: Real,
    size: tuple[int, int],
    dtype: Any = np.float32,
) -> Camera:
    """A camera without skew or distortion, centered on its picture. NumPy leaves."""
    return Camera(
        camera_from_world=np.asarray(camera_from_world, dtype),
        position=np.asarray(position, dtype),
        focal_px=np.asarray(focal_px, dtype),
        principal_point_px=np.asarray(size, dtype) / 2,
        skew_px=np.zeros((), dtype),
        pixel_aspect=np.ones((), dtype),
        radial=np.zeros(3, dtype),
        tangential=np.zeros(2, dtype),
    )


def look_at(
    position: Any,
    target: Any,
    up: Any,
    focal_px: Real,
    size: tuple[int, int],
    dtype: Any = np.float32,
) -> Camera:
    """A pinhole at `position` that looks at `target`; `up` points up in the picture."""
    position, target, up = (np.asarray(x, np.float64) for x in (position, target, up))
    forward = target - position
    distance = np.linalg.norm(forward)
    if not distance > 0:
        raise ValueError(f"the camera at {position} looks at itself; move the target")
    forward = forward / distance
    right = np.cross(forward, up)
    length = np.linalg.norm(right)
    if not length > 1e-6 * np.linalg.norm(up):  # a roll of 1e-6 rad is still defined
        raise ValueError(
            f"up={up} is parallel to the viewing direction {forward}, so the roll is "
            "undefined; choose another up"
        )
    right = right / length
    rotation = np.stack([right, np.cross(forward, right), forward])
    return pinhole(rotation, position, focal_px, size, dtype)


def stack(cameras: Sequence[Camera]) -> Camera:
    """Several cameras as one batch. NumPy leaves."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *cameras)


def take(cameras: Camera, rows: Any) -> Camera:
    """Rows of a batch: one index for one camera, several for a batch of them."""
    return jax.tree.map(lambda leaf: leaf[rows], cameras)


def validate(camera: Camera, size: tuple[int, int], name: str = "camera") -> None:
    """Raise ValueError, with `name`, value and remedy, for what cannot be used.

    On the host, where cameras are read; `size` is (width, height) of the picture.
    """
    shapes = Camera((3, 3), (3,), (), (2,), (), (), (3,), (2,))
    for field, leaf, shape in zip(Camera._fields, camera, shapes, strict=True):
        value = np.asarray(leaf)
        if value.shape[value.ndim - len(shape) :] != shape:
            raise ValueError(
                f"{name}: {field} has shape {value.shape}, must end {shape}"
            )
        bad = ~np.isfinite(value)
        if bad.any():
            raise ValueError(
                f"{name}: {field} is not finite{_row(bad, len(shape))}: leave the "
                "frame out or estimate its camera again"
            )
    rotation = np.asarray(camera.camera_from_world, np.float64)
    product = rotation @ np.swapaxes(rotation, -1, -2)
    drift = np.abs(product - np.eye(3)).max(axis=(-1, -2))
    # Poses printed with four digits come out at 2e-4; a scaled or sheared one does not.
    if (drift > 1e-3).any():
        raise ValueError(
            f"{name}: orientation is not orthonormal{_row(drift > 1e-3, 0)}: "
            f"|R Rᵀ - 1| = {drift.max():.2g} > 1e-3; take the scale out of the pose"
        )
    mirrored = np.linalg.det(rotation) < 0
    if mirrored.any():
        raise ValueError(
            f"{name}: orientation is a reflection{_row(mirrored, 0)} (det = -1); axes "
            "are x right, y down, z forward"
        )
    for field in ("focal_px", "pixel_aspect"):
        value = np.asarray(getattr(camera, field))
        if (value <= 0).any():
            raise ValueError(
                f"{name}: {field} must be positive, got {value.min():g}"
                f"{_row(value <= 0, 0)}"
            )
    if min(size) < 1:
        raise ValueError(f"{name}: picture size {size} must be at least 1x1 pixels")
    # A wrong unit or a camera of another resolution; a crop may lie a picture aside.
    center = np.asarray(camera.principal_point_px, np.float64)
    aside = (np.abs(center / size - 0.5) > 1.5).any(axis=-1)
    if aside.any():
        raise ValueError(
            f"{name}: the principal point {center.reshape(-1, 2)[aside.ravel()][0]} is "
            f"more than a picture outside {size[0]}x{size[1]}{_row(aside, 0)}; resize "
            "the camera with its picture"
        )


def _in_camera(camera: Camera, point: Float[Array, "3"]):
    """Lateral offset and depth. R (x - c), never R x + t: that cancels far from 0."""
    refuse_half("the camera or the point", camera.position, point)
    offset = exact_product(camera.camera_from_world, point - camera.position)
    return offset[:2], offset[2]


def _row(bad: np.ndarray | np.bool_, inner: int) -> str:
    """Where in a batch the first bad entry lies; empty for a single camera."""
    rows = bad.reshape(*bad.shape[: bad.ndim - inner], -1).any(axis=-1)
    return f" (row {int(np.flatnonzero(rows)[0])})" if rows.ndim else ""
