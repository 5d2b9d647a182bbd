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

# PSNR is reported to 100 dB, where 8-bit images ended long ago (51 dB for one level).
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
    # max, not `mse + eps`: the sum would read 79.957 dB where 80 is right.
    return -10 * jnp.log10(jnp.maximum(mse, least) / value_range**2)


def _only_valid(
    image: Float[Array, "*pixels channels"],
    target: Float[Array, "*pixels channels"],
    valid: Bool[Array, "*pixels"] | None,
) -> tuple[Float[Array, "*pixels channels"], Float[Array, "*pixels channels"]]:
    """Both widened, with zeros where `valid` is false, so nothing there has a gradient.

    On the input: selecting after the residual is squared would still multiply a zero
    cotangent with the NaN that EXR and undistorted images carry in unfilmed pixels.
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
    # The difference of roots would be 0 below s = 1e-8 at width 1e-2 in float32, and
    # the quotient is NaN where a square has become infinite.
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
      width: Norm at which the loss leaves the parabola, positive.
      scaling: "paper", or "official" to multiply with `width` as the published code
        does. There the elastic weight acts as 0.03 of its value and the background
        weight as 0.001.

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
    """Check the settings of `geman_mcclure`, without JAX.

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
    """u / (1 + u) for u >= 0, up to and with u = inf."""
    large = 1 / (1 + 1 / jnp.maximum(ratio, 1))
    return jnp.where(ratio < 1, ratio / (1 + ratio), large)


@_saturating.defjvp
def _saturating_jvp(primals, tangents):
    # Written out: the quotient rule is 1/(1+u) - u/(1+u)^2, which at u = 280 (a stretch
    # of 2.7 under width 0.03) has lost three digits in float32 and at 1e5 has two left.
    (ratio,), (tangent,) = primals, tangents
    return _saturating(ratio), jnp.square(1 / (1 + ratio)) * tangent


def _positive(width: float) -> None:
    if not 0 < width < math.inf:
        raise ValueError(
            f"a robust penalty needs a finite width > 0, got {width}; "
            "it is the residual at which the penalty stops being quadratic"
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
    nearly equal numbers, and takes four windows instead of five. Variances are taken
    about the target's mean, which they do not depend on. Uncentered, a pair of constant
    images at 0.9 gives 4e-5 too low in float32, and 1000 ± 1 is 2e-3 off.

    The window is eleven shifted sums along each axis with one of the four maps in
    flight. Milliseconds of forward and backward on one CPU core at 160x120x3 and
    480x270x3:

        this form                               1.7    11
        banded matrix products, in blocks       2.7    28
        banded matrix products, whole           4.2    58
        shifted sums, left to autodiff           15   173
        dm-pix                                   42   251
        XLA's depthwise convolution              75   443

    The window is its own transpose, so the backward pass is the same code.

    Args:
      image: Rendered image, [height, width, channels].
      target: Ground truth of the same shape.
      padding: "zero" is the form that INRIA's 3DGS and its descendants train on and
        report: the window reaches into zeros outside the frame. "valid" leaves those 5
        border pixels out. It is scikit-image's Gaussian form (`gaussian_weights=True,
        sigma=1.5, use_sample_covariance=False`), which is 0.002 to 0.011 lower on
        photographs.
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
      valid: True for pixels that count, [height, width]. The others are zero in both
        images and have no gradient. Windows that overlap the edge of the mask see that
        zero in both. None for all.
      dssim_weight: Weight w in [0, 1]. At 0 no windows are computed.

    Returns:
      The loss, a scalar.

    Raises:
      ValueError: If `dssim_weight` is out of range.

    References:
      Kerbl et al. 2023, arXiv:2308.04079, equation 7.
    """
    if not 0 <= dssim_weight <= 1:
        raise ValueError(
            f"dssim_weight is a share of the loss in [0, 1], got {dssim_weight}"
        )
    absolute = l1(image, target, valid)
    if dssim_weight == 0:
        return absolute
    image, target = _only_valid(image, target, valid)
    structural = masked_mean(dssim_map(image, target), valid)
    return (1 - dssim_weight) * absolute + dssim_weight * structural


@checked
def middle_level(target: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Compute the mean, rounded to 12 bits, as a center for variances. Without
    gradient.

    The compiler may fuse x - sum * (1 / count) into one operation in one place and not
    in another, and so compute E[x] and E[x²] about two centers that are half an ulp of
    the level apart, which is 4e-5 of SSIM at level 1000 in float32. Rounding makes them
    equal.

    Args:
      target: Values of any shape.

    Returns:
      A scalar.
    """
    mean = lax.stop_gradient(jnp.mean(target))
    return lax.reduce_precision(mean, jnp.finfo(mean.dtype).nexp, 12)


def _comparable(image, target, padding):
    """Both in float32 at least, of one shape that a window fits into."""
    if image.shape != target.shape:
        raise ValueError(
            f"SSIM of images of two shapes, {image.shape} and {target.shape}"
        )
    if padding not in ("zero", "valid"):
        raise ValueError(f"SSIM padding is 'zero' or 'valid', got {padding!r}")
    if padding == "valid" and min(image.shape[:2]) < len(WINDOW):
        raise ValueError(
            f"an image of {image.shape[1]}x{image.shape[0]} pixels holds no 11x11 "
            "window; use padding='zero' or a larger image"
        )
    return widened(image), widened(target)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _blur(
    maps: Float[Array, "maps height columns"],
    outside: Float[Array, " maps"],
    channels: int,
) -> Float[Array, "maps height columns"]:
    """Filter every map with the window. Outside the frame each has its value of
    `outside`.

    Channels are folded into the columns, so that every shift is contiguous. `outside`
    gets no gradient.
    """

    def one(carried):
        values, beyond = carried
        rows = _window_sum(values, beyond, 0, 1)
        return lax.optimization_barrier(_window_sum(rows, beyond, 1, channels))

    # `map` keeps the four maps apart: fused, XLA evaluates all 88 shifts for each
    # element it reduces, and the forward pass alone takes 45 instead of 4.8 ms.
    return lax.map(one, (maps, outside))


def _window_sum(values, beyond, axis, stride):
    pad = [(0, 0), (0, 0)]
    pad[axis] = (RADIUS * stride, RADIUS * stride)
    padded = jnp.pad(values, pad, constant_values=beyond)
    # Without the barrier XLA fuses the padding into each of the eleven reads: 2x.
    padded = lax.optimization_barrier(padded)
    take = functools.partial(lax.slice_in_dim, padded, axis=axis)
    length = values.shape[axis]
    return sum(
        weight * take(tap * stride, tap * stride + length)
        for tap, weight in enumerate(WINDOW)
    )


@_blur.defjvp
def _blur_jvp(channels, primals, tangents):
    # The window is symmetric, so the transpose is the function itself.
    change = linear_call(_blur_inside, _blur_inside, channels, (), tangents[0])
    return _blur(*primals, channels), change


def _blur_inside(channels, residuals, maps):
    """Under the window with zeros beyond the frame."""
    return _blur(maps, jnp.zeros_like(maps[:, 0, 0]), channels)
