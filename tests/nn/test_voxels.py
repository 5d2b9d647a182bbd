"""A dense grid read at several distances, against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate

from nerfies_jax.nn import voxels
from nerfies_jax.nn.voxels import VoxelGridSpec
from tests import gradients
from tests.oracles import networks

SPEC = VoxelGridSpec(cells=8, features=2, bands=2, contract=False)
encode = jax.jit(voxels.encode, static_argnums=0)


def filled(dtype, seed=0):
    table = np.random.default_rng(seed).normal(size=(9**3, 2))
    return (jnp.asarray(table, dtype),)


def by_hand(table, point):
    """Every fourth, every second and every vertex; then their waves."""
    grid = np.asarray(table, np.float64).reshape(9, 9, 9, 2).transpose(2, 1, 0, 3)
    features = []
    for stride in (4, 2, 1):
        seen = grid[::stride, ::stride, ::stride]
        axes = [np.linspace(-1, 1, len(seen))] * 3
        features.append(scipy.interpolate.RegularGridInterpolator(axes, seen)(point)[0])
    return networks.waves(voxels.EncodingSpec(2), np.concatenate(features))


def test_features_are_those_of_three_grids_in_one(dtype, rng):
    (table,) = tables = filled(dtype)
    for point in rng.uniform(-1, 1, (20, 3)):
        actual = encode(SPEC, tables, point.astype(dtype))
        assert actual.dtype == dtype
        assert actual.shape == (SPEC.width(3),)
        atol = 2e-5 if dtype == "float32" else 1e-13
        np.testing.assert_allclose(actual, by_hand(table, point), rtol=0, atol=atol)


@pytest.mark.hard_cases
@pytest.mark.parametrize("corner", [-1.0, 0.0, 1.0, 9.0])
def test_all_distances_meet_at_a_vertex_of_all(corner, dtype):
    (table,) = tables = filled(dtype)
    actual = encode(SPEC, tables, np.full(3, corner, dtype))
    vertex = {-1.0: 0, 0.0: 4}.get(corner, 8) * (1 + 9 + 81)
    np.testing.assert_array_equal(actual[:6], np.tile(table[vertex], 3))


def test_before_the_last_stride_opens_only_the_vertices_of_wider_ones_learn(rng):
    point = rng.uniform(-1, 1, (64, 3)).astype(np.float32)

    def total(table, window):
        actual = jax.vmap(lambda p: voxels.encode(SPEC, (table,), p, window))(point)
        return jnp.sum(actual[:, :6])

    slopes = jax.jit(jax.grad(total))
    window = jnp.asarray([1.0, 0.5, 0.0])
    learn = np.asarray(slopes(filled("float32")[0], window)).any(1).reshape(9, 9, 9)
    even = np.zeros_like(learn)
    even[::2, ::2, ::2] = True
    assert learn.any()
    assert not (learn & ~even).any()


@pytest.mark.parametrize("contract", [True, False])
def test_gradients_match_central_differences(contract, float64):
    spec = VoxelGridSpec(cells=4, features=2, bands=1, contract=contract)
    rng = np.random.default_rng(1)
    table, weight = rng.normal(size=(125, 2)), rng.normal(size=spec.width(3))

    def total(table, point):
        return jnp.sum(weight * voxels.encode(spec, (table,), point))

    point = np.array((0.3, -0.21, 0.71))
    assert gradients.directional_error(total, table, point) < 1e-7


def test_a_grid_starts_as_nothing_and_learns(dtype, rng):
    (table,) = tables = voxels.init(SPEC, dtype=dtype)
    assert table.shape == (9**3, 2)
    assert not table.any()
    point = jnp.asarray(rng.uniform(-1, 1, 3), dtype)
    slopes = jax.grad(lambda t: jnp.sum(voxels.encode(SPEC, t, point)))(tables)
    assert np.abs(slopes[0]).max() > 0.1


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"cells": 0}, "cells=0"),
        ({"cells": 4096}, "cells=4096"),
        ({"features": 0}, "features=0"),
        ({"cells": 10}, r"strides=\(4, 2, 1\).*divide cells=10"),
        ({"strides": ()}, "not be empty"),
        ({"half_side": 0.0}, "half_side=0.0"),
        ({"bands": 30}, "bands=30"),
    ],
)
def test_a_wrong_grid_is_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        VoxelGridSpec(**wrong)
