"""Trained Gaussians at one time, for rasterizers outside of this package."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gaussians_jax.core import splats
from gaussians_jax.motion import deformation
from gaussians_jax.scene import drawing, scene, variants
from gaussians_jax.splatting import harmonics
from nerfies_jax.evaluation.representation import SplatCloud, Splatting
from nerfies_jax.geometry import quaternion as quaternions
from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.training.model import TrainState


def splatting(spec, metadata, without: tuple[str, ...]) -> Splatting:
    """Build the function that evaluates the Gaussians of a scene for a rasterizer.

    Deformation, spherical harmonics, exposure and covariances are one program, compiled
    once for each shape of the state.

    Args:
      spec: Settings of the scene.
      metadata: Metadata of the capture.
      without: Names of components to leave out, of `variants.parts`.

    Returns:
      A function of a trained state, a time in [0, 1], an appearance id and the position
      of the camera (scene units), which returns a `SplatCloud`.

    Raises:
      ValueError: If the scene cannot be rendered without one of the components.
    """
    spec = variants.reduced(spec, metadata, without)
    effects = scene.all_effects(spec, metadata)
    background = jnp.asarray(metadata.background)

    @jax.jit
    def evaluate(
        params: splats.Params,
        step: Int[Array, ""],
        time: Float[Array, ""],
        appearance: Int[Array, ""],
        position: Float[Array, "3"],
    ):
        cache = deformation.prepare(effects, params)
        gaussians = deformation.deform(effects, params, cache, time)
        rows = deformation.rendered_rows(effects, params)
        degree = splats.active_degree(step, spec.sh_every, spec.sh_degree)
        coefficients = splats.active_harmonics(rows, degree)
        color = harmonics.color_toward(coefficients, gaussians.mean, position)
        backdrop = background.astype(color.dtype)
        painter = drawing.appearance_of(effects)
        if painter is not None:
            assert painter.code is not None
            assert painter.recolor is not None
            code = painter.code(params, appearance)
            color = painter.recolor(params, color, code)
            if painter.backdrop is not None:
                # A viewer has one background color, so that of the middle is used.
                toward = harmonics.unit_direction(
                    jnp.mean(gaussians.mean, axis=0) - position
                )
                backdrop = painter.backdrop(params, toward, code)
        # Compositing weights and transmittance sum to one, so an affine change of the
        # image is the same change of all colors and of the background.
        color = _expose(effects, params, color, appearance)
        backdrop = _expose(effects, params, backdrop[None], appearance)[0]
        leaves: dict[str, Any] = dict(
            centers=gaussians.mean,
            covariances=jax.vmap(_covariance)(gaussians.quaternion, gaussians.scale),
            rgb=color,
            opacity=gaussians.opacity,
            background=backdrop,
            view_dependent=degree > 0,
        )
        return SplatCloud(**leaves), splats.active_mask(rows)

    def cloud(state: TrainState, time, appearance, position) -> SplatCloud:
        dtype = state.params.rows["splats"].mean.dtype
        inputs = (
            jnp.asarray(time, dtype),
            jnp.asarray(appearance, jnp.int32),
            jnp.asarray(position, dtype),
        )
        gaussians, active = jax.device_get(evaluate(state.params, state.step, *inputs))
        # The number of active Gaussians does not depend on the time, so a browser can
        # update its buffers in place.
        return gaussians._replace(
            centers=gaussians.centers[active],
            covariances=gaussians.covariances[active],
            rgb=gaussians.rgb[active],
            opacity=gaussians.opacity[active],
            view_dependent=bool(gaussians.view_dependent),
        )

    return cloud


def _expose(effects, params, color, appearance):
    """Apply every exposure model to a list of colors, as one row of an image."""
    for effect in effects:
        if effect.expose is not None:
            own_params = params.nets.get(effect.name)
            color = effect.expose(own_params, color[None], appearance)[0]
    return color


def _covariance(quaternion, scale):
    """Compute R diag(scale²) Rᵀ of one Gaussian."""
    axes = quaternions.to_matrix(quaternion) * scale
    return exact_product(axes, axes.T)
