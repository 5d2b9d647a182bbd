"""Reconstruction in one call, from a capture or from the last checkpoint of a run."""

import contextlib
import dataclasses
import pathlib
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import CaptureError, describe
from nerfies_jax.capture.external import ExternalFiles
from nerfies_jax.preprocessing import inspection, record
from nerfies_jax.runs import (
    adviser,
    commands,
    effect_choice,
    multiple_hosts,
    plan,
    preparation,
    products,
    quality,
    representations,
    run_folder,
    same_capture,
    train,
    validation,
)
from nerfies_jax.runs.captures import stored_capture
from nerfies_jax.runs.config import MoreMetrics, Preparation, RunConfig
from nerfies_jax.runs.following import following
from nerfies_jax.runs.run import (
    Run,
    initial_state,
    new_run,
    read_config,
    restore,
    save_config,
    saved_run,
    scene_spec,
)
from nerfies_jax.runs.train import Pace
from nerfies_jax.runtime import console, data_parallel, hosts, stopping
from nerfies_jax.training import checkpoint
from nerfies_jax.training.loop import FitResult, Hook

# From the run and its folder to a context that yields a hook of the training loop.
Watched = Callable[[Run, pathlib.Path], contextlib.AbstractContextManager[Hook]]


class Refused(ValueError):
    """The request cannot be fulfilled, and nothing was trained."""


class Outcome(NamedTuple):
    """Result of training a run, and the errors that occurred while writing products."""

    folder: pathlib.Path
    run: Run
    result: FitResult
    errors: tuple[str, ...]  # one line each, empty if there were none


def reconstruct(
    config: RunConfig,
    out: str | pathlib.Path | None = None,
    *,
    effects: Literal["preset", "auto"] | None = None,
    seconds: float | int | None = None,
    evaluate_every: float | int = 20.0,
    evaluate_at: tuple[int, ...] = (),
    checkpoint_every: float | int = 60.0,
    more: MoreMetrics = MoreMetrics(),
    prepare: Preparation = Preparation(),
    watched: Watched | None = None,
    log: Sequence[str] = (),
) -> Outcome:
    """Train a run from its first step and write its products.

    A video or images without cameras are first converted to a capture in the folder
    `OUT-capture`, which is kept. `resume` can continue the run in `out` as soon as the
    folder exists. Events are written to its `events.jsonl` from the beginning
    (`runs.read_events` reads them).

    Args:
      config: Settings of the run.
      out: A new folder for everything. None for `runs/CAPTURE-PRESET`.
      effects: "auto" to enable the effects that the capture needs, or "preset" for
        those of the preset. None for "preset" if `config` names a preset, and "auto" if
        not.
      seconds: Time budget in seconds of training. It determines the number of steps. If
        `config` sets that number, training ends early when the budget is spent.
      evaluate_every: Seconds of training between two evaluations.
      evaluate_at: Steps after which to evaluate as many held-out frames as at the end,
        instead of a few in intervals.
      checkpoint_every: Seconds of training between two checkpoints.
      more: Additional metrics, computed at the end.
      prepare: Settings of the conversion to a capture.
      watched: Context that watches the training, such as `viewer.live`.
      log: Trackers that receive the events: "tensorboard", "wandb", "rerun".

    Returns:
      The run with its result and its folder.

    Raises:
      Refused: If training cannot begin.
    """
    start_time = time.perf_counter()
    with contextlib.ExitStack() as stack:
        stack.enter_context(hosts.dismissing())
        with _refusing():
            pace = Pace(seconds, evaluate_every, checkpoint_every, evaluate_at)
            follow = stack.enter_context(following(log))
            if out is not None:
                out = pathlib.Path(out).absolute()
                run_folder.check_free(out)
            _check_spec(config)
            extra = quality.prepared(more)
            config = _with_cameras(config, out, prepare)
            run = _new_run(config, effects, seconds)
            _describe(run)
            multiple_hosts.check(run)
            validation.check_frames(run)
            extra = quality.fitting(extra, run.capture.size)
            state = initial_state(run)
            if seconds is not None and not run.config.validation:
                left_out = validation.frames_to_leave_out(run, seconds)
                new_config = dataclasses.replace(run.config, validation=left_out)
                run = run._replace(config=new_config)
            if seconds is not None and not _sets_steps(run.config):
                run, line = plan.with_seconds(run, state, seconds)
                console.say(line)
                pace = dataclasses.replace(pace, seconds=plan.OVERRUN * seconds)
            stem = "-".join(run.capture.name.split()) + "-" + run.config.preset
            folder = run_folder.new_run_folder(out, stem)
            stack.enter_context(run_folder.owned(folder))
            notes = record.notes_on(run.capture, CACHE / "evidence")
            save_config(folder, run, notes)
            same_capture.record(folder, run.capture)
            follow.begin(folder, run, None)
            checkpoints = _open_checkpoints(stack, folder, run, state, None)
            hooks = _hooks(stack, watched, run, folder)
        start = state, None, checkpoints
        outcome = _train(folder, run, start, pace, hooks, start_time, extra)
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
    evaluate_at: tuple[int, ...] = (),
    checkpoint_every: float | int = 60.0,
    more: MoreMetrics = MoreMetrics(),
    watched: Watched | None = None,
    log: Sequence[str] = (),
) -> Outcome:
    """Continue a run from its last checkpoint, bit for bit.

    If the run has completed its training, only its products are written again.

    Args:
      folder: The run folder.
      expected: Settings that the run must have been started with: fields of its config
        and of its source by name. If the capture has been moved, its new path.
      overrides: Fields of its spec that it must have been started with, as PATH=VALUE.
      trusted: Names MODULE:NAME of code from other packages that may be loaded if the
        run was started with it. The folder alone cannot cause code to run.
      seconds: Time budget of this call in seconds of training.
      evaluate_every: Seconds of training between two evaluations.
      evaluate_at: Steps after which to evaluate as many held-out frames as at the end,
        instead of a few in intervals.
      checkpoint_every: Seconds of training between two checkpoints.
      more: Additional metrics, computed at the end.
      watched: Context that watches the training, such as `viewer.live`.
      log: Trackers that receive the events: "tensorboard", "wandb", "rerun".

    Returns:
      The run with its result and its folder.

    Raises:
      Refused: If settings, images or cameras differ from those at the start of the run,
        or another process is working in the folder.
    """
    start_time = time.perf_counter()
    folder = pathlib.Path(folder)
    with contextlib.ExitStack() as stack:
        stack.enter_context(hosts.dismissing())
        with _refusing():
            pace = Pace(seconds, evaluate_every, checkpoint_every, evaluate_at)
            follow = stack.enter_context(following(log))
            new_paths = _check_expected(folder, expected)
            stack.enter_context(run_folder.owned(folder))
            extra = quality.prepared(more)
            run = saved_run(folder, overrides, new_paths, trusted)
            _describe(run)
            multiple_hosts.check(run)
            validation.check_frames(run)
            extra = quality.fitting(extra, run.capture.size)
            state, history, after = _restore(folder, run)
            follow.begin(folder, run, after or 0)
            checkpoints = _open_checkpoints(stack, folder, run, state, after)
            hooks = _hooks(stack, watched, run, folder)
        start = state, history, checkpoints
        outcome = _train(folder, run, start, pace, hooks, start_time, extra)
        follow.end(outcome.result, outcome.errors)
        return outcome


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """Convert errors in settings, captures and folders to `Refused`."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise Refused(str(error)) from error


def _check_spec(config):
    """Refuse wrong settings before the minutes that cameras and tracks may take.

    If the preset is yet to be chosen from the tracks, overrides are refused only if no
    candidate accepts them.
    """
    names = [config.preset]
    if config.preset is None:
        names = [n for each, _ in representations.choosing() for n in each.presets]
    errors = []
    for name in names:
        try:
            scene_spec(dataclasses.replace(config, preset=name))
        except ValueError as error:
            errors.append(error)
    if errors and len(errors) == len(names):
        raise errors[0]


def _with_cameras(config, out, how):
    """Return the config with a capture as its source, converted first if needed."""
    source = config.source.capture
    if source is not None:
        run_folder.refuse_run(source)
    if source is None or not preparation.needed(source):
        if how != Preparation():
            raise ValueError(
                "settings of the conversion (prepare) apply to videos and images "
                f"without cameras, but {source or 'a built-in scene'} has cameras; "
                "remove them"
            )
        return config
    out = out or pathlib.Path("runs") / source.stem
    folder = preparation.prepared(source, out.with_name(f"{out.name}-capture"), how)
    new_source = dataclasses.replace(config.source, capture=folder)
    return dataclasses.replace(config, source=new_source)


def _sets_steps(config):
    """Test if a config sets the number of steps."""
    overridden = any(text.startswith("steps=") for text in config.overrides)
    return overridden or config.steps is not None


def _new_run(config, effects, seconds):
    if config.preset is not None and effects != "auto":
        return new_run(config)
    capture = stored_capture(config.source, config.seed)
    new_config, lines = config, []
    if config.preset is None:
        budget = None if _sets_steps(config) else seconds
        try_out = None if effects == "preset" else effect_choice.compare_configs
        new_config, lines = adviser.by_tracks(config, capture, budget, try_out)
        if effects != "preset":
            new_config, effect_lines = effect_choice.choose(
                new_config, capture, config.overrides
            )
            lines += effect_lines
    else:
        findings = inspection.inspect(capture, CACHE / "evidence").findings
        new_config, lines = adviser.follow(new_config, config.overrides, findings)
    console.say("\n".join(lines))
    return new_run(new_config, capture)


def _describe(run):
    resources = run.representation.resources
    shares, setting = resources.shares(run.spec), resources.share_setting
    idle = data_parallel.idle_note(run.model.devices, shares, setting)
    for line in (*describe(run.capture), *idle):
        console.say(line)


def _check_expected(folder, settings):
    """Check that a run was started with the expected settings.

    Returns the new paths of files of its source that have been moved, by field name.
    Raises ValueError with the saved and the expected value of each difference.
    """
    config = read_config(folder)
    values = {**vars(config), **vars(config.source)}
    capture, source = values["capture"], settings.get("capture")
    if capture is not None and source is not None and run_folder.is_of(capture, source):
        settings = {**settings, "capture": capture}  # also if `source` is its video
    new_paths = {k: x for k, x in settings.items() if _has_moved(values[k], x)}
    values = values | new_paths
    differences = [
        f"{name.replace('_', '-')}: saved {values[name]}, now {value}"
        for name, value in settings.items()
        if value != values[name]
    ]
    if differences:
        raise ValueError(
            f"{folder}: the run was started with other settings: "
            f"{'; '.join(differences)}; leave them out to continue it, or start a new "
            "run in another folder, out=..."
        )
    return new_paths


def _has_moved(old, new):
    """Test if a file that is missing may be the one at a new path."""
    if isinstance(old, ExternalFiles):
        pairs = [(x, getattr(new, name)) for name, x in vars(old).items()]
        different = [(x, y) for x, y in pairs if x != y]
        return bool(different) and all(_has_moved(x, y) for x, y in different)
    are_paths = isinstance(old, pathlib.Path) and isinstance(new, pathlib.Path)
    return are_paths and not old.exists() and new.exists()


def _restore(folder, run):
    """Return the newest saved state, the history and the step of a run.

    If it was killed before it saved any, the initial state without the other two.
    """
    if checkpoint.latest(folder / run_folder.CHECKPOINTS) is None:
        return initial_state(run), None, None
    latest = restore(folder, run, newest=True)
    return latest.state, latest.record, latest.step


def _open_checkpoints(stack, folder, run, state, after):
    """Open the checkpoints of a run, and save the initial state of a new run."""
    line = commands.resume(folder, run.code)
    stopping.advise(f"continue with: {line}")
    checkpoints = stack.enter_context(train.open_checkpoints(folder, run, after))
    if after is None:
        checkpoints.save(state, 0)
        checkpoints.wait()
    return checkpoints


def _hooks(stack, observer, run, folder):
    """Return the hooks of observers, which stay active until `stack` is closed."""
    return () if observer is None else (stack.enter_context(observer(run, folder)),)


def _train(folder, run, start, pace, hooks, start_time, extra):
    """Train a run to its end and write its products."""
    with multiple_hosts.sharing(folder, run) as shared_run:
        training = train.train(shared_run, *start, pace, hooks)
    result = training.result
    errors = [result.unsaved] if result.unsaved else []
    if result.stopped_by in ("steps", "seconds", "non-finite"):
        try:
            products.make(folder, run, training, start_time, extra)
        except FloatingPointError as error:
            errors.append(str(error))
        except (OSError, CaptureError) as error:
            errors.append(
                f"some products of the run could not be written: {error}; free disk "
                "space and resume the run to write them"
            )
    if result.stopped_by == "non-finite":
        errors.append(
            f"{result.message}; start a new run with lower learning rates "
            f"(their names are in {folder / run_folder.CONFIG})"
        )
    return Outcome(folder, run, result, tuple(errors))
