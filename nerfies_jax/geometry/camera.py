"""A camera with Brown-Conrady or fisheye distortion: project and unproject.

Frames and axes (docs/conventions.md): camera x points right, y down, z forward; pixel
centers lie at +0.5, so the center of the top-left pixel is (0.5, 0.5).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry import lens, lie, matrices
from nerfies_jax.geometry.precision import exact_product, refuse_half
from nerfies_jax.runtime.contract import checked

# Both keep points at or behind the camera finite in float32, where 1/z² overflows
# below 1e-19 and the seventh power of a slope above 1e5.
MAX_SLOPE = 1e4  # lateral offset over depth: 0.006 degrees short of sideways
MIN_DEPTH = 1e-12  # scene units
MAX_ASIDE = 20  # images, of the principal point from the center
# Bounds of `validate`: fields of view from 179.4 degrees to 0.06, and coefficients,
# which reach some hundreds in calibrations of wide lenses.
FOCAL_RANGE = (0.005, 1000.0)  # of the longer side of the image
MAX_ASPECT, MAX_SKEW, MAX_DISTORTION = 10.0, 1.0, 1e4
MAX_POSITION = 1e6  # scene units; float32 has steps of 0.06 there
Real = int | float | np.number


class Camera(NamedTuple):
    """Camera with Brown-Conrady or fisheye distortion, or a batch along leading axes.

    Leaves are NumPy or JAX arrays. The image size is not part of the camera. Functions
    that need it take it as an argument. Zeros in `radial` and `tangential` without
    `fisheye` are a pinhole.
    """

    camera_from_world: Float[Array, "*batch 3 3"]  # rotation; rows right, down, forward
    position: Float[Array, "*batch 3"]  # of the center, in world scene units
    focal_px: Float[Array, "*batch"]  # horizontal focal length
    principal_point_px: Float[Array, "*batch 2"]
    skew_px: Float[Array, "*batch"]
    pixel_aspect: Float[Array, "*batch"]  # vertical over horizontal focal length
    radial: Float[Array, "*batch 3"]  # k1 k2 k3
    tangential: Float[Array, "*batch 2"]  # p1 p2
    # k1 k2 k3 k4 of OpenCV's fisheye model, which then replaces the other two.
    fisheye: Float[Array, "*batch 4"] | None = None

    @classmethod
    def from_K(
        cls,
        K: Any,
        camera_from_world: Any,
        width: int,
        height: int,
        distortion: Any = None,
        dtype: Any = np.float32,
        camera_model: str = "pinhole",
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
            order, [..., 4] or [..., 5]. Of a fisheye (k1, k2, k3, k4), [..., 4]. None
            for zeros.
          dtype: Floating-point type of the result; conversions are made in float64.
          camera_model: "pinhole", which may have distortion, or "fisheye".

        Returns:
          A camera with NumPy leaves, or a batch of them with the leading axes of the
          arguments, which broadcast.

        Raises:
          ValueError: Where a shape is wrong, K is not an intrinsic matrix, the pose is
            not rigid, or the principal point lies far outside the image.
        """
        parts = matrices.camera_fields(K, camera_from_world, distortion, camera_model)
        leaves: dict[str, Any] = {k: part.astype(dtype) for k, part in parts.items()}
        camera = cls(**leaves)
        validate(camera, (width, height), "Camera.from_K")
        return camera


@checked(broadcast=True)
def project(
    camera: Camera, point: Float[Array, "3"]
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Project world points to pixels.

    A point at the side of the camera gets a pixel far outside the image, and one behind
    it on the axis gets the principal point. Pixel and derivatives are finite there but
    meaningless. See `projectable` for points outside the range of the lens model.

    Args:
      camera: Cameras, [...].
      point: World points in scene units, [..., 3].

    Returns:
      Pixel positions (x, y) [..., 2] with pixel centers at +0.5, and z-depths in scene
      units [...]. A depth that is not positive means that the camera cannot see the
      point.
    """
    lateral, depth = _in_camera(camera, point)
    # A maximum, not a division under `where`: the quotient that is not wanted is never
    # formed, so no 0 * inf reaches the gradient.
    reach = jnp.max(jnp.abs(lateral))
    divisor = jnp.maximum(depth, jnp.maximum(reach / MAX_SLOPE, MIN_DEPTH))
    distorted_xy = lens.distort(camera, lateral / divisor)
    pixel = jnp.stack(
        [
            camera.focal_px * distorted_xy[0] + camera.skew_px * distorted_xy[1],
            camera.focal_px * camera.pixel_aspect * distorted_xy[1],
        ]
    )
    return pixel + camera.principal_point_px, depth


@checked(broadcast=True)
def projectable(camera: Camera, point: Float[Array, "3"]) -> Bool[Array, ""]:
    """Test if world points are in front of the camera and in the range of the lens.

    Outside the range where it is one-to-one, a polynomial distortion folds back, and a
    point far outside the field of view would land inside the image.

    Args:
      camera: Cameras, [...].
      point: World points in scene units, [..., 3].

    Returns:
      Booleans [...], True where `project` can be trusted.
    """
    lateral, depth = _in_camera(camera, point)
    in_front = depth > jnp.maximum(jnp.max(jnp.abs(lateral)) / MAX_SLOPE, MIN_DEPTH)
    slopes = lateral / jnp.where(in_front, depth, 1)
    return in_front & lens.one_to_one(camera, slopes)


@checked(broadcast=True)
def unproject(
    camera: Camera, pixel: Float[Array, "2"]
) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """Compute the world direction in which pixels look.

    Args:
      camera: Cameras, [...], in float32 or float64.
      pixel: Pixel positions (x, y) with centers at +0.5, [..., 2].

    Returns:
      Unit directions in the world [..., 3], and booleans [...] that are False where the
      lens model has no one-to-one solution. The direction is then finite with zero
      gradient with respect to the pixel, but meaningless.

    Raises:
      ValueError: If the camera or the pixel is bfloat16 or float16.
    """
    refuse_half("the camera or the pixel", camera.position, pixel)
    offset = pixel - camera.principal_point_px
    distorted_y = offset[1] / (camera.focal_px * camera.pixel_aspect)
    distorted_x = (offset[0] - camera.skew_px * distorted_y) / camera.focal_px
    slopes, has_solution = lens.undistort(camera, jnp.stack([distorted_x, distorted_y]))
    in_camera = jnp.concatenate([slopes, jnp.ones_like(slopes[:1])])
    in_camera = in_camera / jnp.sqrt(jnp.sum(in_camera**2))  # at least 1: no zero here
    return exact_product(in_camera, camera.camera_from_world), has_solution


def forward_axis(camera: Camera) -> Float[Array, "*batch 3"]:
    """Return the viewing axis, along which z-depth is measured.

    Args:
      camera: Cameras, [...].

    Returns:
      Unit vectors in the world, [..., 3].
    """
    return jnp.asarray(camera.camera_from_world)[..., 2, :]


def camera_matrix(camera: Camera) -> Float[Array, "*batch 3 3"]:
    """Return the intrinsic matrix, without the distortion.

    Args:
      camera: Cameras, [...].

    Returns:
      K [..., 3, 3] in pixels, with `pixel ~ K @ point_in_camera`.
    """
    zero, one = jnp.zeros_like(camera.focal_px), jnp.ones_like(camera.focal_px)
    center = camera.principal_point_px
    rows = [
        [camera.focal_px, camera.skew_px, center[..., 0]],
        [zero, camera.focal_px * camera.pixel_aspect, center[..., 1]],
        [zero, zero, one],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def world_from_camera(camera: Camera) -> Float[Array, "*batch 4 4"]:
    """Return the camera-to-world transform.

    Args:
      camera: Cameras, [...].

    Returns:
      Homogeneous matrices [..., 4, 4]. The last column is the camera's position in
      scene units.
    """
    rotation = jnp.swapaxes(camera.camera_from_world, -1, -2)
    upper = jnp.concatenate([rotation, camera.position[..., None]], axis=-1)
    last = jnp.zeros_like(upper[..., :1, :]).at[..., 0, 3].set(1)
    return jnp.concatenate([upper, last], axis=-2)


def move(
    camera: Camera, angular: Float[Array, "3"], linear: Float[Array, "3"]
) -> Camera:
    """Apply a rigid motion on the left of `camera_from_world`.

    Args:
      camera: One camera.
      angular: Rotation vector in radians in the camera's own frame, [3].
      linear: Linear part of the twist in scene units in the same frame, [3]. See
        `se3.exp`.

    Returns:
      The camera with rotation and position changed.
    """
    rotation, shift = lie.exp_se3(angular, linear)
    rotation_from_world = exact_product(rotation, camera.camera_from_world)
    # t' = R t + V v with t = -R c; the center moves by -R'ᵀ V v, and nothing cancels.
    position = camera.position - exact_product(shift, rotation_from_world)
    return camera._replace(camera_from_world=rotation_from_world, position=position)


def resize(
    camera: Camera, old_size: tuple[int, int], new_size: tuple[int, int]
) -> Camera:
    """Adapt cameras to an image resampled to another size.

    Args:
      camera: Cameras of the original image.
      old_size: Width and height of the original image in pixels.
      new_size: Width and height of the resampled image in pixels.

    Returns:
      Cameras of the resampled image.

    Raises:
      ValueError: If a size is below 1x1 pixels.
    """
    for name, size in (("old_size", old_size), ("new_size", new_size)):
        if min(size) < 1:
            raise ValueError(
                f"{name}={size} must be at least 1x1 pixels (width, height)"
            )
    across, down = new_size[0] / old_size[0], new_size[1] / old_size[1]
    factors = np.asarray([across, down], dtype=camera.principal_point_px.dtype)
    return camera._replace(
        focal_px=camera.focal_px * across,
        principal_point_px=camera.principal_point_px * factors,
        skew_px=camera.skew_px * across,
        pixel_aspect=camera.pixel_aspect * (down / across),
    )


def crop(camera: Camera, left_px: Real, top_px: Real) -> Camera:
    """Adapt cameras to an image with columns and rows removed at the left and top.

    Args:
      camera: Cameras of the original image.
      left_px: Number of columns removed on the left.
      top_px: Number of rows removed at the top.

    Returns:
      Cameras of the cropped image.
    """
    corner = np.asarray([left_px, top_px], dtype=camera.principal_point_px.dtype)
    return camera._replace(principal_point_px=camera.principal_point_px - corner)


def pinhole(
    camera_from_world: Any,
    position: Any,
    focal_px: Real,
    size: tuple[int, int],
    dtype: Any = np.float32,
) -> Camera:
    """Create a camera without skew or distortion, centered on its image.

    Args:
      camera_from_world: Rotation matrix [3, 3] with rows right, down, forward.
      position: Camera center in world scene units, [3].
      focal_px: Focal length in pixels.
      size: Width and height of the image in pixels.
      dtype: Floating-point type of the result.

    Returns:
      A camera with NumPy leaves.
    """
    leaves: dict[str, Any] = dict(
        camera_from_world=np.asarray(camera_from_world, dtype),
        position=np.asarray(position, dtype),
        focal_px=np.asarray(focal_px, dtype),
        principal_point_px=np.asarray(size, dtype) / 2,
        skew_px=np.zeros((), dtype),
        pixel_aspect=np.ones((), dtype),
        radial=np.zeros(3, dtype),
        tangential=np.zeros(2, dtype),
    )
    return Camera(**leaves)


def look_at(
    position: Any,
    target: Any,
    up: Any,
    focal_px: Real,
    size: tuple[int, int],
    dtype: Any = np.float32,
) -> Camera:
    """Create a pinhole camera that looks at a target.

    Args:
      position: Camera center in world scene units, [3].
      target: World point on the optical axis, [3].
      up: World direction that points up in the image, [3]. Its length does not matter.
      focal_px: Focal length in pixels.
      size: Width and height of the image in pixels.
      dtype: Floating-point type of the result.

    Returns:
      A camera with NumPy leaves.

    Raises:
      ValueError: If position and target coincide, or `up` is parallel to the viewing
        direction.
    """
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
    """Stack cameras into one batch.

    Args:
      cameras: Cameras of equal shape and type.

    Returns:
      A camera with NumPy leaves and a new leading axis.
    """
    return jax.tree.map(lambda *leaves: np.stack(leaves), *cameras)


def take(cameras: Camera, rows: Any) -> Camera:
    """Select cameras of a batch.

    Args:
      cameras: A batch of cameras.
      rows: Index along the first axis, or several for a batch.

    Returns:
      The selected camera or batch.
    """
    return jax.tree.map(lambda leaf: leaf[rows], cameras)


def validate(camera: Camera, size: tuple[int, int], name: str = "camera") -> None:
    """Refuse cameras that cannot be used. Runs on the host, where cameras are read.

    Args:
      camera: A camera or a batch, with NumPy leaves.
      size: Width and height of the image in pixels.
      name: Name of the camera in the error message.

    Raises:
      ValueError: If a shape is wrong, a value is not finite, the orientation is not a
        rotation, or the intrinsics cannot belong to an image of `size`.
    """
    shapes: list[tuple[int, ...]] = [(3, 3), (3,), (), (2,), (), (), (3,), (2,), (4,)]
    for field, leaf, shape in zip(Camera._fields, camera, shapes, strict=True):
        if leaf is None and field == "fisheye":
            continue
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
    is_mirrored = np.linalg.det(rotation) < 0
    if is_mirrored.any():
        raise ValueError(
            f"{name}: orientation is a reflection{_row(is_mirrored, 0)} (det = -1); "
            "axes are x right, y down, z forward"
        )
    for field in ("focal_px", "pixel_aspect"):
        value = np.asarray(getattr(camera, field))
        if (value <= 0).any():
            raise ValueError(
                f"{name}: {field} must be positive, got {value.min():g}"
                f"{_row(value <= 0, 0)}"
            )
    if min(size) < 1:
        raise ValueError(f"{name}: image size {size} must be at least 1x1 pixels")
    _check_range(camera, size, name)
    # Tiles of a large image have it far outside, of another resolution or unit farther.
    center = np.asarray(camera.principal_point_px, np.float64)
    is_outside = (np.abs(center / size - 0.5) > MAX_ASIDE).any(axis=-1)
    if is_outside.any():
        raise ValueError(
            f"{name}: the principal point "
            f"{center.reshape(-1, 2)[is_outside.ravel()][0]} is more than {MAX_ASIDE} "
            f"images outside {size[0]}x{size[1]}"
            f"{_row(is_outside, 0)}; resize the camera with its image"
        )


def _check_range(camera, size, name):
    """Refuse numbers that no camera has and float32 cannot compute with."""
    focal = np.asarray(camera.focal_px, np.float64)
    side = max(size)
    terms = np.concatenate([camera.radial, camera.tangential], axis=-1)
    if camera.fisheye is not None:
        if np.any(terms != 0):
            raise ValueError(
                f"{name}: a fisheye has no radial and tangential coefficients, got "
                f"{terms.reshape(-1, 5)[0].tolist()}; leave one of the two out"
            )
        terms = camera.fisheye
    for what, value, least, most in (
        ("focal_px over the longer side of the image", focal / side, *FOCAL_RANGE),
        ("pixel_aspect", camera.pixel_aspect, 1 / MAX_ASPECT, MAX_ASPECT),
        ("|skew_px| over focal_px", np.abs(camera.skew_px) / focal, 0.0, MAX_SKEW),
        ("the largest of |position|", _largest(camera.position), 0.0, MAX_POSITION),
        (
            "the largest distortion coefficient",
            _largest(terms),
            0.0,
            MAX_DISTORTION,
        ),
    ):
        value = np.asarray(value, np.float64)
        bad = (value < least) | (value > most)
        if bad.any():
            raise ValueError(
                f"{name}: {what} is {value[bad][0]:.3g}{_row(bad, 0)}; expected "
                f"{least:g} to {most:g}, so estimate the camera again or leave the "
                "frame out"
            )


def _largest(vectors):
    return np.abs(np.asarray(vectors, np.float64)).max(axis=-1)


def _in_camera(camera: Camera, point: Float[Array, "3"]):
    """Lateral offset and depth. R (x - c), never R x + t: that cancels far from 0."""
    refuse_half("the camera or the point", camera.position, point)
    offset = exact_product(camera.camera_from_world, point - camera.position)
    return offset[:2], offset[2]


def _row(bad: np.ndarray | np.bool_, inner: int) -> str:
    """Describe where in a batch the first bad entry lies. Empty for a single camera."""
    rows = bad.reshape(*bad.shape[: bad.ndim - inner], -1).any(axis=-1)
    return f" (row {int(np.flatnonzero(rows)[0])})" if rows.ndim else ""
