"""Whose turn it is, and what a frozen group keeps."""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gaussians_jax import phases, scene
from gaussians_jax.optimiser import scale_by_row_adam, scale_by_row_radam
from gaussians_jax.phases import AlternationSpec, AnnealingSpec, Trained, UpdateMask
from gaussians_jax.splats import Params, Splats
from nerfies_jax import evaluation
from tests import gradients, scenes

COUNT = 5
ALTERNATION = AlternationSpec(start=2, stop=13)
RATE = 1e-2


def make(dtype="float32"):
    rng = np.random.default_rng(0)

    def leaf(*shape):
        return jnp.asarray(rng.normal(size=shape), dtype)

    rows = Splats(
        leaf(COUNT, 3),
        leaf(COUNT, 3),
        leaf(COUNT, 4),
        leaf(COUNT),
        leaf(COUNT, 1, 3),
        leaf(COUNT, 3, 3),
    )
    # A weight matrix with as many rows as there are Gaussians, to catch guessing.
    return Params({"splats": rows, "code": leaf(COUNT, 2)}, {"w": leaf(COUNT, 5)})


def labels(params):
    del params
    kinds = Splats("mean", *["rest"] * 5)
    return Params({"splats": kinds, "code": "rest"}, {"w": "nets"})


def partitioned():
    """A count and a schedule's count for each of three parts, behind a clip."""

    def part(optimiser):
        return optax.chain(optimiser, optax.scale_by_schedule(lambda step: 1.0))

    each = {
        "mean": part(scale_by_row_adam()),
        "rest": part(optax.scale_by_adam(eps=1e-15)),
        "nets": part(optax.scale_by_radam()),
    }
    return optax.chain(optax.clip_by_global_norm(1e9), optax.partition(each, labels))


OPTIMISERS = {
    "row adam": scale_by_row_adam,
    "row radam": scale_by_row_radam,
    "partitioned": partitioned,
}


def slopes_at(params, step):
    """Of a quadratic about a point that wanders, so that momentum shows."""
    aim = jnp.sin(step.astype(params.nets["w"].dtype))
    return jax.tree.map(lambda leaf: leaf - aim, params)


def descend(optimiser, trained, grads):
    # optax mixes integers and floats in its bias corrections.
    with jax.numpy_dtype_promotion("standard"):
        directions, moments = optimiser.update(grads, trained.opt_state, trained.params)
    moved = jax.tree.map(lambda p, d: p - RATE * d, trained.params, directions)
    return Trained(moved, moments)


def alternate(optimiser, spec, steps, trained):
    """All states of a run in one scan, and whose turn it was."""

    def body(carried, step):
        mine = phases.update_mask(spec, step)
        after = descend(optimiser, carried, slopes_at(carried.params, step))
        carried = phases.freeze(optimiser, mine, carried, after)
        return carried, (carried, mine)

    return jax.lax.scan(body, trained, jnp.arange(steps))[1]


@functools.cache
def alternated(name, steps, dtype):
    optimiser = OPTIMISERS[name]()
    params = make(dtype)
    start = Trained(params, optimiser.init(params))
    run = jax.jit(functools.partial(alternate, optimiser, ALTERNATION, steps))
    states, turns = run(start)
    with_start = jax.tree.map(lambda a, b: np.stack([a, *b]), start, states)
    return with_start, jax.tree.map(np.asarray, turns)


def of_group(name, trained, group):
    """Parameters and state of one group, picked out by hand."""
    kept = [getattr(trained.params, group)]
    if name != "partitioned":
        kept += [getattr(part, group) for part in trained.opt_state]
    else:
        inner = trained.opt_state[1].inner_states
        kept += [
            inner[key] for key in {"rows": ("mean", "rest"), "nets": ("nets",)}[group]
        ]
    return jax.tree.leaves(kept)


def slow_turn(spec, step):
    """By walking through the cycle; (rows, nets)."""
    if spec is None or step < spec.start:
        return True, True
    here, turn = spec.start, ["nets"] * spec.nets + ["rows"] * spec.rows
    while here < spec.stop:
        for name in turn:
            if here == step and here < spec.stop:
                return name == "rows", name == "nets"
            here += 1
    return True, True


@pytest.mark.parametrize(
    "spec",
    [
        None,
        ALTERNATION,
        AlternationSpec(0, 1),
        AlternationSpec(0, 2),
        AlternationSpec(5, 30, nets=3, rows=4),
        AlternationSpec(7, 29, nets=1, rows=1),
    ],
)
def test_turns_follow_the_cycle_in_one_program(spec):
    traced = []

    @jax.jit
    def run(first):
        traced.append(first)

        def body(step, _):
            return step + 1, phases.update_mask(spec, step)

        return jax.lax.scan(body, first, None, length=20)[1]

    for first in (0, 20):
        turns = run(jnp.asarray(first, jnp.int32))
        expected = [slow_turn(spec, step) for step in range(first, first + 20)]
        np.testing.assert_array_equal(np.stack(turns, axis=1), expected)
    assert len(traced) == 1


@pytest.mark.parametrize("name", OPTIMISERS)
@pytest.mark.parametrize("group", Params._fields)
def test_a_frozen_group_and_its_optimiser_stay_bit_for_bit(name, group, dtype):
    states, turns = alternated(name, 16, dtype)
    trains = getattr(turns, group)
    assert 0 < trains.sum() < len(trains)
    leaves = of_group(name, states, group)
    number = {
        ("row", "rows"): 4 * 7,  # parameter, count and two moments of seven leaves
        ("row", "nets"): 4,
        ("partitioned", "rows"): 7 + (3 + 1) + (1 + 2 * 6 + 1),
        ("partitioned", "nets"): 1 + (1 + 2 + 1),
    }
    assert len(leaves) == number[name.split()[0], group]
    for step, on in enumerate(trains):
        for leaf in leaves:
            same = leaf[step].tobytes() == leaf[step + 1].tobytes()
            assert same != on, (step, leaf.shape)


def numpy_adam(params, slopes_of, turns):
    """Float64 Adam whose moments and count only know the group's own steps."""
    first, second = np.zeros_like(params), np.zeros_like(params)
    for count, step in enumerate(np.flatnonzero(turns), start=1):
        grad = slopes_of(params, step)
        first = 0.9 * first + 0.1 * grad
        second = 0.999 * second + 0.001 * grad**2
        mean, square = first / (1 - 0.9**count), second / (1 - 0.999**count)
        params = params - RATE * mean / (np.sqrt(square) + 1e-15)
    return params


def test_each_group_is_adam_on_its_own_steps(dtype):
    states, turns = alternated("row adam", 16, dtype)
    for group in Params._fields:
        for leaf in jax.tree.leaves(getattr(states.params, group)):
            expected = numpy_adam(
                leaf[0].astype(float),
                lambda p, step: p - math.sin(step),
                getattr(turns, group),
            )
            tolerance = {"float32": 2e-5, "float64": 1e-12}[dtype]
            np.testing.assert_allclose(leaf[-1], expected, atol=tolerance)


@jax.jit
def adam_step(trained, grads):
    return descend(scale_by_row_adam(), trained, grads)


@jax.jit
def adam_freeze(turn, before, after):
    return phases.freeze(scale_by_row_adam(), turn, before, after)


def begun(params):
    """After a first step."""
    trained = Trained(params, jax.jit(scale_by_row_adam().init)(params))
    return adam_step(trained, params)


def test_zero_slopes_do_not_freeze_what_has_momentum():
    """The trap: this is why `hold` exists."""
    trained = begun(make())
    drifted = adam_step(trained, jax.tree.map(np.zeros_like, trained.params))
    for a, b in zip(*map(jax.tree.leaves, (trained, drifted)), strict=True):
        assert (np.asarray(a) != np.asarray(b)).any()
    held = adam_freeze(phases.update_mask(ALTERNATION, 2), trained, drifted)
    jax.tree.map(np.testing.assert_array_equal, held.params.rows, trained.params.rows)
    jax.tree.map(np.testing.assert_array_equal, held.params.nets, drifted.params.nets)


@pytest.mark.hard_cases
def test_what_is_frozen_is_safe_from_values_that_are_not_finite(dtype):
    before = begun(make(dtype))
    after = jax.tree.map(lambda leaf: np.full_like(leaf, np.nan), before.params)
    after = adam_step(before, after)
    assert np.isnan(after.opt_state.first.nets["w"]).all()
    held = adam_freeze(UpdateMask(*map(jnp.asarray, (False, False))), before, after)
    jax.tree.map(np.testing.assert_array_equal, held, before)


@pytest.mark.full
def test_without_an_alternation_everything_trains():
    before = begun(make())
    after = adam_step(before, before.params)
    held = adam_freeze(phases.update_mask(None, 3), before, after)
    jax.tree.map(np.testing.assert_array_equal, held, after)


@pytest.mark.parametrize(
    "optimiser",
    [
        optax.adam(1e-3),
        optax.chain(scale_by_row_adam(), optax.scale_by_schedule(lambda step: 1.0)),
    ],
)
def test_a_state_that_both_groups_share_is_refused(optimiser):
    params = make()
    state = Trained(params, jax.jit(optimiser.init)(params))
    with pytest.raises(ValueError, match=r"count belongs to rows and networks alike"):
        phases.freeze(optimiser, phases.update_mask(ALTERNATION, 3), state, state)


def wave(params, shift):
    """Some function of everything, with two matrix products in the networks."""
    hidden = jnp.sin(params.rows["splats"].mean[:, :2] @ params.nets["w"][:2] + shift)
    return jnp.sin(hidden @ params.nets["w"]) + params.rows["code"][:, :1]


def loss(params, shift, on):
    mine = UpdateMask(jnp.asarray(True), on)
    return jnp.sum(phases.stop_frozen_gradients(mine, wave)(params, shift) ** 2)


def test_stopped_gradients_have_the_values_and_the_slopes_of_the_function(dtype):
    params, shift = make(dtype), jnp.asarray(0.3, dtype)
    plain = jax.value_and_grad(lambda params: jnp.sum(wave(params, shift) ** 2))
    value, grads = jax.jit(plain)(params)
    stop_frozen_gradients = jax.jit(jax.value_and_grad(loss))
    tolerance = {"float32": 1e-5, "float64": 1e-13}[dtype]
    for on in (True, False):
        same, kept = stop_frozen_gradients(params, shift, jnp.asarray(on))
        np.testing.assert_allclose(same, value, rtol=tolerance)
        for group in ("rows", "nets") if on else ("rows",):
            jax.tree.map(
                functools.partial(
                    np.testing.assert_allclose, rtol=tolerance, atol=1e-6
                ),
                getattr(kept, group),
                getattr(grads, group),
            )
        if not on:
            assert not np.asarray(kept.nets["w"]).any()
            assert np.asarray(grads.nets["w"]).all()


def test_stopped_gradients_are_those_of_central_differences(float64):
    params, on = make("float64"), jnp.asarray(True)
    error = gradients.directional_error(lambda p: loss(p, 0.3, on), params)
    assert error < 1e-8

    def of_rows(rows):
        return loss(params._replace(rows=rows), 0.3, ~on)

    assert gradients.directional_error(of_rows, params.rows) < 1e-8


def products(jaxpr):
    """Matrix products in a program, by where they stand: outside or in a branch."""
    count = 0
    for equation in jaxpr.eqns:
        count += equation.primitive.name == "dot_general"
        for value in equation.params.values():
            for inner in value if isinstance(value, (tuple, list)) else (value,):
                if hasattr(inner, "jaxpr"):
                    count += products(inner.jaxpr)
    return count


@pytest.mark.full
def test_the_turn_of_the_rows_leaves_out_the_slopes_of_the_weights():
    params = make()
    program = jax.make_jaxpr(jax.grad(loss))(
        params, jnp.asarray(0.3), jnp.asarray(True)
    )
    conds = [e for e in program.eqns if e.primitive.name == "cond"]
    still, full = (
        sum(products(cond.params["branches"][which].jaxpr) for cond in conds)
        for which in (0, 1)
    )
    # Forward two; backward one for each of two inputs, and one for each use of weights.
    assert (still, full) == (4, 6)


def steps_at_rest(states, leaves_of):
    """The steps that leave all of these leaves as they are, bit for bit."""
    bits = [[np.asarray(x).tobytes() for x in leaves_of(state)] for state in states]
    return [step for step, (a, b) in enumerate(itertools.pairwise(bits)) if a == b]


@pytest.mark.slow  # compiles a scene of its own
def test_a_scene_trains_one_group_at_a_time_in_one_program():
    spec = dataclasses.replace(
        scenes.TINY_DEFORMABLE,  # whose motion starts at step 3
        alternation=AlternationSpec(start=4, stop=10),
        annealing=AnnealingSpec(after=5, freeze_share=0.6),  # means rest from 12 on
    )
    capture = scenes.tiny_capture()
    model = scene.build(spec, scene.metadata_of(capture))
    step, frames = jax.jit(model.step), evaluation.frames_of(capture)
    states = [model.init(capture, jax.random.key(0))]
    for _ in range(14):
        states.append(step(states[-1], frames)[0])
    assert step._cache_size() == 1

    def of(group):
        return lambda state: of_group(
            "row adam", Trained(state.params, state.optimiser), group
        )

    assert steps_at_rest(states, of("rows")) == [4, 5, 7, 8]
    assert steps_at_rest(states, of("nets")) == [0, 1, 2, 6, 9]
    means = steps_at_rest(states, lambda state: [state.params.rows["splats"].mean])
    assert means == [4, 5, 7, 8, 12, 13]
