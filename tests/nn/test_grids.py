"""Features from tables against SciPy and plain integers, and where cells meet."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate

from nerfies_jax.nn import grids
from nerfies_jax.nn.grids import HashGridSpec
from tests import gradients

SPEC = HashGridSpec(levels=3, coarsest=2, finest=8, rows=100)  # the last is hashed
encode = jax.jit(grids.encode, static_argnums=0)
level = jax.jit(grids.level_features, static_argnums=2)


def filled(spec, dtype, seed=0):
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(lambda key: grids.init(spec, key), jax.random.key(0))
    return jax.tree.map(lambda x: rng.normal(size=x.shape).astype(dtype), shapes)


def hashed(vertex, rows):
    """Of Python's integers, of any length."""
    primes = (1, 2654435761, 805459861)
    x, y, z = (int(v) * p % 2**32 for v, p in zip(vertex, primes, strict=True))
    return (x ^ y ^ z) % rows


def test_a_level_is_trilinear_between_its_vertices(dtype, rng):
    cells, table = 4, rng.normal(size=(125, 2)).astype(dtype)
    axes = [np.arange(5) / cells] * 3
    values = table.reshape(5, 5, 5, 2).transpose(2, 1, 0, 3)  # x runs fastest
    oracle = scipy.interpolate.RegularGridInterpolator(axes, values)
    places = rng.uniform(size=(40, 3))
    actual = [level(table, place.astype(dtype), cells) for place in places]
    atol = 2e-6 if dtype == "float32" else 1e-14
    np.testing.assert_allclose(actual, oracle(places), rtol=0, atol=atol)


def test_vertices_without_a_row_of_their_own_share_by_the_hash(rng):
    vertices = rng.integers(0, 4096, (50, 3))
    actual = jax.jit(grids.vertex_row, static_argnums=(1, 2))(
        vertices.astype(np.int32), 4096, 1000
    )
    assert actual.tolist() == [hashed(vertex, 1000) for vertex in vertices]


@pytest.mark.parametrize("edge", [0.0, 0.25, 0.5, 1.0])
def test_cells_agree_where_they_meet(edge, dtype, rng):
    table = rng.normal(size=(125, 2)).astype(dtype)
    tiny = np.finfo(dtype).eps
    sides = [np.clip(edge * (1 + k * tiny), 0, 1) for k in (-1, 0, 1)]
    actual = np.array(
        [level(table, np.array([s, 0.4, 0.9], dtype), 4) for s in sides], np.float64
    )
    assert np.abs(np.diff(actual, axis=0)).max() < 20 * tiny
    at_vertex = level(table, np.full(3, edge, dtype), 4)
    number = round(4 * edge)
    np.testing.assert_array_equal(at_vertex, table[number * (1 + 5 + 25)])


def test_space_is_contracted_into_twice_the_box(dtype):
    points = np.array(
        [[0, 0, 0], [1, -1, 0.5], [2, 0, 1], [-4, 4, 1], [1e30, -3, 0]], dtype
    )
    wanted = [[0, 0, 0], [1, -1, 0.5], [1.5, 0, 0.75], [-1.75, 1.75, 0.4375], [2, 0, 0]]
    actual = jax.vmap(grids.contract)(points)
    np.testing.assert_allclose(actual, wanted, rtol=0, atol=1e-6)
    slopes = jax.vmap(jax.jacfwd(grids.contract))(points)
    assert np.isfinite(slopes).all()
    assert np.abs(np.asarray(slopes[0]) - np.eye(3)).max() == 0


def test_beyond_the_box_are_the_features_of_its_side(dtype):
    spec = HashGridSpec(levels=3, coarsest=2, finest=8, rows=100, contract=False)
    tables = filled(spec, dtype)
    outside = encode(spec, tables, np.array([3, 0.2, -7], dtype))
    np.testing.assert_array_equal(
        outside, encode(spec, tables, np.array([1, 0.2, -1], dtype))
    )


def test_a_shut_level_adds_nothing(dtype):
    tables, point = filled(SPEC, dtype), np.array([0.3, -0.2, 0.7], dtype)
    whole = np.asarray(encode(SPEC, tables, point))
    part = encode(SPEC, tables, point, np.array([1, 0.5, 0], dtype))
    np.testing.assert_array_equal(part, whole * np.repeat([1, 0.5, 0], 2).astype(dtype))


@pytest.mark.parametrize("place", [(0.3, -0.21, 0.71), (1.7, -0.2, 4.0)])
def test_gradients_match_central_differences(place, float64):
    tables, weight = filled(SPEC, np.float64), np.random.default_rng(1).normal(size=6)

    def total(tables, point):
        return jnp.sum(weight * grids.encode(SPEC, tables, point))

    point = np.array(place, np.float64)
    assert gradients.directional_error(total, tables, point) < 1e-7


def test_slopes_have_slopes_and_values_beside_them_are_the_same(float64):
    """Losses read normals: the gradient by position has gradients by table entries."""
    tables = filled(SPEC, np.float64)
    weight = np.random.default_rng(1).normal(size=6)
    point = jnp.array([0.3, -0.21, 0.71])

    @jax.jit
    def total(tables, point):
        return jnp.sum(weight * grids.encode(SPEC, tables, point))

    @jax.jit
    def steepness(tables, point):
        return jnp.sum(jnp.square(jax.grad(total, 1)(tables, point)))

    assert gradients.directional_error(steepness, tables, point) < 1e-7
    value, _ = jax.jit(jax.value_and_grad(total))(tables, point)
    np.testing.assert_allclose(value, total(tables, point), rtol=1e-14)


def test_total_variation_is_the_mean_over_neighbors(float64, rng):
    table = rng.normal(size=(27, 2))
    grid = table.reshape(3, 3, 3, 2)
    pairs = [
        np.mean((np.delete(grid, 0, axis) - np.delete(grid, -1, axis)) ** 2)
        for axis in range(3)
    ]
    actual = jax.jit(grids.total_variation, static_argnums=1)(table, 2)
    np.testing.assert_allclose(actual, np.mean(pairs), rtol=1e-14)
    with pytest.raises(ValueError, match="use variation_at_random for hashed levels"):
        grids.total_variation(jnp.asarray(table[:20]), 2)


def test_variation_at_random_is_that_of_every_level_hashed_or_not(float64):
    """Every pair of neighbors of each level in a loop; the last one is hashed."""
    tables, key = filled(SPEC, np.float64), jax.random.key(0)
    pairs = []
    for table, cells in zip(tables, SPEC.cells(), strict=True):
        side = range(cells + 1)
        own = len(table) >= (cells + 1) ** 3

        def row(*v, own=own, cells=cells, rows=len(table)):
            along = v[0] + (cells + 1) * (v[1] + (cells + 1) * v[2])
            return along if own else hashed(v, rows)

        level = []
        for vertex in itertools.product(side, side, side):
            for axis in range(3):
                beyond = [v + (k == axis) for k, v in enumerate(vertex)]
                if max(beyond) <= cells:
                    level.append((table[row(*vertex)] - table[row(*beyond)]) ** 2)
        pairs.append(np.mean(level))
    vary = jax.jit(grids.variation_at_random, static_argnums=(0, 3))
    actual = vary(SPEC, tables, key, 20_000)
    assert abs(actual / np.mean(pairs) - 1) < 0.02  # six sigmas

    def few(tables):
        return grids.variation_at_random(SPEC, tables, key, 5)

    assert gradients.directional_error(few, tables) < 1e-7
    even = jax.tree.map(jnp.ones_like, tables)
    assert all((slope == 0).all() for slope in jax.jit(jax.grad(few))(even))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"levels": 0}, "levels=0"),
        ({"rows": 4}, "rows=4"),
        ({"coarsest": 32, "finest": 16}, "coarsest=32 and finest=16"),
        ({"half_side": 0.0}, "half_side=0.0"),
    ],
)
def test_a_wrong_grid_is_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        HashGridSpec(**wrong)
