"""Multilayer perceptrons against NumPy loops and the Nerfies code's weights."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.nn import mlp
from nerfies_jax.nn.mlp import HeadSpec, MLPSpec
from tests import gradients, random_params
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
    return random_params.like(lambda key: mlp.init(spec, key), dtype, 0.1)


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


@functools.partial(jax.jit, static_argnums=0)
def heads_and_slopes(spec, params, inputs):
    def total(params, inputs):
        heads = mlp.apply(spec, params, inputs)
        return sum(jnp.sum(head) for head in heads.values()), heads

    grads, heads = jax.grad(total, has_aux=True)(params, inputs)
    return heads, grads


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
