"""Photometric losses, robust penalties and structural dissimilarity.

Use `optax.losses.huber_loss` for the Huber loss of single residuals. The one here takes
a squared norm, because the norm itself has no gradient at zero.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry.fusion import materialized
from nerfies_jax.geometry.linear_call import linear_call
from nerfies_jax.geometry.precision import at_least_float32, widened
from nerfies_jax.runtime.contract import checked

# Bounds PSNR at 100 dB, far above what 8-bit images resolve (51 dB for one level).
LEAST_MSE = 1e-10


@checked
def psnr(
    mse: Float[Array, "*batch"], value_range: float = 1.0
) -> Float[Array, "*batch"]:
    """Compute the PSNR of a mean squared error.

    Args:
      mse: Mean squared errors, [...].
      value_range: Difference between the largest and the smallest possible value.

    Returns:
      PSNR in dB, at most 100.
    """
    least = LEAST_MSE * value_range**2
    mse = widened(mse)
    # A maximum, because `mse + eps` would give 79.957 dB instead of 80.
    return -10 * jnp.log10(jnp.maximum(mse, least) / value_range**2)


def _only_valid(
    image: Float[Array, "*pixels channels"],
    target: Float[Array, "*pixels channels"],
    valid: Bool[Array, "*pixels"] | None,
) -> tuple[Float[Array, "*pixels channels"], Float[Array, "*pixels channels"]]:
    """Widen both images and set invalid pixels to zero, where gradients are then zero.

    The inputs are masked, because EXR and undistorted images have NaN in unobserved
    pixels. Masking the squared residual would multiply a zero cotangent with NaN.
    """
    image, target = widened(image), widened(target)
    if valid is None:
        return image, target
    keep = valid[..., None]
    return jnp.where(keep, image, 0), jnp.where(keep, target, 0)


@checked
def masked_mean(
    values: Float[Array, "*pixels channels"], valid: Bool[Array, "*pixels"] | None
) -> Float[Array, ""]:
    """Compute the mean over the valid pixels.

    Args:
      values: Values, [..., channels].
      valid: True for pixels that count, [...]. None for all.

    Returns:
      The mean in float32 or float64, zero if no pixel is valid.
    """
    values = widened(values)
    if valid is None:
        return jnp.mean(values)
    count = jnp.sum(valid, dtype=values.dtype) * values.shape[-1]
    total = jnp.sum(jnp.where(valid[..., None], values, 0))
    return total / jnp.maximum(count, 1)


@checked(images=("image", "target"))
def l1(
    image: Float[Array, "*pixels channels"],
    target: Float[Array, "*pixels channels"],
    valid: Bool[Array, "*pixels"] | None = None,
) -> Float[Array, ""]:
    """Compute the mean absolute difference over the valid pixels.

    Args:
      image: Rendered values, [..., channels].
      target: Ground truth of the same shape.
      valid: True for pixels that count, [...]. None for all.

    Returns:
      A scalar, zero if no pixel is valid.
    """
    image, target = _only_valid(image, target, valid)
    return masked_mean(jnp.abs(image - target), valid)


@checked(images=("image", "target"))
def mse(
    image: Float[Array, "*pixels channels"],
    target: Float[Array, "*pixels channels"],
    valid: Bool[Array, "*pixels"] | None = None,
) -> Float[Array, ""]:
    """Compute the mean squared difference over the valid pixels.

    Args:
      image: Rendered values, [..., channels].
      target: Ground truth of the same shape.
      valid: True for pixels that count, [...]. None for all.

    Returns:
      A scalar, zero if no pixel is valid.
    """
    image, target = _only_valid(image, target, valid)
    return masked_mean(jnp.square(image - target), valid)


@checked
@at_least_float32
def charbonnier(
    residual_sq: Float[Array, "*batch"], width: float
) -> Float[Array, "*batch"]:
    """Compute the Charbonnier loss sqrt(s + width²) - width of s = |residual|².

    Args:
      residual_sq: Squared norms s, non-negative, [...].
      width: Norm below which the loss is quadratic, positive.

    Returns:
      Losses [...], zero at zero.

    Raises:
      ValueError: If `width` is not positive.

    References:
      Charbonnier et al. 1994, with the offset subtracted.
    """
    _positive(width)
    # In float32 the difference of roots is 0 below s = 1e-8 at width 1e-2, and the
    # quotient is NaN if s is infinite.
    near = residual_sq < 8 * width**2
    small = jnp.where(near, residual_sq, 0)
    quotient = small / (jnp.sqrt(small + width**2) + width)
    return jnp.where(near, quotient, jnp.sqrt(residual_sq + width**2) - width)


@checked
@at_least_float32
def huber(residual_sq: Float[Array, "*batch"], width: float) -> Float[Array, "*batch"]:
    """Compute the Huber loss of s = |residual|².

    It is s / 2 up to |residual| = width, then width (|residual| - width / 2).

    Args:
      residual_sq: Squared norms s, non-negative, [...].
      width: Norm at which the loss becomes linear, positive.

    Returns:
      Losses, [...].

    Raises:
      ValueError: If `width` is not positive.
    """
    _positive(width)
    near = residual_sq < width**2
    length = jnp.sqrt(jnp.where(near, width**2, residual_sq))
    return jnp.where(near, residual_sq / 2, width * (length - width / 2))


@checked
@at_least_float32
def geman_mcclure(
    residual_sq: Float[Array, "*batch"],
    width: float,
    scaling: str = "paper",
) -> Float[Array, "*batch"]:
    """Compute the Geman-McClure loss 2 s / (s + 4 width²) of s = |residual|².

    Args:
      residual_sq: Squared norms s, non-negative, [...].
      width: Norm at which the loss stops being quadratic, positive.
      scaling: "paper", or "official" to multiply by `width` as the published code does.
        In that code the elastic weight is therefore scaled by 0.03 and the background
        weight by 0.001.

    Returns:
      Losses [...], which saturate at two, or at 2 `width` for "official".

    Raises:
      ValueError: If a setting is out of range.

    References:
      Park et al. 2021 (Nerfies), arXiv:2011.12948, section 3.3.
    """
    check_geman_mcclure(width, scaling)
    factor = 2.0 if scaling == "paper" else 2.0 * width
    return factor * _saturating(residual_sq / (4 * width**2))


def check_geman_mcclure(width: float, scaling: str) -> None:
    """Check the settings of `geman_mcclure` without running JAX.

    Args:
      width: As for `geman_mcclure`.
      scaling: As for `geman_mcclure`.

    Raises:
      ValueError: If a setting is out of range.
    """
    _positive(width)
    if scaling not in ("paper", "official"):
        raise ValueError(
            f"Geman-McClure scaling is 'paper' or 'official', got {scaling!r}"
        )


@jax.custom_jvp
def _saturating(ratio: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Compute u / (1 + u) for u >= 0, including u = inf."""
    large = 1 / (1 + 1 / jnp.maximum(ratio, 1))
    return jnp.where(ratio < 1, ratio / (1 + ratio), large)


@_saturating.defjvp
def _saturating_jvp(primals, tangents):
    # The quotient rule gives 1/(1+u) - u/(1+u)^2, which cancels: in float32 it loses
    # three digits at u = 280 (a stretch of 2.7 with width 0.03), and has two digits
    # left at 1e5.
    (ratio,), (tangent,) = primals, tangents
    return _saturating(ratio), jnp.square(1 / (1 + ratio)) * tangent


def _positive(width: float) -> None:
    if not 0 < width < math.inf:
        raise ValueError(
            f"a robust penalty needs a finite width > 0, got {width}; the width is the "
            "residual at which the penalty stops being quadratic"
        )


# Structural similarity, Wang et al. 2004: an 11 x 11 Gaussian window of 1.5 px.
RADIUS = 5
_OFFSETS = np.arange(-RADIUS, RADIUS + 1)
_WINDOW = np.exp(-(_OFFSETS**2) / (2 * 1.5**2))
WINDOW = tuple(float(w) for w in _WINDOW / _WINDOW.sum())
LUMINANCE = 0.01**2  # C1 over the squared value range
CONTRAST = 0.03**2  # C2


@checked(images=("image", "target"))
def dssim_map(
    image: Float[Array, "height width channels"],
    target: Float[Array, "height width channels"],
    *,
    padding: str = "zero",
    value_range: float = 1.0,
) -> Float[Array, "rows columns channels"]:
    """Compute 1 - SSIM around every pixel.

    It is exactly zero, with zero gradient, for equal images. Forward mode, reverse mode
    and forward over reverse (Hessian-vector products) work.

    With d = image - target and local means m and variances v, 1 - SSIM = a + b - ab, a
    = m_d² / (m_i² + m_t² + C1), b = v_d / (v_i + v_t + C2). This avoids differences of
    nearly equal numbers, and needs four filtered maps instead of five. The mean of the
    target is subtracted before variances are computed, which does not change them. In
    float32, images of constant 0.9 otherwise have an error of 4e-5, and values of
    1000 ± 1 one of 2e-3.

    The window is applied as eleven shifted sums along each axis, to one of the four
    maps at a time. Milliseconds of forward and backward pass on one CPU core for
    160x120x3 and 480x270x3 pixels:

        this implementation                     1.7    11
        banded matrix products in blocks        2.7    28
        banded matrix products                  4.2    58
        shifted sums with autodiff               15   173
        dm-pix                                   42   251
        XLA's depthwise convolution              75   443

    The window is symmetric, so the backward pass uses the same code.

    Args:
      image: Rendered image, [height, width, channels].
      target: Ground truth of the same shape.
      padding: "zero" pads images with zeros, as INRIA's 3DGS and its derivatives do
        for training and evaluation. "valid" omits the 5 border pixels, as scikit-image
        does (`gaussian_weights=True, sigma=1.5, use_sample_covariance=False`). Its SSIM
        is 0.002 to 0.011 lower on photographs.
      value_range: Difference between the largest and the smallest possible value.

    Returns:
      Dissimilarities of the same shape, without the border for "valid".

    Raises:
      ValueError: If shapes differ, the image is smaller than the window, or the padding
        is unknown.

    References:
      Wang et al. 2004.
    """
    image, target = _comparable(image, target, padding)
    constant = value_range**2
    center = middle_level(target)
    shape, channels = image.shape, image.shape[-1]
    image, target = (materialized(x.reshape(shape[0], -1)) for x in (image, target))
    difference = image - target
    x, y = image - center, target - center
    maps = jnp.stack([x, y, x * x + y * y, difference * difference])
    outside = jnp.stack([-center, -center, 2 * center**2, jnp.zeros_like(center)])
    mean_x, mean_y, power, power_d = _blur(maps, outside, channels)
    mean_d = mean_x - mean_y
    variance_d = power_d - mean_d**2
    variances = power - mean_x**2 - mean_y**2
    means_sq = (mean_x + center) ** 2 + (mean_y + center) ** 2
    luminance = mean_d**2 / (means_sq + LUMINANCE * constant)
    structure = variance_d / (variances + CONTRAST * constant)
    dissimilarity = luminance + structure - luminance * structure
    dissimilarity = dissimilarity.reshape(shape)
    if padding == "valid":
        dissimilarity = dissimilarity[RADIUS:-RADIUS, RADIUS:-RADIUS]
    return dissimilarity


@checked(images=("image", "target"))
def ssim(
    image: Float[Array, "height width channels"],
    target: Float[Array, "height width channels"],
    *,
    padding: str = "zero",
    value_range: float = 1.0,
) -> Float[Array, ""]:
    """Compute the mean structural similarity of two images.

    Args:
      image: Rendered image, [height, width, channels].
      target: Ground truth of the same shape.
      padding: "zero" or "valid", as for `dssim_map`.
      value_range: Difference between the largest and the smallest possible value.

    Returns:
      SSIM, a scalar of at most 1.
    """
    dissimilarity = dssim_map(image, target, padding=padding, value_range=value_range)
    return 1 - jnp.mean(dissimilarity)


@checked(images=("image", "target"))
def photometric(
    image: Float[Array, "height width channels"],
    target: Float[Array, "height width channels"],
    valid: Bool[Array, "height width"] | None = None,
    *,
    dssim_weight: float = 0.2,
) -> Float[Array, ""]:
    """Compute the loss of 3DGS, (1 - w) L1 + w (1 - SSIM).

    SSIM is zero-padded as in the published code, and 1 - SSIM is not halved.

    Args:
      image: Rendered image, [height, width, channels].
      target: Ground truth of the same shape.
      valid: True for pixels that count, [height, width], or None for all. The others
        are set to zero in both images, also in windows that overlap the edge of the
        mask, and have no gradient.
      dssim_weight: Weight w in [0, 1]. At 0 SSIM is not computed.

    Returns:
      The loss, a scalar.

    Raises:
      ValueError: If `dssim_weight` is out of range.

    References:
      Kerbl et al. 2023, arXiv:2308.04079, equation 7.
    """
    if not 0 <= dssim_weight <= 1:
        raise ValueError(f"dssim_weight must be in [0, 1], got {dssim_weight}")
    absolute = l1(image, target, valid)
    if dssim_weight == 0:
        return absolute
    image, target = _only_valid(image, target, valid)
    structural = masked_mean(dssim_map(image, target), valid)
    return (1 - dssim_weight) * absolute + dssim_weight * structural


@checked
def middle_level(target: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Compute the mean rounded to 12 bits, to center variances, without gradient.

    The compiler may fuse x - sum * (1 / count) in one place and not in another. E[x]
    and E[x²] would then be computed with centers that differ by half an ulp, which
    changes SSIM by 4e-5 at level 1000 in float32. Rounding makes the centers equal.

    Args:
      target: Values of any shape.

    Returns:
      A scalar.
    """
    mean = lax.stop_gradient(jnp.mean(target))
    return lax.reduce_precision(mean, jnp.finfo(mean.dtype).nexp, 12)


def _comparable(image, target, padding):
    """Check that the images have one shape that fits a window, and widen them."""
    if image.shape != target.shape:
        raise ValueError(
            f"SSIM needs images of one shape, got {image.shape} and {target.shape}"
        )
    if padding not in ("zero", "valid"):
        raise ValueError(f"SSIM padding is 'zero' or 'valid', got {padding!r}")
    if padding == "valid" and min(image.shape[:2]) < len(WINDOW):
        raise ValueError(
            f"an image of {image.shape[1]}x{image.shape[0]} pixels is smaller than the "
            "11x11 window; use padding='zero' or a larger image"
        )
    return widened(image), widened(target)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _blur(
    maps: Float[Array, "maps height columns"],
    outside: Float[Array, " maps"],
    channels: int,
) -> Float[Array, "maps height columns"]:
    """Filter each map with the window, padded with its value of `outside`.

    Channels are folded into the columns, so that every shift is contiguous. `outside`
    has no gradient.
    """

    def filter_map(map_and_padding):
        values, padding = map_and_padding
        rows = _window_sum(values, padding, 0, 1)
        return lax.optimization_barrier(_window_sum(rows, padding, 1, channels))

    # `lax.map` prevents fusion of the four maps. Fused, XLA evaluates all 88 shifts for
    # each element of the sums, and the forward pass takes 45 ms instead of 4.8.
    return lax.map(filter_map, (maps, outside))


def _window_sum(values, padding, axis, stride):
    pad = [(0, 0), (0, 0)]
    pad[axis] = (RADIUS * stride, RADIUS * stride)
    padded_values = jnp.pad(values, pad, constant_values=padding)
    # Without the barrier XLA fuses the padding into each of the eleven reads, which
    # takes twice the time.
    padded_values = lax.optimization_barrier(padded_values)
    take = functools.partial(lax.slice_in_dim, padded_values, axis=axis)
    length = values.shape[axis]
    return sum(
        weight * take(tap * stride, tap * stride + length)
        for tap, weight in enumerate(WINDOW)
    )


@_blur.defjvp
def _blur_jvp(channels, primals, tangents):
    # The window is symmetric, so the function is its own transpose.
    tangent = linear_call(_blur_padded, _blur_padded, channels, (), tangents[0])
    return _blur(*primals, channels), tangent


def _blur_padded(channels, residuals, maps):
    """Filter maps that are padded with zeros."""
    return _blur(maps, jnp.zeros_like(maps[:, 0, 0]), channels)
