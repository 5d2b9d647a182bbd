"""Residuals, robust penalties and structural dissimilarity.

Huber on single residuals is `optax.losses.huber_loss`; here it takes a squared length,
because the length itself has no gradient at zero.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from nerfies_jax.contract import checked
from nerfies_jax.geometry.fusion import materialized
from nerfies_jax.geometry.linear_call import linear_call
from nerfies_jax.geometry.precision import at_least_float32, widened

# PSNR is reported to 100 dB, where 8-bit images ended long ago (51 dB for one level).
LEAST_MSE = 1e-10


@checked
def psnr(
    mse: Float[Array, "*batch"], value_range: float = 1.0
) -> Float[Array, "*batch"]:
    """Decibels of a mean squared error; at most 100 for a range of one."""
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
    """Mean over the valid pixels, float32 at least; zero where there are none."""
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
    """Mean absolute difference over the valid pixels."""
    image, target = _only_valid(image, target, valid)
    return masked_mean(jnp.abs(image - target), valid)


@checked(images=("image", "target"))
def mse(
    image: Float[Array, "*pixels channels"],
    target: Float[Array, "*pixels channels"],
    valid: Bool[Array, "*pixels"] | None = None,
) -> Float[Array, ""]:
    """Mean squared difference over the valid pixels."""
    image, target = _only_valid(image, target, valid)
    return masked_mean(jnp.square(image - target), valid)


@checked
@at_least_float32
def charbonnier(
    residual_sq: Float[Array, "*batch"], width: float
) -> Float[Array, "*batch"]:
    """sqrt(s + width^2) - width for s = |residual|^2: the length, rounded at zero.

    Charbonnier et al. 1994, with the offset taken out so that it is zero at zero.
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
    """s / 2 up to |residual| = width, then width (|residual| - width / 2)."""
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
    """2 s / (s + 4 width^2) for s = |residual|^2; saturates at two.

    Park et al. 2021 (Nerfies), arXiv:2011.12948, section 3.3. Their code multiplies it
    with `width`, so that its elastic weight acts as 0.03 of what it says and the
    background weight as 0.001: `scaling="official"`.
    """
    check_geman_mcclure(width, scaling)
    factor = 2.0 if scaling == "paper" else 2.0 * width
    return factor * _saturating(residual_sq / (4 * width**2))


def check_geman_mcclure(width: float, scaling: str) -> None:
    """Raise ValueError for settings that `geman_mcclure` cannot have; no JAX."""
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
    """1 - SSIM around every pixel; exactly zero, with zero gradient, for equal images.

    `padding="zero"` is what INRIA's 3DGS and its descendants train on and report: the
    window reaches into zeros outside the frame. `"valid"` leaves those 5 border pixels
    out, which is scikit-image's Gaussian form (`gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False`) and reads 0.002 to 0.011 lower on photographs.

    With d = image - target and local means m and variances v,
    1 - SSIM = a + b - ab, a = m_d^2 / (m_i^2 + m_t^2 + C1), b = v_d / (v_i + v_t + C2):
    no difference of nearly equal numbers, and four windows instead of five. Variances
    are taken about the target's mean, which they do not depend on; uncentered, a pair
    of constant images at 0.9 reads 4e-5 too low in float32, and 1000 +- 1 is 2e-3 off.

    The window is eleven shifted sums along each axis with one of the four maps in
    flight. CPU ms of forward and backward at 160x120x3 and 480x270x3, one core:

        this form                               1.7    11
        banded matrix products, in blocks       2.7    28
        banded matrix products, whole           4.2    58
        shifted sums, left to autodiff           15   173
        dm-pix                                   42   251
        XLA's depthwise convolution              75   443

    The window is its own transpose, so backward is the same code. Forward mode and
    forward over reverse (Hessian-vector products) work as well.
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
    """Mean structural similarity of one pair of images; see `dssim_map`."""
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
    """(1 - w) L1 + w (1 - SSIM), Kerbl et al. 2023, arXiv:2308.04079, equation 7.

    SSIM is zero-padded as in their code, and 1 - SSIM is not halved. Where `valid` is
    false both images read zero, so nothing there is learned; windows that overlap the
    edge of the mask see that zero in both. `dssim_weight=0` builds no windows.
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
    """The mean to 12 bits, without a slope; variances may be taken about it.

    The compiler may contract x - sum * (1 / count) into one operation, in one place and
    not in another, and so take E[x] and E[x^2] about two centers that are half an ulp
    of the level apart: 4e-5 of SSIM at level 1000 in float32. Rounded, it is one.
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
    """Every map under the window; beyond the frame each reads its value of `outside`.

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
