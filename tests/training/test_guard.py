"""Nothing that is not finite is kept: no state, no checkpoint, no history."""

import re

import jax
import jax.experimental
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from nerfies_jax.training import chunk, guard
from nerfies_jax.training.checkpoint import Checkpoints
from nerfies_jax.training.model import Event
from tests.hard_cases import hostile
from tests.training import toy
from tests.training.toy import MODEL, fit, start

STEPS = 20  # of which the toy grows after the seventh
NAMES = {
    "metric": "metric loss",
    "parameter": r"params\.rows\.mean \(1 of",
    "moment": r"optimizer\.0\.nu\.rows\.mean \(1 of",
    "statistic": r"aux_state\.hits \(1 of",
}

all_finite = jax.jit(chunk._all_finite)


@pytest.fixture(scope="module")
def frames():
    return toy.frames()


def spoil(state, where, value):
    """The state with one number of one of its arrays replaced by a sum with `value`."""
    rows = state.params.rows["mean"].at[2, 1].add(value)
    if where == "parameter":
        return state._replace(params=state.params._replace(rows={"mean": rows}))
    if where == "moment":
        adam, *rest = state.optimizer
        second = adam.nu._replace(
            rows={"mean": adam.nu.rows["mean"].at[1, 0].add(value)}
        )
        return state._replace(optimizer=(adam._replace(nu=second), *rest))
    hits = state.aux_state["hits"].at[3].add(value)
    return state._replace(aux_state={**state.aux_state, "hits": hits})


spoilt_at = jax.jit(spoil, static_argnums=1)


def _poisoned(state, frames):
    """A step of the toy that leaves one number in one place not finite.

    After which step, what number and where `poison` writes into the depths, which the
    toy does not read: one program for all of them.
    """
    at, value, place = frames.depths
    value = jnp.where((state.step + 1).astype(jnp.float32) == at, value, 0.0)
    new, metrics = toy.step(state, frames)
    for index, where in enumerate(NAMES):
        here = jnp.where(place == index, value, 0.0)
        if where == "metric":
            metrics["loss"] = metrics["loss"] + here
        else:
            new = spoil(new, where, here)
    return new, metrics


POISONED = toy.model(change=_poisoned)


def poison(frames, where, at, value=np.nan):
    place = list(NAMES).index(where)
    return frames._replace(depths=jnp.asarray(np.float32([at, value, place])))


def held(folder, result, model):
    """The run kept nothing that is not finite, in memory or on disk."""
    assert result.stopped_by == "non-finite"
    assert not hostile.not_finite(result.state)
    assert int(result.state.step) == result.steps
    for row in result.history.rows:
        assert row["step"] <= result.steps
        assert np.isfinite(list(row.values())).all()
    hostile.assert_checkpoints_finite(folder, model, result)


@pytest.mark.parametrize("where", NAMES)
@pytest.mark.parametrize(
    "at", [8, *(pytest.param(at, marks=pytest.mark.full) for at in (1, 15))]
)
def test_a_step_that_blows_up_is_named_and_undone(where, at, frames, tmp_path):
    model, spoilt = POISONED, poison(frames, where, at)
    # A checkpoint after every chunk, and one at the end alone.
    for name, every in (("often", 0.0), ("seldom", 1e9)):
        folder = tmp_path / name
        with Checkpoints(folder, model.spec, keep=100) as checkpoints:
            result = fit(
                spoilt,
                model=model,
                steps=STEPS,
                checkpoints=checkpoints,
                checkpoint_seconds=every,
            )
        assert result.steps == at - 1
        message = (
            rf"stopped at step {at - 1} of 20: step {at} is not finite: {NAMES[where]}"
        )
        assert re.match(message, result.message), result.message
        held(folder, result, model)
    good = fit(spoilt, model=model, steps=at - 1) if at > 1 else None
    assert toy.same(result.state, good.state if good else start())


def test_a_second_moment_that_overflows_stops_the_run(frames):
    """Its row would never move again, while every parameter stays finite."""

    def steep(state, frames):
        def loss(params):  # a cliff of 1e20 in one number, at step 9
            wall = jnp.where(state.step == 8, 1e20, 0.0)
            return jnp.mean(params.nets["weight"] ** 2) + wall * params.nets["bias"][3]

        grad = jax.grad(loss)(state.params)
        with jax.numpy_dtype_promotion("standard"):
            updates, optimizer = toy.OPTIMIZER.update(grad, state.optimizer)
        params = optax.apply_updates(state.params, updates)
        new = state._replace(params=params, optimizer=optimizer, step=state.step + 1)
        return new, {"loss": loss(params) * 0}

    state, stepped = start(), jax.jit(steep)
    for _ in range(9):
        state, metrics = stepped(state, frames)
    assert not hostile.not_finite((state.params, metrics))
    for _ in range(20):  # what a guard of parameters alone would let go on
        stuck, _ = stepped(state, frames)
    bias = [s.params.nets["bias"][3] for s in (state, stuck)]
    assert bias[0] == bias[1]
    result = fit(frames, model=toy.model(change=steep), steps=STEPS)
    assert result.steps == 8
    assert re.search(
        r"step 9 is not finite: optimizer\.0\.nu\.nets\.bias \(1 of 8", result.message
    )


@pytest.mark.parametrize("where", [name for name in NAMES if name != "metric"])
@pytest.mark.parametrize(
    "at", [7, *(pytest.param(at, marks=pytest.mark.full) for at in (1, 12))]
)
def test_an_event_that_blows_up_is_named_and_undone(where, at, frames, tmp_path):
    def harm(state, _):
        return spoilt_at(state, where, np.nan)

    harmful = [Event("harm", (at,), harm)]
    with Checkpoints(tmp_path, MODEL.spec, keep=100) as checkpoints:
        result = fit(
            frames,
            steps=STEPS,
            events=harmful,
            checkpoints=checkpoints,
            checkpoint_seconds=0.0,
        )
    # Before the step after which it happens: a resumed run must not leave it out.
    assert result.steps == at - 1
    message = rf"event 'harm' after step {at} is not finite: {NAMES[where]}"
    assert re.search(message, result.message), result.message
    held(tmp_path, result, MODEL)
    straight = fit(frames, steps=STEPS)
    assert toy.same(fit(frames, result.state, steps=STEPS).state, straight.state)


@pytest.mark.parametrize("where", [name for name in NAMES if name != "metric"])
def test_a_start_that_is_not_finite_is_refused(where, frames):
    with pytest.raises(ValueError, match=f"state is not finite: {NAMES[where]}"):
        fit(frames, spoilt_at(start(), where, np.nan), steps=STEPS)


@pytest.mark.full
def test_large_metrics_do_not_overflow_together(frames):
    def large(state, frames):
        new, metrics = toy.step(state, frames)
        return new, {**metrics, "sum": jnp.float32(3e38)}

    result = fit(frames, model=toy.model(change=large), steps=STEPS)
    assert result.stopped_by == "steps"
    for row in result.history.rows:
        assert row["sum"] == pytest.approx(3e38, rel=1e-6)


@pytest.mark.full
def test_a_blow_up_that_does_not_repeat_keeps_the_last_good_chunk(frames):
    calls = []

    def once(step):
        calls.append(int(step))
        return np.float32(np.nan if calls.count(12) == 1 and step == 12 else 0)

    def step(state, frames):
        new, metrics = toy.step(state, frames)
        like = jax.ShapeDtypeStruct((), jnp.float32)
        poison = jax.experimental.io_callback(once, like, new.step)
        return spoil(new, "parameter", poison), metrics

    result = fit(frames, model=toy.model(change=step), steps=STEPS)
    assert result.stopped_by == "non-finite"
    assert "but was when it was repeated" in result.message
    assert result.steps == 7  # the chunk before ended with the growth
    assert not hostile.not_finite(result.state)


@pytest.mark.parametrize("kind", ["float16", "bfloat16", "float32"])
@pytest.mark.parametrize("value", [jnp.nan, jnp.inf, -jnp.inf, 6e4])
def test_the_two_looks_at_a_state_agree(kind, value):
    wide = np.ones((4, 5))
    wide[2, 3] = value
    state = {
        "whole": jnp.arange(3),
        "none": jnp.zeros((0, 3), kind),
        "key": jax.random.key(0),
        "wide": jnp.asarray(wide, kind),
        "flat": jnp.asarray(-value, kind),
    }
    finite = all_finite(state)
    named = guard.bad_arrays(state)
    if np.isfinite(value):
        assert finite
        assert named == []
    else:
        assert not finite
        assert named == ["flat (1 of 1 values)", "wide (1 of 20 values)"]


@pytest.mark.parametrize(
    "value", [np.nan, pytest.param(-np.inf, marks=pytest.mark.full)]
)
def test_one_number_is_found_wherever_it_hides(value, dtype):
    """The largest of many is NaN where one is, whatever the order of the reduction."""
    state = np.random.default_rng(0).normal(size=(1000, 59)).astype(dtype)
    assert all_finite(state)
    for row in (0, 1, 7, 8, 63, 64, 500, 991, 998, 999):
        spoilt = state.copy()
        spoilt[row, row % 59] = value
        assert not all_finite(spoilt)
