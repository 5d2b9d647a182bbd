"""A run: which capture, which scene, and the folder that holds what came of it."""

import dataclasses
import json
import os
import pathlib
import shlex
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import psutil

from nerfies_jax import capture as captures
from nerfies_jax import events
from nerfies_jax.capture import gate, pinholes, synthetic
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.json_files import write_json
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.evaluation import Renderer, as_found
from nerfies_jax.evaluation.lens import ThroughLens
from nerfies_jax.evaluation.representation import Representation
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.evidence import frame_flow, frame_masks, given_files
from nerfies_jax.runs import own_effects, representations, same_capture, trust
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.runs.run_folder import CHECKPOINTS, CONFIG, LEFT_OUT
from nerfies_jax.training import checkpoint, specs
from nerfies_jax.training.effects import Effect
from nerfies_jax.training.model import Model, TrainState
from nerfies_jax.training.provenance import provenance


class Settings(NamedTuple):
    """What a `config.json` says."""

    config: RunConfig
    representation: Representation
    spec: Any  # of the representation's `spec_type`


class Run(NamedTuple):
    """Everything that a run is made of before its first step."""

    config: RunConfig
    capture: Capture  # what is learned from: with pinholes where only they are drawn
    filmed: Capture  # what held-out frames are scored against (`pinholes.scorable`)
    representation: Representation
    spec: Any  # of the representation's `spec_type`
    metadata: Any  # what the scene must know of the capture
    model: Model
    effects: tuple[Effect, ...] = ()  # of the user's own, beside those of the spec


def new_run(config: RunConfig, stored: Capture | None = None) -> Run:
    """A run as it is asked for; ValueErrors name what the user can mend.

    `stored` is its `stored_capture` where that has been read already.
    """
    representation = representations.of_preset(config.preset)
    run = open_run(config, representation, scene_spec(config), stored)
    if not len(run.capture.heldout):  # before a training that ends without a score
        raise ValueError(
            f"{run.capture.path or run.capture.name}: no held-out frames to judge by; "
            "give three pictures or more, or choose some with --heldout, as --heldout 8"
        )
    return run


def open_run(
    config: RunConfig,
    representation: Representation,
    spec: Any,
    stored: Capture | None = None,
) -> Run:
    """Read the capture and build the model."""
    stored = stored or stored_capture(config.source, config.seed)
    filmed = pinholes.scorable(stored, representation.traces_lenses)
    capture = filmed if representation.traces_lenses else pinholes.as_pinholes(stored)
    run = _built(config, representation, spec, capture, filmed)
    capture = _completed(capture, run.model.required_data)
    if capture is run.capture:
        return run
    return _built(config, representation, spec, capture, filmed)


def _completed(capture, wanted):
    """With flow and masks found in the pictures where they are wanted; what else lacks
    is noted.
    """
    if "flow" in wanted and capture.flow is None:
        capture = frame_flow.with_flow(capture)
    if "moving" in wanted and capture.moving is None:
        capture = frame_masks.with_masks(capture)
    if "depths" in wanted and capture.depths is None:
        note = "this preset learns from depth as well, and the capture has none"
        capture = dataclasses.replace(capture, notes=(*capture.notes, note))
    return capture


def with_steps(run: Run, steps: int) -> Run:
    """The run over another number of steps, of the same pictures."""
    config = dataclasses.replace(run.config, steps=steps)
    spec = scene_spec(config)
    return _built(config, run.representation, spec, run.capture, run.filmed)


@events.stage("building the model")
def _built(config, representation, spec, capture, filmed):
    metadata = representation.metadata_of(capture, spec)
    effects = own_effects.load(config.effects, metadata)
    model = representation.build(spec, metadata, effects=effects)
    return Run(config, capture, filmed, representation, spec, metadata, model, effects)


def with_found_cameras(run: Run, state: TrainState) -> Run:
    """The run with its cameras as training found them; as it is where they stay."""
    capture = as_found(run.model, state, run.capture)
    if run.filmed is run.capture:
        return run._replace(capture=capture, filmed=capture)
    filmed = as_found(run.model, state, run.filmed)
    return run._replace(capture=capture, filmed=filmed)


def drawer(run: Run, renderer: Renderer) -> Draw:
    """What draws the views of `run.filmed`: the renderer, through a lens if need be."""
    if run.representation.traces_lenses or run.filmed is run.capture:
        return renderer
    return ThroughLens(renderer, run.filmed.size)


def scene_spec(config: RunConfig) -> Any:
    """The preset with its steps and overrides; with either's, schedules stretch."""
    representation = representations.of_preset(config.preset)
    spec = representation.presets[config.preset]
    steps = config.steps
    for words in config.overrides:
        if words.startswith("steps="):
            steps = specs.override(spec, (words,)).steps
    if steps is not None:
        spec = representation.with_steps(spec, steps)
    return specs.override(spec, config.overrides)


def load_capture(
    folder: str | os.PathLike,
    *,
    factor: int | None = None,
    max_side: int | None = None,
    heldout: int | str | None = None,
) -> Capture:
    """A capture of any known format, for a pinhole renderer; host side.

    `factor` and `max_side` (pixels) make the pictures smaller; `heldout` chooses the
    frames to judge by, every n-th or a split by its name. Raises ValueError where it
    cannot be read.
    """
    chosen = None if heldout is None else str(heldout)
    return read_capture(
        CaptureSource(
            capture=pathlib.Path(folder),
            factor=factor,
            max_side=max_side,
            heldout=chosen,
        )
    )


def built_in_scene(name: str = "default", seed: int = 0) -> Capture:
    """A film of a built-in scene; ValueError names those there are."""
    return read_capture(CaptureSource(scene=name), seed)


def read_capture(source: CaptureSource, seed: int = 0) -> Capture:
    """The capture asked for, for a pinhole renderer."""
    return pinholes.as_pinholes(stored_capture(source, seed))


def stored_capture(source: CaptureSource, seed: int = 0) -> Capture:
    """The capture asked for, with the lens that filmed it; host side.

    `seed` makes a built-in scene. Raises ValueError where it cannot be read as asked.
    """
    capture = given_files.attached(_filmed(source, seed), source.files)
    gate.check_observed(capture)
    if source.preprocessing is None:
        return capture
    return dataclasses.replace(capture, preprocessing=source.preprocessing)


def _filmed(source, seed):
    if source.capture is None:
        return _built_in(source, seed)
    heldout = source.heldout
    if heldout is not None and heldout.isdigit():
        heldout = int(heldout)
    return captures.load(
        source.capture,
        factor=source.factor,
        max_side=source.max_side,
        heldout=heldout,
        missing=source.missing,
    )


def _built_in(source, seed):
    if source.scene not in synthetic.PRESETS:
        raise ValueError(
            f"--scene {source.scene}: no such built-in scene; "
            + known_names(source.scene, synthetic.PRESETS)
        )
    for name in ("factor", "max_side", "heldout"):
        if getattr(source, name) is not None:
            raise ValueError(
                f"--{name.replace('_', '-')} is for captures; film the built-in "
                "scene as you want it with experiments.make_scene and name its "
                "folder"
            )
    film = synthetic.PRESETS[source.scene]
    return synthetic.cached(film, CACHE / "scenes", seed)[0]


def save_config(folder: pathlib.Path, run: Run, left_out: Sequence[str] = ()) -> None:
    """`config.json`: the config, the whole spec it led to, and what made it.

    With notes on what preprocessing `left_out`, if it did.
    """
    stored = {
        "config": specs.as_json(run.config),
        "representation": run.representation.name,
        "spec": specs.as_json(run.spec),
        "made by": provenance(),
    }
    if left_out:
        stored[LEFT_OUT] = [*left_out]
    write_json(folder / CONFIG, stored)


def saved_run(
    folder: pathlib.Path,
    overrides: tuple[str, ...] = (),
    moved: Mapping[str, Any] = {},
    effects: Collection[str] = (),
) -> Run:
    """Open the run in a folder, with the settings and the capture it was made with.

    Opening a folder runs no code of it: it may come from a stranger.

    Args:
      folder: The run folder. Settings come from its `config.json`, not from the preset,
        which may have changed since.
      overrides: Settings that the run must have, as PATH=VALUE.
      moved: The parts of its source that have another path today, which is kept.
      effects: The effects from outside of this package that the caller trusts, as
        MODULE:NAME. They are loaded if the run was trained with them.

    Returns:
      The run.

    Raises:
      UntrustedEffects: The run uses effects that are not in `effects`. It is a
        ValueError, and nothing has been imported.
      ValueError: `overrides` would change settings, or the capture is not the one that
        the run was begun with.
    """
    folder = pathlib.Path(folder)
    config, kind, spec = read_settings(folder)
    trust.check_effects(folder, config.effects, effects)
    wanted = specs.override(spec, overrides)
    changed = specs.differences(specs.as_json(spec), specs.as_json(wanted))
    if changed:
        raise ValueError(
            f"{folder}: the run was started with other settings: {'; '.join(changed)}; "
            "leave them out to continue it, or start anew in another --out"
        )
    source = dataclasses.replace(config.source, **moved)
    if source.capture is not None and not source.capture.exists():
        raise ValueError(
            f"{folder}: its capture {source.capture} is not there; if it lies "
            "elsewhere now, say where: python -m experiments.reconstruct CAPTURE --out "
            f"{shlex.quote(str(folder))} --resume"
        )
    run = open_run(dataclasses.replace(config, source=source), kind, spec)
    same_capture.check(folder, run.capture)
    if moved:
        stored = json.loads((folder / CONFIG).read_text())
        write_json(folder / CONFIG, stored | {"config": specs.as_json(run.config)})
    return run


def read_settings(folder: pathlib.Path) -> Settings:
    """The settings of the run in a folder; ValueError where they cannot be read."""
    path = folder / CONFIG
    if not path.is_file():
        raise ValueError(
            f"{folder}: no run here (there is no {CONFIG}); name the folder that "
            "experiments.reconstruct printed; a run that was killed before it had one "
            "is started again, without --resume"
        )
    try:
        stored = json.loads(path.read_text())
        kind = representations.named(stored["representation"])
        config = specs.from_json(stored["config"], RunConfig)
        spec = representations.stored_spec(kind, stored["spec"])
        for value, wanted in ((config, RunConfig), (spec, kind.spec_type)):
            if not isinstance(value, wanted):
                raise ValueError(f"a {type(value).__name__} for a {wanted.__name__}")
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path}: not the settings of a run ({error})") from error
    return Settings(config, kind, spec)


@events.stage("initializing the scene")
def first_state(run: Run) -> TrainState:
    """The state before the first step; ValueError where it would not fit in memory."""
    needed = run.representation.estimate_memory_bytes(run.spec, run.capture)
    free = free_memory()
    if needed > free:
        raise ValueError(
            f"the first state needs about {needed / 2**30:.1f} GiB and "
            f"{free / 2**30:.1f} GiB are free; {run.representation.memory_hint}, or "
            "read smaller pictures with --max-side"
        )
    return run.model.init(run.capture, jax.random.key(run.config.seed))


def free_memory() -> int:
    """Bytes of memory that programs may still take."""
    return psutil.virtual_memory().available


@events.stage("restoring the checkpoint")
def restore(folder: pathlib.Path, run: Run) -> checkpoint.Restored:
    """The newest state saved in a run folder."""
    model = run.model
    example = (model.example or model.init)(run.capture, jax.random.key(0))
    return checkpoint.restore(folder / CHECKPOINTS, example, model.spec)
