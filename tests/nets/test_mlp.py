"""Multilayer perceptrons against NumPy loops and the Nerfies code's weights."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.geometry import lie
from nerfies_jax.nets import encoding, mlp
from nerfies_jax.nets.mlp import HeadSpec, MLPSpec
from tests import gradients

SPEC = MLPSpec(
    inputs=5,
    depth=4,
    width=7,
    heads=(("shift", HeadSpec(3, "small")), ("density", HeadSpec(1))),
    skips=(2,),
    activation="softplus",
)


def by_hand(spec, params, x):
    """Neuron by neuron in Python floats."""
    activations = {
        "relu": lambda v: max(v, 0.0),
        "softplus": lambda v: math.log1p(math.exp(v)),
        "silu": lambda v: v / (1 + math.exp(-v)),
        "tanh": math.tanh,
        "sine": math.sin,
        "none": lambda v: v,
    }

    def affine(layer, values):
        weight, bias = (np.asarray(leaf, np.float64) for leaf in layer)
        assert weight.shape[0] == len(values)
        return [
            bias[j] + sum(values[i] * weight[i, j] for i in range(len(values)))
            for j in range(weight.shape[1])
        ]

    hidden = list(x)
    for index, layer in enumerate(params.hidden):
        if index in spec.skips:
            hidden = hidden + list(x)
        hidden = [activations[spec.activation](v) for v in affine(layer, hidden)]
    return {name: affine(layer, hidden) for name, layer in params.heads.items()}


@pytest.mark.parametrize("activation", mlp.ACTIVATIONS)
def test_outputs_neuron_by_neuron(activation, dtype, rng):
    spec = dataclasses.replace(SPEC, activation=activation)
    params = mlp.init(spec, jax.random.key(0), jnp.dtype(dtype))
    # biases that are not zero, so that a lost bias shows
    params = jax.tree.map(lambda x: x + jnp.asarray(0.1, dtype), params)
    inputs = jnp.asarray(rng.normal(size=(6, 5)), dtype)
    batch = mlp.apply(spec, params, inputs)
    for row in range(6):
        truth = by_hand(spec, params, np.asarray(inputs[row], np.float64))
        one = mlp.apply(spec, params, inputs[row])
        for name, value in truth.items():
            assert one[name].dtype == dtype
            bound = {"float32": 1e-5, "float64": 1e-13}[dtype]
            np.testing.assert_allclose(one[name], value, rtol=bound, atol=bound)
            np.testing.assert_allclose(batch[name][row], value, rtol=bound, atol=bound)


def test_gradients(float64, rng):
    params = mlp.init(SPEC, jax.random.key(1), jnp.float64)
    inputs = jnp.asarray(rng.normal(size=5))

    def total(params, inputs):
        heads = mlp.apply(SPEC, params, inputs)
        return jnp.sum(1e4 * heads["shift"] ** 2) + jnp.sum(heads["density"])

    assert gradients.directional_error(total, params, inputs) < 1e-6


def test_initial_weights_have_the_promised_spread(dtype):
    key = jax.random.key(2)
    for name, variance in (("glorot", 2 / (400 + 200)), ("he", 2 / 400)):
        weight, bias = mlp.init_layer(key, 400, 200, name, jnp.dtype(dtype))
        assert weight.dtype == bias.dtype == dtype
        assert abs(np.var(weight) / variance - 1) < 0.02  # 80 000 draws
        assert abs(np.mean(weight)) < 4 * math.sqrt(variance / weight.size)
        assert np.all(bias == 0)
    assert np.all(mlp.init_layer(key, 4, 3, "zero").weight == 0)
    small = mlp.init_layer(key, 400, 200, "small").weight
    assert 0.99e-4 < np.max(small) <= 1e-4
    assert -1e-4 <= np.min(small) < -0.99e-4  # two-sided


@pytest.mark.full
def test_both_precisions_start_from_the_same_weights():
    with jax.enable_x64(True):
        wide = mlp.init(SPEC, jax.random.key(3), jnp.float64)
    narrow = mlp.init(SPEC, jax.random.key(3))
    for one, other in zip(jax.tree.leaves(wide), jax.tree.leaves(narrow), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def test_layers_are_drawn_independently():
    params = mlp.init(dataclasses.replace(SPEC, skips=()), jax.random.key(4))
    first, second = params.hidden[1].weight, params.hidden[2].weight
    assert first.shape == second.shape
    assert not np.any(first == second)


def test_without_hidden_layers_heads_read_the_input():
    spec = MLPSpec(inputs=2, depth=0, width=8, heads=(("out", HeadSpec(2)),))
    params = mlp.init(spec, jax.random.key(0))
    inputs = jnp.asarray([1.0, -2.0])
    out = mlp.apply(spec, params, inputs)["out"]
    np.testing.assert_allclose(out, inputs @ params.heads["out"].weight, rtol=1e-6)


@pytest.mark.full
def test_nerfies_warp_field(oracle_dir, float64):
    """Nerfies' own trained-like screw field, from its weights: points and Jacobians.

    Encoding with its window, code, skip, heads and screw, all of these floors at once.
    """
    values = np.load(oracle_dir / "nerfies.npz")
    field = "params/live/warp_field/"

    def layer(name):
        leaves = (values[f"{field}{name}/{leaf}"] for leaf in ("kernel", "bias"))
        return mlp.Layer(*(jnp.asarray(np.array(x, np.float64)) for x in leaves))

    heads = tuple((name, HeadSpec(3)) for name in "wv")
    spec = MLPSpec(inputs=59, depth=6, width=128, heads=heads, skips=(4,))
    params = mlp.MLP(
        hidden=tuple(layer(f"trunk/hidden_{i}") for i in range(6)),
        heads={name: layer(f"branches_{name}/logit") for name in "wv"},
    )
    fresh = mlp.init(spec, jax.random.key(0), jnp.float64)
    assert jax.tree.map(jnp.shape, fresh) == jax.tree.map(jnp.shape, params)
    table = np.array(values[field + "metadata_encoder/embed/embedding"], np.float64)
    window = encoding.anneal(8, jnp.asarray(4.25))

    def warp(point, code):
        features = encoding.encode(encoding.EncodingSpec(8), point, window)
        screw = mlp.apply(spec, params, jnp.concatenate([features, code]))
        return lie.transform_point(screw["w"], screw["v"], point)

    points = jnp.asarray(np.array(values["f64/live/coarse/points"])).reshape(-1, 3)
    ids = np.repeat(values["in/id_warp"][:, 0], 16)
    chosen = jnp.asarray(table[ids])
    warped = jax.jit(jax.vmap(warp))(points, chosen)
    jacobian = jax.jit(jax.vmap(jax.jacfwd(warp)))(points, chosen)
    truth = values["f64/live/coarse/warped_points"].reshape(-1, 3)
    np.testing.assert_allclose(warped, truth, rtol=1e-12, atol=1e-13)
    truth = values["f64/live/coarse/warp_jacobian"].reshape(-1, 3, 3)
    np.testing.assert_allclose(jacobian, truth, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inputs": 0}, "inputs=0"),
        ({"depth": -1}, "depth=-1"),
        ({"skips": (0,)}, "layer 0 is not in 1 .. 3"),
        ({"skips": (4,)}, "layer 4 is not in 1 .. 3"),
        ({"activation": "swish"}, "'swish'; choose from"),
        ({"init": "xavier"}, "'xavier'; choose from"),
        ({"heads": (("a", HeadSpec(1)), ("a", HeadSpec(2)))}, "different names"),
    ],
)
def test_impossible_networks_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SPEC, **changes)


def test_impossible_heads_are_refused():
    with pytest.raises(ValueError, match="width=0"):
        HeadSpec(0)
    with pytest.raises(ValueError, match="initialiser"):
        HeadSpec(1, "one")


@pytest.mark.parametrize("skips", [(1, 2), pytest.param((), marks=pytest.mark.full)])
def test_inputs_known_beforehand_may_be_summed_once(skips, dtype):
    """Against the network that reads them with every row."""
    heads = (("out", HeadSpec(4)),)
    spec = MLPSpec(7, 3, 8, heads, skips, "softplus")
    params = mlp.init(spec, jax.random.key(0), jnp.dtype(dtype))
    rows = jax.random.normal(jax.random.key(1), (5, 4), dtype)
    known = jax.random.normal(jax.random.key(2), (3,), dtype)
    whole = jnp.concatenate([rows, jnp.broadcast_to(known, (5, 3))], axis=1)
    rest = dataclasses.replace(spec, inputs=4)
    ours = mlp.apply(rest, mlp.with_known(spec, params, known), rows)["out"]
    theirs = mlp.apply(spec, params, whole)["out"]
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(ours, theirs, atol=tolerance)


@functools.partial(jax.jit, static_argnums=0)
def heads_and_slopes(spec, params, inputs):
    def total(params, inputs):
        found = mlp.apply(spec, params, inputs)
        return sum(jnp.sum(head) for head in found.values()), found

    grads, found = jax.grad(total, has_aux=True)(params, inputs)
    return found, grads


@pytest.mark.full
@pytest.mark.hard_cases
@pytest.mark.parametrize("activation", mlp.ACTIVATIONS)
def test_bfloat16_is_finite_and_near(activation, rng):
    """Parameters and inputs of eight bits: outputs as near, slopes finite."""
    heads = (("shift", HeadSpec(3)), ("density", HeadSpec(1)))
    spec = MLPSpec(5, 2, 7, heads, skips=(1,), activation=activation)
    shapes = jax.eval_shape(lambda key: mlp.init(spec, key), jax.random.key(0))

    def draw(leaf):
        # As initialised: weights of variance 2 / (inputs + outputs), biases of zero.
        weights = len(leaf.shape) > 1
        spread = np.sqrt(2 / sum(leaf.shape)) if weights else 0.0
        return (spread * rng.normal(size=leaf.shape)).astype(jnp.bfloat16)

    params = jax.tree.map(draw, shapes)
    inputs = rng.normal(size=(32, 5)).astype(jnp.bfloat16)
    wide = jax.tree.map(lambda x: x.astype(np.float32), (params, inputs))
    (narrow, grads), (exact, wanted) = (
        jax.tree.map(np.asarray, heads_and_slopes(spec, *args))
        for args in ((params, inputs), wide)
    )
    for name, value in narrow.items():
        assert value.dtype == jnp.bfloat16
        off = np.abs(np.asarray(value, np.float32) - exact[name])
        # Three roundings to 2^-9 on the way
        assert off.max() < 0.03 * np.abs(exact[name]).max()
    for grad, truth in zip(*map(jax.tree.leaves, (grads, wanted)), strict=True):
        assert grad.dtype == jnp.bfloat16
        off = np.abs(np.asarray(grad, np.float32) - truth)
        assert off.max() <= 0.03 * np.abs(truth).max()
