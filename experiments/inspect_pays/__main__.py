"""Does an inspection's advice pay? Presets as they are against what is advised.

    python -m experiments.inspect_pays                       # the built-in scenes
    python -m experiments.inspect_pays CAPTURE CAPTURE --max-side 256 --jobs 4
    python -m experiments.inspect_pays --scenes exposure --presets nerf-small

Every capture is inspected once. Then each of --presets is trained as it is, and with
the effects advised (what `reconstruct --effects auto` would take), over the same steps
from the same seeds, in processes with one core each. Where both are the same scene
there is nothing to decide and nothing is trained. Prints a table, writes pays.md and
pays.json. What is finished is kept in --out: the same command goes on.
"""

import dataclasses
import pathlib

from experiments import cli
from nerfies_jax import console
from nerfies_jax.runs import platform


@dataclasses.dataclass(frozen=True)
class InspectPays:
    """Hold what an inspection advises against presets, by training both."""

    captures: cli.Positional[tuple[pathlib.Path, ...]] = ()
    """Folders of captures with held-out frames."""
    scenes: tuple[str, ...] = ()
    """Built-in scenes (default: all of them where no capture is given)."""
    presets: tuple[str, ...] = ("splats-deformable-small", "nerfies-small")
    """What the advice is held against; each says a representation and a size."""
    steps: int = 300
    """Of every run; schedules stretch with them."""
    seeds: int = 1
    """Runs of each; the table has their means."""
    jobs: int = 1
    """Runs at once, each on one core."""
    factor: int | None = None
    """Read the captures' pictures at 1/FACTOR of their size."""
    max_side: int | None = None
    """Read the captures' pictures with no side longer than this, in pixels."""
    heldout: str | None = None
    """Frames of the captures to judge by: n for every n-th, or a split's name."""
    frames: int = 6
    """Held-out frames to render, evenly over the time."""
    set: cli.Overrides = ()
    """Fields that are changed in every run, as rays=256."""
    out: pathlib.Path = pathlib.Path("runs", "inspect_pays")
    """Folder of results; may hold finished runs."""

    def __post_init__(self):
        if not self.presets or min(self.steps, self.seeds, self.jobs, self.frames) < 1:
            raise ValueError(
                "--presets, --steps, --seeds, --jobs and --frames: at least one of "
                f"each, got {len(self.presets)}, {self.steps}, {self.seeds}, "
                f"{self.jobs}, {self.frames}"
            )


@cli.command(InspectPays)
def main(args):
    """Run the job of the command line; exit code 1 where a run failed, 2 where its
    input is wrong."""
    with cli.user_errors():
        platform.start_jax("cpu")
        check(args.presets)
        from experiments.inspect_pays import report
        from experiments.inspect_pays.job import Trial, read

        # All are read before the first is trained: a wrong name ends it at once.
        trials = [Trial(args, *read(args, path)) for path in args.captures]
        names = args.scenes or (() if args.captures else _built_in())
        trials += [Trial(args, *read(args, None, scene)) for scene in names]
    failed, rows = False, []
    for trial in trials:
        failed |= bool(trial.run())
        rows += trial.rows()
    lines = report.write(args.out, args, rows)
    console.say("\n".join(lines))
    return cli.Ended(cli.stored(args.out / "pays.json"), 1 if failed else 0)


def check(presets: tuple[str, ...]) -> None:
    """Raise ValueError for a preset that no advice is held against."""
    from experiments.inspect_pays.arms import held_against

    known = held_against()
    for preset in presets:
        if preset not in known:
            raise ValueError(f"--presets {preset}: choose from {', '.join(known)}")


def _built_in():
    from nerfies_jax.capture import synthetic

    return tuple(synthetic.PRESETS)


if __name__ == "__main__":
    main()
