"""Neighbor graph and the consistency of embeddings over it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core import splats as rows
from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.losses import neighbors
from gaussians_jax.losses.neighbors import Neighbors, NeighborSpec
from nerfies_jax.training.effects import PenaltyContext, weighted_sum
from tests import gradients
from tests.gaussians.shared import finite, full, jitted, put

FEW = NeighborSpec(count=4)
value_and_slope = jitted(jax.value_and_grad(neighbors.inconsistency))


def scene(mean, active=None, width=3, dtype="float32"):
    """Gaussians at given places with random embeddings under "code"."""
    count, rng = len(mean), np.random.default_rng(0)
    active = np.ones(count, bool) if active is None else active
    splats = Splats(
        np.asarray(mean, np.float64),
        *(np.zeros((count, n)) for n in (3, 4)),
        np.where(active, 0, rows.INACTIVE_LOGIT),
        *(np.zeros((count, n, 3)) for n in (1, 0)),
    )
    code = rng.normal(size=(count, width))
    return put(Params({"splats": splats, "code": code}, {}), dtype)


def graph_of(spec, *args, extent=1.0, **options):
    """A scene's codes, and its graph as NumPy arrays."""
    params = scene(*args, **options)
    graph = neighbors.find(spec, params, extent=extent)
    return params.rows["code"], jax.tree.map(np.asarray, graph)


def some_places(count=40, seed=1):
    return np.random.default_rng(seed).normal(size=(count, 3))


def listed(graph, row):
    """The neighbors of a row that have a weight."""
    return set(graph.neighbor[row][graph.weight[row] > 0].tolist())


@pytest.mark.parametrize("scale", ["extent", "spacing", *full("units")])
def test_the_graph_is_that_of_all_distances(scale, dtype):
    places = some_places()
    active = np.arange(40) % 5 != 2
    spec = NeighborSpec(count=6, gamma=3.0, scale=scale)
    _, graph = graph_of(spec, places, active, dtype=dtype, extent=0.7)

    places = places.astype(dtype).astype(float)
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    apart[:, ~active] = np.inf
    np.fill_diagonal(apart, np.inf)
    nearest = np.argsort(apart, axis=1)[:, :6]
    distance = np.take_along_axis(apart, nearest, axis=1)
    unit = {
        "units": 1,
        "extent": 0.7,
        "spacing": np.median(distance[active][:, -1]) / 0.03,
    }[scale]
    weight = np.exp(-3.0 * (distance / unit) ** 2)
    weight[~active] = 0
    nearest[~active] = np.flatnonzero(~active)[:, None]
    np.testing.assert_array_equal(graph.neighbor, nearest)
    tolerance = {"float32": 1e-6, "float64": 1e-13}[dtype]
    np.testing.assert_allclose(graph.weight, weight, rtol=tolerance)
    assert (graph.neighbor.dtype, graph.weight.dtype) == (jnp.int32, jnp.dtype(dtype))


@pytest.mark.hard_cases
def test_the_weight_is_that_of_the_published_code():
    """0.82 at a hundredth of a unit; the printed form has 2e-9 there, 0 from 0.044."""
    _, graph = graph_of(NeighborSpec(scale="units"), [[0, 0, 0], [0.01, 0, 0]])
    np.testing.assert_allclose(graph.weight[:, 0], 0.8187308, rtol=1e-6)


@pytest.mark.hard_cases
def test_weights_by_spacing_do_not_depend_on_the_unit():
    places, spec = some_places(), NeighborSpec(count=5)
    (_, graph), (_, large) = (graph_of(spec, size * places) for size in (1, 1e3))
    np.testing.assert_array_equal(graph.neighbor, large.neighbor)
    np.testing.assert_allclose(graph.weight, large.weight, rtol=1e-5)
    middle = np.median(graph.weight[:, -1])
    np.testing.assert_allclose(middle, np.exp(-2000 * 0.03**2), rtol=1e-6)


@pytest.mark.hard_cases
@pytest.mark.parametrize("active_count", [0, 1, 2, *full(4)])
def test_with_few_active_rows_the_rest_names_itself(active_count, dtype):
    active = np.isin(np.arange(8), [6, 1, 3, 4][:active_count])
    code, graph = graph_of(FEW, some_places(8), active, dtype=dtype)
    others = set(np.flatnonzero(active).tolist())
    for row in range(8):
        assert listed(graph, row) == (others - {row} if active[row] else set())
        assert (graph.neighbor[row][graph.weight[row] == 0] == row).all()
    value, grad = value_and_slope(code, graph, active)
    assert finite((value, grad))
    assert (active_count >= 2) == grad.any()
    assert not grad[~active].any()


@pytest.mark.hard_cases
@pytest.mark.parametrize("copies", [2, *full(5, 12)])
def test_clones_at_one_place_are_neighbors_but_never_oneself(copies, dtype):
    """Densification puts a clone onto its parent; the nearest distance is then zero."""
    places = np.repeat(some_places(6), copies, axis=0)
    _, graph = graph_of(FEW, places, dtype=dtype)
    for row in range(len(places)):
        assert row not in graph.neighbor[row]
        assert len(set(graph.neighbor[row].tolist())) == 4
        alike = graph.neighbor[row] // copies == row // copies
        assert alike.sum() == min(copies - 1, 4)
        np.testing.assert_array_equal(graph.weight[row][alike], 1)
    assert np.isfinite(graph.weight).all()


def slow_inconsistency(code, graph, active, count):
    total, pairs = 0.0, 0
    for i in np.flatnonzero(active):
        for k, w in zip(graph.neighbor[i], graph.weight[i], strict=True):
            total += np.sqrt(w * np.sum((code[i] - code[k]) ** 2) + 1e-20)
        pairs += count
    return total / pairs


def test_the_penalty_is_the_sum_over_all_pairs(dtype):
    active = np.arange(40) % 7 != 3
    spec = NeighborSpec(count=6)
    code, graph = graph_of(spec, some_places(), active, width=5, dtype=dtype)
    value, _ = value_and_slope(code, graph, active)
    exact = graph._replace(weight=graph.weight.astype(float))
    expected = slow_inconsistency(np.asarray(code, np.float64), exact, active, 6)
    assert value.dtype.name == dtype
    np.testing.assert_allclose(
        value, expected, rtol={"float32": 1e-6, "float64": 1e-13}[dtype]
    )


def test_few_neighbors_are_averaged_over_those_there_are(float64):
    active = np.arange(8) < 3
    spec = NeighborSpec(count=6, gamma=0.0)
    code, graph = graph_of(spec, some_places(8), active, dtype="float64")
    value, _ = value_and_slope(code, graph, active)
    code = np.asarray(code)[:3]
    apart = np.linalg.norm(code[:, None] - code, axis=-1)
    # The three rows' idle places cost the floor's 1e-10 each.
    np.testing.assert_allclose(value, apart.sum() / 6, atol=1e-9)


def test_gradients_of_the_penalty(float64):
    active, spec = np.arange(40) % 7 != 3, NeighborSpec(count=6)
    code, graph = graph_of(spec, some_places(), active, width=5, dtype="float64")
    graph, active = put(graph), put(active)

    def total(code):
        return neighbors.inconsistency(code, graph, active)

    assert gradients.directional_error(total, code) < 1e-7


@pytest.mark.hard_cases
@pytest.mark.parametrize("kind", ["bfloat16", "float32", *full("float16")])
@pytest.mark.parametrize("apart", [0.0, 1e-30, 1e-12, 1e-6, 1.0])
def test_slopes_are_finite_and_bounded_where_embeddings_meet(kind, apart):
    """1e-20 is 0 in float16, and the square root's slope at 0 is infinite."""
    kind = jnp.dtype(kind)
    graph = Neighbors(np.int32([[1], [0]]), np.full((2, 1), 0.25, kind))
    code = np.asarray([[0.0, 0.0], [apart, 0.0]], kind)
    value, grad = value_and_slope(code, graph, np.ones(2, bool))
    assert np.isfinite(np.asarray(value, np.float64))
    size = np.linalg.norm(np.asarray(grad, np.float64), axis=1)
    # Each row is in two of the pairs, which count 1 / 2 each: sqrt(w) at most.
    assert (size <= 0.5 * 1.01).all()
    assert apart > 0 or not size.any()


@pytest.mark.hard_cases
def test_weights_that_vanish_bring_neither_loss_nor_slope(dtype):
    places = [[0, 0, 0], [1, 0, 0], [0, 3, 0]]
    code, graph = graph_of(NeighborSpec(scale="units"), places, dtype=dtype)
    assert not graph.weight.any()
    value, grad = value_and_slope(code, graph, np.ones(3, bool))
    np.testing.assert_allclose(value, 1e-9, rtol=1e-6)  # 20 floors of 2 neighbors
    assert not grad.any()


def test_the_effect_weighs_and_waits_for_its_start():
    params = scene(some_places())
    spec = NeighborSpec(weight=0.5, start=10)
    regularizer = neighbors.Bound(spec, extent=1.0, of="code")
    graph = regularizer.state(params)

    def penalty(params, graph, step):
        context = PenaltyContext(None, step, None, params, state=graph)
        terms = regularizer.loss(params, context)
        return weighted_sum(terms), terms["linked"].value

    program = jax.jit(penalty).lower(params, graph, np.int32(9)).compile()
    assert "conditional" in program.as_text()
    assert program(params, graph, np.int32(9))[0] == 0
    loss, linked_term = program(params, graph, np.int32(10))
    expected, _ = value_and_slope(params.rows["code"], graph, np.ones(40, bool))
    np.testing.assert_allclose(loss, 0.5 * expected, rtol=1e-6)
    linked = np.mean(np.asarray(graph.weight) > 1e-3)
    np.testing.assert_allclose(linked_term, linked, rtol=1e-6)
    assert linked > 0.5
    absent = neighbors.Bound(NeighborSpec(), extent=1.0, of="kan_motion")
    with pytest.raises(
        ValueError, match=r"no per-Gaussian parameters .kan_motion.*code"
    ):
        absent.state(params)
