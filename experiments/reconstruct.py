"""The main job: a filmed moving scene comes back as a model that can be looked at.

    python -m experiments.reconstruct              # the built-in scene
    python -m experiments.reconstruct CAPTURE      # your own

Leaves a run folder with checkpoints, metrics, pictures, a video and a report.
"""

import dataclasses
import pathlib
import sys
import time
from typing import Literal

from experiments import settings as run_settings

DEFAULT_PRESET = "splats-deformable-small"
EVALUATED = 4  # held-out frames in the curve; all of them are scored at the end


@dataclasses.dataclass(frozen=True)
class Reconstruct:
    """Reconstruct a filmed, moving scene; without a capture, the built-in one."""

    capture: run_settings.Positional[pathlib.Path | None] = None
    """Folder in Nerfies, HyperNeRF, Blender, D-NeRF or COLMAP layout."""
    preset: str | None = None
    """Gaussian splats: splats-static, splats-mcmc, splats-deformable, sonata, moba.
    Radiance fields: nerf, nerf-w, d-nerf, t-nerf, nerfies, hypernerf, nsff. Each with
    -small is made for a CPU (default: splats-deformable-small)."""
    effects: Literal["preset", "auto"] = "preset"
    """auto: look at the capture first and take the effects that it calls for, in the
    representation and size of the preset (see experiments.inspect_scene)."""
    scene: str = "default"
    """Which built-in scene, where no capture is given."""
    steps: int | None = None
    """Steps of training; schedules stretch with them."""
    seconds: float | None = None
    """Stop training after so many seconds, whatever the step."""
    out: pathlib.Path | None = None
    """Run folder (default: runs/CAPTURE-PRESET)."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Where to compute."""
    seed: int = 0
    """Of everything random."""
    factor: int | None = None
    """Read the pictures at 1/FACTOR of their size."""
    max_side: int | None = None
    """Read the pictures with no side longer than this, in pixels."""
    heldout: str | None = None
    """Which frames to score: n for every n-th, or the name of a split."""
    set: tuple[str, ...] = ()
    """Fields of the preset: densification.cap_max=20000 motion.width=128 warp=none."""
    evaluate_every: float = 20.0
    """Seconds of training between two points of the PSNR curve."""


def main(arguments=None):
    """Run the job of the command line.

    Exit code 1 where training blew up, 2 where the input is wrong.
    """
    try:
        _main(run_settings.parse(Reconstruct, arguments))
    except KeyboardInterrupt:
        # While it trains, the loop takes the signal itself, saves and says so.
        print("interrupted while no step was running", file=sys.stderr)
        raise SystemExit(130) from None


def _main(asked):
    with run_settings.user_errors():
        run_settings.start_jax(asked.device, run_settings.threads_for(_preset(asked)))
        from experiments import runs
        from nerfies_jax.capture.capture import describe

        began = time.perf_counter()
        run = _resumed(asked, runs) if asked.resume else _new(asked, runs)
        for line in describe(run.capture):
            print(line)
        folder, state, history, after = _start(asked, run, runs)
    from experiments import training

    with run_settings.user_errors():
        checkpoints = training.open_checkpoints(folder, run, after)
    outcome = training.train(
        run,
        state,
        history,
        checkpoints,
        seconds=asked.seconds,
        evaluate_every=asked.evaluate_every,
        evaluated=EVALUATED,
    )
    if outcome.result.stopped_by in ("SIGINT", "SIGTERM"):
        print(f"continue with: {_command(folder)}")
        raise SystemExit(128 + (2 if outcome.result.stopped_by == "SIGINT" else 15))
    from experiments import products

    errors = []
    try:
        products.make(folder, run, outcome, began)
    except FloatingPointError as error:
        errors.append(str(error))
    if outcome.result.stopped_by == "non-finite":
        errors.append(
            f"{outcome.result.message}; start anew with lower learning rates "
            f"(--set, their names are in {folder / run_settings.CONFIG})"
        )
    for line in errors:
        print(f"error: {line}", file=sys.stderr)
    raise SystemExit(1 if errors else 0)


def _preset(asked):
    """The preset that the run has, or will have."""
    if asked.resume and asked.out is not None:
        return run_settings.stored_preset(asked.out)
    return asked.preset or DEFAULT_PRESET


def _resumed(asked, runs):
    """The run in --out; other steps or settings make a spec its checkpoint refuses."""
    if asked.out is None:
        raise ValueError("--resume continues the run in a folder: name it with --out")
    steps = () if asked.steps is None else (f"steps={asked.steps}",)
    return runs.saved_run(asked.out, (*steps, *asked.set))


def _new(asked, runs):
    """The run that the command line asks for."""
    choices = runs.Choices(
        capture=None if asked.capture is None else str(asked.capture.absolute()),
        scene=asked.scene,
        preset=asked.preset or DEFAULT_PRESET,
        steps=asked.steps,
        overrides=asked.set,
        factor=asked.factor,
        max_side=asked.max_side,
        heldout=asked.heldout,
        seed=asked.seed,
    )
    stored = None
    if asked.effects == "auto":
        from experiments import inspect_advice, inspect_job

        runs.scene_spec(choices)  # refuses a wrong preset before half a minute's look
        stored = runs.stored_capture(choices)
        found = inspect_job.inspect(stored)
        choices, lines = inspect_advice.follow(choices, found.findings)
        print("\n".join(lines))
    return runs.new_run(choices, stored)


def _start(asked, run, runs):
    """The run folder, the state to go on from and its history."""
    if asked.resume:
        restored = runs.restore(asked.out, run)
        return asked.out, restored.state, restored.record, restored.step
    state = runs.first_state(run)
    stem = "-".join(run.capture.name.split()) + "-" + run.choices.preset
    folder = run_settings.new_run_folder(asked.out, stem)
    runs.save_choices(folder, run)
    return folder, state, None, None


def _command(folder):
    return f"python -m experiments.reconstruct --out {folder} --resume"


if __name__ == "__main__":
    main()
