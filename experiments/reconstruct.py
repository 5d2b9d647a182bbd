"""Reconstruct a dynamic scene from a capture, a video or images.

    nerfies reconstruct              # the built-in scene
    nerfies reconstruct CAPTURE      # your own
    nerfies reconstruct CLIP.mp4     # a video: cameras first

Writes a run folder with checkpoints, metrics, images, a video and a report.
"""

import dataclasses
import functools
import pathlib
import signal
from typing import ClassVar, Literal

from experiments import cli
from nerfies_jax.runs import commands, platform, representations, run_folder
from nerfies_jax.runs.config import MoreMetrics, Preparation, RunConfig
from nerfies_jax.runtime import console, stopping
from nerfies_jax.training import extensions


@dataclasses.dataclass(frozen=True)
class Reconstruct:
    """Reconstruct a dynamic scene from a capture, a video or images (default:
    built-in).

    A video, or a folder of images without cameras, becomes a capture first, in a folder
    next to the run's, which is kept.
    """

    GROUPS: ClassVar = {
        "model": ("preset", "effects", "set", "trust"),
        "training": (
            *("steps", "seconds", "quality", "seed"),
            *("evaluate_every", "evaluate_at", "checkpoint_every"),
        ),
        "hosts": ("coordinator", "processes", "process"),
        "following": ("view", "log"),
    }

    source: cli.Source = cli.NamedSource()
    preset: cli.Preset = None
    """Gaussian splats: splats-static, splats-collection, splats-mcmc, splats-tracked,
    splats-deformable, sonata, moba, dynmf, spacetime, spline, 4dgs, e-d3dgs, sc-gs,
    edgs, d-miso, adc-gs, motion-gs. Radiance fields: nerf, nerf-w, d-nerf, t-nerf,
    nerfies, hypernerf, nsff, tineuvox, nerf-ds. Each has a version for a CPU with the
    suffix -small. nerf-grid, nerf-w-grid, d-nerf-grid, nerfies-grid, hypernerf-grid and
    nsff-grid, on feature grids, exist with -small only (default: the best measured in
    the time of --seconds, which is splats-tracked-small, or splats-static-small if
    nothing moves; splats-collection-small for photographs in changing light, and
    spacetime-small without tracks if tracking fails)."""
    effects: Literal["preset", "auto"] | None = None
    """auto: inspect the capture first. Without --preset, compensation of exposures and
    a depth loss are enabled where they are certainly needed, and tried in a short run
    where they are likely to be. With --preset, all recommendations of
    nerfies inspect_scene are followed. preset: only what the preset has (default:
    auto without --preset, preset with it)."""
    steps: int | None = None
    """Training steps. Schedules are stretched with them."""
    seconds: float | None = None
    """Train for so many seconds, without compiling: schedules stretch with the steps
    that fit, and the number of Gaussians grows with the time if no preset is named.
    With --steps or --resume: stop after them, whatever the step."""
    quality: Literal["draft", "good", "best"] | None = None
    """Short for --seconds: 30 (draft), 120 (good) or 1200 (best)."""
    out: pathlib.Path | None = None
    """Run folder (default: runs/CAPTURE-PRESET)."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint. Without --out, the newest run
    of the given capture or video in the folder runs."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Device to compute on."""
    devices: int | None = None
    """Number of devices that share a training step: the views of splats (batch_size),
    or bands of the image of one view, or the rays of a field (micro_batches). The
    result is that of one device up to rounding (default: all; of a CPU, as many as it
    has cores and the step has parts; one for the image of one view)."""
    frame_memory: float | None = None
    """GiB of device memory for training frames (default: all that training leaves, no
    limit on a CPU). If they do not fit, those of the next steps are streamed to the
    device, with the same result."""
    coordinator: str | None = None
    """Train on several hosts, on each of which this command is started: HOST:PORT at
    which the first process listens, with --processes and --process, or auto if Slurm
    or Open MPI started them. See docs/hosts.md."""
    processes: int | None = None
    """Number of processes, which share each training step."""
    process: int | None = None
    """Number of this process, from 0."""
    seed: int | None = None
    """Seed of all random numbers (default: 0)."""
    set: cli.Overrides = ()
    """Fields of the preset, strategy.cap_max=20000 motion.width=128 warp=none,
    say; experiments.settings lists those there are."""
    trust: cli.Code = ()
    """With --resume, code from other packages that the run was started with, as
    MODULE:NAME. It is loaded only if it is named here again."""
    evaluate_every: float = 20.0
    """Seconds of training between two points of the PSNR curve."""
    evaluate_at: tuple[int, ...] = ()
    """Steps of the points of the PSNR curve, each over as many held-out frames as the
    final metrics (default: points of a few frames in intervals of time)."""
    checkpoint_every: float = 60.0
    """Seconds between two checkpoints, which is the most that a killed run loses."""
    view: bool = False
    """View the scene while it trains, in the browser of this machine, as
    nerfies view does afterwards. Training waits while it renders."""
    log: tuple[Literal["tensorboard", "wandb", "rerun"], ...] = ()
    """Experiment trackers that receive losses and metrics during training, in addition
    to events.jsonl (docs/events.md); extra log."""
    more: cli.More = MoreMetrics()
    prepare: Preparation = Preparation()
    """Options for a video or a folder of images without cameras."""


QUALITY_SECONDS = {"draft": 30.0, "good": 120.0, "best": 1200.0}


@cli.command(Reconstruct)
def main(args):
    """Train a run and write its products.

    The exit code is 1 if training diverged or results could not be written, 2 for
    wrong input, and 128 + number after a signal.
    """
    try:
        outcome = _outcome(args)
    except KeyboardInterrupt as stop:
        console.note(str(stop) or "interrupted while no step was running")
        raise SystemExit(130) from None
    if outcome is None:  # process 0 writes the results
        return None
    for line in outcome.errors:
        console.error(line)
    stopped_by = outcome.result.stopped_by
    code = 1 if outcome.errors else 0
    if stopped_by in stopping.NAMES:
        again = commands.resume(outcome.folder, outcome.run.code)
        console.say(f"continue with: {again}")
        code = code or 128 + signal.Signals[stopped_by]
    return cli.Ended(_result(outcome), code)


def _result(outcome):
    """Return how the run ended, with the metrics if it has any."""
    return {
        "folder": str(outcome.folder),
        "preset": outcome.run.config.preset,
        "stopped_by": outcome.result.stopped_by,
        "errors": list(outcome.errors),
        "metrics": cli.stored(outcome.folder / "metrics.json"),
    }


def _outcome(args):
    with cli.user_errors():
        args = _with_seconds(args)
        names = extensions.names_in_assignments(args.set)
        cli.find_code((*args.trust, *names))
        if args.resume:
            args = _with_folder(args)
            _check_resumed(args)
        wide = not (args.trust or names)
        cores = _cores(args)
        cluster = _cluster(args)
        platform.start_jax(
            args.device,
            *cores,
            devices=args.devices,
            frame_memory=args.frame_memory,
            cluster=cluster,
            wide=wide,
        )
        viewer = _open_viewer(args)
    from nerfies_jax import runs
    from nerfies_jax.runs import multiple_hosts
    from nerfies_jax.runtime import hosts

    if hosts.joined() and not hosts.leads():
        with cli.user_errors():
            multiple_hosts.follow((*args.trust, *names))
        return None

    common = {
        name: getattr(args, name)
        for name in (
            *("more", "seconds", "log"),
            *("evaluate_every", "evaluate_at", "checkpoint_every"),
        )
    }
    if args.resume:
        steps = () if args.steps is None else (f"steps={args.steps}",)
        with cli.user_errors((runs.Refused, hosts.Lost)):
            return runs.resume(
                args.out,
                expected=_expected_options(args),
                overrides=(*steps, *args.set),
                trusted=args.trust,
                watched=viewer,
                **common,
            )
    config = RunConfig(
        preset=args.preset,
        source=cli.plain(args.source),
        steps=args.steps,
        overrides=args.set,
        seed=args.seed or 0,
    )
    with cli.user_errors((runs.Refused, hosts.Lost)):
        return runs.reconstruct(
            config,
            args.out,
            effects=args.effects,
            prepare=args.prepare,
            watched=viewer,
            **common,
        )


def _with_seconds(args):
    """Return the options with --seconds in place of --quality."""
    if args.quality is None:
        return args
    if args.seconds is not None:
        raise ValueError(
            f"--quality {args.quality} is short for --seconds "
            f"{QUALITY_SECONDS[args.quality]:g}; leave out one of the two"
        )
    return dataclasses.replace(args, seconds=QUALITY_SECONDS[args.quality])


def _open_viewer(args):
    """Open the viewer of --view, or return None; ValueError if it is not available."""
    if not args.view:
        return None
    from nerfies_jax.runs import viewer

    viewer.check_installed()
    return functools.partial(viewer.live, port=cli.VIEW_PORT)


def _with_folder(args):
    """Return the options with --out, the newest run of the capture if not given."""
    if args.out is not None:
        return args
    capture = args.source.capture
    if capture is None:
        raise ValueError(
            "--resume continues the run in a folder: name it with --out, or name the "
            "capture or video that it was made from"
        )
    folder = run_folder.newest_of(capture)
    console.say(f"the newest run of {capture}: {folder}")
    return dataclasses.replace(args, out=folder)


def _check_resumed(args):
    """Raise ValueError where options do not go with --resume."""
    if args.prepare != Preparation():
        raise ValueError(
            "--prepare converts a video to a capture, and the run to continue has one; "
            "leave it out with --resume"
        )
    if args.effects == "auto":
        raise ValueError(
            "--effects auto chooses what a new run begins with; leave it out with "
            "--resume"
        )


def _cluster(args):
    """Return the processes to train with, or None; ValueError if they are unclear."""
    numbers = {"processes": args.processes, "process": args.process}
    if args.coordinator is None:
        for name, number in numbers.items():
            if number is not None:
                raise ValueError(
                    f"--{name} {number}: name the coordinator too, with --coordinator "
                    "HOST:PORT, or leave it out"
                )
        return None
    if args.coordinator == "auto":
        return platform.Cluster(None, **numbers)
    if None in numbers.values():
        raise ValueError(
            f"--coordinator {args.coordinator}: give --processes and --process too, or "
            "--coordinator auto under Slurm or Open MPI"
        )
    return platform.Cluster(args.coordinator, **numbers)


def _cores(args):
    """Return the number of cores for XLA, and the shares of a step."""
    if args.resume:
        return representations.cores_of_run(args.out)
    return representations.cores(args.preset, args.set)


def _expected_options(args):
    """Collect the options that must agree with the run that is continued."""
    options = {"preset": args.preset, "seed": args.seed}
    options = {name: value for name, value in options.items() if value is not None}
    return {**cli.set_options(args.source), **options}


if __name__ == "__main__":
    main()
