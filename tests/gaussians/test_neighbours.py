"""Neighbour graph and the consistency of embeddings over it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import splats as rows
from gaussians_jax.effects import neighbours
from gaussians_jax.effects.neighbours import Neighbours, NeighbourSpec
from gaussians_jax.splats import Params, Splats
from nerfies_jax.training.effects import PenaltyContext, weighted_sum
from tests import gradients

FEW = NeighbourSpec(count=4)
inconsistency = jax.jit(neighbours.inconsistency)
value_and_slope = jax.jit(jax.value_and_grad(neighbours.inconsistency))


def scene(mean, active=None, width=3, dtype="float32", seed=0):
    """Gaussians at given places with random embeddings under "code"."""
    mean = np.asarray(mean, np.float64)
    count = len(mean)
    rng = np.random.default_rng(seed)
    rest = (np.zeros((count, *shape)) for shape in [(3,), (4,), (), (1, 3), (0, 3)])
    splats = Splats(*(jnp.asarray(leaf, dtype) for leaf in (mean, *rest)))
    if active is not None:
        logit = np.where(active, 0, rows.INACTIVE_LOGIT)
        splats = splats._replace(opacity_logit=jnp.asarray(logit, dtype))
    code = jnp.asarray(rng.normal(size=(count, width)), dtype)
    return Params({"splats": splats, "code": code}, {})


def some_places(count=40, seed=1):
    return np.random.default_rng(seed).normal(size=(count, 3))


def listed(graph, row):
    """The neighbours of a row that have a weight."""
    weighed = np.asarray(graph.weight)[row] > 0
    return set(np.asarray(graph.index)[row][weighed].tolist())


@pytest.mark.parametrize("scale", neighbours.SCALES)
def test_the_graph_is_that_of_all_distances(scale, dtype):
    places = some_places()
    active = np.arange(40) % 5 != 2
    params = scene(places, active, dtype=dtype)
    spec = NeighbourSpec(count=6, gamma=3.0, scale=scale)
    graph = neighbours.find(spec, params, extent=0.7)

    places = np.asarray(params.rows["splats"].mean, np.float64)
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
    np.testing.assert_array_equal(graph.index, nearest)
    tolerance = {"float32": 1e-6, "float64": 1e-13}[dtype]
    np.testing.assert_allclose(graph.weight, weight, rtol=tolerance)
    assert (graph.index.dtype, graph.weight.dtype) == (jnp.int32, jnp.dtype(dtype))


@pytest.mark.hard_cases
def test_the_weight_is_that_of_the_published_code():
    """0.82 at a hundredth of a unit; the printed form has 2e-9 there, 0 from 0.044."""
    params = scene([[0, 0, 0], [0.01, 0, 0]])
    graph = neighbours.find(NeighbourSpec(scale="units"), params, extent=1.0)
    np.testing.assert_allclose(graph.weight[:, 0], 0.8187308, rtol=1e-6)


@pytest.mark.hard_cases
def test_weights_by_spacing_do_not_depend_on_the_unit():
    places, spec = some_places(), NeighbourSpec(count=5)
    graph = neighbours.find(spec, scene(places), extent=1.0)
    large = neighbours.find(spec, scene(1e3 * places), extent=1.0)
    np.testing.assert_array_equal(graph.index, large.index)
    np.testing.assert_allclose(graph.weight, large.weight, rtol=1e-5)
    middle = np.median(graph.weight[:, -1])
    np.testing.assert_allclose(middle, np.exp(-2000 * 0.03**2), rtol=1e-6)


@pytest.mark.hard_cases
@pytest.mark.parametrize("active_count", [0, 1, 2, 4])
def test_with_few_active_rows_the_rest_names_itself(active_count, dtype):
    active = np.isin(np.arange(8), [6, 1, 3, 4][:active_count])
    params = scene(some_places(8), active, dtype=dtype)
    graph = jax.tree.map(np.asarray, neighbours.find(FEW, params, extent=1.0))
    others = set(np.flatnonzero(active).tolist())
    for row in range(8):
        assert listed(graph, row) == (others - {row} if active[row] else set())
        assert (graph.index[row][graph.weight[row] == 0] == row).all()
    value, grad = value_and_slope(params.rows["code"], graph, active)
    assert np.isfinite(value)
    assert np.isfinite(grad).all()
    assert (active_count >= 2) == bool(np.asarray(grad).any())
    assert not np.asarray(grad)[~active].any()


@pytest.mark.hard_cases
@pytest.mark.parametrize("copies", [2, 5, 12])
def test_clones_at_one_place_are_neighbours_but_never_oneself(copies, dtype):
    """Densification puts a clone onto its parent; the nearest distance is then zero."""
    places = np.repeat(some_places(6), copies, axis=0)
    graph = neighbours.find(FEW, scene(places, dtype=dtype), extent=1.0)
    graph = jax.tree.map(np.asarray, graph)
    for row in range(len(places)):
        assert row not in graph.index[row]
        assert len(set(graph.index[row].tolist())) == 4
        alike = graph.index[row] // copies == row // copies
        assert alike.sum() == min(copies - 1, 4)
        np.testing.assert_array_equal(graph.weight[row][alike], 1)
    assert np.isfinite(graph.weight).all()


def slow_inconsistency(code, graph, active, count):
    total, pairs = 0.0, 0
    for i in np.flatnonzero(active):
        for k, w in zip(graph.index[i], graph.weight[i], strict=True):
            total += np.sqrt(w * np.sum((code[i] - code[k]) ** 2) + 1e-20)
        pairs += count
    return total / pairs


def test_the_penalty_is_the_sum_over_all_pairs(dtype):
    active = np.arange(40) % 7 != 3
    params = scene(some_places(), active, width=5, dtype=dtype)
    graph = neighbours.find(NeighbourSpec(count=6), params, extent=1.0)
    code = params.rows["code"]
    value = inconsistency(code, graph, jnp.asarray(active))
    as_numpy = Neighbours(*(np.asarray(leaf, np.float64) for leaf in graph))
    as_numpy = as_numpy._replace(index=np.asarray(graph.index))
    expected = slow_inconsistency(np.asarray(code, np.float64), as_numpy, active, 6)
    assert value.dtype.name == dtype
    np.testing.assert_allclose(
        value, expected, rtol={"float32": 1e-6, "float64": 1e-13}[dtype]
    )


def test_few_neighbours_are_averaged_over_those_there_are(float64):
    active = np.arange(8) < 3
    params = scene(some_places(8), active, dtype="float64")
    graph = neighbours.find(NeighbourSpec(count=6, gamma=0.0), params, extent=1.0)
    code = np.asarray(params.rows["code"])[:3]
    apart = np.linalg.norm(code[:, None] - code, axis=-1)
    value = inconsistency(params.rows["code"], graph, jnp.asarray(active))
    # The three rows' idle places cost the floor's 1e-10 each.
    np.testing.assert_allclose(value, apart.sum() / 6, atol=1e-9)


def test_gradients_of_the_penalty(float64):
    active = jnp.arange(40) % 7 != 3
    params = scene(some_places(), np.asarray(active), width=5, dtype="float64")
    graph = neighbours.find(NeighbourSpec(count=6), params, extent=1.0)

    def total(code):
        return neighbours.inconsistency(code, graph, active)

    assert gradients.directional_error(total, params.rows["code"]) < 1e-7


@pytest.mark.hard_cases
@pytest.mark.parametrize("kind", ["float16", "bfloat16", "float32"])
@pytest.mark.parametrize("apart", [0.0, 1e-30, 1e-12, 1e-6, 1.0])
def test_slopes_are_finite_and_bounded_where_embeddings_meet(kind, apart):
    """1e-20 is 0 in float16, and the square root's slope at 0 is infinite."""
    kind = jnp.dtype(kind)
    graph = Neighbours(np.int32([[1], [0]]), np.full((2, 1), 0.25, kind))
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
    params = scene(places, dtype=dtype)
    graph = neighbours.find(NeighbourSpec(scale="units"), params, extent=1.0)
    assert not np.asarray(graph.weight).any()
    value, grad = value_and_slope(params.rows["code"], graph, np.ones(3, bool))
    np.testing.assert_allclose(value, 1e-9, rtol=1e-6)  # 20 floors of 2 neighbours
    assert not np.asarray(grad).any()


@functools.cache
def compiled_penalty(spec):
    effect = neighbours.effect(spec, extent=1.0, of="code")

    def penalty(params, graph, step):
        return effect.penalty(
            None, PenaltyContext(None, step, None, params, state=graph)
        )

    return effect, jax.jit(penalty)


def test_the_effect_weighs_and_waits_for_its_start():
    params = scene(some_places(), dtype="float32")
    effect, penalty = compiled_penalty(NeighbourSpec(weight=0.5, start=10))
    graph = effect.state(params)
    before = weighted_sum(penalty(params, graph, jnp.asarray(9)))
    after = penalty(params, graph, jnp.asarray(10))
    assert before == 0
    expected = inconsistency(params.rows["code"], graph, jnp.ones(40, bool))
    np.testing.assert_allclose(weighted_sum(after), 0.5 * expected, rtol=1e-6)
    linked = np.mean(np.asarray(graph.weight) > 1e-3)
    np.testing.assert_allclose(after["linked"].value, linked, rtol=1e-6)
    assert linked > 0.5
    program = penalty.lower(params, graph, jnp.asarray(9)).compile().as_text()
    assert "conditional" in program


@pytest.mark.full
def test_the_penalty_draws_neighbours_together_and_leaves_the_far_apart():
    """Two groups with mixed embeddings: each ends up with its own."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(24, 3)) * 0.1 + np.repeat([[0.0], [50.0]], 12, axis=0)
    params = scene(places, dtype="float32")
    spec = NeighbourSpec(count=8, gamma=100.0)
    graph = neighbours.find(spec, params, extent=1.0)

    def spread(code):
        return [float(jnp.std(code[part], axis=0).mean()) for part in halves]

    halves = np.arange(12), np.arange(12, 24)
    grad = jax.grad(lambda code: neighbours.inconsistency(code, graph, active))
    active = jnp.ones(24, bool)
    code = params.rows["code"]
    centres = [np.asarray(code[part]).mean(axis=0) for part in halves]
    end = jax.jit(
        lambda code: jax.lax.fori_loop(0, 3000, lambda _, c: c - 0.1 * grad(c), code)
    )(code)
    for before, after in zip(spread(code), spread(end), strict=True):
        assert after < 0.3 * before
    # Slopes of a pair cancel, so a group keeps its centre.
    for part, centre in zip(halves, centres, strict=True):
        np.testing.assert_allclose(
            np.asarray(end)[part].mean(axis=0), centre, atol=1e-3
        )


def test_missing_rows_are_named():
    effect = neighbours.effect(NeighbourSpec(), extent=1.0, of="kan_motion")
    with pytest.raises(ValueError, match=r"no rows .kan_motion.*code"):
        effect.state(scene(some_places()))
