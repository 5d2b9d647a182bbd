"""Modules of other libraries as networks, against their own calls."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.nn import adapters

X = np.linspace(-1, 1, 15, dtype=np.float32).reshape(5, 3)


def trained(network, one_by_one):
    """Outputs and the loss after ten steps of descent, all under `jit`."""
    call = network.apply
    if one_by_one:
        call = jax.vmap(network.apply, (None, 0))

    @jax.jit
    def run(key):
        params = network.init(key)
        first = call(params, X)
        for _ in range(10):
            grads = jax.grad(lambda p: jnp.mean(call(p, X) ** 2))(params)
            params = jax.tree.map(lambda p, g: p - 0.1 * g, params, grads)
        return first, call(params, X)

    first, last = run(jax.random.key(3))
    assert np.mean(last**2) < 0.9 * np.mean(first**2)
    return first


def test_an_equinox_module_is_a_network():
    eqx = pytest.importorskip("equinox")

    def make(key):
        return eqx.nn.MLP(3, 2, 8, 1, key=key)

    expected = jax.vmap(eqx.filter_jit(make)(jax.random.key(3)))(X)
    actual = trained(adapters.equinox(make), one_by_one=True)
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-6)


def test_a_linen_module_is_a_network():
    linen = pytest.importorskip("flax.linen")
    module = linen.Dense(2)
    expected, _ = module.init_with_output(jax.random.key(3), X)
    actual = trained(adapters.linen(module, X), one_by_one=False)
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-6)
    with pytest.raises(
        TypeError, match=r"`module` must be a flax\.linen\.Module, got a"
    ):
        adapters.linen(lambda x: x, X)


def test_an_nnx_module_is_a_network():
    nnx = pytest.importorskip("flax.nnx")

    def make(rngs):
        return nnx.Linear(3, 2, rngs=rngs)

    expected = make(nnx.Rngs(jax.random.key(3)))(X)
    actual = trained(adapters.nnx(make), one_by_one=False)
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-6)


def test_a_library_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "equinox", None)
    with pytest.raises(ImportError, match=r"pip install 'nerfies-jax\[equinox\]'"):
        adapters.equinox(lambda key: None)
