"""A run: which capture, which scene, and the folder that holds what came of it."""

import dataclasses
import json
import pathlib
from typing import NamedTuple

import jax

from experiments import settings as run_settings
from gaussians_jax import presets as splat_presets
from gaussians_jax import scene as splat_scene
from nerfies_jax import capture as captures
from nerfies_jax.capture import pinholes, synthetic
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.json_files import write_json
from nerfies_jax.training import checkpoint
from nerfies_jax.training.model import Model, TrainState

CONFIG = "config.json"
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
    spec: splat_scene.SplatScene
    model: Model


def open_run(choices: Choices, spec: splat_scene.SplatScene | None = None) -> Run:
    """Read the capture and build the model; `spec` where a run has one already.

    ValueErrors name what the user can mend.
    """
    spec = scene_spec(choices) if spec is None else spec
    capture = read_capture(choices)
    model = splat_scene.build(spec, splat_scene.facts_of(capture))
    return Run(choices, capture, spec, model)


def scene_spec(choices: Choices) -> splat_scene.SplatScene:
    """The preset with its overrides."""
    named = splat_presets.PRESETS
    if choices.preset not in named:
        raise ValueError(
            f"--preset {choices.preset}: no such preset; there are "
            + ", ".join(sorted(named))
        )
    spec = named[choices.preset]
    if choices.steps is not None:
        spec = splat_presets.with_steps(spec, choices.steps)
    return run_settings.override(spec, choices.overrides)


def read_capture(choices: Choices) -> Capture:
    """The capture asked for, ready for a pinhole renderer."""
    if choices.capture is None:
        if choices.scene not in synthetic.PRESETS:
            raise ValueError(
                f"--scene {choices.scene}: no such built-in scene; there are "
                + ", ".join(synthetic.PRESETS)
            )
        scene = synthetic.PRESETS[choices.scene]
        folder = run_settings.CACHE / "scenes"
        return synthetic.cached(scene, folder, choices.seed)[0]
    heldout = choices.heldout
    if heldout is not None and heldout.isdigit():
        heldout = int(heldout)
    capture = captures.load(
        choices.capture,
        factor=choices.factor,
        max_side=choices.max_side,
        heldout=heldout,
    )
    return pinholes.as_pinholes(capture)


def save_choices(folder: pathlib.Path, run: Run) -> None:
    """`config.json`: the choices, the whole spec they led to, and what made it."""
    write_json(
        folder / CONFIG,
        {
            "choices": run_settings.as_json(run.choices),
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
        spec = run_settings.from_json(splat_scene.SplatScene, stored["spec"])
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path}: not the settings of a run ({error})") from error
    return open_run(choices, run_settings.override(spec, overrides))


def first_state(run: Run) -> TrainState:
    """The state before the first step; ValueError where it would not fit in memory."""
    needed = splat_scene.first_bytes(run.spec, run.capture)
    free = free_memory()
    if free is not None and needed > free:
        raise ValueError(
            f"the first state needs about {needed / 2**30:.1f} GiB and "
            f"{free / 2**30:.1f} GiB are free; lower start.points, start.random or "
            "raster.capacity with --set, or read smaller pictures with --max-side"
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
