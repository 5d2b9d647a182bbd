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

from experiments import cli
from nerfies_jax.runs import platform, representations, run_folder
from nerfies_jax.runs.config import RunConfig

DEFAULT_PRESET = "splats-deformable-small"
EVALUATED = 4  # held-out frames in the curve; all of them are scored at the end


@dataclasses.dataclass(frozen=True)
class Reconstruct:
    """Reconstruct a filmed, moving scene; without a capture, the built-in one."""

    source: cli.Source = cli.NamedSource()
    preset: str | None = None
    """Gaussian splats: splats-static, splats-deformable, sonata, moba. Radiance fields:
    nerf, nerf-w, d-nerf, t-nerf, nerfies, hypernerf, nsff. Each with -small is made for
    a CPU (default: splats-deformable-small)."""
    effects: Literal["preset", "auto"] = "preset"
    """auto: look at the capture first and take the effects that it calls for, in the
    representation and size of the preset (see experiments.inspect_scene)."""
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
    set: tuple[str, ...] = ()
    """Fields of the preset, as density.most=20000 motion.width=128 warp=none."""
    evaluate_every: float = 20.0
    """Seconds of training between two points of the PSNR curve."""
    lpips_weights: tuple[pathlib.Path, ...] = ()
    """Measure LPIPS, too: files (.pth, .safetensors, .npz) with the trained classifier
    and LPIPS heads; read before the training."""
    lpips_network: Literal["alex", "vgg"] = "alex"
    """Whose weights these are."""
    fit_heldout_cameras: int = 0
    """Fit the cameras of so many held-out frames to what was filmed, the scene as it is
    after training, and score them again."""

    def __post_init__(self):
        if self.fit_heldout_cameras < 0:
            raise ValueError(
                f"--fit-heldout-cameras {self.fit_heldout_cameras}: a number of "
                "frames, not negative"
            )


def main(arguments=None):
    """Run the job of the command line.

    Exit code 1 where training blew up, 2 where the input is wrong.
    """
    try:
        _main(cli.parse(Reconstruct, arguments))
    except KeyboardInterrupt:
        # While it trains, the loop takes the signal itself, saves and says so.
        print("interrupted while no step was running", file=sys.stderr)
        raise SystemExit(130) from None


def _main(asked):
    with cli.user_errors():
        platform.start_jax(asked.device, _threads(asked))
        from nerfies_jax import runs
        from nerfies_jax.capture.capture import describe

        began = time.perf_counter()
        run = _resumed(asked, runs) if asked.resume else _new(asked, runs)
        for line in describe(run.capture):
            print(line)
        lpips = _lpips(asked, run)
        folder, state, history, after = _start(asked, run, runs)
    from nerfies_jax.runs import train

    with cli.user_errors():
        checkpoints = train.open_checkpoints(folder, run, after)
    outcome = train.train(
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
    from nerfies_jax.runs import products

    errors = []
    try:
        products.make(folder, run, outcome, began, lpips, asked.fit_heldout_cameras)
    except FloatingPointError as error:
        errors.append(str(error))
    if outcome.result.stopped_by == "non-finite":
        errors.append(
            f"{outcome.result.message}; start anew with lower learning rates "
            f"(--set, their names are in {folder / run_folder.CONFIG})"
        )
    for line in errors:
        print(f"error: {line}", file=sys.stderr)
    raise SystemExit(1 if errors else 0)


def _lpips(asked, run):
    """The weights named on the command line; None without any."""
    if not asked.lpips_weights:
        return None
    from nerfies_jax.evaluation import heldout
    from nerfies_jax.measure import perceptual

    network = {"alex": perceptual.ALEX, "vgg": perceptual.VGG}[asked.lpips_network]
    return heldout.load_lpips(network, asked.lpips_weights, run.capture.size)


def _threads(asked):
    """How many cores the representation wants XLA to see."""
    found = None
    if asked.resume and asked.out is not None:
        found = representations.of_run(asked.out)
    return (found or representations.of_preset(_preset(asked))).threads


def _preset(asked):
    return asked.preset or DEFAULT_PRESET


def _resumed(asked, runs):
    """The run in --out; other steps or settings make a spec its checkpoint refuses."""
    if asked.out is None:
        raise ValueError("--resume continues the run in a folder: name it with --out")
    steps = () if asked.steps is None else (f"steps={asked.steps}",)
    return runs.saved_run(asked.out, (*steps, *asked.set))


def _new(asked, runs):
    """The run that the command line asks for."""
    config = RunConfig(
        preset=_preset(asked),
        source=cli.plain(asked.source),
        steps=asked.steps,
        overrides=asked.set,
        seed=asked.seed,
    )
    stored = None
    if asked.effects == "auto":
        from nerfies_jax.evidence import inspection
        from nerfies_jax.runs import adviser

        runs.scene_spec(config)  # refuses a wrong preset before half a minute's look
        stored = runs.stored_capture(config.source, config.seed)
        found = inspection.inspect(stored)
        config, lines = adviser.follow(config, found.findings)
        print("\n".join(lines))
    return runs.new_run(config, stored)


def _start(asked, run, runs):
    """The run folder, the state to go on from and its history."""
    if asked.resume:
        restored = runs.restore(asked.out, run)
        return asked.out, restored.state, restored.record, restored.step
    state = runs.first_state(run)
    stem = "-".join(run.capture.name.split()) + "-" + run.config.preset
    folder = run_folder.new_run_folder(asked.out, stem)
    runs.save_config(folder, run)
    return folder, state, None, None


def _command(folder):
    return f"python -m experiments.reconstruct --out {folder} --resume"


if __name__ == "__main__":
    main()
