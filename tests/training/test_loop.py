"""The loop: the same bits however it is cut, and every way in which it can end."""

import io
import math
import os
import signal
import sys
import threading
import time
from typing import NamedTuple

import jax
import jax.experimental
import jax.numpy as jnp
import numpy as np
import pytest
import rich.console

from nerfies_jax.runtime.progress import duration
from nerfies_jax.training import chunk, loop, rate
from nerfies_jax.training.model import Event
from tests.training import toy
from tests.training.toy import fit, start


@pytest.fixture(scope="module")
def frames():
    return toy.frames()


@pytest.fixture(scope="module")
def straight(frames):
    return fit(frames, steps=20)


def test_a_run_is_the_plain_loop_over_its_steps(frames, straight):
    state = start()
    step = jax.jit(toy.step)
    for count in range(1, 21):
        state, _ = step(state, frames)
        if count == 7:
            state = toy.grow(state, frames)
    for ours, plain in zip(
        jax.tree.leaves(straight.state), jax.tree.leaves(state), strict=True
    ):
        if not jnp.issubdtype(plain.dtype, jax.dtypes.prng_key):
            # Another program: a few ulps, which Adam's normalization may enlarge.
            np.testing.assert_allclose(ours, plain, rtol=2e-4, atol=2e-6)
    assert straight.state.aux_state["hits"].shape == (9,)
    assert int(straight.state.step) == straight.steps == 20
    assert straight.stopped_by == "steps"


@pytest.mark.parametrize("longest", [3, pytest.param(100, marks=pytest.mark.full)])
def test_chunk_length_does_not_change_a_bit(longest, frames, straight, monkeypatch):
    monkeypatch.setattr(loop, "CHUNK_STEPS", longest)
    result = fit(frames, steps=20)
    assert toy.same(result.state, straight.state)
    lengths = np.diff([0] + [row["step"] for row in result.history.rows])
    assert lengths.max() <= longest
    assert 7 in np.cumsum(lengths)  # a chunk ends where an event happens


def test_one_program_serves_every_chunk_of_a_shape(frames):
    model = toy.model(change=lambda state, frames: toy.step(state, frames))
    result = fit(frames, model=model, steps=300)
    assert len(chunk._programs(model.step)) == 2  # before and after growth
    assert result.compile_seconds > 0
    again = fit(frames, model=model, steps=300)
    assert again.compile_seconds == 0
    assert len(chunk._programs(model.step)) == 2


def test_what_is_compiled_ahead_is_what_trains(frames):
    models = [toy.model(change=lambda *run: toy.step(*run)) for _ in "ab"]
    assert chunk.compiling(models[0], start(), frames, 7).result() > 0
    ahead, plain = (fit(frames, model=model, steps=7) for model in models)
    assert ahead.compile_seconds == 0
    assert plain.compile_seconds > 0
    assert toy.same(ahead.state, plain.state)


def test_steps_are_compiled_as_their_model_asks(frames):
    model = toy.model(change=lambda *run: toy.step(*run))
    model = model._replace(compiler_options={"no_such_option": "1"})
    with pytest.raises(jax.errors.JaxRuntimeError, match="no_such_option"):
        fit(frames, model=model, steps=7)


def test_what_steps_have_learned_can_be_differentiated(float64):
    """By the rate of a gradient descent whose fourth step is known in closed form."""

    class Point(NamedTuple):
        x: jax.Array
        step: jax.Array

    def learned(rate):
        def step(state, frames):
            x = state.x - rate * 2 * frames * state.x
            return Point(x, state.step + 1), {"loss": jnp.sum(x**2)}

        start = Point(jnp.array([1.0, -2.0]), jnp.zeros((), jnp.int32))
        state, metrics = chunk.scan_steps(step, start, jnp.array([0.5, 3.0]), 4)
        return jnp.sum(state.x), metrics["loss"]

    (total, losses), slope = jax.value_and_grad(learned, has_aux=True)(0.1)
    shrink = 1 - 0.1 * np.array([1.0, 6.0])
    np.testing.assert_allclose(total, shrink**4 @ [1, -2], rtol=1e-12)
    expected = [((shrink**n * [1, -2]) ** 2).sum() for n in range(1, 5)]
    np.testing.assert_allclose(losses, expected, rtol=1e-12)
    by_rate = 4 * shrink**3 * [-1.0, -6.0]
    np.testing.assert_allclose(slope, by_rate @ [1, -2], rtol=1e-12)


def test_metrics_of_a_chunk_are_means_over_its_steps(frames, monkeypatch):
    monkeypatch.setattr(loop, "CHUNK_STEPS", 1)
    single = [row["loss"] for row in fit(frames, steps=6).history.rows]
    monkeypatch.setattr(loop, "CHUNK_STEPS", 100)
    rows = fit(frames, steps=6).history.rows
    assert [row["step"] for row in rows] == [1, 6]
    assert math.isclose(rows[1]["loss"], np.mean(single[1:]), rel_tol=1e-6)


def test_the_state_given_is_left_alone(frames):
    state = start()
    before = jax.tree.map(toy.bits, state)
    fit(frames, state, steps=9)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(
            jax.tree.leaves(before), map(toy.bits, jax.tree.leaves(state)), strict=True
        )
    )


def test_events_happen_in_order_after_their_steps(frames):
    seen = []

    def note(name):
        def apply(state, frames):
            seen.append((name, int(state.step)))
            return state

        return apply

    extra = (Event("a", (2, 5), note("a")), Event("b", (5,), note("b")))
    first = fit(frames, steps=5, events=extra)
    assert seen == [("a", 2), ("a", 5), ("b", 5)]
    fit(frames, first.state, steps=8, events=extra)
    assert len(seen) == 3  # what has happened does not happen again


@pytest.mark.full
def test_an_event_may_put_one_array_in_two_places(frames):
    def share(state, _):
        zero = jnp.zeros(6)
        return state._replace(aux_state=state.aux_state | {"hits": zero, "more": zero})

    state = start()
    state = state._replace(aux_state=state.aux_state | {"more": jnp.ones(6)})
    extra = (Event("share", (2,), share),)
    assert fit(frames, state, steps=5, events=extra).steps == 5


def test_hooks_run_at_their_steps_and_at_the_end(frames):
    hook = loop.Hook(
        "score", lambda _, step, metrics: {"psnr": step / 2}, every_steps=4
    )
    result = fit(frames, steps=10, hooks=[hook])
    assert [row["step"] for row in result.history.evaluations] == [4, 8, 10]
    assert result.history.evaluations[0]["psnr"] == 2.0
    assert result.history.evaluations[0]["hook"] == "score"


def test_hooks_run_at_listed_steps(frames):
    hook = loop.Hook("score", lambda _, step, metrics: {"psnr": step}, at_steps=(3, 8))
    result = fit(frames, steps=10, hooks=[hook])
    rows = result.history.evaluations
    assert [row["step"] for row in rows] == [3, 8, 10]
    assert 0 < rows[0]["cpu_seconds"] < rows[-1]["cpu_seconds"]
    assert rows[-1]["cpu_seconds"] == result.history.cpu_seconds


class Clock:
    """The module `time`, but seconds pass only where a test says so."""

    monotonic, process_time = time.monotonic, time.process_time

    def __init__(self):
        self.now = 1000.0

    def perf_counter(self):
        self.now += 1e-6
        return self.now

    def spend(self, seconds):
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    for module in (loop, rate):
        monkeypatch.setattr(module, "time", clock)
    return clock


def test_time_in_hooks_is_not_training_time(frames, straight, clock):
    hook = loop.Hook("nap", lambda *_: clock.spend(0.3), every_steps=5)
    result = fit(frames, steps=20, hooks=[hook])
    assert result.seconds < 1e-3
    assert toy.same(result.state, straight.state)
    assert result.history.evaluations == ()


def test_hooks_by_seconds_count_training_seconds(frames):
    seen = []
    hook = loop.Hook(
        "often", lambda _, step, metrics: seen.append(step), every_seconds=0.0
    )
    fit(frames, steps=10, hooks=[hook])
    assert seen[0] == 1
    assert seen[-1] == 10
    seen.clear()
    fit(frames, steps=10, hooks=[hook._replace(every_seconds=1e9)])
    assert seen == [1, 10]


def slow_model(nap):
    """A toy that calls a function in every step."""

    def slow(state, frames):
        jax.experimental.io_callback(nap, None)
        return toy.step(state, frames)

    return toy.model(change=slow)


def test_a_budget_of_seconds_ends_the_training_and_says_so(frames, clock):
    """Neither compiling nor a hook counts; what was trained before does not either."""
    nap = loop.Hook("nap", lambda *_: clock.spend(0.4), every_steps=1000)
    before = loop.History(seconds=100.0)
    result = fit(
        frames,
        model=slow_model(lambda: clock.spend(0.02)),
        steps=10_000,
        hooks=[nap],
        seconds=0.4,
        history=before,
    )
    assert result.stopped_by == "seconds"
    assert 15 <= result.steps <= 20
    assert result.seconds == pytest.approx(100 + 0.02 * result.steps, abs=1e-3)
    assert "of 10,000 at the time limit of 0:00" in result.message


def test_the_time_of_a_step_is_that_of_the_whole_schedule(frames, clock):
    """A step that is dearer from a quarter of the run on, and the state left alone."""

    def late(state, frames):
        seconds = jnp.where(state.step >= 250, 0.04, 0.01)
        jax.experimental.io_callback(
            lambda each: clock.spend(float(each)), None, seconds
        )
        return toy.step(state, frames)

    state = start()
    measured = rate.step_time(toy.model(change=late), state, frames, 1000)
    mean = (0.01 + 3 * 0.04) / 4  # of four phases
    assert measured.seconds == pytest.approx(mean, abs=1e-4)
    assert measured.compile_seconds > 0
    assert int(state.step) == 0
    assert toy.same(state, start())


def test_a_step_is_timed_by_the_program_that_trained(frames, clock):
    model = slow_model(lambda: clock.spend(0.02))
    trained = fit(frames, model=model, steps=100, seconds=0.1).state
    programs = dict(chunk._programs(model.step))
    assert rate.step_ms(model, trained, frames, 100) == pytest.approx(20, abs=0.1)
    assert chunk._programs(model.step) == programs
    assert int(trained.step) < 100


@pytest.mark.full
def test_chunks_of_slow_steps_stay_short_enough_to_interrupt(
    frames, clock, monkeypatch
):
    monkeypatch.setattr(loop, "CHUNK_SECONDS", 0.1)
    model = slow_model(lambda: clock.spend(0.02))
    result = fit(frames, model=model, steps=30)
    lengths = np.diff([0] + [row["step"] for row in result.history.rows])
    assert lengths.max() <= 5
    # Few steps after a first that may be slow to start, not one at a time for ever.
    assert len(lengths) < 25


@pytest.mark.parametrize(
    ("rounds", "length"), [(2, chunk.LENGTH), (60, 5), (120, 2), (240, 1), (800, 1)]
)
def test_large_steps_are_scanned_few_at_once(rounds, length, frames):
    def step(state, frames):
        state, metrics = toy.step(state, frames)
        squares = jnp.full((rounds, 512, 512), metrics["loss"])
        # 0.27e9 operations a round, which XLA counts once
        each = jax.lax.map(lambda square: jnp.sum(square @ square), squares)
        return state, metrics | {"products": jnp.sum(each)}

    model = toy.model(change=step)
    assert chunk.Program(model, start(), frames, 100).length == length


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        *(
            pytest.param(n, marks=pytest.mark.full)
            for n in (signal.SIGTERM, signal.SIGHUP)
        ),
    ],
)
def test_a_signal_ends_the_run_after_its_chunk(number, frames, straight):
    def send(state, step, metrics):
        if step == 11:
            os.kill(os.getpid(), number)

    before = signal.getsignal(number)
    hook = loop.Hook("send", send, every_steps=1)
    result = fit(frames, steps=1000, hooks=[hook])
    assert result.stopped_by == signal.Signals(number).name
    assert result.steps == 11
    assert signal.getsignal(number) is before
    rest = fit(frames, result.state, steps=20)
    assert toy.same(rest.state, straight.state)


def test_a_second_interrupt_does_not_wait(frames):
    def send(state, step, metrics):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)

    with pytest.raises(KeyboardInterrupt, match="interrupted twice"):
        fit(frames, steps=1000, hooks=[loop.Hook("send", send, every_steps=3)])
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.full
def test_a_signal_that_is_to_be_ignored_still_is(frames):
    def send(state, step, metrics):
        os.kill(os.getpid(), signal.SIGHUP)

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        result = fit(frames, steps=4, hooks=[loop.Hook("send", send, every_steps=2)])
    finally:
        signal.signal(signal.SIGHUP, before)
    assert result.stopped_by == "steps"


@pytest.mark.full
def test_a_run_outside_the_main_thread_leaves_signals_alone(frames):
    results = []
    thread = threading.Thread(target=lambda: results.append(fit(frames, steps=3)))
    thread.start()
    thread.join()
    assert results[0].stopped_by == "steps"


def test_what_a_step_gets_wrong_is_named(frames):
    def wider(state, frames):
        new, metrics = toy.step(state, frames)
        extra = {**new.aux_state, "hits": jnp.zeros(7)}
        return new._replace(aux_state=extra), metrics

    def standing(state, frames):
        new, metrics = toy.step(state, frames)
        return new._replace(step=state.step), metrics

    def stepping(state, frames):
        return state._replace(step=state.step + 1)

    with pytest.raises(
        ValueError, match=r"aux_state.hits from float32\[6\] to float32\[7\]"
    ):
        fit(frames, model=toy.model(change=wider), steps=2)
    with pytest.raises(ValueError, match=r"returned state\.step=0 after step 1"):
        fit(frames, model=toy.model(change=standing), steps=2)
    with pytest.raises(ValueError, match=r"event 'odd' must not change state\.step"):
        fit(frames, steps=2, events=[Event("odd", (1,), lambda s, f: stepping(s, f))])


@pytest.mark.parametrize("steps", [(0, 3), (3, 3), (5, 2)])
def test_events_out_of_order_are_refused(steps, frames):
    with pytest.raises(ValueError, match="event 'x' needs ascending steps of"):
        fit(frames, steps=9, events=[Event("x", steps, lambda s, f: s)])


def test_fewer_steps_than_done_are_refused(frames, straight):
    with pytest.raises(ValueError, match="completed 20 steps, but steps=10"):
        fit(frames, straight.state, steps=10)
    assert fit(frames, straight.state, steps=20).steps == 20


@pytest.mark.full
def test_a_log_file_gets_lines_and_a_terminal_a_bar(frames):
    for terminal in (False, True):
        text = io.StringIO()
        console = rich.console.Console(
            file=text, force_terminal=terminal, width=120, color_system=None
        )
        # Long enough for its bar to be drawn.
        nap = loop.Hook("nap", lambda *_: time.sleep(0.3), every_steps=2)
        fit(frames, steps=8, hooks=[nap], console=console)
        shown = text.getvalue()
        assert "completed 8 steps" in shown
        assert "steps/s  loss" in shown
        assert "dB" in shown
        assert "rows" in shown
        assert "left" in shown
        assert ("\x1b" in shown) == terminal


def test_a_terminal_that_is_gone_does_not_end_a_run(frames, straight, monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as gone:
        monkeypatch.setattr(sys, "stderr", gone)
        monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes it for a terminal
        # Long enough for its bars to be drawn.
        nap = loop.Hook("nap", lambda *_: time.sleep(0.1), every_steps=2)
        result = fit(frames, steps=20, hooks=[nap], console=None)
    assert result.stopped_by == "steps"
    assert toy.same(result.state, straight.state)


def test_hooks_receive_the_metrics_of_the_last_chunk(frames):
    received = {}
    hook = loop.Hook("log", lambda _, step, metrics: received.update({step: metrics}))
    hook = hook._replace(every_steps=4)
    result = fit(frames, steps=8, hooks=[hook])
    rows = {row["step"]: row for row in result.history.rows}
    assert received.keys() == {4, 8}
    for step, metrics in received.items():
        assert metrics["loss"] == rows[step]["loss"]
        assert "seconds" not in metrics


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0, "0:00"), (59.6, "1:00"), (125.0, "2:05"), (3723.0, "1:02:03")],
)
def test_durations_read_like_a_clock(seconds, text):
    assert duration(seconds) == text
