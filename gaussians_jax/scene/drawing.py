"""Rendering of one view of a scene, in the appearance of its photograph."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from gaussians_jax.core import splats
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Gaussians, Params, Splats
from gaussians_jax.scene.spec import SceneMetadata, SplatScene, raster_of
from gaussians_jax.splatting import harmonics, rendering
from nerfies_jax.geometry import rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.training.model import Rendering, View


def appearance_of(effects: tuple[SplatRecord, ...]) -> SplatRecord | None:
    """Return the component that changes the colors of the Gaussians, or None.

    Args:
      effects: Records of the components.

    Returns:
      The record.
    """
    return next((effect for effect in effects if effect.recolor is not None), None)


def check_one_appearance(effects: tuple[SplatRecord, ...]) -> None:
    """Raise ValueError if two components change the colors of the Gaussians.

    Args:
      effects: Records of the components.

    Raises:
      ValueError: If two components do so.
    """
    names = [effect.name for effect in effects if effect.recolor is not None]
    if len(names) > 1:
        raise ValueError(
            f"{' and '.join(names)} both change the colors of the Gaussians; leave all "
            "but one out"
        )


def draw(
    spec: SplatScene,
    metadata: SceneMetadata,
    effects: tuple[SplatRecord, ...],
    params: Params,
    rows: Splats,
    gaussians: Gaussians,
    view: View,
    size: tuple[int, int],
    degree,
    *,
    mean2d_offset: Float[Array, "gaussians 2"] | None = None,
    depth: bool = True,
    devices: int = 1,
) -> rendering.Frame:
    """Render Gaussians from a view, without the exposure of its image.

    Args:
      spec: Settings of the scene.
      metadata: Metadata of the capture.
      effects: Components of the scene.
      params: Parameters of the scene.
      rows: Raw parameters of the rendered Gaussians.
      gaussians: The Gaussians at the time of the view.
      view: The view.
      size: (width, height) of the image in pixels.
      degree: Degree of the spherical harmonics in use.
      mean2d_offset: Shift of the projected means, as in `rendering.render`.
      depth: Whether to render the expected depth.
      devices: Number of devices that rasterize the image, in horizontal bands.

    Returns:
      The rendered frame.
    """
    raster = raster_of(spec, metadata)
    background = jnp.asarray(metadata.background, gaussians.mean.dtype)
    coefficients = splats.active_harmonics(rows, degree)
    appearance = appearance_of(effects)
    if appearance is None:
        return rendering.render_harmonics(
            gaussians,
            coefficients,
            view.camera,
            size,
            raster,
            background,
            mean2d_offset=mean2d_offset,
            depth=depth,
            devices=devices,
        )
    assert appearance.code is not None
    assert appearance.recolor is not None
    code = appearance.code(params, view.appearance)
    camera = view.camera
    colors = harmonics.color_toward(coefficients, gaussians.mean, camera.position)
    colors = appearance.recolor(params, colors, code)
    if appearance.backdrop is not None:
        direction = directions(camera, size, distorted=raster.distorted)
        background = appearance.backdrop(params, direction, code)
    return rendering.render(
        gaussians,
        colors,
        camera,
        size,
        raster,
        background,
        mean2d_offset=mean2d_offset,
        depth=depth,
        devices=devices,
    )


def directions(
    camera: Camera, size: tuple[int, int], *, distorted: bool
) -> Float[Array, "height width 3"]:
    """Compute the world directions of all pixels.

    Args:
      camera: The camera.
      size: (width, height) of the image in pixels.
      distorted: Whether lens distortion is modeled, which takes a solver.

    Returns:
      Unit vectors.
    """
    if distorted:
        return rays.pixel_rays(camera, size).direction
    pixel = rays.pixel_centers(size, camera.position.dtype)
    offset = pixel - camera.principal_point_px
    y = offset[..., 1] / (camera.focal_px * camera.pixel_aspect)
    x = (offset[..., 0] - camera.skew_px * y) / camera.focal_px
    slope = jnp.stack([x, y, jnp.ones_like(x)], axis=-1)
    return harmonics.unit_direction(exact_product(slope, camera.camera_from_world))


def exposed(
    effects: tuple[SplatRecord, ...], params: Params, rendered: Rendering, view: View
) -> Rendering:
    """Apply the exposure model of the view to a render.

    Args:
      effects: Records of the components.
      params: Parameters of the scene.
      rendered: The render.
      view: Its view, with an appearance id.

    Returns:
      The render with changed colors.
    """
    for effect in effects:
        if effect.expose is not None:
            own_params = params.nets.get(effect.name)
            color = effect.expose(own_params, rendered.color, view.appearance)
            rendered = rendered._replace(color=color)
    return rendered
