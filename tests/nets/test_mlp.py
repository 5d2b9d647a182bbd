"""Multilayer perceptrons against NumPy loops and the Nerfies code's weights."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.nets import mlp
from nerfies_jax.nets.mlp import HeadSpec, MLPSpec
from tests import drawn, gradients
from tests.oracles import networks

SPEC = MLPSpec(
    inputs=5,
    depth=4,
    width=7,
    heads=(("shift", HeadSpec(3, "small")), ("density", HeadSpec(1))),
    skips=(2,),
    activation="softplus",
)


EXACT = {
    "relu": networks.rectified,
    "softplus": lambda x: np.log1p(np.exp(x)),
    "silu": lambda x: x / (1 + np.exp(-x)),
    "tanh": np.tanh,
    "sine": np.sin,
    "none": lambda x: x,
}


def by_hand(spec, params, x):
    return networks.heads(params, x, spec.skips, EXACT[spec.activation])


apply = jax.jit(mlp.apply, static_argnums=0)


def drawn_net(spec, dtype):
    """With biases that are not zero, so that a lost one shows."""
    return drawn.params(lambda key: mlp.init(spec, key), dtype, 0.1)


@pytest.mark.parametrize(
    "spec",
    [
        *(dataclasses.replace(SPEC, activation=name) for name in mlp.ACTIVATIONS),
        dataclasses.replace(SPEC, depth=0, skips=()),
    ],
    ids=lambda spec: spec.activation if spec.depth else "no layers",
)
def test_outputs_neuron_by_neuron(spec, dtype, rng):
    params = drawn_net(spec, dtype)
    inputs = rng.normal(size=(6, 5)).astype(dtype)
    batch = jax.tree.map(np.asarray, apply(spec, params, inputs))
    for row in range(6):
        truth = by_hand(spec, params, inputs[row].astype(np.float64))
        for name, value in truth.items():
            assert batch[name].dtype == dtype
            bound = {"float32": 1e-5, "float64": 1e-13}[dtype]
            np.testing.assert_allclose(batch[name][row], value, rtol=bound, atol=bound)


def test_gradients(float64, rng):
    def total(params, inputs):
        heads = mlp.apply(SPEC, params, inputs)
        return jnp.sum(heads["shift"] ** 2) + jnp.sum(heads["density"])

    params, inputs = drawn_net(SPEC, "float64"), rng.normal(size=5)
    assert gradients.directional_error(total, params, inputs) < 1e-6


@functools.partial(jax.jit, static_argnums=(1, 2))
def four_layers(key, shape, dtype):
    kinds = ("glorot", "he", "zero", "small")
    kind = jnp.dtype(dtype)
    return {name: mlp.init_layer(key, *shape, name, kind) for name in kinds}


def test_initial_weights_have_the_promised_spread(dtype):
    layers = four_layers(jax.random.key(2), (400, 200), dtype)
    layers = jax.tree.map(np.asarray, layers)
    for name, variance in (("glorot", 2 / (400 + 200)), ("he", 2 / 400)):
        weight, bias = layers[name]
        assert weight.dtype == bias.dtype == dtype
        assert abs(np.var(weight) / variance - 1) < 0.02  # 80 000 draws
        assert abs(np.mean(weight)) < 4 * math.sqrt(variance / weight.size)
        assert np.all(bias == 0)
    assert np.all(layers["zero"].weight == 0)
    small = layers["small"].weight
    assert 0.99e-4 < np.max(small) <= 1e-4
    assert -1e-4 <= np.min(small) < -0.99e-4  # two-sided


@pytest.mark.full
def test_both_precisions_start_from_the_same_weights_each_its_own():
    init = jax.jit(mlp.init, static_argnums=(0, 2))
    spec = dataclasses.replace(SPEC, skips=())
    with jax.enable_x64(True):
        wide = jax.tree.map(np.asarray, init(spec, jax.random.key(3), jnp.float64))
    narrow = jax.tree.map(np.asarray, init(spec, jax.random.key(3), jnp.float32))
    for one, other in zip(jax.tree.leaves(wide), jax.tree.leaves(narrow), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    first, second = narrow.hidden[1].weight, narrow.hidden[2].weight
    assert first.shape == second.shape
    assert not np.any(first == second)


@pytest.mark.parametrize("skips", [(1, 2), pytest.param((), marks=pytest.mark.full)])
def test_inputs_known_beforehand_may_be_summed_once(skips, dtype, rng):
    """Against the network that reads them with every row."""
    spec = MLPSpec(7, 3, 8, (("out", HeadSpec(4)),), skips, "softplus")
    params = drawn_net(spec, dtype)
    rows, known = rng.normal(size=(5, 4)).astype(dtype), rng.normal(size=3)
    known = known.astype(dtype)

    @jax.jit
    def ours(params, known, rows):
        rest = dataclasses.replace(spec, inputs=4)
        return mlp.apply(rest, mlp.with_known(spec, params, known), rows)["out"]

    whole = np.concatenate([rows, np.broadcast_to(known, (5, 3))], axis=1)
    theirs = [by_hand(spec, params, row.astype(np.float64))["out"] for row in whole]
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(ours(params, known, rows), theirs, atol=tolerance)


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
    params = drawn_net(spec, "bfloat16")
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
