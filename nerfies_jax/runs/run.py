"""A run: its capture, scene and model, and the settings in its folder."""

import contextlib
import dataclasses
import json
import pathlib
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import psutil

from nerfies_jax.capture import frame_memory, pinholes
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.errors import UNEXPECTED_CONTENT, FileError
from nerfies_jax.capture.json_files import read_json, write_json
from nerfies_jax.evaluation import with_refined_cameras
from nerfies_jax.evaluation.representation import Representation
from nerfies_jax.preprocessing import frame_flow, frame_masks
from nerfies_jax.runs import representations, same_capture, trust
from nerfies_jax.runs.captures import stored_capture
from nerfies_jax.runs.config import CaptureNotFound, RunConfig
from nerfies_jax.runs.run_folder import CHECKPOINTS, CONFIG, PREPROCESSING_NOTES
from nerfies_jax.runtime import events
from nerfies_jax.training import best, checkpoint, specs
from nerfies_jax.training.model import Model, TrainState
from nerfies_jax.training.provenance import provenance


class Settings(NamedTuple):
    """Contents of a `config.json`."""

    config: RunConfig
    representation: Representation
    spec: Any  # of the representation's `spec_type`


class Run(NamedTuple):
    """Capture, scene and model of a run."""

    config: RunConfig
    # Training images, with data that was computed for the model.
    capture: Capture
    # Images that held-out frames are scored against (`pinholes.scorable`).
    observed: Capture
    representation: Representation
    spec: Any  # of the representation's `spec_type`
    metadata: Any  # scene metadata computed from the capture
    model: Model

    @property
    def code(self) -> tuple[str, ...]:
        """Names of the code from other packages that the run needs."""
        settings = {"config": vars(self.config), "spec": specs.as_json(self.spec)}
        return trust.outside_names(settings, type(self.spec))


def new_run(config: RunConfig, stored: Capture | None = None) -> Run:
    """Create a run from its settings.

    Args:
      config: Settings of the run.
      stored: Result of `stored_capture`, if it has already been read.

    Returns:
      The run.

    Raises:
      ValueError: If settings or capture are invalid, or no frames are held out.
    """
    representation = representations.of_preset(config.preset_name)
    run = open_run(config, representation, scene_spec(config), stored)
    # Otherwise the error would occur after training.
    if not len(run.capture.heldout):
        raise ValueError(
            f"{run.capture.path or run.capture.name}: no held-out frames to evaluate; "
            "use three images or more, or hold out every 8th with heldout=8"
        )
    return run


def open_run(
    config: RunConfig,
    representation: Representation,
    spec: Any,
    stored: Capture | None = None,
) -> Run:
    """Read the capture and build the model.

    Args:
      config: Settings of the run.
      representation: Representation of its preset.
      spec: Spec of the representation.
      stored: Result of `stored_capture`, if it has already been read.

    Returns:
      The run.
    """
    stored = stored or stored_capture(config.source, config.seed)
    observed = pinholes.scorable(stored)
    run = _build(config, representation, spec, observed, observed)
    capture = _add_required(observed, run.model.required_data)
    if capture is observed:
        return run
    return _build(config, representation, spec, capture, observed)


def _add_required(capture, required_data):
    """Add optical flow and masks computed from the images if the model needs them.

    Missing depth cannot be computed and becomes a note.
    """
    if "flow" in required_data and capture.flow is None:
        capture = frame_flow.with_flow(capture)
    if "moving" in required_data and capture.moving is None:
        capture = frame_masks.with_masks(capture)
    if "depths" in required_data and capture.depths is None:
        note = (
            "this preset can also use depth maps, but the capture has none: its depth "
            "loss is disabled"
        )
        capture = dataclasses.replace(capture, notes=(*capture.notes, note))
    return capture


def with_steps(run: Run, steps: int) -> Run:
    """Change the number of steps of a run.

    Args:
      run: The run.
      steps: Number of steps.

    Returns:
      The run, with its schedules rescaled to that number.
    """
    config = dataclasses.replace(run.config, steps=steps)
    spec = scene_spec(config)
    return _build(config, run.representation, spec, run.capture, run.observed)


def rebuilt(run: Run) -> Run:
    """Build the model of a run again, for the devices that are available now.

    Args:
      run: The run.

    Returns:
      The run with another model for the same scene.
    """
    config, representation, spec = run.config, run.representation, run.spec
    return _build(config, representation, spec, run.capture, run.observed)


@events.stage("building the model")
def _build(config, representation, spec, capture, observed):
    metadata = representation.metadata_of(capture, spec)
    model = representation.build(spec, metadata)
    return Run(config, capture, observed, representation, spec, metadata, model)


def with_found_cameras(run: Run, state: TrainState) -> Run:
    """Replace the cameras of a run by its refined cameras.

    Args:
      run: The run.
      state: Trained state.

    Returns:
      The run, unchanged if its cameras are not trained.
    """
    capture = with_refined_cameras(run.model, state, run.capture)
    if run.observed is run.capture:
        return run._replace(capture=capture, observed=capture)
    observed = with_refined_cameras(run.model, state, run.observed)
    return run._replace(capture=capture, observed=observed)


def scene_spec(config: RunConfig) -> Any:
    """Return the spec of a preset with its steps and overrides.

    Args:
      config: Settings of the run.

    Returns:
      The spec, with schedules rescaled to the number of steps.
    """
    representation = representations.of_preset(config.preset_name)
    spec = representation.presets[config.preset_name]
    steps = config.steps
    for override in config.overrides:
        if override.startswith("steps="):
            steps = specs.override(spec, (override,)).steps
    if steps is not None:
        spec = representation.with_steps(spec, steps)
    return specs.override(spec, config.overrides)


def save_config(folder: pathlib.Path, run: Run, notes: Sequence[str] = ()) -> None:
    """Write `config.json`: the settings, the complete spec, and the environment.

    Args:
      folder: The run folder.
      run: The run.
      notes: Notes on steps of preprocessing that were skipped.
    """
    content = {
        "config": specs.as_json(run.config),
        "representation": run.representation.name,
        "spec": specs.as_json(run.spec),
        "made by": provenance(),
    }
    if notes:
        content[PREPROCESSING_NOTES] = [*notes]
    write_json(folder / CONFIG, content)


def saved_run(
    folder: pathlib.Path,
    overrides: tuple[str, ...] = (),
    new_source: Mapping[str, Any] = {},
    trusted: Collection[str] = (),
) -> Run:
    """Open the run in a folder with the settings and the capture it was started with.

    Opening a run folder never executes code that it names, because it may come from an
    untrusted source.

    Args:
      folder: The run folder. Settings come from its `config.json`, not from the preset,
        which may have changed since.
      overrides: Settings that the run must have, as PATH=VALUE.
      new_source: New values of fields of its source whose files have been moved. They
        are stored in the run.
      trusted: Names MODULE:NAME of code from other packages that the caller trusts. It
        is loaded if the run needs it.

    Returns:
      The run.

    Raises:
      UntrustedCode: The run needs code that is not in `trusted`. It is a ValueError,
        and nothing has been imported.
      CaptureNotFound: The capture is no longer at its path. It is a ValueError.
      ValueError: `overrides` would change settings, or the capture is not the one that
        the run was started with.
    """
    folder = pathlib.Path(folder)
    config, kind, spec = read_settings(folder, trusted)
    new_spec = specs.override(spec, overrides)
    changes = specs.differences(specs.as_json(spec), specs.as_json(new_spec))
    if changes:
        raise ValueError(
            f"{folder}: the run was started with other settings: {'; '.join(changes)}; "
            "leave them out to continue it, or start a new run in another folder, "
            "out=..."
        )
    source = dataclasses.replace(config.source, **new_source)
    if source.capture is not None and not pathlib.Path(source.capture).exists():
        raise CaptureNotFound(folder, source.capture)
    run = open_run(dataclasses.replace(config, source=source), kind, spec)
    same_capture.check(folder, run.capture)
    if new_source:
        content = json.loads((folder / CONFIG).read_text())
        write_json(folder / CONFIG, content | {"config": specs.as_json(run.config)})
    return run


def read_settings(folder: pathlib.Path, trusted: Collection[str] = ()) -> Settings:
    """Read the settings of the run in a folder.

    Args:
      folder: The run folder.
      trusted: Names MODULE:NAME of code from other packages that may be loaded.

    Returns:
      The settings.

    Raises:
      UntrustedCode: If the run needs code that is not among `trusted`. It is a
        ValueError, and nothing has been imported.
      FileError: If the settings cannot be read.
    """
    content = _stored_settings(folder)
    with _readable(folder):
        kind = representations.named(content["representation"])
        config = specs.from_json(content["config"], RunConfig)
    trust.check(folder, content, kind.spec_type, trusted)
    with _readable(folder):
        spec = representations.stored_spec(kind, content["spec"], load=True)
        _check_type(config, RunConfig)
        _check_type(spec, kind.spec_type)
    return Settings(config, kind, spec)


def _check_type(value, expected_type):
    if not isinstance(value, expected_type):
        raise ValueError(
            f"expected {expected_type.__name__}, got {type(value).__name__}"
        )


def read_config(folder: pathlib.Path) -> RunConfig:
    """Read the config that a run was started with, without loading any code.

    Args:
      folder: The run folder.

    Returns:
      The config.

    Raises:
      ValueError: If it cannot be read.
    """
    content = _stored_settings(folder)
    with _readable(folder):
        config = specs.from_json(content["config"], RunConfig)
        _check_type(config, RunConfig)
    return config


def _stored_settings(folder):
    path = folder / CONFIG
    if not path.is_file():
        raise ValueError(
            f"{folder}: not a run folder (there is no {CONFIG}); pass the folder that "
            "nerfies reconstruct printed; a run that was killed before it wrote "
            "that file must be started again"
        )
    with _readable(folder):
        return read_json(path, dict[str, Any])


@contextlib.contextmanager
def _readable(folder):
    """Add the path of the settings to errors raised in the block."""
    try:
        yield
    except FileError:  # it names the path already
        raise
    except UNEXPECTED_CONTENT as error:
        reason = " ".join(str(error).split())
        raise FileError(
            f"{folder / CONFIG}: not valid settings of a run ({reason})"
        ) from error


@events.stage("initializing the scene")
def initial_state(run: Run) -> TrainState:
    """Initialize the training state.

    Args:
      run: The run.

    Returns:
      The state before the first step.

    Raises:
      ValueError: If it would not fit in memory.
    """
    resources = run.representation.resources
    if resources.estimate_memory_bytes is not None:
        needed_bytes = resources.estimate_memory_bytes(run.spec, run.capture)
        needed_bytes -= frame_memory.capture_bytes(run.capture)  # already allocated
        free = free_memory()
        if needed_bytes > free:
            raise ValueError(
                f"the initial training state needs about {needed_bytes / 2**30:.1f} "
                f"GiB of memory, but {free / 2**30:.1f} GiB are free; "
                f"{resources.memory_hint}, or read smaller images with max_side=..."
            )
    return run.model.init(run.capture, jax.random.key(run.config.seed))


def free_memory() -> int:
    """Return the available memory.

    Returns:
      Bytes that programs may still allocate.
    """
    return psutil.virtual_memory().available


@events.stage("restoring the checkpoint")
def restore(
    folder: pathlib.Path, run: Run, newest: bool = False
) -> checkpoint.Restored:
    """Restore the best checkpoint of a run.

    Args:
      folder: The run folder.
      run: The run.
      newest: True for the newest checkpoint, from which training continues.

    Returns:
      The state with its metadata. It is the newest one unless an earlier state was
      better on training frames that were left out (`RunConfig.validation`).
    """
    model, checkpoints = run.model, folder / CHECKPOINTS
    example = (model.example or model.init)(run.capture, jax.random.key(0))
    latest = checkpoint.restore(checkpoints, example, model.spec)
    evaluations = (latest.record or {}).get("evaluations", ())
    step = best.best_step(evaluations)
    if newest or step == latest.step or step not in checkpoint.steps(checkpoints):
        return latest
    return checkpoint.restore(checkpoints, example, model.spec, step=step)
