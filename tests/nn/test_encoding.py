"""Fourier features against 50-digit arithmetic and the Nerfies code's values."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from nerfies_jax.nn import encoding
from nerfies_jax.nn.encoding import EncodingSpec
from tests import gradients

encode = jax.jit(encoding.encode, static_argnums=0)
anneal = jax.jit(encoding.anneal, static_argnums=0)


def exact_features(spec, point, window):
    """Band by band in Python, with 50 digits."""
    features = list(point) if spec.identity else []
    with mpmath.workdps(50):
        factor = mpmath.pi if spec.times_pi else mpmath.mpf(1)
        for band in range(spec.bands):
            for function in (mpmath.sin, mpmath.cos):
                for coordinate in point:
                    angle = factor * 2**band * mpmath.mpf(float(coordinate))
                    features.append(float(function(angle)) * window[band])
    return np.array(features, np.float64)


@pytest.mark.parametrize(
    "spec",
    [
        EncodingSpec(10, identity=True, times_pi=True),
        EncodingSpec(10, identity=False),
        EncodingSpec(0),
    ],
    ids=["half turns", "waves", "identity"],
)
def test_features_band_by_band(spec, dtype, rng):
    point = rng.uniform(-1, 1, 3).astype(dtype)
    window = rng.uniform(0, 1, spec.bands).astype(dtype)
    features = encode(spec, point, window)
    assert features.dtype == dtype
    assert features.shape == (spec.width(3),)
    truth = exact_features(spec, point, np.asarray(window, np.float64))
    np.testing.assert_allclose(
        features, truth, atol={"float32": 2e-7, "float64": 5e-16}[dtype]
    )


@pytest.mark.parametrize(
    "times_pi", [pytest.param(False, marks=pytest.mark.full), True]
)
def test_gradient_and_curvature(times_pi, float64, rng):
    spec = EncodingSpec(4, times_pi=times_pi)
    point, window = rng.uniform(-1, 1, 3), rng.uniform(0, 1, 4)
    weight = jnp.asarray(rng.normal(size=spec.width(3)))

    def value(point, window):
        return encoding.encode(spec, point, window) @ weight

    def both(point, window):
        grad = jax.grad(value)(point, window)
        return value(point, window) + jnp.sum(grad * weight[:3])

    assert gradients.directional_error(both, point, window) < 1e-7


def test_a_compiled_slope_reads_the_waves_of_the_features():
    """Of XLA:CPU, which computes sines wherever they are read if they may be fused."""
    spec = EncodingSpec(8)

    def slope(points, matrix):
        return jax.grad(
            lambda x: jnp.sum(
                jnp.tanh(jax.vmap(lambda p: encoding.encode(spec, p, None))(x) @ matrix)
            )
        )(points)

    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        lowered = jax.jit(slope).lower(np.ones((64, 3)), np.ones((51, 4)))
        text = lowered.compile().as_text()
    assert text.count(" sine(") == text.count(" cosine(") == 1


@pytest.mark.hard_cases
def test_the_window_is_exact_at_its_ends_and_opens_smoothly(dtype):
    def window(alpha):
        weights = encoding.anneal(6, alpha)
        return weights, weights

    both = jax.jit(jax.jacfwd(window, has_aux=True))

    def slope_and_window(alpha):
        return map(np.asarray, both(np.asarray(alpha, dtype)))

    grad, shut = slope_and_window(0)
    assert np.array_equal(shut, np.zeros(6))
    assert np.all(grad == 0)
    assert np.array_equal(list(slope_and_window(6))[1], np.ones(6))
    opening = np.stack([list(slope_and_window(a))[1] for a in np.linspace(-1, 7, 65)])
    assert np.all(np.diff(opening, axis=0) >= 0)
    # (1 - cos) / 2 is 20 % off here in float32
    small = list(slope_and_window(1e-4))[1][0]
    assert abs(small / np.sin(np.pi * np.float64(np.float32(1e-4)) / 2) ** 2 - 1) < 1e-6
    for alpha in (0, 1e-20, 2, 2.5, 6):
        assert np.all(np.isfinite(next(slope_and_window(alpha))))


@pytest.mark.full
@pytest.mark.hard_cases
@pytest.mark.parametrize("narrow", [jnp.bfloat16, jnp.float16])
@pytest.mark.parametrize("times_pi", [False, True])
def test_narrow_coordinates_are_encoded_in_float32(times_pi, narrow):
    """2^15 x overflows float16, and a bfloat16 sine of 2^7 x is noise."""
    spec = EncodingSpec(16, times_pi=times_pi)
    point = np.asarray([0.0, -0.7371, 3.25], narrow)
    features, window = jax.jit(
        lambda point, alpha: (
            encoding.encode(spec, point, None),
            encoding.anneal(4, alpha),
        )
    )(point, np.asarray(1.5, narrow))
    assert features.dtype == narrow
    exact = exact_features(spec, np.asarray(point, np.float64), np.ones(16))
    unit = float(jnp.finfo(narrow).eps)
    np.testing.assert_allclose(
        np.asarray(features, np.float64), exact, atol=unit, rtol=unit
    )
    assert window.dtype == narrow
    assert window.tolist() == [1, 0.5, 0, 0]


def test_encoding_and_window_of_a_batch_are_those_of_each_point(dtype, rng):
    points = rng.uniform(-1, 1, (2, 5, 3)).astype(dtype)
    alpha = np.array([0, 0.25, 2.5, 4, 9], dtype)

    @jax.jit
    def both(points, alpha):
        window = encoding.coarse_to_fine_window(4, alpha)
        return window, encoding.positional_encoding(points, 4, window, times_pi=True)

    window, features = both(points, alpha)
    assert window.dtype == features.dtype == dtype
    opened = np.clip(alpha[:, None].astype(np.float64) - np.arange(4), 0, 1)
    bound = {"float32": 3e-7, "float64": 1e-15}[dtype]
    assert np.max(np.abs(window - (1 - np.cos(np.pi * opened)) / 2)) < bound
    spec = EncodingSpec(4, times_pi=True)
    for place in np.ndindex(2, 5):
        weights = np.asarray(window[place[1]], np.float64)
        truth = exact_features(spec, points[place], weights)
        assert np.max(np.abs(features[place] - truth)) < bound
    with pytest.raises(ValueError, match="3 weights does not fit 4 bands"):
        encoding.positional_encoding(points, 4, window[:, :3])
