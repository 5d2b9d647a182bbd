"""Trained Gaussians at one time, as a rasterizer outside this package draws them."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gaussians_jax.core import splats
from gaussians_jax.motion import deformation
from gaussians_jax.scene import scene, variants
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
      spec: Specification of the scene.
      metadata: Its metadata.
      without: Names of effects to leave out, of `variants.parts`.

    Returns:
      A function of a trained state, a time in [0, 1], an appearance id and the position
      of the camera (scene units), which returns a `SplatCloud`.

    Raises:
      ValueError: If the scene cannot be rendered without one of the effects.
    """
    spec = variants.reduced(spec, metadata, without)
    every = scene.all_effects(spec, metadata)
    background = jnp.asarray(metadata.background)

    @jax.jit
    def evaluate(
        params: splats.Params,
        step: Int[Array, ""],
        time: Float[Array, ""],
        appearance: Int[Array, ""],
        position: Float[Array, "3"],
    ):
        prepared = deformation.prepare(every, params)
        gaussians = deformation.deform(every, params, prepared, time)
        rows = deformation.drawn_rows(every, params)
        degree = splats.active_degree(step, spec.sh_every, spec.sh_degree)
        coefficients = splats.active_harmonics(rows, degree)
        color = harmonics.color_toward(coefficients, gaussians.mean, position)
        # The compositing weights and the transmittance sum to one, so an affine change
        # of the image is the same change of every color and of the background.
        behind = background.astype(color.dtype)
        color = _exposed(every, params, color, appearance)
        behind = _exposed(every, params, behind[None], appearance)[0]
        leaves: dict[str, Any] = dict(
            centers=gaussians.mean,
            covariances=jax.vmap(_covariance)(gaussians.quaternion, gaussians.scale),
            rgb=color,
            opacity=gaussians.opacity,
            background=behind,
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
        every, active = jax.device_get(evaluate(state.params, state.step, *inputs))
        # The rows do not change with the time, so their number does not either, and a
        # browser can update its buffers in place.
        return every._replace(
            centers=every.centers[active],
            covariances=every.covariances[active],
            rgb=every.rgb[active],
            opacity=every.opacity[active],
            view_dependent=bool(every.view_dependent),
        )

    return cloud


def _exposed(effects, params, color, appearance):
    """Apply every exposure model to a list of colors, as one row of an image."""
    for effect in effects:
        if effect.expose is not None:
            own = params.nets.get(effect.name)
            color = effect.expose(own, color[None], appearance)[0]
    return color


def _covariance(quaternion, scale):
    """R diag(scale²) Rᵀ of one Gaussian."""
    axes = quaternions.to_matrix(quaternion) * scale
    return exact_product(axes, axes.T)
