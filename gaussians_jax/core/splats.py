"""Gaussians: the raw parameters that are trained, and their activated values.

A slot that is not in use is *inactive*: its opacity logit is `INACTIVE_LOGIT`, so its
opacity and the gradient of its opacity are exactly zero in float32 and float64. It is
culled by the renderer, covers no tile, and no gradient can activate it. Only an event
between two chunks does. `active_mask` depends on the opacity logit alone.
"""

import math
import pathlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial
from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.geometry import lens
from nerfies_jax.geometry import quaternion as quaternions
from nerfies_jax.geometry.camera import Camera

PyTree = Any

INACTIVE_LOGIT = -1000.0  # sigmoid and its gradient are 0 below -745 in float64
# exp(15)^2 = 1e13 and exp(-20)^2 = 4e-18 keep products of scales far from overflow and
# underflow. Raw values outside the range are clamped and get no gradient. Without the
# range, exp overflows to inf at 89 in float32.
LOG_SCALE_RANGE = (-20.0, 15.0)
SH_DC = 0.28209479177387814  # 1 / (2 sqrt(pi)), the constant harmonic
BUCKET = 256  # capacities are multiples of this
TREMOR = 0.1  # smallest extent of the cameras, as a share of a typical depth


class Splats(NamedTuple):
    """Trained parameters of each Gaussian, unconstrained."""

    mean: Float[Array, "gaussians 3"]  # scene units
    log_scale: Float[Array, "gaussians 3"]  # log of the standard deviations
    quaternion: Float[Array, "gaussians 4"]  # wxyz, any length but zero
    opacity_logit: Float[Array, " gaussians"]
    sh_dc: Float[Array, "gaussians 1 3"]  # degree 0
    sh_rest: Float[Array, "gaussians rest 3"]  # degrees 1.., rest = (degree+1)^2 - 1


class Gaussians(NamedTuple):
    """Activated Gaussians in world coordinates, ready to render."""

    mean: Float[Array, "gaussians 3"]
    quaternion: Float[Array, "gaussians 4"]  # wxyz, normalized where it is used
    scale: Float[Array, "gaussians 3"]  # standard deviations, positive
    opacity: Float[Array, " gaussians"]  # in [0, 1]


class Params(NamedTuple):
    """Trained parameters, separated by structure.

    Every leaf of `rows` has the capacity as its first axis. No leaf of `nets` has.
    """

    rows: dict[str, PyTree]  # {"splats": Splats, "embedding": ..., ...}
    nets: dict[str, PyTree]


def refuse_half(dtype: Any) -> None:
    """Raise for a half-precision type. Gaussians are float32 or float64.

    In bfloat16, a mean at 256 px is accurate to one pixel only, and at usual learning
    rates the steps of Adam are below half an ulp, so no parameter would change.

    Args:
      dtype: Type of the arrays.

    Raises:
      ValueError: If it has fewer than 32 bits.
    """
    if jnp.finfo(dtype).bits < 32:
        raise ValueError(
            f"Gaussians in {jnp.dtype(dtype).name} cannot be rendered or trained; cast "
            "them to float32"
        )


def activate(splats: Splats) -> Gaussians:
    """Activate raw parameters: exp for scales, the logistic function for opacities.

    The result is finite for all finite parameters. The logarithm of the scale is
    clamped to `LOG_SCALE_RANGE`.

    Args:
      splats: Raw parameters.

    Returns:
      Gaussians in world coordinates.

    References:
      Kerbl et al. 2023 (arXiv:2308.04079), section 5.1.
    """
    return Gaussians(
        mean=splats.mean,
        quaternion=splats.quaternion,
        scale=jnp.exp(jnp.clip(splats.log_scale, *LOG_SCALE_RANGE)),
        opacity=jax.nn.sigmoid(splats.opacity_logit),
    )


def rotate(
    gaussians: Gaussians, rotation: Float[Array, "gaussians 3"]
) -> Float[Array, "gaussians 4"]:
    """Rotate Gaussians in world axes: exp(rotation) q / |q|.

    Args:
      gaussians: The Gaussians.
      rotation: Rotation vectors (rad, world axes).

    Returns:
      Unit quaternions (wxyz).
    """

    def compose(rotation, orientation):
        return quaternions.multiply(
            quaternions.exp(rotation), quaternions.normalize(orientation)
        )

    return jax.vmap(compose)(rotation, gaussians.quaternion)


def active_mask(splats: Splats) -> Bool[Array, " gaussians"]:
    """Test which slots hold a Gaussian. A NaN logit counts as active.

    Args:
      splats: Raw parameters.

    Returns:
      True for active Gaussians.
    """
    return _is_active(splats.opacity_logit)


def _is_active(logit):
    return ~(logit <= INACTIVE_LOGIT / 2)


def active_count(splats: Splats) -> int:
    """Count the Gaussians, on the host.

    Args:
      splats: Raw parameters.

    Returns:
      The number of active Gaussians.
    """
    return int(_is_active(np.asarray(splats.opacity_logit)).sum())


def in_use(gaussians: Gaussians) -> Bool[Array, " gaussians"]:
    """Select the Gaussians that can be seen.

    The opacity of an inactive Gaussian is exactly zero.

    Args:
      gaussians: Gaussians of a scene, at any time.

    Returns:
      True where the opacity is not zero.
    """
    return ~(gaussians.opacity <= 0)


def rows_to_write(splats: Splats, path: pathlib.Path) -> np.ndarray:
    """Select the Gaussians that a file holds, on the host.

    Args:
      splats: Raw parameters.
      path: The file, for the error message.

    Returns:
      [gaussians] bool.

    Raises:
      ValueError: If there is none.
    """
    active = np.asarray(active_mask(splats))
    if not active.any():
        raise ValueError(
            f"{path}: none of the {len(active)} Gaussians is active, so there is "
            "nothing to write"
        )
    return active


def active_degree(step: Int[Array, ""], interval: int, degree: int) -> Int[Array, ""]:
    """Compute the harmonic degree in use: one more after every `interval` steps.

    Args:
      step: Number of updates so far.
      interval: Number of steps from one degree to the next.
      degree: Largest degree.

    Returns:
      The degree.
    """
    return jnp.minimum(step // interval, degree)


def active_harmonics(
    splats: Splats, degree: Int[Array, ""] | int
) -> Float[Array, "gaussians coefficients 3"]:
    """Return all coefficients, with those above a degree set to zero.

    Masked coefficients get no gradient.

    Args:
      splats: Raw parameters.
      degree: Largest degree in use. It may be traced, so that a schedule that raises it
        compiles once.

    Returns:
      The coefficients, degree 0 first.
    """
    count = splats.sh_rest.shape[1]
    # Coefficient k belongs to the degree floor(sqrt(k)); k = 0 is `sh_dc`.
    band = np.array([math.isqrt(k) for k in range(1, count + 1)], np.int32)
    is_active = jnp.asarray(band) <= degree
    sh_rest = jnp.where(
        is_active[:, None], splats.sh_rest, jnp.zeros_like(splats.sh_rest)
    )
    return jnp.concatenate([splats.sh_dc, sh_rest], axis=1)


def capacity_for(count: int, most: int | None = None) -> int:
    """Compute the smallest bucket that holds a number of Gaussians.

    Buckets grow from 256 by a factor of 1.5, rounded up to a multiple of 256. A growing
    scene then compiles a handful of programs, and at most a third of its slots are
    unused. A maximum that is not beyond the next bucket is used at once: a program
    takes 10 s to compile, and 3000 unused slots cost 1 ms of a step.

    Args:
      count: Number of Gaussians.
      most: Largest capacity.

    Returns:
      The capacity.

    Raises:
      ValueError: If `count` is larger than `most`.
    """
    if most is not None and count > most:
        raise ValueError(
            f"{count} Gaussians do not fit under the cap of {most}; raise the cap or "
            "start from fewer points"
        )
    size = BUCKET
    while size < count:
        size = -(-size * 3 // (2 * BUCKET)) * BUCKET
    return size if most is None or most > 3 * size // 2 else most


def take_rows(params: Params, rows: Int[Array, " kept"]) -> Params:
    """Gather Gaussians by index in all per-Gaussian parameters.

    Args:
      params: All parameters.
      rows: Indices of the Gaussians.

    Returns:
      Parameters with the gathered Gaussians.
    """
    return params._replace(rows=jax.tree.map(lambda leaf: leaf[rows], params.rows))


def deactivate(splats: Splats, inactive: Bool[Array, " gaussians"]) -> Splats:
    """Mark Gaussians as inactive.

    Args:
      splats: Raw parameters.
      inactive: True for the Gaussians to deactivate.

    Returns:
      Raw parameters with their opacity logits replaced.
    """
    return _deactivate(splats, inactive)


def _deactivate(splats, inactive):
    logit = splats.opacity_logit
    mark = np.asarray(INACTIVE_LOGIT, logit.dtype)
    # Arrays of the host stay there: their length is that of a capture, and JAX would
    # compile a program for each.
    where = np.where if isinstance(logit, np.ndarray) else jnp.where
    return splats._replace(opacity_logit=where(inactive, mark, logit))


def pad_rows(params: Params, capacity: int) -> Params:
    """Append inactive Gaussians up to a capacity.

    They repeat the first Gaussian, so that all values are valid (a unit quaternion, a
    finite scale).

    Args:
      params: All parameters.
      capacity: New number of slots.

    Returns:
      Parameters of that capacity.

    Raises:
      ValueError: If there are no Gaussians, or more than `capacity`.
    """
    count = params.rows["splats"].mean.shape[0]
    if not 0 < count <= capacity:
        raise ValueError(
            f"{count} Gaussians cannot be padded to a capacity of {capacity}; pass at "
            "least one Gaussian and a capacity that is not smaller than their number"
        )
    rows = np.concatenate([np.arange(count), np.zeros(capacity - count, int)])
    padded_rows = jax.tree.map(lambda leaf: leaf[rows], params.rows)
    inactive = np.arange(capacity) >= count
    padded_rows["splats"] = _deactivate(padded_rows["splats"], inactive)
    return params._replace(rows=padded_rows)


def from_points(
    points: np.ndarray,
    colors: np.ndarray,
    *,
    degree: int = 3,
    opacity: float = 0.1,
    scale: float = 1.0,
    lone_scale: float = 1.0,
    dtype: Any = jnp.float32,
) -> Splats:
    """Initialize one isotropic Gaussian per point, on the host.

    The standard deviation is `scale` times the root mean square distance to the three
    nearest points at other positions. This differs from Kerbl et al. 2023, section 5.1,
    who use the mean distance. Their code counts a duplicate as a neighbor at distance
    zero and clamps the result to at least 3e-4 in any unit.

    Args:
      points: [n, 3] positions in scene units.
      colors: [n, 3] colors in [0, 1].
      degree: Degree of the spherical harmonics.
      opacity: Initial opacity.
      scale: Factor of the neighbor distance.
      lone_scale: Distance to use if all points coincide, in scene units.
      dtype: Floating-point type.

    Returns:
      Raw parameters of n Gaussians.

    Raises:
      ValueError: If a shape, value or setting is invalid.
    """
    refuse_half(dtype)
    points = np.asarray(points, np.float64)
    colors = np.asarray(colors, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or points.shape != colors.shape:
        raise ValueError(
            "points and colors must have shape [n, 3], got "
            f"{points.shape} and {colors.shape}"
        )
    if not len(points):
        raise ValueError("points is empty; use `random_in_views` to sample points")
    if not 0 < opacity < 1:
        raise ValueError(f"opacity must lie between 0 and 1, got {opacity}")
    for name, values in (("point", points), ("color", colors)):
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise ValueError(
                f"{name} {np.flatnonzero(bad)[0]} is not finite, like {bad.sum() - 1} "
                "others; remove those rows"
            )
    if not 0 < scale < math.inf:
        raise ValueError(f"scale must be positive and finite, got {scale}")
    distance = neighbor_distance(points, lone_scale)
    log_scale = np.clip(np.log(scale * distance), *LOG_SCALE_RANGE)
    count, rest = len(points), (degree + 1) ** 2 - 1
    rows = dict(
        mean=points,
        log_scale=np.repeat(log_scale[:, None], 3, axis=1),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        opacity_logit=np.full(count, math.log(opacity / (1 - opacity))),
        sh_dc=(colors[:, None, :] - 0.5) / SH_DC,
        sh_rest=np.zeros((count, rest, 3)),
    )
    # Converted on the host: JAX would compile a program for each shape, and the number
    # of points depends on the capture.
    return Splats(
        **{name: jnp.asarray(x.astype(dtype), dtype) for name, x in rows.items()}
    )


def neighbor_distance(
    points: Float[np.ndarray, "points 3"], lone_scale: float
) -> Float[np.ndarray, " points"]:
    """Compute the root mean square distance to the three nearest other points, on the
    host.

    Args:
      points: Positions in scene units. Duplicates are not neighbors.
      lone_scale: Distance to use if there is only one distinct point.

    Returns:
      The distance of each point, to fewer neighbors if there are fewer.
    """
    # Duplicates are found in float32, the precision of training.
    distinct, index = np.unique(points.astype(np.float32), axis=0, return_inverse=True)
    neighbors = min(3, len(distinct) - 1)
    if neighbors == 0:
        return np.full(len(points), float(lone_scale))
    tree = scipy.spatial.cKDTree(distinct.astype(np.float64))
    distance, _ = tree.query(tree.data, k=neighbors + 1)
    return np.sqrt(np.mean(distance[:, 1:] ** 2, axis=1))[index.reshape(-1)]


def random_in_views(
    rng: np.random.Generator,
    cameras: Camera,
    size: tuple[int, int],
    near: np.ndarray | float,
    far: np.ndarray | float,
    count: int,
) -> np.ndarray:
    """Sample points that the cameras see, on the host.

    Camera, pixel and z-depth are uniform, so every image has the same density at every
    depth. Samples uniform in the volume would mostly lie at its far end.

    Args:
      rng: Random generator.
      cameras: Cameras of the views.
      size: (width, height) in pixels.
      near: Smallest z-depth in scene units, one value or one per camera.
      far: Largest z-depth, likewise.
      count: Number of points.

    Returns:
      [count, 3] positions in scene units.
    """
    views = np.reshape(cameras.position, (-1, 3)).shape[0]
    near, far = (
        np.broadcast_to(np.asarray(x, np.float64), (views,)) for x in (near, far)
    )
    if not (np.isfinite(far).all() and (near > 0).all() and (near < far).all()):
        raise ValueError(
            "near and far must satisfy 0 < near < far < inf, got near in "
            f"[{near.min()}, {near.max()}] and far in [{far.min()}, {far.max()}]"
        )
    view = rng.integers(views, size=count)

    def per_view(leaf, *shape):
        return np.asarray(leaf, np.float64).reshape(views, *shape)[view]

    pixel = rng.uniform((0, 0), size, (count, 2))
    z = rng.uniform(near[view], far[view])
    focal = per_view(cameras.focal_px)
    offset = pixel - per_view(cameras.principal_point_px, 2)
    y = offset[:, 1] / (focal * per_view(cameras.pixel_aspect))
    x = (offset[:, 0] - per_view(cameras.skew_px) * y) / focal
    has_distortion = np.any(cameras.radial) or np.any(cameras.tangential)
    if has_distortion or cameras.fisheye is not None:
        axes = np.ndim(cameras.focal_px)
        cameras_of_view = jax.tree.map(
            lambda leaf: jnp.float32(per_view(leaf, *np.shape(leaf)[axes:])), cameras
        )
        distorted_slopes = jnp.float32(np.stack([x, y], axis=-1))
        slopes, _ = jax.vmap(lens.undistort)(cameras_of_view, distorted_slopes)
        x, y = np.asarray(slopes, np.float64).T
    in_camera = np.stack([x, y, np.ones_like(x)], axis=-1) * z[:, None]
    rotation = per_view(cameras.camera_from_world, 3, 3)
    return np.einsum("nij,ni->nj", rotation, in_camera) + per_view(cameras.position, 3)


def scene_extent(position: np.ndarray, static: float | None = None) -> float:
    """Compute 1.1 times the largest distance of a camera from their mean, on the host.

    This is the unit of the learning rate of the means and of the densification
    thresholds (Kerbl et al. 2023, reference implementation). It would be zero for a
    static camera, whose means would not learn. The extent is at least a tenth of
    `static`: the tremor of a hand-held camera is no unit for surfaces meters away, and
    densification would prune all of them.

    Args:
      position: [cameras, 3] camera centers in scene units.
      static: Typical depth in scene units.

    Returns:
      The extent in scene units.

    Raises:
      ValueError: If the cameras are static and `static` is None.
    """
    position = np.asarray(position, np.float64).reshape(-1, 3)
    middle = position.mean(axis=0)
    extent = 1.1 * float(np.linalg.norm(position - middle, axis=1).max())
    # Rounding of float32 positions far from the origin is not motion.
    if extent > 1e-5 * float(np.abs(position).max()):
        return extent if static is None else max(extent, TREMOR * float(static))
    if static is None:
        raise ValueError(
            f"the cameras are static (extent {extent:g} scene units), so the means "
            "would not learn; pass `static`, a typical depth of the scene"
        )
    return float(static)
