"""Reconstruction in one call, from a capture or on from a checkpoint."""

import contextlib
import dataclasses
import pathlib
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import CaptureError, describe
from nerfies_jax.capture.given import GivenFiles
from nerfies_jax.preprocessing import inspection, record
from nerfies_jax.runs import (
    adviser,
    commands,
    plan,
    preparation,
    products,
    quality,
    representations,
    run_folder,
    same_capture,
    train,
)
from nerfies_jax.runs.config import MoreMetrics, Preparation, RunConfig
from nerfies_jax.runs.following import following
from nerfies_jax.runs.run import (
    Run,
    first_state,
    new_run,
    read_config,
    restore,
    save_config,
    saved_run,
    scene_spec,
    stored_capture,
)
from nerfies_jax.runs.train import Pace
from nerfies_jax.runtime import console, stopping
from nerfies_jax.training import checkpoint
from nerfies_jax.training.loop import FitResult, Hook

# (run, its folder) -> what is called between chunks of steps while the run is trained
Watched = Callable[[Run, pathlib.Path], contextlib.AbstractContextManager[Hook]]


class Refused(ValueError):
    """The request cannot be fulfilled, and nothing was trained."""


class Outcome(NamedTuple):
    """Result of a run with its folder, and errors."""

    folder: pathlib.Path
    run: Run
    result: FitResult
    errors: tuple[str, ...]  # one line each; empty where all went well


def reconstruct(
    config: RunConfig,
    out: str | pathlib.Path | None = None,
    *,
    effects: Literal["preset", "auto"] = "preset",
    seconds: float | int | None = None,
    evaluate_every: float | int = 20.0,
    checkpoint_every: float | int = 60.0,
    more: MoreMetrics = MoreMetrics(),
    prepare: Preparation = Preparation(),
    watched: Watched | None = None,
    log: Sequence[str] = (),
) -> Outcome:
    """Train a run from its first step and write its products.

    A video or images without cameras are converted first into a folder `OUT-capture`,
    which is kept. From the first moment on, `resume` can continue the run in `out`. Its
    events are in `events.jsonl` from the beginning on (`runs.read_events`).

    Args:
      config: Settings of the run.
      out: A new folder for everything. None for `runs/CAPTURE-PRESET`.
      effects: "preset", or "auto" to enable the effects that the capture needs.
      seconds: Seconds of training, which determine the number of steps or, if that is
        set, end training early.
      evaluate_every: Seconds of training between two evaluations.
      checkpoint_every: Seconds of training between two checkpoints.
      more: Additional metrics, computed at the end.
      prepare: Settings of the conversion to a capture.
      watched: Context that watches the training, such as `viewer.live`.
      log: Trackers that receive the events: "tensorboard", "wandb", "rerun".

    Returns:
      The result.

    Raises:
      Refused: If training cannot begin.
    """
    began = time.perf_counter()
    with contextlib.ExitStack() as held:
        with _refusing():
            pace = Pace(seconds, evaluate_every, checkpoint_every)
            follow = held.enter_context(following(log))
            if out is not None:
                out = pathlib.Path(out).absolute()
                run_folder.check_free(out)
            _check_spec(config)
            extra = quality.prepared(more)
            config = _with_cameras(config, out, prepare)
            run = _new_run(config, effects)
            _describe(run)
            quality.check(extra, run.capture.size)
            state = first_state(run)
            if seconds is not None and not _steps_given(run.config):
                run, line = plan.with_seconds(run, state, seconds)
                console.say(line)
                pace = dataclasses.replace(pace, seconds=plan.OVERRUN * seconds)
            stem = "-".join(run.capture.name.split()) + "-" + run.config.preset
            folder = run_folder.new_run_folder(out, stem)
            held.enter_context(run_folder.owned(folder))
            left_out = record.notes_on(run.capture, CACHE / "evidence")
            save_config(folder, run, left_out)
            same_capture.record(folder, run.capture)
            follow.begin(folder, run, None)
            checkpoints = _opened(held, folder, run, state, None)
            hooks = _watching(held, watched, run, folder)
        start = state, None, checkpoints
        outcome = _finished(folder, run, start, pace, hooks, began, extra)
        follow.end(outcome.result, outcome.errors)
        return outcome


def resume(
    folder: str | pathlib.Path,
    *,
    expected: Mapping[str, Any] = {},
    overrides: tuple[str, ...] = (),
    trusted: Collection[str] = (),
    seconds: float | int | None = None,
    evaluate_every: float | int = 20.0,
    checkpoint_every: float | int = 60.0,
    more: MoreMetrics = MoreMetrics(),
    watched: Watched | None = None,
    log: Sequence[str] = (),
) -> Outcome:
    """Continue a run from its last checkpoint, bit for bit.

    A complete run gets its products written again.

    Args:
      folder: The run folder.
      expected: Settings that the run must have been started with: fields of its config
        and of its source by name. A capture that was moved since is named at its new
        place.
      overrides: Fields of its spec that it must have been started with, as PATH=VALUE.
      trusted: Names MODULE:NAME of code from other packages that may be loaded if the
        run was started with it. The folder alone cannot cause code to run.
      seconds: Seconds of training of this call.
      evaluate_every: Seconds of training between two evaluations.
      checkpoint_every: Seconds of training between two checkpoints.
      more: Additional metrics, computed at the end.
      watched: Context that watches the training, such as `viewer.live`.
      log: Trackers that receive the events: "tensorboard", "wandb", "rerun".

    Returns:
      The result.

    Raises:
      Refused: If settings, images or cameras differ from those at the start of the run,
        or another process is working in the folder.
    """
    began = time.perf_counter()
    folder = pathlib.Path(folder)
    with contextlib.ExitStack() as held:
        with _refusing():
            pace = Pace(seconds, evaluate_every, checkpoint_every)
            follow = held.enter_context(following(log))
            moved = _check_expected(folder, expected)
            held.enter_context(run_folder.owned(folder))
            extra = quality.prepared(more)
            run = saved_run(folder, overrides, moved, trusted)
            _describe(run)
            quality.check(extra, run.capture.size)
            state, record, after = _restored(folder, run)
            follow.begin(folder, run, after or 0)
            checkpoints = _opened(held, folder, run, state, after)
            hooks = _watching(held, watched, run, folder)
        start = state, record, checkpoints
        outcome = _finished(folder, run, start, pace, hooks, began, extra)
        follow.end(outcome.result, outcome.errors)
        return outcome


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """Raise errors of readers of settings, captures and folders as Refused."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise Refused(str(error)) from error


def _check_spec(config):
    """Refuse wrong settings before minutes of looking for cameras and motion.

    Of a preset that tracks will choose, what none of those allows.
    """
    names = [config.preset]
    if config.preset is None:
        names = [n for each, _ in representations.choosing() for n in each.presets]
    refused = []
    for name in names:
        try:
            scene_spec(dataclasses.replace(config, preset=name))
        except ValueError as error:
            refused.append(error)
    if refused and len(refused) == len(names):
        raise refused[0]


def _with_cameras(config, out, how):
    """The config, its source a capture: prepared now, or before, if it was none."""
    source = config.source.capture
    if source is not None:
        run_folder.refuse_run(source)
    if source is None or not preparation.needed(source):
        if how != Preparation():
            raise ValueError(
                "prepare is for videos and images without cameras, and "
                f"{source or 'a built-in scene'} has its own; leave it out"
            )
        return config
    out = out or pathlib.Path("runs") / source.stem
    folder = preparation.prepared(source, out.with_name(f"{out.name}-capture"), how)
    named = dataclasses.replace(config.source, capture=folder)
    return dataclasses.replace(config, source=named)


def _steps_given(config):
    """Test if the user has set the number of steps."""
    given = any(words.startswith("steps=") for words in config.overrides)
    return given or config.steps is not None


def _new_run(config, effects):
    if config.preset is not None and effects == "preset":
        return new_run(config)
    stored = stored_capture(config.source, config.seed)
    chosen, lines = config, []
    if config.preset is None:
        chosen, lines = adviser.by_tracks(config, stored)
    if effects == "auto":
        inspected = inspection.inspect(stored, CACHE / "evidence")
        found = inspected.findings
        chosen, more = adviser.follow(chosen, config.overrides, found)
        lines += more
    console.say("\n".join(lines))
    return new_run(chosen, stored)


def _describe(run):
    for line in describe(run.capture):
        console.say(line)


def _check_expected(folder, expected):
    """Raise ValueError naming both values where a run was started with others.

    Returns what of its source has been moved since, by name.
    """
    config = read_config(folder)
    stored = {**vars(config), **vars(config.source)}
    there, source = stored["capture"], expected.get("capture")
    if there is not None and source is not None and run_folder.is_of(there, source):
        expected = {**expected, "capture": there}  # or a film that it was made of
    moved = {k: x for k, x in expected.items() if _has_moved(stored[k], x)}
    stored = stored | moved
    unlike = [
        f"{name.replace('_', '-')}: saved {stored[name]}, now {value}"
        for name, value in expected.items()
        if value != stored[name]
    ]
    if unlike:
        raise ValueError(
            f"{folder}: the run was started with other settings: {'; '.join(unlike)}; "
            "leave them out to continue it, or start anew in another folder, out=..."
        )
    return moved


def _has_moved(old, new):
    """Test if a missing file or folder may be the one that is named now."""
    if isinstance(old, GivenFiles):
        pairs = [(x, getattr(new, name)) for name, x in vars(old).items()]
        unlike = [(x, y) for x, y in pairs if x != y]
        return bool(unlike) and all(_has_moved(x, y) for x, y in unlike)
    paths = isinstance(old, pathlib.Path) and isinstance(new, pathlib.Path)
    return paths and not old.exists() and new.exists()


def _restored(folder, run):
    """The newest state saved, its record and step.

    The first one, without them, where the run was killed before it saved that.
    """
    if checkpoint.latest(folder / run_folder.CHECKPOINTS) is None:
        return first_state(run), None, None
    restored = restore(folder, run)
    return restored.state, restored.record, restored.step


def _opened(held, folder, run, state, after):
    """Open the checkpoints of a run, and save the state of a new one."""
    line = commands.resume(folder, run.code)
    stopping.advise(f"continue with: {line}")
    checkpoints = held.enter_context(train.open_checkpoints(folder, run, after))
    if after is None:
        checkpoints.save(state, 0)
        checkpoints.wait()
    return checkpoints


def _watching(held, watched, run, folder):
    """The hooks of who looks on, for as long as `held` is."""
    return () if watched is None else (held.enter_context(watched(run, folder)),)


def _finished(folder, run, start, pace, hooks, began, extra):
    """The outcome of training to the end, with what is to be seen of it written."""
    trained = train.train(run, *start, pace, hooks)
    result = trained.result
    errors = [result.unsaved] if result.unsaved else []
    if result.stopped_by in ("steps", "seconds", "non-finite"):
        try:
            products.make(folder, run, trained, began, extra)
        except FloatingPointError as error:
            errors.append(str(error))
        except (OSError, CaptureError) as error:
            errors.append(
                f"not all of what came of the run is written: {error}; resume the run "
                "once there is room"
            )
    if result.stopped_by == "non-finite":
        errors.append(
            f"{result.message}; start anew with lower learning rates "
            f"(their names are in {folder / run_folder.CONFIG})"
        )
    return Outcome(folder, run, result, tuple(errors))
