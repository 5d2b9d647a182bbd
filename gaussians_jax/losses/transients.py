"""Robust photometric loss: pixels of transient objects are left out.

People and cars in single photographs are not part of the scene, and Gaussians that
represent them float in front of the other cameras. Pixels whose residual is large
compared with that of the image, averaged over a window, are taken for transient objects
and left out of the photometric loss. This follows the trimmed kernels of RobustNeRF
(Sabour et al. 2023, arXiv:2302.00833), whose residuals are also averaged over a window,
so that fine detail, which a single pixel may miss by as much, is learned.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.training import losses
from nerfies_jax.training.step_counts import steps

SHARE = "transient/share"  # name of the logged share of pixels


@dataclasses.dataclass(frozen=True)
class TransientMaskSpec:
    """Settings of the mask of transient objects.

    Attributes:
      start: Number of steps before the mask is used, while residuals are large
        everywhere.
      window: Side of the window over which residuals are averaged, in pixels.
      ratio: Mean residual of a window, relative to that of the image, above which its
        center is left out.
      least: Mean residual of a window, in sRGB, up to which its center is kept.
    """

    start: int = steps(500)
    window: int = 9
    ratio: float = 3.0
    least: float = 0.1

    def __post_init__(self):
        if self.start < 0:
            raise ValueError(f"start={self.start} must not be negative")
        if self.window < 1 or self.window % 2 == 0:
            raise ValueError(
                f"window={self.window} must be odd and positive, to have a center pixel"
            )
        if not self.ratio > 1:
            raise ValueError(
                f"ratio={self.ratio} must be above 1; at 1 half of an image is left out"
            )
        if not self.least > 0:
            raise ValueError(f"least={self.least} must be positive, in sRGB of [0, 1]")


def static_pixels(
    spec: TransientMaskSpec,
    color: Float[Array, "height width 3"],
    truth: Float[Array, "height width 3"],
    valid: Bool[Array, "height width"] | None,
    step: Int[Array, ""],
) -> tuple[Bool[Array, "height width"], Float[Array, ""]]:
    """Find the pixels that show no transient object.

    Args:
      spec: Settings.
      color: Rendered image.
      truth: Observed image.
      valid: True for observed pixels. None for all.
      step: Number of completed steps.

    Returns:
      True for the pixels to learn from, and the share of the observed pixels that is
      left out.
    """
    color, truth = jax.lax.stop_gradient((color, truth))
    is_observed = jnp.ones(color.shape[:2], bool) if valid is None else valid
    # Unobserved pixels may be NaN.
    residual = jnp.mean(jnp.abs(color - truth), axis=-1)
    residual = jnp.where(is_observed, residual, 0)
    if valid is None:
        # Not summed by XLA, which takes seconds to fold a constant.
        count = jnp.asarray(
            _window_count(is_observed.shape, spec.window), residual.dtype
        )
    else:
        count = _window_sum(is_observed.astype(residual.dtype), spec.window)
    local = _window_sum(residual, spec.window) / jnp.maximum(count, 1)
    mean = losses.masked_mean(residual[..., None], is_observed)
    transient = local > jnp.maximum(spec.ratio * mean, spec.least)
    transient = transient & is_observed & (step >= spec.start)
    share = losses.masked_mean(transient.astype(residual.dtype)[..., None], is_observed)
    return is_observed & ~transient, share


def _window_count(shape, side):
    """Number of pixels of the window around each pixel that are in the image."""
    reach = side // 2
    counts = []
    for length in shape:
        place = np.arange(length)
        counts.append(
            np.minimum(place + reach, length - 1) - np.maximum(place - reach, 0) + 1
        )
    return np.outer(*counts)


def _window_sum(image, side):
    window = (side, side)
    return jax.lax.reduce_window(image, 0.0, jax.lax.add, window, (1, 1), "SAME")
