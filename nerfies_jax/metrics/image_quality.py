"""Image quality metrics: PSNR, SSIM, MS-SSIM and their masked forms.

Images are `[height, width, channels]` or gray `[height, width]`, in [0, 1] or as uint8
or uint16, which are divided by 255 and 65535. Leading axes are a batch, with one score
for each image.

Published results use different protocols, which have separate names here. The SSIM with
`padding="valid"` is the Gaussian SSIM of scikit-image, and `padding="zero"` is that of
INRIA (0.002 to 0.011 higher for photographs). Apply `quantize` first to score an image
as if it were stored with 8 bits. Dtypes below float32 are converted to float32.
"""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry.precision import exact_einsum, widened
from nerfies_jax.runtime.contract import checked
from nerfies_jax.training import losses

TAPS = len(losses.WINDOW)  # 11 pixels
C1, C2 = losses.LUMINANCE, losses.CONTRAST
# Wang, Simoncelli and Bovik 2003, "Multiscale structural similarity". The published
# weights sum to 1.0001.
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)

MAX_CHANNELS = 16  # a larger last axis means a batch of gray images

Padding = Literal["valid", "zero"]


def _refuse_stacks(image: Float[Array, "height width channels"]) -> None:
    """Refuse a stack of gray images [n, height, width], which looks like one image."""
    if image.shape[-1] > MAX_CHANNELS:
        raise ValueError(
            f"an image {list(image.shape)} has {image.shape[-1]} channels, more than "
            f"{MAX_CHANNELS}; images are [height, width, channels], and a batch of "
            "gray images needs a last axis of length 1"
        )


@checked(images=("image",))
def quantize(image: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Clip an image to [0, 1] and round it to n/255, as an 8-bit file does.

    Args:
      image: Values of any shape.

    Returns:
      The rounded values, in [0, 1].
    """
    return jnp.round(jnp.clip(image, 0.0, 1.0) * 255.0) / 255.0


@checked(broadcast=True, images=("image", "truth"))
def psnr(
    image: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
) -> Float[Array, ""]:
    """Compute the peak signal-to-noise ratio for a peak of 1.

    It is limited to 100 dB (`losses.LEAST_MSE`) by a maximum. Adding 1e-10 to the error
    instead would change 80 dB to 79.957 dB. The gradient for equal images is zero.

    Args:
      image: Rendered images in [0, 1], [..., height, width, channels].
      truth: Ground truth of the same shape.

    Returns:
      PSNR in dB, [...].
    """
    _refuse_stacks(image)
    error = widened(image) - widened(truth)
    return losses.psnr(jnp.mean(error**2))


@checked(broadcast=True, images=("image", "truth"))
def masked_psnr(
    image: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
    mask: Bool[Array, "height width"],
) -> Float[Array, ""]:
    """Compute the PSNR of the masked pixels.

    Pixels outside the mask have no effect and may be NaN.

    Args:
      image: Rendered images in [0, 1], [..., height, width, channels].
      truth: Ground truth of the same shape.
      mask: True for the pixels to compare, [..., height, width].

    Returns:
      PSNR in dB [...], NaN if the mask is empty.

    References:
      mPSNR of Gao et al. 2022 (DyCheck), arXiv:2210.13445.
    """
    _refuse_stacks(image)
    mask = mask[..., None]
    image, truth = widened(image), widened(truth)
    # Pixels are masked before the difference: NaN * 0 is NaN, and so is the gradient of
    # a `where` whose other branch is NaN.
    error = jnp.where(mask, image, 0.0) - jnp.where(mask, truth, 0.0)
    count = jnp.sum(mask).astype(image.dtype) * image.shape[-1]
    return losses.psnr(jnp.sum(error**2) / count)


@checked(broadcast=True, images=("image", "truth"))
def ssim(
    image: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
    padding: Padding = "valid",
) -> Float[Array, ""]:
    """Compute the structural similarity, averaged over windows and channels.

    The window is a Gaussian of 11 pixels with a sigma of 1.5. "valid" averages the
    windows inside the image and equals `structural_similarity` of scikit-image with
    `gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1`.
    "zero" pads both images with zeros and averages all pixels, as INRIA does.

    Args:
      image: Rendered images in [0, 1], [..., height, width, channels].
      truth: Ground truth of the same shape.
      padding: "valid" or "zero".

    Returns:
      SSIM [...], at most 1.

    References:
      Wang et al. 2004.
    """
    _refuse_stacks(image)
    return losses.ssim(image, truth, padding=padding)


@checked(broadcast=True, images=("image", "truth"))
def ms_ssim(
    image: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
    scales: int = 5,
) -> Float[Array, ""]:
    """Compute the multi-scale structural similarity with valid windows.

    Contrast and structure are compared at every scale, and luminance at the coarsest.
    Images are halved by 2x2 means, with an odd last row or column repeated. Means over
    pixels are clipped at zero for each channel, and the score is averaged over
    channels, as in TensorFlow and pytorch-msssim.

    Five scales need more than 160 pixels on the shorter side. With fewer scales the
    remaining weights are normalized to sum to one. This is another metric, so report
    the number of scales with the score.

    Args:
      image: Rendered images in [0, 1], [..., height, width, channels].
      truth: Ground truth of the same shape.
      scales: Number of scales, 1 to 5.

    Returns:
      MS-SSIM in [0, 1], [...].

    Raises:
      ValueError: If the image is too small for the number of scales.

    References:
      Wang, Simoncelli and Bovik 2003.
    """
    _refuse_stacks(image)
    _check_scales(image.shape, scales)
    image, truth = widened(image), widened(truth)
    weights = SCALE_WEIGHTS[:scales]
    if scales < len(SCALE_WEIGHTS):
        weights = tuple(weight / sum(weights) for weight in weights)
    score = jnp.ones_like(image[0, 0])
    for scale, weight in enumerate(weights):
        luminance, contrast = _terms(image, truth, _window_mean)
        last = scale == scales - 1
        term = jnp.mean(luminance * contrast if last else contrast, axis=(0, 1))
        # A negative number has no real power, and the gradient of x^0.04 at 0 is
        # infinite. The score of such a scale is 0 and has no gradient.
        similar = term > 0
        score = score * jnp.where(similar, jnp.where(similar, term, 1.0) ** weight, 0.0)
        image, truth = _halve(image), _halve(truth)
    return jnp.mean(score)


def _check_scales(shape, scales):
    if not 1 <= scales <= len(SCALE_WEIGHTS):
        raise ValueError(
            f"MS-SSIM is defined for 1 to {len(SCALE_WEIGHTS)} scales, got {scales}"
        )
    fit = max(
        (n for n in range(1, 6) if min(shape[:2]) > (TAPS - 1) * 2 ** (n - 1)),
        default=0,
    )
    if fit < scales:
        raise ValueError(
            f"MS-SSIM with {scales} scales needs more than "
            f"{(TAPS - 1) * 2 ** (scales - 1)} pixels on the shorter side, got "
            f"{shape[1]}x{shape[0]}; "
            + (f"pass scales={fit} and report it with the score" if fit else "use psnr")
        )


def _halve(image):
    height, width = image.shape[:2]
    image = jnp.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    rows = (image[0::2] + image[1::2]) / 2.0
    return (rows[:, 0::2] + rows[:, 1::2]) / 2.0


@checked(broadcast=True, images=("image", "truth"))
def masked_ssim(
    image: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
    mask: Bool[Array, "height width"],
) -> Float[Array, ""]:
    """Compute the SSIM of the masked pixels.

    The moments of every window are means over its pixels inside the mask (with Gaussian
    weights divided by their sum), and windows centered on the mask are averaged. With a
    full mask this is `ssim`. Pixels outside the mask have no effect. `partial_ssim` is
    the published protocol.

    Args:
      image: Rendered images in [0, 1], [..., height, width, channels].
      truth: Ground truth of the same shape.
      mask: True for the pixels to compare, [..., height, width].

    Returns:
      SSIM [...], NaN if no window is centered on the mask.

    Raises:
      ValueError: If the image is smaller than 11x11 pixels.
    """
    _refuse_stacks(image)
    if min(mask.shape) < TAPS:
        raise ValueError(
            f"masked SSIM needs {TAPS}x{TAPS} pixels, got {mask.shape[1]}x"
            f"{mask.shape[0]}; use masked_psnr"
        )
    image, truth = widened(image), widened(truth)
    inside = mask[..., None].astype(image.dtype)
    image, truth = (jnp.where(mask[..., None], x, 0.0) for x in (image, truth))
    weight = _window_mean(inside)
    safe_weight = jnp.where(weight > 0, weight, 1.0)

    def mean(x):
        return _window_mean(x * inside) / safe_weight

    luminance, contrast = _terms(image, truth, mean)
    radius = losses.RADIUS
    center_mask = mask[radius:-radius, radius:-radius, None]
    total = jnp.sum(jnp.where(center_mask, luminance * contrast, 0.0))
    return total / (jnp.sum(center_mask).astype(image.dtype) * image.shape[-1])


@checked(broadcast=True, images=("image", "truth"))
def partial_ssim(
    image: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
    mask: Bool[Array, "height width"],
) -> Float[Array, ""]:
    """Compute the mSSIM published by DyCheck, for comparison with its tables.

    Each pass of the window is a partial convolution. It is rescaled by the share of
    *pixels* in the mask instead of their weights, so that the mean of a constant is
    wrong near the edge of the mask. Variances are clipped, and windows without masked
    pixels have a score of 1. `masked_ssim` has none of these properties.

    Args:
      image: Rendered images in [0, 1], [..., height, width, channels].
      truth: Ground truth of the same shape.
      mask: True for the pixels to compare, [..., height, width].

    Returns:
      mSSIM, [...].

    References:
      Gao et al. 2022 (DyCheck), arXiv:2210.13445. Liu et al. 2018, arXiv:1804.07723,
      for partial convolutions.
    """
    _refuse_stacks(image)
    image, truth = widened(image), widened(truth)
    inside = mask.astype(image.dtype)[..., None]
    image, truth = (jnp.where(mask[..., None], x, 0.0) for x in (image, truth))

    def mean(x):
        # Columns first. Each pass uses the mask that results from the previous one.
        remaining = inside
        for axis in (1, 0):
            slide = jax.vmap(_window_sum, (1 - axis, None), 1 - axis)
            share = slide(remaining, np.full(TAPS, 1 / TAPS))
            has_pixels = share > 0.5 / TAPS  # at least one of eleven pixels
            smooth = slide(x * remaining, np.array(losses.WINDOW))
            x = jnp.where(has_pixels, smooth / jnp.where(has_pixels, share, 1.0), 0.0)
            remaining = has_pixels.astype(x.dtype)
        return x

    mean_image, mean_truth = mean(image), mean(truth)
    variance_image = jnp.maximum(mean(image**2) - mean_image**2, 0.0)
    variance_truth = jnp.maximum(mean(truth**2) - mean_truth**2, 0.0)
    bound_sq = variance_image * variance_truth
    bound = jnp.where(
        bound_sq > 0, jnp.sqrt(jnp.where(bound_sq > 0, bound_sq, 1.0)), 0.0
    )
    covariance = jnp.clip(mean(image * truth) - mean_image * mean_truth, -bound, bound)
    luminance = (2 * mean_image * mean_truth + C1) / (
        mean_image**2 + mean_truth**2 + C1
    )
    contrast = (2 * covariance + C2) / (variance_image + variance_truth + C2)
    return jnp.mean(luminance * contrast)


def _terms(image, truth, mean):
    """Compute the luminance and contrast-structure terms of SSIM, Wang et al. 2004.

    This is the identity of `losses.dssim_map` with separate terms and any windowed
    `mean`: 2 cov(x, y) = var(x) + var(y) - var(x - y), about the mean of the truth.
    """
    center = losses.middle_level(truth)
    difference = image - truth
    mean_image, mean_truth = mean(image - center), mean(truth - center)
    mean_difference = mean_image - mean_truth
    variance_difference = mean(difference**2) - mean_difference**2
    squares = mean((image - center) ** 2 + (truth - center) ** 2)
    variances = squares - mean_image**2 - mean_truth**2
    brightness = (mean_image + center) ** 2 + (mean_truth + center) ** 2
    luminance = 1.0 - mean_difference**2 / (brightness + C1)
    contrast = 1.0 - variance_difference / (variances + C2)
    return luminance, contrast


def _window_mean(image):
    window = np.array(losses.WINDOW)
    rows = jax.vmap(_window_sum, (1, None), 1)(image, window)
    return jax.vmap(_window_sum, (0, None), 0)(rows, window)


def _window_sum(values, weights):
    """Compute weighted sums of neighbors along the first axis, without padding.

    A product with a banded matrix in blocks of 64 supports any weights and derivatives.
    Forward and backward passes take 26 ms at 480x270, compared with 1259 ms for sums of
    shifted slices, and 9 ms for the self-adjoint form in `losses`, which needs
    symmetric weights and zero padding.
    """
    taps = len(weights)
    outputs = values.shape[0] - taps + 1
    block = min(64, outputs)
    blocks = -(-outputs // block)
    values = jnp.pad(values, ((0, blocks * block - outputs), (0, 0)))
    parts = jnp.stack(
        [values[i * block : (i + 1) * block + taps - 1] for i in range(blocks)]
    )
    band = np.stack([np.pad(weights, (i, block - 1 - i)) for i in range(block)])
    sums = exact_einsum(
        "ot,ntc->noc",
        jnp.asarray(band, values.dtype),
        parts,
    )
    return sums.reshape(blocks * block, -1)[:outputs]
