"""Gaussians: the rows that are trained, and what they stand for.

A row that is not in use is *inactive*: its opacity logit is `INACTIVE_LOGIT`, so its
opacity and the slope of its opacity are exactly zero in float32 and float64. It is
culled by the renderer's cut-off, covers no tile, and no gradient can bring it back;
only an event between two chunks activates a row. `active_mask` reads that mark and
nothing else.
"""

import math
import pathlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial
from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.geometry import quaternion as quaternions
from nerfies_jax.geometry.camera import Camera

PyTree = Any

INACTIVE_LOGIT = -1000.0  # sigmoid and its slope underflow to 0 below -745 in float64
# exp(15)^2 = 1e13 and exp(-20)^2 = 4e-18 keep products of scales far from overflow and
# from the flush to zero; raw values beyond are drawn at the bound and get no gradient.
# An unbounded exp is inf at 89 in float32.
LOG_SCALE_RANGE = (-20.0, 15.0)
SH_DC = 0.28209479177387814  # 1 / (2 sqrt(pi)), the constant harmonic
BUCKET = 256  # capacities are multiples of this
TREMOR = 0.1  # of a typical depth: cameras that move less stand still, nearly


class Splats(NamedTuple):
    """What is trained: one row per Gaussian, unconstrained."""

    mean: Float[Array, "gaussians 3"]  # scene units
    log_scale: Float[Array, "gaussians 3"]  # log of the standard deviations
    quaternion: Float[Array, "gaussians 4"]  # wxyz, any length but zero
    opacity_logit: Float[Array, " gaussians"]
    sh_dc: Float[Array, "gaussians 1 3"]  # degree 0
    sh_rest: Float[Array, "gaussians rest 3"]  # degrees 1.., rest = (degree+1)^2 - 1


class Gaussians(NamedTuple):
    """What is drawn: activated, in world coordinates."""

    mean: Float[Array, "gaussians 3"]
    quaternion: Float[Array, "gaussians 4"]  # wxyz; normalized where it is used
    scale: Float[Array, "gaussians 3"]  # standard deviations, positive
    opacity: Float[Array, " gaussians"]  # in [0, 1]


class Params(NamedTuple):
    """Trained parameters, kept apart by structure.

    Every leaf of `rows` has the capacity as its first axis; nothing in `nets` has.
    """

    rows: dict[str, PyTree]  # {"splats": Splats, "embedding": ..., ...}
    nets: dict[str, PyTree]


def refuse_half(dtype: Any) -> None:
    """Raise for a type that cannot hold Gaussians: they are float32 or float64.

    bfloat16 places a mean at 256 px to a whole pixel, and at usual rates Adam's steps
    are below half an ulp of such parameters: nothing moves.
    """
    if jnp.finfo(dtype).bits < 32:
        raise ValueError(
            f"Gaussians in {jnp.dtype(dtype).name} cannot be drawn or trained; cast "
            "them to float32"
        )


def activate(splats: Splats) -> Gaussians:
    """Scales by exp, opacities by the logistic function; finite for every finite row.

    Kerbl et al. 2023, arXiv:2308.04079, section 5.1, with the logarithm of the scale
    held to `LOG_SCALE_RANGE`.
    """
    return Gaussians(
        mean=splats.mean,
        quaternion=splats.quaternion,
        scale=jnp.exp(jnp.clip(splats.log_scale, *LOG_SCALE_RANGE)),
        opacity=jax.nn.sigmoid(splats.opacity_logit),
    )


def turned(
    gaussians: Gaussians, turn: Float[Array, "gaussians 3"]
) -> Float[Array, "gaussians 4"]:
    """The rotations of Gaussians, each followed by a turn: exp(turn) q / |q|.

    `turn` are rotation vectors (rad, world axes); the quaternions have length 1.
    """

    def one(turn, own):
        return quaternions.multiply(quaternions.exp(turn), quaternions.normalize(own))

    return jax.vmap(one)(turn, gaussians.quaternion)


def active_mask(splats: Splats) -> Bool[Array, " gaussians"]:
    """Which rows stand for a Gaussian; the others only fill the capacity.

    A logit that is not a number marks no row as inactive.
    """
    return ~(splats.opacity_logit <= INACTIVE_LOGIT / 2)


def rows_to_write(splats: Splats, path: pathlib.Path) -> np.ndarray:
    """[gaussians] bool: what of them a file holds; ValueError where that is none."""
    active = np.asarray(active_mask(splats))
    if not active.any():
        raise ValueError(
            f"{path}: none of the {len(active)} rows is active; not written"
        )
    return active


def active_degree(step: Int[Array, ""], every: int, degree: int) -> Int[Array, ""]:
    """The harmonic degree in use after `step` updates: one more `every` steps."""
    return jnp.minimum(step // every, degree)


def active_harmonics(
    splats: Splats, degree: Int[Array, ""] | int
) -> Float[Array, "gaussians coefficients 3"]:
    """All coefficients, degree 0 first, those above `degree` set to zero.

    `degree` may be traced, so a schedule that raises it compiles once. A band that is
    masked also gets no gradient.
    """
    rest = splats.sh_rest.shape[1]
    # Coefficient k belongs to the degree floor(sqrt(k)); k = 0 is `sh_dc`.
    band = np.array([math.isqrt(k) for k in range(1, rest + 1)], np.int32)
    shown = jnp.asarray(band) <= degree
    masked = jnp.where(shown[:, None], splats.sh_rest, jnp.zeros_like(splats.sh_rest))
    return jnp.concatenate([splats.sh_dc, masked], axis=1)


def capacity_for(count: int, most: int | None = None) -> int:
    """The smallest bucket that holds `count` rows, never above `most`.

    Buckets are 256 and then 1.5 times the one before, rounded up to a multiple of 256,
    so that a growing scene compiles a handful of programs and carries at most half as
    many rows again as it uses. A cap that is not beyond the next bucket is taken at
    once: a program takes 10 s to compile, 3000 rows that nothing uses 1 ms of a step.
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
    """The given rows of everything that has one row per Gaussian."""
    return params._replace(rows=jax.tree.map(lambda leaf: leaf[rows], params.rows))


def deactivate(splats: Splats, inactive: Bool[Array, " gaussians"]) -> Splats:
    """The same splats with the given rows marked inactive."""
    mark = jnp.asarray(INACTIVE_LOGIT, splats.opacity_logit.dtype)
    return splats._replace(
        opacity_logit=jnp.where(inactive, mark, splats.opacity_logit),
    )


def pad_rows(params: Params, capacity: int) -> Params:
    """The same rows and inactive ones behind them, up to `capacity`.

    Inactive rows repeat the first one, so every leaf keeps values that its own code
    knows how to handle (a unit quaternion, a finite scale).
    """
    count = params.rows["splats"].mean.shape[0]
    if not 0 < count <= capacity:
        raise ValueError(
            f"{count} rows cannot be padded to a capacity of {capacity}; "
            "it must hold at least one row and no fewer than there are"
        )
    rows = np.concatenate([np.arange(count), np.zeros(capacity - count, int)])
    padded = take_rows(params, jnp.asarray(rows, jnp.int32))
    inactive = jnp.arange(capacity) >= count
    return padded._replace(
        rows=padded.rows | {"splats": deactivate(padded.rows["splats"], inactive)}
    )


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
    """One round Gaussian for each point; host side.

    `points` [n, 3] in scene units and `colors` [n, 3] in [0, 1]. The standard
    deviation is `scale` times the root mean square distance to the three nearest points
    that lie elsewhere (Kerbl et al. 2023, section 5.1, says the mean distance; their
    code counts a duplicate as a neighbor at distance zero and floors the result at
    3e-4 whatever the unit). With two or three distinct points it uses those there are;
    where there is one, `lone_scale` is that distance.
    """
    refuse_half(dtype)
    points = np.asarray(points, np.float64)
    colors = np.asarray(colors, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or points.shape != colors.shape:
        raise ValueError(
            f"points and colors are both [n, 3], got {points.shape} and {colors.shape}"
        )
    if not len(points):
        raise ValueError("no points to start from; use `random_in_views` instead")
    if not 0 < opacity < 1:
        raise ValueError(f"the first opacity lies between 0 and 1, got {opacity}")
    for name, values in (("point", points), ("color", colors)):
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise ValueError(
                f"{name} {np.flatnonzero(bad)[0]} is not finite, and so are "
                f"{bad.sum() - 1} more; drop those rows before starting from them"
            )
    if not 0 < scale < math.inf:
        raise ValueError(f"the first scale must be positive and finite, got {scale}")
    distance = neighbor_distance(points, lone_scale)
    log_scale = np.clip(np.log(scale * distance), *LOG_SCALE_RANGE)
    count, rest = len(points), (degree + 1) ** 2 - 1
    return Splats(
        mean=jnp.asarray(points, dtype),
        log_scale=jnp.asarray(np.repeat(log_scale[:, None], 3, axis=1), dtype),
        quaternion=jnp.asarray(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), dtype),
        opacity_logit=jnp.full(count, math.log(opacity / (1 - opacity)), dtype),
        sh_dc=jnp.asarray((colors[:, None, :] - 0.5) / SH_DC, dtype),
        sh_rest=jnp.zeros((count, rest, 3), dtype),
    )


def neighbor_distance(
    points: Float[np.ndarray, "points 3"], lone_scale: float
) -> Float[np.ndarray, " points"]:
    """Root mean square distance to the three nearest points that lie elsewhere.

    Of two or three points, to those there are; of one, `lone_scale`. Host side.
    """
    # Distinct in float32, the precision they are trained in.
    distinct, place = np.unique(points.astype(np.float32), axis=0, return_inverse=True)
    neighbors = min(3, len(distinct) - 1)
    if neighbors == 0:
        return np.full(len(points), float(lone_scale))
    tree = scipy.spatial.cKDTree(distinct.astype(np.float64))
    distance, _ = tree.query(tree.data, k=neighbors + 1)
    return np.sqrt(np.mean(distance[:, 1:] ** 2, axis=1))[place.reshape(-1)]


def random_in_views(
    rng: np.random.Generator,
    cameras: Camera,
    size: tuple[int, int],
    near: np.ndarray | float,
    far: np.ndarray | float,
    count: int,
) -> np.ndarray:
    """`count` points [count, 3] that the cameras see between near and far; host side.

    Camera, pixel and z-depth are drawn evenly, so every picture starts equally dense
    at every depth; drawn evenly over the volume, most points would lie at the far end.
    Lens distortion is left out. `size` is (width, height); `near` and `far` are
    z-depths in scene units, one for all cameras or one each.
    """
    views = np.reshape(cameras.position, (-1, 3)).shape[0]
    near, far = (
        np.broadcast_to(np.asarray(x, np.float64), (views,)) for x in (near, far)
    )
    if not (np.isfinite(far).all() and (near > 0).all() and (near < far).all()):
        raise ValueError(
            "near and far need 0 < near < far and a finite far, got near in "
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
    in_camera = np.stack([x, y, np.ones_like(x)], axis=-1) * z[:, None]
    turn = per_view(cameras.camera_from_world, 3, 3)
    return np.einsum("nij,ni->nj", turn, in_camera) + per_view(cameras.position, 3)


def scene_extent(position: np.ndarray, static: float | None = None) -> float:
    """1.1 times the largest distance of a camera from their mean; host side.

    The unit of the learning rate of the means and of the thresholds of densification
    (Kerbl et al. 2023, reference implementation). Cameras that stand still have none,
    and a zero would stop the means from learning; `static`, a typical depth, stands in
    for it, and a tenth of it for that of cameras that hardly move: a hand's tremor is
    no unit for what lies meters away, and densification would prune all of it.
    """
    position = np.asarray(position, np.float64).reshape(-1, 3)
    middle = position.mean(axis=0)
    extent = 1.1 * float(np.linalg.norm(position - middle, axis=1).max())
    # Rounding of float32 positions far from the origin is no motion.
    if extent > 1e-5 * float(np.abs(position).max()):
        return extent if static is None else max(extent, TREMOR * float(static))
    if static is None:
        raise ValueError(
            f"the cameras stand still (extent {extent:g} scene units), which would "
            "stop the means from learning; pass `static`, a typical depth of the scene"
        )
    return float(static)
