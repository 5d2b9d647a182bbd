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

from nerfies_jax.runtime import events as event_stream
from nerfies_jax.runtime.progress import duration
from nerfies_jax.runtime.stopping import StopRequests
from nerfies_jax.training import best, chunk, frame_stream
from nerfies_jax.training.checkpoint import Checkpoints
from nerfies_jax.training.guard import Snapshot, bad_arrays, join_names, last_good
from nerfies_jax.training.model import Event, Model, TrainState

CHUNK_STEPS = 100  # longer chunks are not faster
CHUNK_SECONDS = 0.5  # a chunk cannot be interrupted, so this bounds the delay of Ctrl-C
EVENT_SECONDS = 0.2  # between `train` events, which may have to wait for the device


class Hook(NamedTuple):
    """A callback between chunks of steps that does not change the state.

    `call(state, step, metrics)` receives the state after `step` steps and the mean
    metrics of the last chunk, for example `{"loss": 0.01, "mse": 0.002}`. They are
    empty if no step was made. The numbers that it returns are stored in the history.
    Its time does not count as training. It must not keep a reference to the state,
    which the next chunk overwrites. It is also called when the run is complete.
    """

    name: str
    call: Callable[[TrainState, int, dict[str, float]], dict[str, float] | None]
    every_steps: int | None = None
    every_seconds: float | int | None = None  # training time
    at_steps: tuple[int, ...] = ()


class History(NamedTuple):
    """Metrics and times of a run so far, as JSON values saved with checkpoints."""

    rows: tuple[dict[str, float], ...] = ()  # per chunk: step, seconds, mean metrics
    evaluations: tuple[dict[str, Any], ...] = ()  # hook, step, seconds, numbers
    seconds: float = 0.0  # training time, of chunks and events
    compile_seconds: float = 0.0
    # Processor time of training, of all threads. NaN after a session of an earlier
    # version, which did not measure it.
    cpu_seconds: float = 0.0


class FitResult(NamedTuple):
    """Final state of a run and the reason why it ended."""

    state: TrainState
    history: History
    steps: int  # completed
    stopped_by: str  # "steps", "seconds", "non-finite" or a signal's name
    message: str  # one line for the user
    unsaved: str = ""  # reason if the last state could not be saved

    @property
    def seconds(self) -> float:
        """Seconds of training, of all sessions of the run."""
        return self.history.seconds

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
    frames: frame_stream.TrainingFrames,
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
    """Train a model until a total number of steps is completed.

    Training also ends at Ctrl-C, SIGTERM, SIGHUP, or if a metric or any value of the
    state is not finite. In each case the last finite state is saved to `checkpoints`
    and returned. If saving fails, a warning is printed, training continues, and the
    next checkpoint is tried.

    Events are applied after their step and before a checkpoint of that step, so a
    resumed run is equal to an uninterrupted one bit for bit (on XLA:CPU with the same
    PJRT_NPROC). The state with the highest PSNR of the hook `best.VALIDATION` is saved
    as soon as it is evaluated, and kept.

    Progress goes to the sinks of `nerfies_jax.runtime.events`, as `train` events and as
    `evaluation` events for hooks that return numbers.

    Steps run in compiled scans. One program runs all chunks of the same shape, and a
    second one the remaining steps before events and before the end (`chunk.Program`).

    Args:
      model: The model.
      state: Initial or restored state. It is overwritten.
      frames: Training frames on the device, or a stream of them.
      steps: Total number of steps of the run, including those of earlier sessions.
      events: Events in addition to those of the model.
      hooks: Callbacks that do not change the state.
      seconds: Maximum training time of this call, which includes chunks and events
        but neither compilation nor hooks. None for no bound.
      checkpoints: Writer of checkpoints. None saves nothing.
      checkpoint_seconds: Training seconds between two checkpoints.
      history: History of earlier sessions of the run, if it is resumed.
      console: Console that shows progress. None for the terminal.

    Returns:
      The last state with its history and the reason why training ended.
    """
    run = _Run(model, state, frames, steps, (*model.events, *events), tuple(hooks))
    run.history, run.checkpoints = history, checkpoints
    if checkpoints is not None:
        checkpoints.best = best.highest_step(history.evaluations)
    run.limits = (math.inf if seconds is None else seconds, checkpoint_seconds)
    run.trained_before = history.seconds
    with (
        StopRequests() as requests,
        event_stream.shown_on(console),
    ):
        with event_stream.stage("training", steps, run.step) as run.stage:
            reason = run.train(requests)
            run.evaluate(reason)
        return run.finish(reason)


class _Run:
    """The host side of one call of `fit`."""

    history: History
    checkpoints: Checkpoints | None
    limits: tuple[float, float]  # seconds of training, and between checkpoints
    trained_before: float  # seconds
    stage: event_stream.Stage

    def __init__(self, model, state, frames, steps, events, hooks):
        self.model, self.steps, self.hooks = model, steps, hooks
        self.step = int(state.step)
        if steps < self.step:
            raise ValueError(
                f"the run has completed {self.step} steps, but steps={steps}; increase "
                "steps, or start a new run"
            )
        self.events = _by_step(events)
        self.frames, self.device_frames = frame_stream.replicate(frames, model.devices)
        self.saved_at = time.monotonic()
        self.is_best = False  # the current state, by validation
        self.step_seconds = math.inf  # unknown
        self.last_calls = {hook.name: [self.step, None] for hook in hooks}
        self.last_report = -math.inf, self.step  # monotonic clock, step
        self.failure_detail = ""
        bad = bad_arrays(state)
        if bad:
            raise ValueError(
                f"the initial state is not finite: {join_names(bad)}; "
                "start from another"
            )
        # A copy, because the first chunk overwrites its input, which is the caller's.
        self.snapshot = Snapshot(self.step, state)
        self.state = self.snapshot.state()

    def train(self, requests: StopRequests) -> str:
        """Run chunks until there is a reason to stop, and return the reason."""
        while self.step < self.steps:
            if requests.name is not None:
                return requests.name
            program, lower_seconds = chunk.program(
                self.model, self.state, self.device_frames, self.steps
            )
            if self._seconds_left() <= self._half_scan_seconds(program.length):
                return "seconds"
            self._save_if_due()
            count = self._count(program.length)
            self._add_time(compile_seconds=lower_seconds + program.prepare(count))
            requests.protect()  # from now on there are results to save
            if not self._chunk(program, count):
                return "non-finite"
            self._after_chunk()
        return "steps"

    def _chunk(self, program, count) -> bool:
        """Run one chunk and the events after it. Return False if not all is finite."""
        began, cpu_began = time.perf_counter(), time.process_time()
        self.state, outcome = program(self.state, self.device_frames, count)
        steps = outcome.done
        if not outcome.finite:
            self.state, self.step, self.failure_detail = last_good(
                program, self.snapshot, self.device_frames, self.step, self.step + steps
            )
            return False
        if int(outcome.step) != self.step + steps:
            raise ValueError(
                f"Model.step returned state.step={int(outcome.step)} after step "
                f"{self.step + steps}; each step must increase it by one"
            )
        seconds = time.perf_counter() - began
        due_events = self.events.get(self.step + steps, ())
        if not self._apply_events(due_events, self.step + steps):
            # Go back to before that step, so that a resumed run applies the event.
            count = self.step + steps - 1 - self.snapshot.step
            self.state, self.step = self.snapshot.state(), self.step + steps - 1
            if count:
                self.state, _ = program(self.state, self.device_frames, count)
            return False
        self.step += steps
        self.stage.done = self.step
        self.step_seconds = seconds / steps
        self._add_time(
            seconds=time.perf_counter() - began,
            cpu_seconds=time.process_time() - cpu_began,
        )
        metrics = {name: float(x) for name, x in outcome.metrics.items()}
        row = {**self._position(), **metrics}
        self.history = self.history._replace(rows=(*self.history.rows, row))
        self.snapshot = self.snapshot.renew(self.step, self.state, bool(due_events))
        return True

    def _apply_events(self, due_events, step) -> bool:
        """Apply the events of a step. Return False if the state is not finite then."""
        for event in due_events:
            self.state = _distinct(event.apply(self.state, self.frames))
            if int(self.state.step) != step:
                raise ValueError(f"event {event.name!r} must not change state.step")
            bad = bad_arrays(self.state)
            if bad:
                self.failure_detail = (
                    f"event {event.name!r} after step {step:,} is not finite: "
                    f"{join_names(bad)}"
                )
                return False
        return True

    def _count(self, length: int) -> int:
        """Choose the number of steps of the next chunk, at most up to the next event.

        It is as many whole scans as fit the time, or else the remaining single steps.
        """
        stops = [self.steps, self.step + CHUNK_STEPS]
        stops += [step for step in self.events if step > self.step]
        for hook in self.hooks:
            if hook.every_steps is not None:
                stops.append((self.step // hook.every_steps + 1) * hook.every_steps)
            stops += [step for step in hook.at_steps if step > self.step]
        affordable = min(CHUNK_SECONDS, self._seconds_left()) / self.step_seconds
        distance = min(stops) - self.step
        if distance < length:
            return distance
        return length * max(1, min(distance, int(affordable)) // length)

    def _seconds_left(self) -> float:
        """Return the training time that is left of the bound."""
        return self.limits[0] - (self.history.seconds - self.trained_before)

    def _half_scan_seconds(self, length: int) -> float:
        """Return half the time of a scan, the least time with which to start one."""
        return length * self.step_seconds / 2 if self.step_seconds < math.inf else 0.0

    def _after_chunk(self) -> None:
        """Run hooks and update the display, none of which is training time."""
        for hook in self.hooks:
            if self._is_due(hook):
                self._call_hook(hook)
        if self.checkpoints is not None:
            self._report_failed_save(self.checkpoints.failure())
        if time.monotonic() - self.last_report[0] >= EVENT_SECONDS:
            self._report()

    def _report(self) -> None:
        """Emit a `train` event, unless one was emitted for this step."""
        if self.last_report[1] == self.step:
            return
        self.last_report = time.monotonic(), self.step
        metrics = self._metrics()
        mse = metrics.get("mse", 0.0)
        remaining = (self.steps - self.step) * self.step_seconds
        remaining = min(remaining, self._seconds_left())
        event_stream.emit(
            "train",
            **self._position(),
            steps=self.steps,
            compile_seconds=self.history.compile_seconds,
            steps_per_second=1 / self.step_seconds,
            eta_seconds=max(remaining, 0.0),
            psnr=-10 * math.log10(mse) if mse > 0 else None,
            metrics=metrics,
            counts=self.model.counts(self.state),
            memory_bytes=psutil.Process().memory_info().rss,
        )

    def _position(self) -> dict[str, Any]:
        """Return the steps and the times of training so far."""
        history = self.history
        return {
            "step": self.step,
            "seconds": history.seconds,
            "cpu_seconds": history.cpu_seconds,
        }

    def _metrics(self) -> dict[str, float]:
        """Mean metrics of the last chunk, empty before the first."""
        row = self.history.rows[-1] if self.history.rows else {}
        return {k: v for k, v in row.items() if k not in self._position()}

    def _is_due(self, hook: Hook) -> bool:
        last_step, last_seconds = self.last_calls[hook.name]
        if hook.every_steps is not None and self.step % hook.every_steps == 0:
            return self.step != last_step
        if self.step in hook.at_steps:
            return self.step != last_step
        if hook.every_seconds is None:
            return False
        interval = self.history.seconds - (last_seconds or 0.0)
        return last_seconds is None or interval >= hook.every_seconds

    def _call_hook(self, hook: Hook) -> None:
        numbers = hook.call(self.state, self.step, self._metrics())
        self.last_calls[hook.name] = [self.step, self.history.seconds]
        if numbers is not None:
            row: dict[str, Any] = {"hook": hook.name, **self._position()}
            values = {name: float(value) for name, value in numbers.items()}
            event_stream.emit("evaluation", **row, metrics=values)
            row |= values
            # One row per step, because resuming a complete run calls its hooks again.
            other_rows = (
                old
                for old in self.history.evaluations
                if (old["hook"], old["step"]) != (hook.name, self.step)
            )
            self.history = self.history._replace(evaluations=(*other_rows, row))
            if hook.name == best.VALIDATION:
                self._mark_best()

    def _mark_best(self) -> None:
        """Keep the checkpoint of the best state so far."""
        step = best.highest_step(self.history.evaluations)
        self.is_best = step == self.step
        if self.checkpoints is not None:
            self.checkpoints.best = step

    def _report_failed_save(self, failure) -> None:
        if failure is not None:
            event_stream.message(f"{failure}; training continues", "warning")

    def _save_if_due(self) -> None:
        """Save before another chunk. `finish` saves the last state."""
        has_trained = self.step_seconds < math.inf  # in this call
        if self.checkpoints is None or not has_trained:
            return
        if self.is_best or time.monotonic() - self.saved_at >= self.limits[1]:
            self._save(self.checkpoints)

    def _save(self, checkpoints: Checkpoints) -> None:
        self._report_failed_save(checkpoints.failure(wait=True))
        checkpoints.save(self.state, self.step, self.history._asdict())
        self.saved_at = time.monotonic()
        self.is_best = False

    def _add_time(self, **seconds: float) -> None:
        values = {name: getattr(self.history, name) + x for name, x in seconds.items()}
        self.history = self.history._replace(**values)

    def evaluate(self, reason: str) -> None:
        """Report the last step, and call the hooks if the run is complete."""
        self._report()
        if reason in ("steps", "seconds"):
            for hook in self.hooks:
                if self.last_calls[hook.name] != [self.step, self.history.seconds]:
                    self._call_hook(hook)

    def finish(self, reason: str) -> FitResult:
        """Save the last checkpoint, and report in one line how the run ended."""
        message = f"stopped at step {self.step:,} of {self.steps:,}"
        if reason == "steps":
            message = f"completed {self.step:,} steps"
        elif reason == "seconds":
            message += f" at the time limit of {duration(self.limits[0])}"
        elif reason == "non-finite":
            message += f": {self.failure_detail}"
        else:
            message += f" by {reason}"
        failure = None
        if self.checkpoints is not None:
            self._save(self.checkpoints)
            failure = self.checkpoints.failure(wait=True)
            if failure is None:
                message += f"; saved in {self.checkpoints.folder}"
                if reason not in ("steps", "non-finite"):
                    message += ", from where it can be resumed"
        event_stream.message(message)
        error = "" if failure is None else f"the last state is not saved: {failure}"
        return FitResult(self.state, self.history, self.step, reason, message, error)


def _distinct(state: TrainState) -> TrainState:
    """Copy arrays that occur several times, because buffers are donated only once."""
    ids: set[int] = set()

    def copy_duplicate(leaf):
        if id(leaf) in ids:
            return jnp.copy(leaf)
        ids.add(id(leaf))
        return leaf

    return jax.tree.map(copy_duplicate, state)


def _by_step(events: Sequence[Event]) -> dict[int, list[Event]]:
    schedule: dict[int, list[Event]] = {}
    for event in events:
        if (
            list(event.steps) != sorted(set(event.steps))
            or min(event.steps, default=1) < 1
        ):
            raise ValueError(
                f"event {event.name!r} needs ascending steps of at least 1, got "
                f"{event.steps}; changes before the first step belong in Model.init"
            )
        for step in event.steps:
            schedule.setdefault(step, []).append(event)
    return schedule
