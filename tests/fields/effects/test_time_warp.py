"""TiNeuVox's motion and its smooth grid against loops in NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields.effects import time_warp
from nerfies_jax.fields.effects.time_warp import TimeWarpSpec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training.effects import FrameCondition
from tests import gradients, random_params
from tests.oracles import networks

SPEC = TimeWarpSpec(EncodingSpec(3), EncodingSpec(2), embedding=4, depth=3, width=7)


def at(time, dtype):
    return FrameCondition(jnp.asarray(time, dtype), {}, jnp.int32(0))


def by_hand(params, point, time):
    """(shift, what the radiance network reads), layer by layer in float64."""
    waves = networks.waves(SPEC.time, time)
    embedding = networks.heads(params.time, waves)["embedding"]
    read = np.concatenate([networks.waves(SPEC.position, point), embedding])
    return networks.heads(params.shift, read)["linear"], read


@pytest.mark.parametrize("time", [0.0, 0.37, 1.0])
def test_shift_and_features_are_those_of_the_layers(time, dtype, rng):
    params = random_params.like(lambda key: time_warp.init(SPEC, key), dtype, 0.3)
    points = rng.uniform(-1, 1, (4, 3)).astype(dtype)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def both(params, point):
        when = at(time, dtype)
        return SPEC.apply(params, point, when), SPEC.trunk_features(params, point, when)

    shifts, lifted = both(params, points)
    assert shifts.dtype == lifted.dtype == dtype
    assert lifted.shape == (4, SPEC.features)
    bound = {"float32": 2e-5, "float64": 1e-13}[dtype]
    for point, shift, features in zip(points, shifts, lifted, strict=True):
        expected = by_hand(params, np.asarray(point, np.float64), time)
        np.testing.assert_allclose(shift, expected[0], rtol=bound, atol=bound)
        np.testing.assert_allclose(features, expected[1], rtol=bound, atol=bound)


def test_it_starts_as_the_identity_and_does_not_stay_there(dtype, rng):
    spec = TimeWarpSpec()
    points = rng.uniform(-1, 1, (300, 3)).astype(dtype)
    moved = jax.vmap(functools.partial(time_warp.displace, spec), (None, 0, None))

    def total(params):
        shift = moved(params, points, at(0.4, dtype))
        return jnp.sum(shift**2), jnp.max(jnp.abs(shift))

    init = jax.jit(time_warp.init, static_argnums=(0, 2))
    start = init(spec, jax.random.key(0), jnp.dtype(dtype))
    slopes, longest = jax.jit(jax.grad(total, has_aux=True))(start)
    assert 0 < longest < 1e-4
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves(slopes.shift.heads))


def test_gradients(float64, rng):
    params = random_params.like(lambda key: time_warp.init(SPEC, key), "float64", 0.3)
    pull = rng.normal(size=SPEC.position.width(3) + SPEC.embedding)

    def total(params, point, time):
        when = FrameCondition(time, {}, jnp.int32(0))
        read = time_warp.features(SPEC, params, point, when)
        shift = time_warp.displace(SPEC, params, point, when)
        return pull @ read + jnp.sum(jnp.sin(shift))

    point = rng.uniform(-1, 1, 3)
    assert gradients.directional_error(total, params, point, np.float64(0.3)) < 1e-6
