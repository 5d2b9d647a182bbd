"""A run: which capture, which scene, and the folder that holds what came of it."""

import dataclasses
import json
import pathlib
from typing import Any, NamedTuple

import jax

from experiments import representations
from experiments import settings as run_settings
from experiments.representations import Representation
from nerfies_jax import capture as captures
from nerfies_jax.capture import pinholes, synthetic
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.json_files import write_json
from nerfies_jax.training import checkpoint
from nerfies_jax.training.model import Model, TrainState

CONFIG = run_settings.CONFIG
CHECKPOINTS = "checkpoints"


@dataclasses.dataclass(frozen=True)
class Choices:
    """What fixes a run: kept in its `config.json` and enough to open it again."""

    capture: str | None  # folder; None for the built-in scene
    scene: str  # which built-in scene, where there is no capture
    preset: str
    steps: int | None
    overrides: tuple[str, ...]
    factor: int | None
    max_side: int | None
    heldout: str | None
    seed: int


class Run(NamedTuple):
    """Everything that a run is made of before its first step."""

    choices: Choices
    capture: Capture
    representation: Representation
    spec: Any  # of the representation's `spec_type`
    facts: Any  # what the scene must know of the capture
    model: Model


def new_run(choices: Choices, stored: Capture | None = None) -> Run:
    """A run as it is asked for; ValueErrors name what the user can mend.

    `stored` is its `stored_capture` where that has been read already.
    """
    representation = representations.of_preset(choices.preset)
    return open_run(choices, representation, scene_spec(choices), stored)


def open_run(
    choices: Choices,
    representation: Representation,
    spec: Any,
    stored: Capture | None = None,
) -> Run:
    """Read the capture and build the model."""
    capture = read_capture(choices, stored)
    facts = representation.facts_of(capture, spec)
    model = representation.build(spec, facts)
    return Run(choices, capture, representation, spec, facts, model)


def scene_spec(choices: Choices) -> Any:
    """The preset with its overrides."""
    representation = representations.of_preset(choices.preset)
    spec = representation.presets[choices.preset]
    if choices.steps is not None:
        spec = representation.with_steps(spec, choices.steps)
    return run_settings.override(spec, choices.overrides)


def read_capture(choices: Choices, stored: Capture | None = None) -> Capture:
    """The capture asked for, read unless it is `stored`, for a pinhole renderer."""
    return pinholes.as_pinholes(stored or stored_capture(choices))


def stored_capture(choices: Choices) -> Capture:
    """The capture asked for, with the lens that filmed it."""
    if choices.capture is None:
        if choices.scene not in synthetic.PRESETS:
            raise ValueError(
                f"--scene {choices.scene}: no such built-in scene; there are "
                + ", ".join(synthetic.PRESETS)
            )
        for name in ("factor", "max_side", "heldout"):
            if getattr(choices, name) is not None:
                raise ValueError(
                    f"--{name.replace('_', '-')} is for captures; film the built-in "
                    "scene as you want it with experiments.make_scene and name its "
                    "folder"
                )
        scene = synthetic.PRESETS[choices.scene]
        folder = run_settings.CACHE / "scenes"
        return synthetic.cached(scene, folder, choices.seed)[0]
    heldout = choices.heldout
    if heldout is not None and heldout.isdigit():
        heldout = int(heldout)
    return captures.load(
        choices.capture,
        factor=choices.factor,
        max_side=choices.max_side,
        heldout=heldout,
    )


def save_choices(folder: pathlib.Path, run: Run) -> None:
    """`config.json`: the choices, the whole spec they led to, and what made it."""
    write_json(
        folder / CONFIG,
        {
            "choices": run_settings.as_json(run.choices),
            "representation": run.representation.name,
            "spec": run_settings.as_json(run.spec),
            "made by": checkpoint.provenance(),
        },
    )


def saved_run(folder: pathlib.Path, overrides: tuple[str, ...] = ()) -> Run:
    """The run in a folder, with the settings it was made with.

    They come from its `config.json`, not from the preset, which may have changed since.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise ValueError(
            f"{folder}: no run here (there is no {CONFIG}); name the folder that "
            "experiments.reconstruct printed"
        )
    try:
        stored = json.loads(path.read_text())
        choices = run_settings.from_json(Choices, stored["choices"])
        # Runs from before there were two are splats.
        kind = representations.named(stored.get("representation", "gaussians"))
        spec = run_settings.from_json(kind.spec_type, stored["spec"])
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path}: not the settings of a run ({error})") from error
    return open_run(choices, kind, run_settings.override(spec, overrides))


def first_state(run: Run) -> TrainState:
    """The state before the first step; ValueError where it would not fit in memory."""
    needed = run.representation.estimate_memory_bytes(run.spec, run.capture)
    free = free_memory()
    if free is not None and needed > free:
        raise ValueError(
            f"the first state needs about {needed / 2**30:.1f} GiB and "
            f"{free / 2**30:.1f} GiB are free; {run.representation.memory_hint}, or "
            "read smaller pictures with --max-side"
        )
    return run.model.init(run.capture, jax.random.key(run.choices.seed))


def free_memory() -> int | None:
    """Bytes of memory that programs may still take; None where nothing tells."""
    try:
        lines = pathlib.Path("/proc/meminfo").read_text().splitlines()
        row = next(line for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return None
    return int(row.split()[1]) * 1024


def restore(folder: pathlib.Path, run: Run) -> checkpoint.Restored:
    """The newest state saved in a run folder."""
    return checkpoint.restore(folder / CHECKPOINTS, first_state(run), run.model.spec)
