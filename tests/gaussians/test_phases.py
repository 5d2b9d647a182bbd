"""Whose turn it is, and what a frozen group keeps."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.optim import phases
from gaussians_jax.optim.optimizer import scale_by_row_adam
from gaussians_jax.optim.phases import (
    AlternationSpec,
    AnnealingSpec,
    Trained,
    UpdateMask,
)
from gaussians_jax.scene import scene
from nerfies_jax import evaluation
from tests import gradients, scenes
from tests.gaussians.shared import (
    any_nonzero,
    full,
    jitted,
    put,
    rows_and_nets,
    same_bits,
)

COUNT = 5
ALTERNATION = AlternationSpec(start=2, stop=13)
RATE = 1e-2


def labels(params):
    del params
    kinds = Splats("mean", *["rest"] * 5)
    return Params({"splats": kinds, "code": "rest"}, {"w": "nets"})


def partitioned():
    """A count and a schedule's count for each of three parts, behind a clip."""

    def part(optimizer):
        return optax.chain(optimizer, optax.scale_by_schedule(lambda step: 1.0))

    each = {
        "mean": part(scale_by_row_adam()),
        "rest": part(optax.scale_by_adam(eps=1e-15)),
        "nets": part(optax.scale_by_radam()),
    }
    return optax.chain(optax.clip_by_global_norm(1e9), optax.partition(each, labels))


OPTIMIZERS = {
    "row adam": scale_by_row_adam,
    "partitioned": partitioned,
}


def slopes_at(params, step):
    """Of a quadratic about a point that wanders, so that momentum shows."""
    aim = jnp.sin(step.astype(params.nets["w"].dtype))
    return jax.tree.map(lambda leaf: leaf - aim, params)


def descend(optimizer, trained, grads):
    # optax mixes integers and floats in its bias corrections.
    with jax.numpy_dtype_promotion("standard"):
        directions, moments = optimizer.update(grads, trained.opt_state, trained.params)
    moved = jax.tree.map(lambda p, d: p - RATE * d, trained.params, directions)
    return Trained(moved, moments)


def alternate(optimizer, spec, steps, trained):
    """All states of a run in one scan, and whose turn it was."""

    def body(carried, step):
        mine = phases.update_mask(spec, step)
        after = descend(optimizer, carried, slopes_at(carried.params, step))
        carried = phases.freeze(optimizer, mine, carried, after)
        return carried, (carried, mine)

    return jax.lax.scan(body, trained, jnp.arange(steps))[1]


@functools.cache
def alternated(name, steps, dtype):
    optimizer, params = OPTIMIZERS[name](), rows_and_nets(COUNT, dtype)
    start = Trained(params, jitted(optimizer.init)(params))
    run = jitted(functools.partial(alternate, optimizer, ALTERNATION, steps))
    states, turns = run(start)
    with_start = jax.tree.map(lambda a, b: np.stack([a, *b]), start, states)
    return with_start, turns


def of_group(name, trained, group):
    """Parameters and state of one group, picked out by hand."""
    frozen = [getattr(trained.params, group)]
    if name != "partitioned":
        frozen += [getattr(part, group) for part in trained.opt_state]
    else:
        inner = trained.opt_state[1].inner_states
        frozen += [
            inner[key] for key in {"rows": ("mean", "rest"), "nets": ("nets",)}[group]
        ]
    return jax.tree.leaves(frozen)


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
        AlternationSpec(5, 30, nets=3, rows=4),
        *full(None, ALTERNATION, AlternationSpec(0, 1), AlternationSpec(7, 29, 1, 1)),
    ],
)
def test_turns_follow_the_cycle_in_one_program(spec):
    turns = jitted(jax.vmap(lambda step: phases.update_mask(spec, step), axis_size=40))
    expected = [slow_turn(spec, step) for step in range(40)]
    np.testing.assert_array_equal(
        np.stack(turns(np.arange(40, dtype=np.int32)), axis=1), expected
    )


@pytest.mark.parametrize("name", ["partitioned", *full("row adam")])
@pytest.mark.parametrize("group", Params._fields)
def test_a_frozen_group_and_its_optimizer_stay_bit_for_bit(name, group, dtype):
    states, turns = alternated(name, 16, dtype)
    trains = getattr(turns, group)
    assert 0 < trains.sum() < len(trains)
    leaves = of_group(name, states, group)
    for step, on in enumerate(trains):
        for leaf in leaves:
            same = leaf[step].tobytes() == leaf[step + 1].tobytes()
            assert same != on, (step, leaf.shape)


@jitted
def adam_step(trained, grads):
    return descend(scale_by_row_adam(), trained, grads)


@jitted
def adam_freeze(turn, before, after):
    return phases.freeze(scale_by_row_adam(), turn, before, after)


@functools.cache
def turn_at(step):
    return jitted(functools.partial(phases.update_mask, ALTERNATION))(np.int32(step))


@jitted
def begun(params):
    """After a first step."""
    optimizer = scale_by_row_adam()
    return descend(optimizer, Trained(params, optimizer.init(params)), params)


def test_zero_slopes_do_not_freeze_what_has_momentum():
    """Momentum moves parameters without gradients, so freezing restores them."""
    trained = begun(rows_and_nets(COUNT))
    drifted = adam_step(trained, jax.tree.map(np.zeros_like, trained.params))
    for a, b in zip(*map(jax.tree.leaves, (trained, drifted)), strict=True):
        assert (a != b).any()
    held = adam_freeze(turn_at(2), trained, drifted)
    same_bits(held.params.rows, trained.params.rows)
    same_bits(held.params.nets, drifted.params.nets)
    same_bits(adam_freeze(turn_at(1), trained, drifted), drifted)  # before it starts


@pytest.mark.hard_cases
def test_what_is_frozen_is_safe_from_values_that_are_not_finite(dtype):
    before = begun(rows_and_nets(COUNT, dtype))
    after = jax.tree.map(lambda leaf: np.full_like(leaf, np.nan), before.params)
    after = adam_step(before, after)
    assert np.isnan(after.opt_state.first.nets["w"]).all()
    held = adam_freeze(UpdateMask(np.False_, np.False_), before, after)
    same_bits(held, before)


@pytest.mark.parametrize(
    "optimizer",
    [
        *full(optax.adam(1e-3)),
        optax.chain(scale_by_row_adam(), optax.scale_by_schedule(lambda step: 1.0)),
    ],
)
def test_a_state_that_both_groups_share_is_refused(optimizer):
    params = rows_and_nets(COUNT)
    state = Trained(params, jax.eval_shape(optimizer.init, params))
    turn = UpdateMask(*put((True, False)))
    with pytest.raises(ValueError, match=r"count belongs to both"):
        phases.freeze(optimizer, turn, state, state)


def wave(params, shift):
    """Some function of everything, with two matrix products in the networks."""
    hidden = jnp.sin(params.rows["splats"].mean[:, :2] @ params.nets["w"][:2] + shift)
    return jnp.sin(hidden @ params.nets["w"]) + params.rows["code"][:, :1]


def loss(params, shift, on):
    mine = UpdateMask(jnp.asarray(True), on)
    return jnp.sum(phases.stop_frozen_gradients(mine, wave)(params, shift) ** 2)


def test_stopped_gradients_have_the_values_and_the_slopes_of_the_function(dtype):
    params, shift = rows_and_nets(COUNT, dtype), np.asarray(0.3, dtype)
    plain = jax.value_and_grad(lambda params: jnp.sum(wave(params, shift) ** 2))
    value, grads = jitted(plain)(params)
    stop_frozen_gradients = jitted(jax.value_and_grad(loss))
    tolerance = {"float32": 1e-5, "float64": 1e-13}[dtype]
    compare = functools.partial(np.testing.assert_allclose, rtol=tolerance, atol=1e-6)
    for on in (True, False):
        same, frozen = stop_frozen_gradients(params, shift, np.asarray(on))
        np.testing.assert_allclose(same, value, rtol=tolerance)
        jax.tree.map(compare, frozen.rows, grads.rows)
        if on:
            jax.tree.map(compare, frozen.nets, grads.nets)
    assert not any_nonzero(frozen.nets)
    assert grads.nets["w"].all()


def test_stopped_gradients_are_those_of_central_differences(float64):
    params, on, off = rows_and_nets(COUNT, "float64"), put(True), put(False)
    error = gradients.directional_error(lambda p: loss(p, 0.3, on), params)
    assert error < 1e-8

    def of_rows(rows):
        return loss(params._replace(rows=rows), 0.3, off)

    assert gradients.directional_error(of_rows, params.rows) < 1e-8


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
            "row adam", Trained(state.params, state.optimizer), group
        )

    assert steps_at_rest(states, of("rows")) == [4, 5, 7, 8]
    assert steps_at_rest(states, of("nets")) == [0, 1, 2, 6, 9]
    means = steps_at_rest(states, lambda state: [state.params.rows["splats"].mean])
    assert means == [4, 5, 7, 8, 12, 13]
