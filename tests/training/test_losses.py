"""Losses against float64 NumPy, scikit-image and reference values, and their edges."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from nerfies_jax.training import losses
from tests import gradients

# Compiled once per shape: uncompiled, each call traces and compiles its loop again.
DSSIM = jax.jit(losses.dssim_map, static_argnames=("padding",))
SSIM_SLOPE = jax.jit(jax.value_and_grad(losses.ssim))
PSNR_SLOPE = jax.jit(jax.value_and_grad(losses.psnr))
ULPS = {"float32": 4e-7, "float64": 1e-15}


def images(rng, height=24, width=19, noise=0.2):
    image = rng.random((height, width, 3))
    return image, np.clip(image + noise * rng.normal(size=image.shape), 0, 1)


def reference_dssim(image, target, padding, value_range=1.0):
    """The five-window textbook form in float64 by scipy.ndimage."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets**2) / 4.5)
    window /= window.sum()

    def blur(x):
        for axis in (0, 1):
            x = scipy.ndimage.correlate1d(x, window, axis=axis, mode="constant")
        return x

    x, y = np.asarray(image, np.float64), np.asarray(target, np.float64)
    c1, c2 = (0.01 * value_range) ** 2, (0.03 * value_range) ** 2
    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    ssim = (2 * mx * my + c1) * (2 * vxy + c2)
    ssim = ssim / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    return 1 - (ssim[5:-5, 5:-5] if padding == "valid" else ssim)


@pytest.mark.parametrize("padding", ["zero", "valid"])
def test_dssim_is_the_textbook_five_window_form(padding, rng, dtype):
    image, target = images(rng)
    loss = DSSIM(image.astype(dtype), target.astype(dtype), padding=padding)
    assert loss.dtype == dtype
    expected = reference_dssim(image, target, padding)
    # The float64 images are rounded to float32 before: 6e-8 of noise beside C2 = 9e-4.
    tolerance = {"float32": 5e-6, "float64": 1e-13}[dtype]
    np.testing.assert_allclose(loss, expected, atol=tolerance)


@pytest.mark.hard_cases
@pytest.mark.parametrize("level", [0.0, pytest.param(0.9, marks=pytest.mark.full)])
def test_constant_equal_images_are_exactly_alike_without_a_slope(level, dtype):
    image = np.full((16, 20, 3), level, dtype)
    value, grad = SSIM_SLOPE(image, image)
    assert float(value) == 1
    assert not np.any(grad)


@pytest.mark.parametrize(
    "padding", ["zero", pytest.param("valid", marks=pytest.mark.full)]
)
def test_dssim_gradient_is_the_slope(padding, rng, float64):
    image, target = (jnp.asarray(x) for x in images(rng, 13, 12))
    weight = jnp.asarray(rng.normal(size=reference_dssim(image, target, padding).shape))

    def loss(x, y):
        return jnp.sum(weight * losses.dssim_map(x, y, padding=padding))

    assert gradients.directional_error(loss, image, target) < 1e-7


def test_dssim_has_forward_mode_and_curvature(rng, float64):
    """Tangents, and Hessian-vector products, against differences."""
    image, target = images(rng, 13, 12)
    along = rng.normal(size=image.shape)
    step = 1e-6

    @jax.jit
    def both(image):
        function = jax.value_and_grad(lambda x: losses.ssim(x, target))
        return jax.jvp(function, (image,), (along,))

    _, (tangent, product) = both(image)
    (ahead, up), (behind, down) = (both(image + s * step * along)[0] for s in (1, -1))
    assert float(tangent) == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-6)
    difference = (np.asarray(up) - np.asarray(down)) / (2 * step)
    error = np.abs(np.asarray(product) - difference).max()
    assert error < 1e-6 * np.abs(difference).max()


ROBUST = {
    "charbonnier": (losses.charbonnier, lambda s, w: np.sqrt(s + w**2) - w),
    "huber": (
        losses.huber,
        lambda s, w: np.where(s < w**2, s / 2, w * (np.sqrt(s) - w / 2)),
    ),
    "geman_mcclure": (losses.geman_mcclure, lambda s, w: 2 * s / (s + 4 * w**2)),
}


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", ROBUST)
def test_robust_penalties_hold_from_nothing_to_the_largest_residual(name, dtype):
    function, closed = ROBUST[name]
    for width in (1e-3, 0.03, 1.0):
        squares = np.float32([0, 1e-30, 1e-12, 1e-6, 1e-3, 0.5, 2, 1e3, 1e30])
        extended = np.asarray(squares, np.longdouble)
        expected = closed(extended, np.longdouble(width))
        if name == "charbonnier":  # 80 bits still cancel at 1e-30
            expected = extended / (np.sqrt(extended + width**2) + width)
        penalty = jax.jit(function, static_argnums=1)(squares.astype(dtype), width)
        np.testing.assert_allclose(
            penalty, np.asarray(expected, np.float64), rtol=ULPS[dtype], atol=0
        )


@pytest.mark.parametrize("name", ROBUST)
def test_robust_penalty_gradients_are_their_slopes(name, rng, float64):
    residual = jnp.asarray(rng.normal(size=(5, 3)))

    def penalty(x):
        return jnp.sum(ROBUST[name][0](jnp.sum(x**2, axis=-1), 0.7))

    assert gradients.directional_error(penalty, residual) < 1e-8


@pytest.mark.hard_cases
def test_geman_mcclure_saturates_at_infinity(dtype):
    both = jax.jit(jax.value_and_grad(lambda s: losses.geman_mcclure(s, 1e-3)))
    value, grad = map(float, both(np.asarray(3e38, dtype)))
    assert value == 2
    assert np.isfinite(grad)
    assert grad < 1e-30


@pytest.mark.hard_cases
def test_charbonnier_of_a_square_that_overflowed_is_infinite(dtype):
    """Not NaN, which s / (sqrt(s + width^2) + width) is there."""

    def penalty(s):
        return losses.charbonnier(s, 1e-3)

    @jax.jit
    def orders(s):
        return penalty(s), jax.grad(penalty)(s), jax.grad(jax.grad(penalty))(s)

    assert [float(x) for x in orders(np.asarray(np.inf, dtype))] == [np.inf, 0, 0]


FORMS = ("paper", "official")


def test_official_geman_mcclure_is_width_times_the_papers():
    s = np.float32([0.0, 1e-3, 0.5])
    both = [jax.jit(lambda s, f=f: losses.geman_mcclure(s, 0.03, f))(s) for f in FORMS]
    np.testing.assert_allclose(both[1], 0.03 * np.asarray(both[0]), rtol=1e-6)


LOSSES = {"l1": losses.l1, "mse": losses.mse, "photometric": losses.photometric}
SLOPES = {name: jax.jit(jax.value_and_grad(loss)) for name, loss in LOSSES.items()}


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize(
    "poison", [np.nan, pytest.param(np.inf, marks=pytest.mark.full)]
)
@pytest.mark.parametrize("where", ["image", "target"])
def test_masked_pixels_teach_nothing_whatever_they_hold(
    name, poison, where, rng, dtype
):
    image, target = images(rng, 14, 13)
    valid = rng.random((14, 13)) > 0.3
    clean = image.astype(dtype), target.astype(dtype), valid
    {"image": image, "target": target}[where][~valid] = poison
    dirty = image.astype(dtype), target.astype(dtype), valid
    value, grad = jax.tree.map(np.asarray, SLOPES[name](*dirty))
    expected, expected_slope = SLOPES[name](*clean)
    assert value == float(expected)
    np.testing.assert_array_equal(grad, expected_slope)
    assert np.all(grad[~valid] == 0)
    assert np.any(grad[valid] != 0)


def test_masked_losses_are_means_over_what_is_valid(rng, dtype):
    image, target = images(rng)
    valid = rng.random(image.shape[:2]) > 0.5
    arrays = image.astype(dtype), target.astype(dtype), valid
    difference = (image - target)[valid]
    tolerance = {"float32": 1e-6, "float64": 1e-14}[dtype]
    assert abs(SLOPES["l1"](*arrays)[0] - np.abs(difference).mean()) < tolerance
    assert abs(SLOPES["mse"](*arrays)[0] - (difference**2).mean()) < tolerance


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", LOSSES)
def test_a_frame_without_a_valid_pixel_has_no_loss(name, dtype):
    image = np.full((14, 13, 3), np.nan, dtype)
    value, grad = SLOPES[name](image, image, np.zeros((14, 13), bool))
    assert float(value) == 0
    assert not np.any(grad)


@pytest.mark.parametrize("weight", [0.2, pytest.param(1.0, marks=pytest.mark.full)])
def test_photometric_loss_mixes_l1_and_dssim(weight, rng, float64):
    image, target = images(rng)
    expected = (1 - weight) * np.abs(image - target).mean()
    expected += weight * reference_dssim(image, target, "zero").mean()
    loss = functools.partial(losses.photometric, dssim_weight=weight)
    value = jax.jit(loss)(image, target)
    assert abs(value - expected) < 1e-12


@pytest.mark.parametrize("name", LOSSES)
def test_loss_gradients_are_their_slopes(name, rng, float64):
    image, target = (jnp.asarray(x) for x in images(rng, 12, 13))
    valid = jnp.asarray(rng.random((12, 13)) > 0.3)

    def loss(x, y):
        return LOSSES[name](x, y, valid)

    assert gradients.directional_error(loss, image, target, step=1e-7) < 1e-5


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    ("error", "expected"), [(1e-8, 80.0), (0.0, 100.0), (0.25, 6.0206)]
)
def test_psnr_is_finite_and_exact(error, expected, dtype):
    value, grad = map(float, PSNR_SLOPE(np.asarray(error, dtype)))
    assert abs(value - expected) < 5e-5
    assert np.isfinite(grad)


def test_psnr_counts_in_its_range():
    psnr = jax.jit(losses.psnr, static_argnums=1)(np.float32(0.01 * 255**2), 255.0)
    assert abs(psnr - 20) < 1e-5
