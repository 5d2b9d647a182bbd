"""Photographs in different light: colors by a code, and a sky behind them."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.special

from gaussians_jax.per_frame import appearance, sky
from gaussians_jax.per_frame.appearance import AppearanceSpec, ColorNetworkSpec
from gaussians_jax.per_frame.exposure import ExposureSpec
from gaussians_jax.per_frame.sky import SkySpec
from gaussians_jax.scene import (
    drawing,
    held_out_appearance,
    held_out_exposure,
    scene,
    variants,
)
from gaussians_jax.scene.spec import refuse_what_cannot_train
from nerfies_jax import evaluation
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import rays
from nerfies_jax.training import loop
from tests import gradients, scenes
from tests.gaussians.shared import jitted

SMALL = AppearanceSpec(
    code=4, network=ColorNetworkSpec(bands=1, depth=1, width=8), sky=SkySpec(width=8)
)
SPEC = dataclasses.replace(scenes.TINY_SPLATS, appearance=SMALL)
EVEN = scenes.tiny_capture()
# Each frame in a light of its own, the held-out one in that of the second.
CAPTURE = dataclasses.replace(
    EVEN,
    appearance_ids=np.where(
        np.arange(7) == EVEN.heldout[0], EVEN.train[1], np.arange(7)
    ).astype(np.int32),
)


def some_parameters(rng, dtype, count=20, depth=1):
    """Parameters that change colors, without any of our initializers."""
    inputs, width = 6 + 3 + 4, 8
    sizes = [inputs] + [width] * depth

    def normal(*shape):
        return (0.5 * rng.normal(size=shape)).astype(dtype)

    layers = tuple(
        appearance.Layer(normal(a, b), normal(b)) for a, b in itertools.pairwise(sizes)
    )
    network = appearance.ColorNetwork(layers, normal(4, width), normal(width, 6))
    shared = appearance.Shared(normal(5, 4), normal(4, 12), network, None)
    return shared, normal(count, 6), normal(count, 3), normal(4)


def by_hand(shared, features, colors, code):
    """Colors in NumPy, one Gaussian after the other."""
    result = []
    for feature, color in zip(features, colors, strict=True):
        hidden = np.concatenate([feature, color, code])
        for layer in shared.network.hidden:
            hidden = np.maximum(hidden @ layer.weight + layer.bias, 0)
        gate = code @ shared.network.gate
        gain, offset = np.split((hidden * gate) @ shared.network.out, 2)
        matrix = (code @ shared.affine).reshape(3, 4)
        change = gain * color + offset + matrix[:, :3] @ color + matrix[:, 3]
        result.append(color + change)
    return np.array(result)


@pytest.mark.parametrize("depth", [1, pytest.param(2, marks=pytest.mark.full)])
def test_colors_equal_those_of_a_loop_over_gaussians(depth, dtype, rng):
    network = dataclasses.replace(SMALL.network, depth=depth)
    spec = dataclasses.replace(SMALL, network=network)
    shared, features, colors, code = some_parameters(rng, dtype, depth=depth)
    recolor = jitted(lambda *args: appearance.recolor(spec, *args))
    changed = recolor(shared, features, colors, code)
    assert changed.dtype == dtype
    expected = by_hand(shared, features, colors, code)
    tolerance = {"float32": 3e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(changed, expected, atol=tolerance)
    # The mean photograph shows the colors of the Gaussians themselves.
    same = recolor(shared, features, colors, np.zeros_like(code))
    np.testing.assert_array_equal(same, colors)


def test_gradients_of_colors_and_sky(float64, rng):
    shared, features, colors, code = some_parameters(rng, "float64")
    weight = rng.normal(size=colors.shape)

    def total(*args):
        return jnp.sum(weight * appearance.recolor(SMALL, *args))

    # Kinks of the network are rare, and smaller steps cross fewer.
    args = (shared, features, colors, code)
    assert gradients.directional_error(total, *args, step=1e-7) < 1e-6
    params = sky.init(jax.random.key(0), SMALL.sky, 4, jnp.float64)
    direction = rng.normal(size=(9, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction = jnp.asarray(direction)

    def light(params, code):
        color = sky.color(SMALL.sky, params, direction, code)
        return jnp.sum(weight[:9] * color)

    params = jax.tree.map(np.asarray, params)
    assert gradients.directional_error(light, params, code, step=1e-7) < 1e-6


def test_sky_is_a_sum_of_harmonics_of_the_code(rng):
    network = sky.init(jax.random.key(1), SMALL.sky, 4).network
    head = network.heads["out"]
    weight = rng.normal(size=head.weight.shape).astype(np.float32)
    network = network._replace(heads={"out": head._replace(weight=weight)})
    mean = rng.normal(size=(9, 3)).astype(np.float32)
    code = rng.normal(size=4).astype(np.float32)
    direction = rng.normal(size=(5, 7, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    color_of = jitted(lambda *args: sky.color(SMALL.sky, *args))
    color = color_of(sky.Sky(mean, network), direction.astype(np.float32), code)
    layer = network.hidden[0]
    hidden = np.maximum(code @ np.asarray(layer.weight) + np.asarray(layer.bias), 0)
    coefficients = mean + (hidden @ weight).reshape(9, 3)
    x, y, z = np.moveaxis(direction, -1, 0)
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    expected = np.full((5, 7, 3), 0.5)
    terms = [(order, m) for order in range(3) for m in range(-order, order + 1)]
    for index, (order, m) in enumerate(terms):
        value = scipy.special.sph_harm_y(order, abs(m), polar, azimuth)
        part = (value.real if m >= 0 else value.imag) * (2**0.5 if m else 1)
        expected += part[..., None] * coefficients[index]
    np.testing.assert_allclose(color, expected, atol=2e-5)


@pytest.mark.parametrize("radial", [0.0, pytest.param(0.1, marks=pytest.mark.full)])
def test_directions_are_those_of_pixel_rays_at_any_aspect_and_skew(radial):
    camera = cameras.look_at((1.0, 0.5, -2.0), (0, 0, 0), (0, 1, 0), 20.0, (16, 12))
    camera = camera._replace(
        skew_px=np.float32(1.5),
        pixel_aspect=np.float32(1.2),
        principal_point_px=np.array([7, 6.5], np.float32),
        radial=np.array([radial, 0, 0], np.float32),
    )

    @jitted
    def both(camera):
        actual = drawing.directions(camera, (16, 12), distorted=radial != 0)
        return actual, rays.pixel_rays(camera, (16, 12)).direction

    np.testing.assert_allclose(*both(camera), atol=1e-6)


def test_features_do_not_depend_on_the_unit_and_place_of_the_scene(rng):
    mean = rng.normal(size=(50, 3))
    features = appearance.fourier_features(mean, 2)
    assert features.shape == (50, 12)
    assert np.abs(features).max() <= 1
    moved = appearance.fourier_features(1000 * mean + 5, 2)
    np.testing.assert_allclose(features, moved, atol=1e-5)
    # One position only has no size.
    assert np.isfinite(appearance.fourier_features(np.ones((3, 3)), 1)).all()


def curved(code):
    """An image of 30 pixels that is not linear in a code of three numbers."""
    place = jnp.linspace(0, 1, 90).reshape(30, 3)
    return code[0] * jnp.exp(code[1] * place) + jnp.sin(code[2] + place)


@jax.jit
def fitted(truth, valid, start):
    def evaluate(code):
        return curved(code), jax.jacfwd(curved)(code)

    code, image = held_out_appearance.fit_code(evaluate, truth, valid, start)
    return code, image, curved(code)


def test_a_fitted_code_is_that_of_scipy(float64, rng):
    truth = np.asarray(curved(np.array([0.4, -0.6, 0.3])))
    truth = truth + 0.01 * rng.normal(size=truth.shape)
    valid = rng.uniform(size=30) < 0.7
    price = held_out_appearance.RIDGE * valid.sum()

    def residuals(code):
        error = (truth - np.asarray(curved(code)))[valid]
        return np.concatenate([error.ravel(), price**0.5 * code])

    start = np.full(3, 0.1)
    expected = scipy.optimize.least_squares(residuals, start, xtol=1e-12).x
    unknown = np.where(valid[:, None], truth, np.nan)
    code, image, of_code = fitted(unknown, valid, start)
    np.testing.assert_allclose(code, expected, atol=2e-3)
    np.testing.assert_allclose(image, of_code, rtol=1e-6)


@pytest.mark.hard_cases
def test_without_pixels_or_with_an_invalid_image_a_code_does_not_grow(float64):
    start = np.full(3, 0.1)
    code, _, _ = fitted(np.full((30, 3), 0.5), np.zeros(30, bool), start)
    assert np.linalg.norm(code) <= np.linalg.norm(start)  # only the price is left
    code, _, _ = fitted(np.full((30, 3), np.nan), np.ones(30, bool), start)
    np.testing.assert_array_equal(code, start)


@pytest.fixture(scope="module")
def built():
    """A model, and a state with codes of its own for some frames."""
    metadata = scene.metadata_of(CAPTURE)
    model = scene.build(SPEC, metadata)
    state = model.init(CAPTURE, jax.random.key(0))
    shared = state.params.nets["appearance"]
    rng = np.random.default_rng(3)
    codes = (0.3 * rng.normal(size=shared.codes.shape)).astype(np.float32)
    nets = {"appearance": shared._replace(codes=jnp.asarray(codes))}
    return model, metadata, state._replace(params=state.params._replace(nets=nets))


@pytest.mark.full
def test_a_known_photograph_is_fitted_from_its_half(built):
    model, metadata, state = built
    row = int(CAPTURE.heldout[0])
    renderer = evaluation.Renderer(model, CAPTURE.size)
    color = renderer(state, evaluation.view_of(CAPTURE, row)).color
    images = CAPTURE.images.copy()
    images[row] = np.round(255 * np.clip(color, 0, 1))
    observed = dataclasses.replace(CAPTURE, images=images)
    score = held_out_exposure.scorer(SPEC, metadata, CAPTURE.size)
    halves = score(state, observed, observed.heldout)
    neutral = variants.without_effects(SPEC, metadata, ("appearance",), False)
    plain = evaluation.Renderer(neutral, CAPTURE.size)
    base = plain(state, evaluation.view_of(CAPTURE, row)).color
    # Saturated pixels and the unknown right half of the sky leave 33 dB.
    mean = evaluation.score_right_halves(observed, observed.heldout, [base])
    assert halves.psnr.min() > 30 > mean.psnr.max() + 6
    assert variants.parts(SPEC, metadata).appearance


@pytest.mark.full
def test_a_step_changes_the_code_of_its_frame_only_and_growth_keeps_features(built):
    model, _, state = built
    frames = evaluation.frames_of(CAPTURE)
    after, _ = jax.jit(model.step)(state, frames)
    changed = after.params.nets["appearance"].codes
    changed = np.asarray(changed != state.params.nets["appearance"].codes)
    assert sorted(changed.any(axis=1)) == [False] * (len(changed) - 1) + [True]
    grown = loop.fit(model, state, frames, steps=12).state
    features = grown.params.rows["appearance"]
    assert len(features) == len(grown.params.rows["splats"].mean)
    assert np.isfinite(features).all()


def test_settings_that_contradict_each_other_are_refused():
    both = dataclasses.replace(SPEC, exposure=ExposureSpec())
    with pytest.raises(ValueError, match="exposure=none or appearance=none"):
        refuse_what_cannot_train(both)
    for change in (
        {"code": 0},
        {"final": 0.0},
        {"code_rate": -1.0},
        {"learning_rate": np.nan},
    ):
        with pytest.raises(ValueError, match=next(iter(change))):
            dataclasses.replace(SMALL, **change)
    with pytest.raises(ValueError, match="width=0"):
        ColorNetworkSpec(width=0)
    with pytest.raises(ValueError, match="feature_rate"):
        ColorNetworkSpec(feature_rate=0.0)
    with pytest.raises(ValueError, match="degree=4"):
        SkySpec(degree=4)
