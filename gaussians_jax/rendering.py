"""One frame of Gaussians from one camera: colour, alpha, depth, features."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gaussians_jax import harmonics, projection, raster
from gaussians_jax.projection import Footprints
from gaussians_jax.raster_spec import GSPLAT, RasterSpec
from gaussians_jax.splats import Gaussians
from nerfies_jax.contract import checked
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.precision import widened
from nerfies_jax.training.model import Rendering

# Expected depth is D / max(alpha, 1e-10), as gsplat: zero, not NaN, where nothing is.
LEAST_ALPHA = 1e-10


class Frame(NamedTuple):
    """All that one pass over the Gaussians gives."""

    rendering: Rendering
    footprints: Footprints
    features: Float[Array, "height width features"] | None  # no background added


@checked
def render(
    gaussians: Gaussians,
    colours: Float[Array, "gaussians 3"],
    camera: Camera,
    size: tuple[int, int],
    spec: RasterSpec = GSPLAT,
    background: Float[Array, "*image 3"] | None = None,
    features: Float[Array, "gaussians features"] | None = None,
    mean2d_offset: Float[Array, "gaussians 2"] | None = None,
    depth: bool = True,
) -> Frame:
    """Composite `colours` and `features`; `size` is (width, height).

    `background` is one colour or an image, black where absent. `mean2d_offset` (px)
    moves the footprints on the image: pass zeros, and its gradient is the gradient of
    each projected mean in pixels, which densification thresholds. Without `depth`
    that of the rendering is None, and a training step 4 % faster. Raises ValueError
    for a camera with distortion; of one that is traced nobody can tell
    (`refuse_distortion` on the host).
    """
    if not isinstance(camera.radial, jax.core.Tracer):
        refuse_distortion(camera)
    footprints = projection.project(gaussians, camera, size, spec)
    drawn = footprints
    if mean2d_offset is not None:
        drawn = footprints._replace(mean_px=footprints.mean_px + mean2d_offset)
    values = [widened(colours)]
    if depth:
        values.append(footprints.depth[:, None])
    if features is not None:
        values.append(widened(features))
    image, transmittance = raster.rasterize(
        drawn, jnp.concatenate(values, axis=1), size, spec
    )
    colour, alpha = image[..., :3], 1 - transmittance
    if background is not None:
        colour = colour + background * transmittance[..., None]
    expected = image[..., 3] / jnp.maximum(alpha, LEAST_ALPHA) if depth else None
    extras = None if features is None else image[..., 4 if depth else 3 :]
    return Frame(Rendering(colour, alpha, expected), footprints, extras)


@checked
def render_harmonics(
    gaussians: Gaussians,
    coefficients: Float[Array, "gaussians coefficients 3"],
    camera: Camera,
    size: tuple[int, int],
    spec: RasterSpec = GSPLAT,
    background: Float[Array, "*image 3"] | None = None,
    features: Float[Array, "gaussians features"] | None = None,
    mean2d_offset: Float[Array, "gaussians 2"] | None = None,
    depth: bool = True,
) -> Frame:
    """`render` with view-dependent colour from 1, 4, 9 or 16 SH coefficients."""
    colours = harmonics.colour_towards(coefficients, gaussians.mean, camera.position)
    extras = background, features, mean2d_offset, depth
    return render(gaussians, colours, camera, size, spec, *extras)


def refuse_distortion(camera: Camera) -> None:
    """Raise where `camera` (host values) is distorted: EWA splatting is a pinhole's."""
    for name in ("radial", "tangential"):
        value = np.asarray(getattr(camera, name))
        if np.any(value != 0):
            raise ValueError(
                f"Gaussian splatting needs a camera without lens distortion, got "
                f"{name}={value.tolist()}; undistort the images first"
            )
