"""Image metrics against scikit-image, reference values and slow float64 loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from nerfies_jax.metrics import image_quality
from tests import gradients

SCIKIT = dict(
    channel_axis=-1,
    data_range=1,
    gaussian_weights=True,
    sigma=1.5,
    use_sample_covariance=False,
)


def pair(rng, shape=(40, 33, 3), noise=0.1):
    truth = scipy.ndimage.gaussian_filter(rng.random(shape), (2, 2, 0))
    truth = (truth - truth.min()) / np.ptp(truth)
    return np.clip(truth + noise * rng.normal(size=shape), 0, 1), truth


def blob(shape):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.hypot(rows - shape[0] / 2, columns - shape[1] / 3) < min(shape) / 3


psnr = jax.jit(image_quality.psnr)
quantize = jax.jit(image_quality.quantize)
ssim = jax.jit(image_quality.ssim, static_argnums=2)
ms_ssim = jax.jit(image_quality.ms_ssim, static_argnums=2)
MASKED = ("masked_psnr", "masked_ssim", "partial_ssim")
masked_and_slope = {
    name: jax.jit(jax.value_and_grad(getattr(image_quality, name))) for name in MASKED
}


def arrays(*values, dtype):
    return [x if x.dtype == bool else np.asarray(x, dtype) for x in values]


psnr_and_slope = jax.jit(jax.value_and_grad(image_quality.psnr))


@pytest.mark.hard_cases
@pytest.mark.parametrize(("offset", "decibels"), [(0.0, 100), (1e-6, 100), (1e-4, 80)])
def test_psnr_is_capped_and_exact_below_the_cap(offset, decibels, dtype):
    flat = np.zeros((8, 8, 3), dtype)
    value, grad = psnr_and_slope(flat + flat.dtype.type(offset), flat)
    assert value == pytest.approx(decibels, abs=1e-4)
    assert np.all(np.isfinite(grad))
    assert np.all(grad == 0) == (decibels == 100)


def test_psnr_is_scikit_images_and_that_of_the_png_when_quantized(dtype, rng):
    image, truth = pair(rng)
    value = psnr(*arrays(image, truth, dtype=dtype))
    error = abs(value - peak_signal_noise_ratio(truth, image, data_range=1))
    assert error < {"float32": 1e-4, "float64": 1e-12}[dtype]
    image = image * 1.2 - 0.1  # leaves [0, 1] on both sides
    stored = [np.round(255 * np.clip(x, 0, 1)).astype(np.uint8) for x in (image, truth)]
    quantized = [quantize(x) for x in arrays(image, truth, dtype=dtype)]
    exact = peak_signal_noise_ratio(stored[1], stored[0])
    assert psnr(*quantized) == pytest.approx(exact, abs=1e-4)


@pytest.mark.parametrize(
    ("shape", "padding"),
    [
        ((13, 12, 2), "zero"),
        ((40, 33, 1), "valid"),
        pytest.param((11, 11, 3), "valid", marks=pytest.mark.full),
    ],
)
def test_ssim_is_scikit_images(shape, padding, dtype, rng):
    image, truth = pair(rng, shape)
    value = ssim(*arrays(image, truth, dtype=dtype), padding)
    if padding == "zero":
        around = ((5, 5), (5, 5), (0, 0))
        image, truth = (np.pad(x, around) for x in (image, truth))
    exact = structural_similarity(image, truth, **SCIKIT)
    # The promise is 1e-4; measured 2e-7 in float32.
    assert abs(value - exact) < {"float32": 2e-6, "float64": 1e-12}[dtype]


def blurred(x):
    weights = np.exp(-(np.arange(-5, 6) ** 2) / 4.5)
    window = np.outer(weights, weights)[..., None] / weights.sum() ** 2
    return scipy.ndimage.correlate(x, window)[5:-5, 5:-5]


def structure_and_luminance(mean, image, truth):
    """The two factors of an SSIM over windows that `mean` averages."""
    mean_x, mean_y = mean(image), mean(truth)
    var_x, var_y = mean(image**2) - mean_x**2, mean(truth**2) - mean_y**2
    cov = mean(image * truth) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4)
    return (2 * cov + 9e-4) / (var_x + var_y + 9e-4), luminance


def slow_ssim(image, truth, mask):
    """Of windows about masked pixels, whose weights are renormalized in the mask."""
    inside = mask[..., None].astype(float)
    share = np.maximum(blurred(inside), 1e-30)
    pair = structure_and_luminance(lambda x: blurred(x * inside) / share, image, truth)
    return np.mean((pair[0] * pair[1])[mask[5:-5, 5:-5]])


def slow_ms_ssim(image, truth, weights):
    """By SciPy in float64, from the definitions in Wang et al. 2003."""
    score = np.ones(image.shape[-1])
    for scale, weight in enumerate(weights):
        term, luminance = structure_and_luminance(blurred, image, truth)
        if scale == len(weights) - 1:
            term = term * luminance
        score *= np.maximum(term.mean((0, 1)), 0) ** weight
        # An odd last row or column stands for itself.
        odd = [(0, size % 2) for size in image.shape[:2]] + [(0, 0)]
        image, truth = (np.pad(x, odd, mode="edge") for x in (image, truth))
        image, truth = (
            x.reshape(x.shape[0] // 2, 2, x.shape[1] // 2, 2, -1).mean((1, 3))
            for x in (image, truth)
        )
    return score.mean()


WEIGHTS = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333])


@pytest.mark.parametrize(
    ("shape", "scales"),
    [((45, 52, 3), 3), pytest.param((161, 170, 3), 5, marks=pytest.mark.full)],
)
def test_ms_ssim_is_the_definition_with_weights_that_sum_to_one(
    shape, scales, dtype, rng
):
    image, truth = pair(rng, shape, 0.3)
    weights = WEIGHTS[:scales] if scales == 5 else WEIGHTS[:3] / WEIGHTS[:3].sum()
    exact = slow_ms_ssim(image, truth, weights)
    value = ms_ssim(*arrays(image, truth, dtype=dtype), scales)
    assert abs(value - exact) < {"float32": 3e-6, "float64": 1e-12}[dtype]


# The tests of its edges share its program.
SMALL = (24, 23)


@jax.jit
def ms_ssim_and_slope(image, truth):
    return jax.value_and_grad(image_quality.ms_ssim)(image, truth, 2)


@pytest.mark.hard_cases
def test_ms_ssim_of_a_negative_image_is_zero_with_a_finite_gradient(dtype, rng):
    image, _ = arrays(*pair(rng, (*SMALL, 3)), dtype=dtype)
    value, grad = ms_ssim_and_slope(1 - image, image)
    assert value == 0
    assert np.all(np.isfinite(grad))


def test_masked_psnr_is_the_psnr_of_the_masked_pixels(dtype, rng):
    image, truth = pair(rng, (*SMALL, 3))
    mask = blob(SMALL)
    value, _ = masked_and_slope["masked_psnr"](*arrays(image, truth, mask, dtype=dtype))
    exact = peak_signal_noise_ratio(truth[mask], image[mask], data_range=1)
    assert abs(value - exact) < {"float32": 1e-4, "float64": 1e-12}[dtype]


@pytest.mark.hard_cases
def test_masked_ssim_is_a_slow_loop_over_masked_windows(dtype, rng):
    image, truth = pair(rng, (*SMALL, 3))
    mask = blob(SMALL)
    value, _ = masked_and_slope["masked_ssim"](*arrays(image, truth, mask, dtype=dtype))
    exact = slow_ssim(image, truth, mask)
    assert abs(value - exact) < {"float32": 3e-6, "float64": 1e-12}[dtype]


def slow_partial_ssim(image, truth, mask):
    """Row windows, then column windows, each scaled by its share of masked pixels."""
    weights = np.exp(-(np.arange(-5, 6) ** 2) / 4.5)
    weights /= weights.sum()

    def one_pass(values, mask):
        out = np.zeros((values.shape[0], values.shape[1] - 10, values.shape[2]))
        left = np.zeros(out.shape[:2])
        for row, column in np.ndindex(left.shape):
            inside = mask[row, column : column + 11]
            if inside.sum() > 0:
                window = values[row, column : column + 11] * inside[:, None]
                out[row, column] = 11 / inside.sum() * (weights @ window)
                left[row, column] = 1
        return out, left

    def mean(values):
        values, left = one_pass(values, mask.astype(float))
        values, _ = one_pass(values.swapaxes(0, 1), left.T)
        return values.swapaxes(0, 1)

    mean_x, mean_y = mean(image), mean(truth)
    var_x = np.maximum(mean(image**2) - mean_x**2, 0)
    var_y = np.maximum(mean(truth**2) - mean_y**2, 0)
    cov = mean(image * truth) - mean_x * mean_y
    cov = np.sign(cov) * np.minimum(np.sqrt(var_x * var_y), np.abs(cov))
    numerator = (2 * mean_x * mean_y + 1e-4) * (2 * cov + 9e-4)
    return np.mean(
        numerator / ((mean_x**2 + mean_y**2 + 1e-4) * (var_x + var_y + 9e-4))
    )


def test_partial_ssim_is_the_published_protocol(dtype, rng):
    image, truth = pair(rng, (*SMALL, 3))
    mask = blob(SMALL) & (rng.random(SMALL) > 0.3)
    inputs = arrays(image, truth, mask, dtype=dtype)
    value, _ = masked_and_slope["partial_ssim"](*inputs)
    exact = slow_partial_ssim(image, truth, mask)
    # Variances that should be zero are clipped after rounding: 1e-7 against c2 = 9e-4.
    assert abs(value - exact) < {"float32": 2e-5, "float64": 1e-12}[dtype]


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", MASKED)
def test_nothing_outside_the_mask_matters(name, dtype, rng):
    image, truth = pair(rng, (*SMALL, 3))
    mask = blob(SMALL)
    metric = masked_and_slope[name]
    clean, clean_slope = metric(*arrays(image, truth, mask, dtype=dtype))
    image[~mask], truth[~mask] = np.nan, np.inf
    value, grad = metric(*arrays(image, truth, mask, dtype=dtype))
    assert value == clean
    np.testing.assert_array_equal(grad, clean_slope)
    assert np.all(np.asarray(grad)[~mask] == 0)


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", ["masked_psnr", "masked_ssim"])
def test_an_empty_mask_scores_nan(name, dtype, rng):
    image, truth = arrays(*pair(rng, (*SMALL, 3)), dtype=dtype)
    assert np.isnan(masked_and_slope[name](image, truth, np.zeros(SMALL, bool))[0])


@pytest.mark.parametrize(
    "name", ["psnr", "ssim", "ms_ssim", "masked_psnr", "masked_ssim"]
)
def test_gradients_agree_with_central_differences(name, float64, rng):
    image, truth = pair(rng, (22, 24, 3))
    rest = {
        "ms_ssim": (2,),
        "masked_psnr": (jnp.asarray(blob((22, 24))),),
        "masked_ssim": (jnp.asarray(blob((22, 24))),),
    }.get(name, ())
    metric = getattr(image_quality, name)

    def score(image, truth):
        return metric(image, truth, *rest)

    assert gradients.directional_error(score, image, truth) < 1e-6


ssim_and_slope = jax.jit(jax.value_and_grad(image_quality.ssim))


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", ["ssim", "ms_ssim", "masked_ssim"])
def test_equal_constant_images_score_one_with_gradient_zero(name, dtype):
    score, rest = {
        "ssim": (ssim_and_slope, ()),
        "ms_ssim": (ms_ssim_and_slope, ()),
        "masked_ssim": (masked_and_slope["masked_ssim"], (np.ones(SMALL, bool),)),
    }[name]
    for level in (0.0, 0.5, 0.9, 1.0):
        flat = np.full((*SMALL, 3), level, dtype)
        value, grad = score(flat, flat, *rest)
        # The textbook form in float32: 4e-5 low, and a slope 1e5 times rounding.
        assert value == 1.0
        assert np.abs(grad).max() < 1e-12


@pytest.mark.full
@pytest.mark.hard_cases
def test_high_dynamic_range_loses_no_variance(dtype, rng):
    image, truth = ((1000 + x).astype(dtype) for x in pair(rng, (*SMALL, 3)))
    value, _ = ms_ssim_and_slope(image, truth)
    exact = slow_ms_ssim(*(x.astype(float) for x in (image, truth)), (0.1356, 0.8644))
    # Without the centering of `_terms` the float32 error is of order one.
    assert abs(value - exact) < {"float32": 2e-3, "float64": 1e-4}[dtype]


def test_images_smaller_than_the_window_are_refused():
    small, image = np.zeros((12, 10, 3)), np.zeros((160, 300, 3))
    inside = np.ones((12, 10), bool)
    for call, words in (
        (lambda: ssim(small, small), "10x12"),
        (lambda: masked_and_slope["masked_ssim"](small, small, inside), "10x12"),
        (lambda: ms_ssim(small, small, 1), "10x12; use psnr"),
        (lambda: ms_ssim(image, image), "more than 160 pixels.*300x160; pass scales=4"),
        (lambda: ms_ssim(image, image, 6), "1 to 5 scales, got 6"),
    ):
        with pytest.raises(ValueError, match=words):
            call()


def test_integer_gray_and_batched_images_score_as_what_they_show(rng):
    """As bytes, 250 and 10 once differed by 16 levels; columns once were channels."""
    far = [np.full((12, 12, 3), level, np.uint8) for level in (250, 10)]
    assert psnr(*far) == pytest.approx(20 * np.log10(255 / 240), abs=1e-4)
    pairs = [pair(rng, (13, 14, 1)) for _ in range(2)]
    image, truth = np.stack(pairs, axis=1).astype(np.float32)
    exact = [
        structural_similarity(t[..., 0], i[..., 0], **(SCIKIT | {"channel_axis": None}))
        for i, t in zip(image, truth, strict=True)
    ]
    np.testing.assert_allclose(
        ssim(image[0, ..., 0], truth[0, ..., 0]), exact[0], atol=2e-6
    )
    np.testing.assert_allclose(ssim(image, truth), exact, atol=2e-6)
    deep = [np.round(65535 * x).astype(np.uint16) for x in (image, truth)]
    np.testing.assert_allclose(ssim(*deep), exact, atol=2e-4)
    mask = np.zeros((13, 14), bool)
    mask[3:9, 4:12] = True
    for masked in (image_quality.masked_psnr, image_quality.partial_ssim):
        both = jax.jit(masked)(image, truth, mask)
        one = jax.jit(masked)(image[1], truth[1], mask)
        np.testing.assert_allclose(both[1], one, rtol=1e-6)
    with pytest.raises(ValueError, match=r"`truth` has shape \[3\]"):
        psnr(np.ones((4, 4, 3), np.float32), np.ones(3, np.float32))
    with pytest.raises(ValueError, match="has 64 channels"):
        image_quality.ssim(*np.ones((2, 16, 64, 64), np.float32))
