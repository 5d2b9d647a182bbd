"""Rasterize Gaussians given as arrays, with the arguments of gsplat."""

import dataclasses
import functools
import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from gaussians_jax.core.splats import Gaussians
from gaussians_jax.splatting import binning, harmonics, projection, raster
from gaussians_jax.splatting.raster_spec import GSPLAT, TILE_SIZES, RasterSpec
from gaussians_jax.splatting.rendering import LEAST_ALPHA
from nerfies_jax.geometry import lens
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.precision import exact_product

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")
# Radii are int32, as in gsplat, so footprints of up to 1e16 px are clamped.
MAX_RADIUS_PX = 1e9


class _Views(NamedTuple):
    """Arrays that differ between cameras, with the cameras as first axis."""

    viewmat: Float[Array, "cameras 4 4"]
    K: Float[Array, "cameras 3 3"]
    colors: Float[Array, "cameras gaussians ..."] | None  # None: shared by all cameras
    background: Float[Array, "cameras channels"] | None
    distortion: Float[Array, "cameras coefficients"] | None
    means2d_offset: Float[Array, "cameras gaussians 2"] | None


class _Settings(NamedTuple):
    """Static settings of one call."""

    spec: RasterSpec
    size: tuple[int, int]
    sh_degree: int | None
    render_mode: str
    radius_clip: float
    camera_model: str


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "means2d", "radii", "depths", "conics", "opacities", "tiles_per_gauss"
    ],
    meta_fields=["width", "height", "tile_size", "n_cameras"],
)  # fmt: skip
@dataclasses.dataclass(frozen=True)
class RasterizationInfo:
    """Intermediate results of `rasterization`, as a densification strategy needs them.

    A pytree with the names of gsplat's `meta`. Gaussians that are not visible in a
    camera have radii of zero. Their other entries are finite but meaningless.

    Attributes:
      means2d: Projected centers, [..., C, N, 2], pixels.
      radii: Half sizes of the box where alpha can reach 1/255, [..., C, N, 2], whole
        pixels, int32.
      depths: Depths z in the camera, [..., C, N], scene units.
      conics: Inverse covariances xx, xy, yy of the projected Gaussians,
        [..., C, N, 3], per squared pixel.
      opacities: [..., C, N], with compensation if `rasterize_mode` is "antialiased".
      tiles_per_gauss: Number of tiles that overlap the box, [..., C, N], int32.
      width: Width of the images, pixels.
      height: Height of the images, pixels.
      tile_size: Edge of a tile, pixels.
      n_cameras: Number of cameras C.
    """

    # `Any`, because transformations rebuild the pytree with other types of leaves.
    means2d: Any
    radii: Any
    depths: Any
    conics: Any
    opacities: Any
    tiles_per_gauss: Any
    width: int
    height: int
    tile_size: int
    n_cameras: int


def rasterization(
    means: ArrayLike,
    quats: ArrayLike,
    scales: ArrayLike,
    opacities: ArrayLike,
    colors: ArrayLike,
    viewmats: ArrayLike,
    Ks: ArrayLike,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    tile_size: int = 8,
    backgrounds: ArrayLike | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    means2d_offset: ArrayLike | None = None,
    distortion: ArrayLike | None = None,
    camera_model: str = "pinhole",
) -> tuple[
    Float[Array, "*batch cameras height width channels"],
    Float[Array, "*batch cameras height width 1"],
    RasterizationInfo,
]:
    """Rasterize N Gaussians to the images of C cameras.

    Argument names and conventions are those of `gsplat.rasterization` (gsplat 1.6):
    x right, y down, z forward, pixel centers at +0.5, alpha clamped at 0.99 with no
    gradient above the clamp, alpha below 1/255 skipped, and a pixel finished before its
    transmittance falls to 1e-4. All arrays may have leading batch axes `...`, the same
    for every array. The function works under `jit`, `grad`, `vmap` and `scan`, in
    float32 and float64, on one dtype for all arrays. It is differentiable in every
    array, also in `Ks`: in reverse mode, in forward mode, and forward over reverse
    (Hessian-vector products). Derivatives leave out the jumps at the thresholds of
    alpha and transmittance. Cameras are rasterized one after another, so memory for
    temporaries does not grow with C.

    `packed`, `sparse_grad`, `channel_chunk`, `segmented` and `distributed` of gsplat
    have no counterpart: nothing has to be packed, and any number of channels is
    rasterized at once. `absgrad`, `covars` and rolling shutter are not available. Skew
    in `Ks` is respected, where gsplat ignores it.

    Gaussians are projected through the lens of `distortion` and `camera_model` by the
    Jacobian of the distorted projection. It takes the place of gsplat's
    `radial_coeffs`, `tangential_coeffs` and `with_ut`. Without it the compiled program
    is that of a pinhole. Gaussians centered where the lens has folded back, or 90
    degrees or more off the axis, are not rendered.

    Args:
      means: Centers in world coordinates, [..., N, 3], scene units.
      quats: Rotations as quaternions wxyz, [..., N, 4], of any nonzero length.
      scales: Standard deviations along the Gaussian's own axes, [..., N, 3], positive.
      opacities: [..., N], in [0, 1].
      colors: Values of any number D of channels, [..., N, D] or per camera
        [..., C, N, D]. With `sh_degree`: spherical harmonics coefficients,
        [..., N, K, 3] or [..., C, N, K, 3]. Ignored by the modes "D" and "ED".
      viewmats: World-to-camera matrices, [..., C, 4, 4].
      Ks: Camera intrinsics in pixels, [..., C, 3, 3].
      width: Width of the images in pixels, a Python integer.
      height: Height of the images in pixels, a Python integer.
      near_plane: Gaussians with a smaller z-depth are skipped, scene units.
      far_plane: Gaussians with a larger z-depth are skipped, scene units.
      radius_clip: Gaussians whose radii are both at most this are skipped, in pixels.
      eps2d: Added to both variances of the projected Gaussian, in squared pixels.
      sh_degree: Degree 0 to 3 of the harmonics in use, (sh_degree + 1)^2 <= K. None
        where `colors` are values.
      tile_size: Edge of a tile in pixels: 4, 8, 16 or 32. It only affects speed.
      backgrounds: Color behind the Gaussians, [..., C, D]. None is black. The
        background of depth is zero.
      render_mode: "RGB" gives the colors, "D" the accumulated z-depth (sum of weight
        times depth), "ED" the expected z-depth (the same over alpha), "RGB+D" and
        "RGB+ED" the colors and then the depth as the last channel.
      rasterize_mode: "antialiased" scales each opacity by the square root of the ratio
        of determinants before and after `eps2d` (Mip-Splatting, arXiv:2311.16493).
      means2d_offset: Shift of the projected means in pixels, [..., C, N, 2]. Pass zeros
        and differentiate with respect to them for the gradient of `means2d`, which
        gsplat keeps with `retain_grad`.
      distortion: Coefficients in OpenCV's order, [..., C, 4] or [..., C, 5]: k1, k2,
        p1, p2 and k3 of radial and tangential distortion, or k1, k2, k3, k4 of a
        fisheye. None is a lens without distortion.
      camera_model: "pinhole", which may have distortion, or "fisheye", as in gsplat.

    Returns:
      The images [..., C, height, width, X], where X is D, 1 or D + 1 by `render_mode`,
      the alphas [..., C, height, width, 1], and a `RasterizationInfo`.

    Raises:
      ValueError: A shape, dtype or setting is not one of the above.

    References:
      Kerbl et al. 2023 (arXiv:2308.04079), Equation 3. Ye et al. 2024 (gsplat,
      arXiv:2409.06765).
    """
    size = _index("width", width), _index("height", height)
    if tile_size not in TILE_SIZES:
        raise ValueError(f"tile_size must be one of {TILE_SIZES}, got {tile_size}")
    if rasterize_mode not in RASTERIZE_MODES:
        raise ValueError(
            f"rasterize_mode must be one of {RASTERIZE_MODES}, got {rasterize_mode!r}"
        )
    if render_mode not in RENDER_MODES:
        raise ValueError(
            f"render_mode must be one of {RENDER_MODES}, got {render_mode!r}"
        )
    if camera_model not in lens.CAMERA_MODELS:
        raise ValueError(
            f"camera_model must be one of {lens.CAMERA_MODELS}, got {camera_model!r}"
        )
    spec = dataclasses.replace(
        GSPLAT,
        near=near_plane,
        far=far_plane,
        eps2d=eps2d,
        tile=tile_size,
        antialiased=rasterize_mode == "antialiased",
        distorted=distortion is not None,
    )
    gaussians, colors, views = _check(
        {
            "means": means,
            "quats": quats,
            "scales": scales,
            "opacities": opacities,
            "colors": colors,
            "viewmats": viewmats,
            "Ks": Ks,
            "backgrounds": backgrounds,
            "distortion": distortion,
            "means2d_offset": means2d_offset,
        },
        sh_degree,
        lens.COEFFICIENTS[camera_model],
    )
    settings = _Settings(spec, size, sh_degree, render_mode, radius_clip, camera_model)
    fields: tuple[Array, Array, Array, Array, Array, Array]
    image, alpha, fields = _batch(settings, gaussians, colors, views)
    cameras = views.viewmat.shape[-3]
    return image, alpha, RasterizationInfo(*fields, *size, tile_size, cameras)


def _index(name, value):
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if number < 1:
        raise ValueError(f"{name} must be a Python integer of at least 1, got {value}")
    return number


def _check(arrays: dict[str, Any], sh_degree, coefficients):
    """Check shapes, and return Gaussians, colors shared by all cameras, and views."""
    arrays = {
        name: None if value is None else jnp.asarray(value)
        for name, value in arrays.items()
    }
    kind = arrays["means"].dtype
    for name, value in arrays.items():
        if value is None:
            continue
        if value.dtype not in (jnp.float32, jnp.float64):
            raise ValueError(
                f"{name} must be float32 or float64, got {value.dtype}; cast it "
                "(8-bit colors are divided by 255)"
            )
        if value.dtype != kind:
            raise ValueError(
                f"{name} is {value.dtype} but means are {kind}; cast them to one dtype"
            )
    if arrays["means"].ndim < 2:
        raise ValueError(
            f"means must have shape [..., N, 3], got {arrays['means'].shape}"
        )
    if arrays["viewmats"].ndim < 3:
        raise ValueError(
            f"viewmats must have shape [..., C, 4, 4], got {arrays['viewmats'].shape}; "
            "one camera is viewmats[None]"
        )
    batch = arrays["means"].shape[:-2]
    count, cameras = arrays["means"].shape[-2], arrays["viewmats"].shape[-3]
    if cameras < 1:
        raise ValueError("viewmats must hold at least one camera, got none")
    sizes = {"N": count, "C": cameras, "3": 3, "4": 4, "2": 2}
    lenses = arrays["distortion"]
    is_lens = lenses is not None and lenses.shape[-1:] in ((n,) for n in coefficients)
    numbers = str(lenses.shape[-1] if is_lens else coefficients[-1])
    sizes[numbers] = int(numbers)
    colors = arrays["colors"]
    last = _color_axes(colors, sh_degree)
    sizes |= dict(zip(last, colors.shape[-len(last) :], strict=False))
    if sh_degree is not None:
        sizes["3"] = 3
    expected_axes = {
        "means": "N 3",
        "quats": "N 4",
        "scales": "N 3",
        "opacities": "N",
        "colors": " ".join(["N", *last]),
        "viewmats": "C 4 4",
        "Ks": "C 3 3",
        "backgrounds": f"C {last[-1]}",
        "distortion": f"C {numbers}",
        "means2d_offset": "C N 2",
    }
    per_camera = colors.ndim == len(batch) + len(last) + 2
    if per_camera:
        expected_axes["colors"] = "C " + expected_axes["colors"]
    for name, value in arrays.items():
        axes = expected_axes[name].split()
        shape = (*batch, *(sizes[axis] for axis in axes))
        if value is not None and value.shape != shape:
            raise ValueError(
                f"{name} must have shape [{', '.join(['...', *axes])}] = {shape}, got "
                f"{value.shape}; N={count}, C={cameras} and the batch axes {batch} are "
                "those of means and viewmats"
            )
    leaves = ("means", "quats", "scales", "opacities")
    gaussians = Gaussians._make(arrays[name] for name in leaves)
    views = _Views(
        arrays["viewmats"],
        arrays["Ks"],
        colors if per_camera else None,
        arrays["backgrounds"],
        arrays["distortion"],
        arrays["means2d_offset"],
    )
    return gaussians, None if per_camera else colors, views


def _color_axes(colors, sh_degree):
    """Return the names of the axes of `colors` after that of the Gaussians."""
    if sh_degree is None:
        if colors.ndim < 2 or colors.shape[-1] < 1:
            raise ValueError(
                "colors must have shape [..., N, D] or [..., C, N, D] with D >= 1, got "
                f"{colors.shape}"
            )
        return ("D",)
    if sh_degree not in range(harmonics.MAX_DEGREE + 1):
        raise ValueError(
            f"sh_degree must be an integer from 0 to {harmonics.MAX_DEGREE} or None, "
            f"got {sh_degree}"
        )
    sh_count = (sh_degree + 1) ** 2
    if colors.ndim < 3 or colors.shape[-2] < sh_count:
        raise ValueError(
            f"colors must have shape [..., N, K, 3] or [..., C, N, K, 3] with K >= "
            f"{sh_count} for sh_degree={sh_degree}, got {colors.shape}"
        )
    return ("K", "3")


# Compiled, so that calls outside of `jit` trace and compile once per shape.
@functools.partial(jax.jit, static_argnums=0)
def _batch(settings, gaussians, colors, views):
    """Render images, alphas and arrays of `RasterizationInfo`, with batch axes."""
    scene = functools.partial(_scene, settings)
    for _ in gaussians.mean.shape[:-2]:
        scene = jax.vmap(scene)
    return scene(gaussians, colors, views)


def _scene(settings, gaussians, colors, views):
    """Render all cameras of one scene, one after another."""

    def render(view):
        view_colors = colors if view.colors is None else view.colors
        return _camera_image(settings, gaussians, view_colors, view)

    return lax.map(render, views)


def _camera_image(settings, gaussians, colors, view):
    """Render one image, its alpha and the arrays of `RasterizationInfo`."""
    spec, size = settings.spec, settings.size
    camera = _camera(view, settings.camera_model)
    footprints = projection.project(gaussians, camera, size, spec)
    if view.means2d_offset is not None:
        mean_px = footprints.mean_px + view.means2d_offset
        footprints = footprints._replace(mean_px=mean_px)
    radii = _radii(footprints, size)
    if settings.radius_clip > 0:
        is_large = jnp.any(radii > int(settings.radius_clip), axis=1, keepdims=True)
        radii = jnp.where(is_large, radii, 0)
        extent = jnp.where(is_large, footprints.extent_px, 0)
        footprints = footprints._replace(extent_px=extent)

    mode = settings.render_mode
    with_color, with_depth = mode.startswith("RGB"), mode.endswith("D")
    values = [_visible_colors(settings, gaussians, colors, view)] if with_color else []
    if with_depth:
        values.append(footprints.depth[:, None])
    image, transmittance = raster.rasterize(
        footprints, jnp.concatenate(values, axis=1), size, spec
    )
    alpha = (1 - transmittance)[..., None]
    if with_color and view.background is not None:
        color = image[..., :-1] if with_depth else image
        color = color + view.background * transmittance[..., None]
        image = jnp.concatenate([color, image[..., color.shape[-1] :]], axis=-1)
    if mode.endswith("ED"):
        expected_depth = image[..., -1:] / jnp.maximum(alpha, LEAST_ALPHA)
        image = jnp.concatenate([image[..., :-1], expected_depth], axis=-1)

    rects = binning.tile_rects(
        lax.stop_gradient(footprints.mean_px),
        footprints.extent_px,
        binning.Grid(*size, spec.tile),
    )
    fields = (
        footprints.mean_px,
        radii,
        footprints.depth,
        _conics(footprints.whitening),
        footprints.opacity,
        rects.tiles,
    )
    return image, alpha, fields


def _camera(view, model):
    """Return the camera of a view, whose center the viewmat maps to zero."""
    rotation, shift = view.viewmat[:3, :3], view.viewmat[:3, 3]
    # Cofactors give the exact inverse of any matrix, so the gradient with respect to
    # the viewmat is that of R x + t, not only along rotations.
    cofactors = jnp.cross(
        jnp.roll(rotation, -1, axis=0), jnp.roll(rotation, -2, axis=0)
    )
    determinant = jnp.sum(rotation[0] * cofactors[0])
    position = -exact_product(shift, cofactors) / determinant
    radial = tangential = jnp.zeros(3, rotation.dtype)
    fisheye, terms = None, view.distortion
    if model == "fisheye":
        fisheye = jnp.zeros(4, rotation.dtype) if terms is None else terms
    elif terms is not None:
        tangential = terms[2:4]
        radial = jnp.concatenate([terms[:2], terms[4:], radial])[:3]
    K = view.K
    return Camera(
        camera_from_world=rotation,
        position=position,
        focal_px=K[0, 0],
        principal_point_px=K[:2, 2],
        skew_px=K[0, 1],
        pixel_aspect=K[1, 1] / K[0, 0],
        radial=radial,
        tangential=tangential[:2],
        fisheye=fisheye,
    )


def _visible_colors(settings, gaussians, colors, view):
    """Return the values of the channels, evaluating harmonics if there are any."""
    if settings.sh_degree is None:
        return colors
    # -R^T t, as in gsplat.
    position = -exact_product(view.viewmat[:3, 3], view.viewmat[:3, :3])
    coefficients = colors[:, : (settings.sh_degree + 1) ** 2]
    return harmonics.color_toward(coefficients, gaussians.mean, position)


def _radii(footprints, size):
    """Return integer radii of the box where alpha >= threshold, zero if not visible."""
    reach = jnp.ceil(jnp.minimum(footprints.extent_px, MAX_RADIUS_PX))
    # Visibility by the box of whole pixels, as in gsplat.
    whole = lax.stop_gradient(footprints)._replace(extent_px=reach)
    return jnp.where(whole.overlaps_image(size)[:, None], reach, 0).astype(jnp.int32)


def _conics(whitening):
    """Return xx, xy, yy of the inverse covariance. Its form is 2 (u^2 + v^2)."""
    p, k, r = whitening.T
    rr = 2 * r * r
    return jnp.stack([2 * p * p + k * k * rr, -k * rr, rr], axis=-1)
