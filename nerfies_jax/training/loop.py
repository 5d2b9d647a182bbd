"""Training loop: compiled chunks of steps between events on the host."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import psutil
import rich.console
from jaxtyping import Array, Key

from nerfies_jax.runtime import data_parallel
from nerfies_jax.runtime import events as event_stream
from nerfies_jax.runtime.progress import duration
from nerfies_jax.runtime.stopping import StopRequests
from nerfies_jax.training import chunk
from nerfies_jax.training.checkpoint import Checkpoints
from nerfies_jax.training.guard import Snapshot, bad_arrays, last_good, listed
from nerfies_jax.training.model import Event, Frames, Model, TrainState

CHUNK_STEPS = 100  # longer ones gain nothing
CHUNK_SECONDS = 0.5  # a chunk cannot be interrupted: Ctrl-C acts within this time
EVENT_SECONDS = 0.2  # between two `train` events; counting may wait for the device


class Hook(NamedTuple):
    """A callback between chunks of steps that does not change the state.

    `call(state, step, metrics)` receives the state after `step` steps and the mean
    metrics of the last chunk, for example `{"loss": 0.01, "mse": 0.002}`. They are
    empty if no step was taken. The numbers that it returns are kept in the history. Its
    time does not count as training, and it must not keep the state: the next chunk
    overwrites it. It also runs once when the run is complete.
    """

    name: str
    call: Callable[[TrainState, int, dict[str, float]], dict[str, float] | None]
    every_steps: int | None = None
    every_seconds: float | int | None = None  # of training


class History(NamedTuple):
    """Metrics and times of a run so far, as JSON values saved with checkpoints."""

    rows: tuple[dict[str, float], ...] = ()  # per chunk: step, seconds, mean metrics
    evaluations: tuple[dict[str, Any], ...] = ()  # hook, step, seconds, its numbers
    seconds: float = 0.0  # training alone: chunks and events
    compile_seconds: float = 0.0


class FitResult(NamedTuple):
    """Final state of a run and the reason why it ended."""

    state: TrainState
    history: History
    steps: int  # completed
    stopped_by: str  # "steps", "seconds", "non-finite" or a signal's name
    message: str  # one line for the user
    unsaved: str = ""  # why the last state could not be saved

    @property
    def seconds(self) -> float:
        """Seconds of training, of all sessions of the run."""
        return self.history.seconds

    @property
    def training_share(self) -> float:
        """Training time as a share of training and compilation.

        Processor time is measured only for both together.
        """
        both = self.seconds + self.compile_seconds
        return self.seconds / both if both else 0.0

    @property
    def compile_seconds(self) -> float:
        """Seconds of tracing and compiling, of all sessions of the run."""
        return self.history.compile_seconds


def step_key(state: TrainState) -> Key[Array, ""]:
    """Return the PRNG key of the next step, a function of the run's key and the step.

    Args:
      state: Training state.

    Returns:
      The key.
    """
    return jax.random.fold_in(state.key, state.step)


def fit(
    model: Model,
    state: TrainState,
    frames: Frames,
    *,
    steps: int,
    events: Sequence[Event] = (),
    hooks: Sequence[Hook] = (),
    seconds: float | int | None = None,
    checkpoints: Checkpoints | None = None,
    checkpoint_seconds: float | int = 60.0,
    history: History = History(),
    console: rich.console.Console | None = None,
) -> FitResult:
    """Train a model until a number of steps is completed in all.

    Training also ends at Ctrl-C, SIGTERM, SIGHUP, or a number that is not finite in a
    metric or anywhere in the state. In each case the last good state is saved to
    `checkpoints` and returned. A save that fails is reported and retried with the next
    one. It does not end the run.

    An event happens when its step is completed, before a checkpoint of that step, so a
    resumed run repeats the uninterrupted one bit for bit (on XLA:CPU with the same
    PJRT_NPROC). Progress goes to the sinks of `nerfies_jax.runtime.events`: `train`
    events, and `evaluation` events of hooks that return numbers.

    Steps are scanned. One program serves all chunks of a shape, and a second one the
    remainder where events or the end fall between them (`chunk.Program`).

    Args:
      model: The model.
      state: Initial or restored state. It is overwritten.
      frames: Training frames on the device.
      steps: Number of steps of the whole run, counted from its very beginning.
      events: Events in addition to those of the model.
      hooks: Callbacks that do not change the state.
      seconds: Bound on the training time of this call, which counts chunks and events
        but neither compilation nor hooks. None for no bound.
      checkpoints: Writer of checkpoints. None saves nothing.
      checkpoint_seconds: Training seconds between two checkpoints.
      history: History of the run so far, which a restored run must pass on.
      console: Console that shows progress. None for the terminal.

    Returns:
      The last state with its history and the reason why training ended.
    """
    run = _Run(model, state, frames, steps, (*model.events, *events), tuple(hooks))
    run.history, run.checkpoints = history, checkpoints
    run.limits = (math.inf if seconds is None else seconds, checkpoint_seconds)
    run.trained_before = history.seconds
    with (
        StopRequests() as requests,
        event_stream.shown_on(console),
    ):
        with event_stream.stage("training", steps, run.step) as run.stage:
            reason = run.go(requests)
            run.evaluate(reason)
        return run.finish(reason)


class _Run:
    """The host side of one call of `fit`."""

    history: History
    checkpoints: Checkpoints | None
    limits: tuple[float, float]  # seconds of training, and between two checkpoints
    trained_before: float  # seconds
    stage: event_stream.Stage

    def __init__(self, model, state, frames, steps, events, hooks):
        self.model, self.steps, self.hooks = model, steps, hooks
        self.step = int(state.step)
        if steps < self.step:
            raise ValueError(
                f"the run has {self.step} steps behind it and was asked for {steps} in "
                "all; ask for more steps, or start anew"
            )
        self.events = _by_step(events)
        self.frames = jax.tree.map(jnp.asarray, frames)
        self.spread_frames = data_parallel.shared(self.frames, model.devices)
        self.saved_at = time.monotonic()
        self.step_seconds = math.inf  # not known yet: the first chunk is one step
        self.called = {hook.name: [self.step, None] for hook in hooks}
        self.reported = -math.inf, self.step  # when, by the monotonic clock; the step
        self.detail = ""
        bad = bad_arrays(state)
        if bad:
            raise ValueError(
                f"the state to train from is not finite: {listed(bad)}; start from "
                "another one"
            )
        # A copy: the first chunk overwrites its input, which is the caller's.
        self.snapshot = Snapshot(self.step, state)
        self.state = self.snapshot.state()

    def go(self, requests: StopRequests) -> str:
        """Chunk after chunk until there is a reason to stop."""
        while self.step < self.steps:
            if requests.name is not None:
                return requests.name
            program, lower_seconds = chunk.program(
                self.model, self.state, self.spread_frames, self.steps
            )
            if self._left() <= self._half_a_scan(program.length):
                return "seconds"
            self._save_overdue()
            count = self._count(program.length)
            self._add(compile_seconds=lower_seconds + program.prepare(count))
            requests.protect()  # from now on there is something to save
            if not self._chunk(program, count):
                return "non-finite"
            self._after_chunk()
        return "steps"

    def _chunk(self, program, count) -> bool:
        """Run one chunk and the events at its end. False if something became
        non-finite.
        """
        began = time.perf_counter()
        self.state, outcome = program(self.state, self.spread_frames, count)
        done = outcome.done
        if not outcome.finite:
            self.state, self.step, self.detail = last_good(
                program, self.snapshot, self.spread_frames, self.step, self.step + done
            )
            return False
        if int(outcome.step) != self.step + done:
            raise ValueError(
                f"Model.step left state.step at {int(outcome.step)} after step "
                f"{self.step + done}; it must return it one higher each time"
            )
        elapsed = time.perf_counter() - began
        happening = self.events.get(self.step + done, ())
        if not self._happen(happening, self.step + done):
            # Before that step: a run that is resumed must not leave the event out.
            count = self.step + done - 1 - self.snapshot.step
            self.state, self.step = self.snapshot.state(), self.step + done - 1
            if count:
                self.state, _ = program(self.state, self.spread_frames, count)
            return False
        self.step += done
        self.stage.done = self.step
        self.step_seconds = elapsed / done
        self._add(seconds=time.perf_counter() - began)
        metrics = {name: float(x) for name, x in outcome.metrics.items()}
        row = {"step": self.step, "seconds": self.history.seconds, **metrics}
        self.history = self.history._replace(rows=(*self.history.rows, row))
        self.snapshot = self.snapshot.renewed(self.step, self.state, bool(happening))
        return True

    def _happen(self, happening, step) -> bool:
        """Apply the events of a step. False if one made something non-finite."""
        for event in happening:
            self.state = _distinct(event.apply(self.state, self.frames))
            if int(self.state.step) != step:
                raise ValueError(
                    f"event {event.name!r} changed state.step; it must not"
                )
            bad = bad_arrays(self.state)
            if bad:
                self.detail = (
                    f"event {event.name!r} after step {step:,} is not finite: "
                    f"{listed(bad)}"
                )
                return False
        return True

    def _count(self, length: int) -> int:
        """Steps of the next chunk: up to the next event, not too long to wait for.

        Of scans as many as there is time for, of single steps those that are left over.
        """
        stops = [self.steps, self.step + CHUNK_STEPS]
        stops += [step for step in self.events if step > self.step]
        for hook in self.hooks:
            if hook.every_steps is not None:
                stops.append((self.step // hook.every_steps + 1) * hook.every_steps)
        affordable = min(CHUNK_SECONDS, self._left()) / self.step_seconds
        distance = min(stops) - self.step
        if distance < length:
            return distance
        return length * max(1, min(distance, int(affordable)) // length)

    def _left(self) -> float:
        """Seconds of training that this call may still take."""
        return self.limits[0] - (self.history.seconds - self.trained_before)

    def _half_a_scan(self, length: int) -> float:
        """Seconds of half a scan. With less time left than this, no other scan
        begins.
        """
        return length * self.step_seconds / 2 if self.step_seconds < math.inf else 0.0

    def _after_chunk(self) -> None:
        """Run hooks and update the display, none of which is training time."""
        for hook in self.hooks:
            if self._due(hook):
                self._call(hook)
        if self.checkpoints is not None:
            self._tell_failed_save(self.checkpoints.failure())
        if time.monotonic() - self.reported[0] >= EVENT_SECONDS:
            self._report()

    def _report(self) -> None:
        """Emit a `train` event, unless that of this step was emitted."""
        if self.reported[1] == self.step:
            return
        self.reported = time.monotonic(), self.step
        metrics = self._metrics()
        mse = metrics.get("mse", 0.0)
        left = min((self.steps - self.step) * self.step_seconds, self._left())
        event_stream.emit(
            "train",
            step=self.step,
            steps=self.steps,
            seconds=self.history.seconds,
            compile_seconds=self.history.compile_seconds,
            steps_per_second=1 / self.step_seconds,
            eta_seconds=max(left, 0.0),
            psnr=-10 * math.log10(mse) if mse > 0 else None,
            metrics=metrics,
            counts=self.model.counts(self.state),
            memory_bytes=psutil.Process().memory_info().rss,
        )

    def _metrics(self) -> dict[str, float]:
        """Mean metrics of the last chunk, empty before the first."""
        row = self.history.rows[-1] if self.history.rows else {}
        return {k: v for k, v in row.items() if k not in ("step", "seconds")}

    def _due(self, hook: Hook) -> bool:
        last_step, last_seconds = self.called[hook.name]
        if hook.every_steps is not None and self.step % hook.every_steps == 0:
            return self.step != last_step
        if hook.every_seconds is None:
            return False
        passed = self.history.seconds - (last_seconds or 0.0)
        return last_seconds is None or passed >= hook.every_seconds

    def _call(self, hook: Hook) -> None:
        numbers = hook.call(self.state, self.step, self._metrics())
        self.called[hook.name] = [self.step, self.history.seconds]
        if numbers is not None:
            row = {
                "hook": hook.name,
                "step": self.step,
                "seconds": self.history.seconds,
            }
            values = {name: float(value) for name, value in numbers.items()}
            event_stream.emit("evaluation", **row, metrics=values)
            row |= values
            # One row for a step: a complete run that is resumed calls its hooks again.
            earlier = (
                old
                for old in self.history.evaluations
                if (old["hook"], old["step"]) != (hook.name, self.step)
            )
            self.history = self.history._replace(evaluations=(*earlier, row))

    def _tell_failed_save(self, failure) -> None:
        if failure is not None:
            event_stream.message(f"{failure}; training goes on", "warning")

    def _save_overdue(self) -> None:
        """Save only before another chunk, since `finish` saves the last state."""
        trained = self.step_seconds < math.inf  # in this call: there is something new
        if self.checkpoints is None or not trained:
            return
        if time.monotonic() - self.saved_at >= self.limits[1]:
            self._save(self.checkpoints)

    def _save(self, checkpoints: Checkpoints) -> None:
        self._tell_failed_save(checkpoints.failure(wait=True))
        checkpoints.save(self.state, self.step, self.history._asdict())
        self.saved_at = time.monotonic()

    def _add(self, **more: float) -> None:
        values = {name: getattr(self.history, name) + x for name, x in more.items()}
        self.history = self.history._replace(**values)

    def evaluate(self, reason: str) -> None:
        """Report the last step, and call the hooks once more where the run is over."""
        self._report()
        if reason in ("steps", "seconds"):
            for hook in self.hooks:
                if self.called[hook.name] != [self.step, self.history.seconds]:
                    self._call(hook)

    def finish(self, reason: str) -> FitResult:
        """Save the last checkpoint, and say in a line how the run ended."""
        message = f"stopped at step {self.step:,} of {self.steps:,}"
        if reason == "steps":
            message = f"completed {self.step:,} steps"
        elif reason == "seconds":
            message += f" by seconds: the {duration(self.limits[0])} given are over"
        elif reason == "non-finite":
            message += f": {self.detail}"
        else:
            message += f" by {reason}"
        failure = None
        if self.checkpoints is not None:
            self._save(self.checkpoints)
            failure = self.checkpoints.failure(wait=True)
            if failure is None:
                message += f"; saved in {self.checkpoints.folder}"
                if reason not in ("steps", "non-finite"):
                    message += ", resume from there to go on"
        event_stream.message(message)
        unsaved = "" if failure is None else f"the last state is not saved: {failure}"
        return FitResult(self.state, self.history, self.step, reason, message, unsaved)


def _distinct(state: TrainState) -> TrainState:
    """Copies of arrays that stand in several places: one buffer is donated once."""
    seen: set[int] = set()

    def own(leaf):
        if id(leaf) in seen:
            return jnp.copy(leaf)
        seen.add(id(leaf))
        return leaf

    return jax.tree.map(own, state)


def _by_step(events: Sequence[Event]) -> dict[int, list[Event]]:
    schedule: dict[int, list[Event]] = {}
    for event in events:
        if (
            list(event.steps) != sorted(set(event.steps))
            or min(event.steps, default=1) < 1
        ):
            raise ValueError(
                f"event {event.name!r} needs growing steps from 1 on, got "
                f"{event.steps}; what comes before them belongs into Model.init"
            )
        for step in event.steps:
            schedule.setdefault(step, []).append(event)
    return schedule
