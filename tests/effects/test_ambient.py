"""The slice through ambient dimensions, against loops in NumPy."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.effects import ambient
from nerfies_jax.effects.ambient import AmbientSpec
from nerfies_jax.nets import mlp
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.training.effects import MOMENT, FrameCondition, Table
from tests import gradients

BENT = AmbientSpec(
    position=EncodingSpec(3, identity=False),
    depth=4,
    width=16,
    skips=(2,),
    code_width=4,
    encoding=EncodingSpec(2, identity=False),
)
PLANE = AmbientSpec(kind="plane", dims=3)
# Past the last step of the default window
OPEN = 11_000


def condition(dtype, step=OPEN, seed=3):
    rng = np.random.default_rng(seed)
    codes = {"motion": rng.normal(size=4), "ambient": rng.normal(size=3)}
    codes = {name: jnp.asarray(code, dtype) for name, code in codes.items()}
    return FrameCondition(jnp.asarray(0.4, dtype), codes, jnp.int32(step))


started = jax.jit(ambient.init, static_argnums=(0, 2))


def bent_params(dtype, size=0.3, seed=0):
    """A surface far from the plane it starts as."""
    params = started(BENT, jax.random.key(seed), jnp.dtype(dtype))
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda x: jnp.asarray(np.asarray(x) + size * rng.normal(size=x.shape), dtype),
        params,
    )


def waves(x, bands, opened):
    """Sines and cosines of each band, band by band, weighed; no identity."""
    return np.concatenate(
        [
            opened[k] * wave(2.0**k * x)
            for k in range(bands)
            for wave in (np.sin, np.cos)
        ]
    )


def window_by_hand(spec, step):
    passed = min(max(step - spec.closed_steps, 0), spec.anneal_steps)
    alpha = spec.encoding.bands * passed / spec.anneal_steps
    return [
        (1 - math.cos(math.pi * min(max(alpha - k, 0), 1))) / 2
        for k in range(spec.encoding.bands)
    ]


def slice_by_hand(params, point, when):
    params = jax.tree.map(lambda x: np.asarray(x, np.float64), params)
    encoded = waves(np.asarray(point, np.float64), 3, [1, 1, 1])
    inputs = np.concatenate([encoded, np.asarray(when.codes["motion"], np.float64)])
    hidden = inputs
    for index, layer in enumerate(params.hidden):
        if index == 2:
            hidden = np.concatenate([hidden, inputs])
        hidden = np.maximum(hidden @ layer.weight + layer.bias, 0)
    head = params.heads["ambient"]
    return hidden @ head.weight + head.bias


@pytest.mark.parametrize("step", [0, 1000, 2300, 6000, 8500, OPEN, 250_000])
def test_a_bent_slice_is_the_loop_over_its_layers(step, dtype, rng):
    params = bent_params(dtype)
    point = jnp.asarray(rng.uniform(-1, 1, 3), dtype)
    when = condition(dtype, step)
    made = ambient.effect(BENT)
    exact = slice_by_hand(params, point, when)
    tolerance = {"float32": 3e-6, "float64": 1e-13}[dtype]
    found = ambient.ambient_point(BENT, params, point, when)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, exact, atol=tolerance)
    lifted = made.lift(params, point, when)
    assert lifted.dtype == dtype
    assert lifted.shape == (made.lift_width,) == (8,)
    features = waves(exact, 2, window_by_hand(BENT, step))
    np.testing.assert_allclose(lifted, features, atol=tolerance)


@pytest.mark.hard_cases
def test_the_window_follows_a_traced_step_and_ends_exactly(dtype):
    steps = np.asarray([0, 999, 1000, 1001, 6000, 10_999, 11_000, 10**6], np.int32)
    opened = jax.jit(
        jax.vmap(lambda step: ambient.window(BENT, step, jnp.zeros(2, dtype)))
    )(steps)
    opened = np.asarray(opened)
    assert opened.dtype == dtype
    exact = [window_by_hand(BENT, int(step)) for step in steps]
    tolerance = {"float32": 3e-7, "float64": 1e-13}[dtype]
    np.testing.assert_allclose(opened, exact, atol=tolerance)
    assert np.all(opened[:3] == 0)
    # HyperNeRF's alpha goes to the number of bands: band one is half open at its half
    np.testing.assert_allclose(opened[4], [1, 0], atol=tolerance)
    assert np.all(opened[6:] == 1)


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    "spec",
    [
        pytest.param(BENT, id="bent"),
        pytest.param(PLANE, id="plane", marks=pytest.mark.full),
    ],
)
def test_while_shut_the_template_reads_zeros_and_nothing_learns(spec, dtype, rng):
    made = ambient.effect(spec)
    params = bent_params(dtype) if spec.kind == "bent" else None
    point = jnp.asarray(rng.uniform(-1, 1, 3), dtype)
    pull = jnp.asarray(rng.normal(size=made.lift_width), dtype)
    still = condition(dtype)

    @jax.jit
    def read(params, codes, step):
        def total(params, codes):
            lifted = made.lift(params, point, FrameCondition(still.time, codes, step))
            return pull @ lifted, lifted

        return jax.grad(total, argnums=(0, 1), has_aux=True)(params, codes)

    def found(step):
        return jax.tree.map(np.asarray, read(params, still.codes, np.int32(step)))

    for step in (0, 1000):
        grads, lifted = found(step)
        assert np.all(lifted == 0)
        for grad in jax.tree.leaves(grads):
            assert np.all(grad == 0)
    # and just after it has begun to open, both do
    grad = found(1500)[0][1][made.tables[0].name]
    assert np.all(grad != 0)
    assert np.all(np.isfinite(grad))


@pytest.mark.full
def test_identity_is_never_shut(dtype, rng):
    spec = dataclasses.replace(PLANE, encoding=EncodingSpec(1))
    when = condition(dtype, 0)
    lifted = ambient.effect(spec).lift(None, jnp.zeros(3, dtype), when)
    np.testing.assert_array_equal(lifted[:3], when.codes["ambient"])
    assert np.all(lifted[3:] == 0)


@pytest.mark.full
def test_an_encoding_without_bands_is_the_ambient_point(dtype):
    spec = dataclasses.replace(PLANE, encoding=EncodingSpec(0))
    when = condition(dtype, 0)
    lifted = ambient.effect(spec).lift(None, jnp.zeros(3, dtype), when)
    np.testing.assert_array_equal(lifted, when.codes["ambient"])


def test_a_plane_has_one_ambient_point_for_all_points(dtype, rng):
    made = ambient.effect(PLANE)
    assert made.init is None
    assert made.tables == (Table("ambient", MOMENT, 3),)
    when = condition(dtype)
    points = jnp.asarray(rng.normal(size=(5, 3)), dtype)
    for point in points:
        found = ambient.ambient_point(PLANE, None, point, when)
        np.testing.assert_array_equal(found, when.codes["ambient"])
    lifted = jax.vmap(lambda point: made.lift(None, point, when))(points)
    exact = waves(np.asarray(when.codes["ambient"], np.float64), 1, [1])
    np.testing.assert_allclose(lifted, np.tile(exact, (5, 1)), atol=1e-6)


def test_a_bent_slice_shares_the_code_of_the_warp_and_starts_flat():
    spec = AmbientSpec()
    assert ambient.effect(spec).tables == (Table("motion", MOMENT, 8),)
    params = ambient.effect(spec).init(jax.random.key(0))
    weight = np.asarray(params.heads["ambient"].weight)
    # of 128 numbers the deviation is known to 6 %
    assert abs(np.std(weight) / 1e-5 - 1) < 0.2
    rng = np.random.default_rng(0)
    points = jnp.asarray(rng.uniform(-1, 1, (200, 3)), jnp.float32)
    codes = {"motion": jnp.full(8, 0.05)}
    when = FrameCondition(jnp.asarray(0.0), codes, jnp.int32(0))
    found = jax.vmap(lambda x: ambient.ambient_point(spec, params, x, when))(points)
    # 64 features of size one, each times 1e-5, of random sign
    assert 0 < np.abs(found).max() < 1e-3
    hidden = mlp.hidden_features(
        ambient.network(spec), params, jnp.ones(ambient.network(spec).inputs)
    )
    assert hidden.shape == (64,)


def test_a_slice_has_its_slopes_in_point_code_and_weights(float64, rng):
    params, when = bent_params(float64), condition(float64, 7000)
    made = ambient.effect(BENT)
    pull = jnp.asarray(rng.normal(size=made.lift_width))

    def read(params, point, code):
        seen = when._replace(codes={"motion": code})
        return pull @ made.lift(params, point, seen)

    point = jnp.asarray(rng.uniform(-1, 1, 3))
    error = gradients.directional_error(
        read, params, point, when.codes["motion"], step=1e-6
    )
    assert error < 1e-6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "curved"}, "unknown kind of slice 'curved'.*bent"),
        ({"dims": 0}, "dims=0 must be at least 1.*none"),
        ({"code_width": 0}, "code_width=0"),
        ({"anneal_steps": 0}, "anneal_steps=0"),
        ({"closed_steps": -1}, "closed_steps=-1"),
        ({"skips": (9,)}, "layer 9 is not in 1 .. 5"),
        ({"width": 0}, "width=0"),
    ],
)
def test_wrong_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        AmbientSpec(**changes)
