"""What it costs to put Gaussians where they are at a time, and what sparing it costs.

    python -m experiments.deformation_cost
    python -m experiments.deformation_cost --run runs/NAME --out runs/NAME/cost.json

The first table has, for 10,000 Gaussians, the time and the flops of every way: motion
networks of the papers' sizes and small ones, forward and, as in training, backward;
with what does not change in time kept (`prepare`); with the Gaussians that stand still
left out; and read from a table of time knots. The second has the error of such tables
against their number of knots, for the motion of a run, or for a small network that was
fitted to a motion in closed form.

Times are medians of this process's processor time, the ways in turn, on one core. Flops
are the compiler's count of one instant.
"""

import dataclasses
import functools
import pathlib
from typing import Annotated

from experiments import cli
from nerfies_jax import console
from nerfies_jax.runs import platform


@dataclasses.dataclass(frozen=True)
class DeformationCost:
    """Tabulate time and flops of deformations, and the error of time knots."""

    run: pathlib.Path | None = None
    """Run folder whose motion is tabulated (default: a small network fitted to a motion
    in closed form)."""
    gaussians: int = 10_000
    """Gaussians to deform; times and flops are given for 10,000."""
    still: float = 0.5
    """Share of them that stands still where that is made use of."""
    knots: tuple[int, ...] = (4, 8, 16, 32, 64)
    """Knots of the tables."""
    static_threshold: Annotated[float, cli.formerly("--still-below")] = 0.0
    """Gaussians that move less, in scene units, are not in the tables."""
    repeats: int = 7
    """Rounds of timing."""
    effect: cli.Effects = ()
    """Effects of your own that the run of --run was trained with, as MODULE:NAME."""
    out: pathlib.Path | None = None
    """Also write the figures here, as JSON, and a picture of the same name beside."""
    device: str = "auto"
    """cpu, gpu, or whatever JAX finds."""

    def __post_init__(self):
        for name in ("gaussians", "repeats"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} {getattr(self, name)} must be at least 1")
        if not 0 <= self.still < 1:
            raise ValueError(f"--still {self.still} is a share in [0, 1)")
        if not self.knots or min(self.knots) < 2:
            raise ValueError(f"--knots {self.knots}: a table has at least 2")
        if not self.static_threshold >= 0:
            raise ValueError(
                f"--static-threshold {self.static_threshold} cannot be negative"
            )


@cli.command(DeformationCost)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        cli.check_out_file(args.out)
        if args.out is not None:
            cli.check_out_file(args.out.with_suffix(".png"), "beside --out:")
        cli.find_effects(args.effect)
        platform.start_jax(args.device, "one")
        from experiments.deformation_cost import knot_curve

        motion = _motion(args)
        curve = knot_curve.curve(
            motion, args.knots, args.static_threshold, args.repeats
        )
    rows = costs(args.gaussians, args.still, args.repeats)
    console.say(text(rows, args.gaussians))
    for line in spared():
        console.say(line)
    console.say()
    console.say(knot_curve.text(curve))
    record = _record(rows, curve)
    if args.out is not None:
        _save(args.out, record, curve)
    return record


def _motion(args):
    from experiments.deformation_cost import known_motion
    from gaussians_jax.effects.mlp_motion import SMALL_MOTION
    from nerfies_jax import runs

    if args.run is None:
        steps = known_motion.FIT_STEPS
        return known_motion.fitted(args.gaussians, SMALL_MOTION, steps)
    run = runs.saved_run(args.run, effects=args.effect)
    state = runs.restore(args.run, run).state
    return known_motion.of_run(run.model, state, run.capture)


def costs(count: int, still: float, repeats: int) -> list[dict]:
    """One row for each arm: CPU and wall milliseconds and flops, None where it has no
    backward pass, all in proportion for 10,000 Gaussians.
    """
    import jax

    from experiments.deformation_cost import arms as deformation_arms
    from nerfies_jax.measure import clock

    arms = deformation_arms.arms(count, still)
    calls, rows = {}, []
    for arm in arms:
        row = {"name": arm.name}
        for kind, field in (("forward", "deform"), ("both", "gradient")):
            function = getattr(arm.used, field)
            if function is None:
                row |= {f"{kind}_{x}": None for x in ("ms", "cpu_ms", "flops")}
                continue
            calls[f"{arm.name}: {kind}"] = functools.partial(
                jax.jit(function), *arm.used.inputs
            )
            flops = sum(
                weight * clock.cost(jax.jit(getattr(way, field)), *way.inputs).flops
                for weight, way in arm.counted
            )
            row[f"{kind}_flops"] = flops * 1e4 / count
        rows.append(row)
    timings = clock.compare(calls, repeats=repeats, warm_up=1)
    for row in rows:
        for kind in ("forward", "both"):
            timing = timings.get(f"{row['name']}: {kind}")
            if timing is not None:
                row[f"{kind}_ms"] = 1e3 * timing.median * 1e4 / count
                row[f"{kind}_cpu_ms"] = 1e3 * timing.median_cpu * 1e4 / count
    return rows


def text(rows: list[dict], count: int) -> str:
    """The rows as a table."""
    lines = [
        f"for 10,000 Gaussians, measured with {count}: milliseconds of one core "
        "(wall), and million flops",
        f"{'':40s} {'forward':>17s} {'and backward':>17s} {'Mflop':>8s} {'both':>8s}",
    ]

    def time(row, kind):
        if row[f"{kind}_cpu_ms"] is None:
            return f"{'-':>17s}"
        return f"{row[f'{kind}_cpu_ms']:8.2f} ({row[f'{kind}_ms']:6.1f})"

    def flops(row, kind):
        value = row[f"{kind}_flops"]
        return f"{'-':>8s}" if value is None else f"{value / 1e6:8.1f}"

    for row in rows:
        lines.append(
            f"{row['name']:40s} {time(row, 'forward')} {time(row, 'both')} "
            f"{flops(row, 'forward')} {flops(row, 'both')}"
        )
    return "\n".join(lines)


def spared() -> list[str]:
    """What keeping what does not change in time spares, counted."""
    from gaussians_jax.effects import motion_basis
    from gaussians_jax.effects.motion_basis import SMALL_BASIS_MOTION, BasisMotionSpec

    lines = ["keeping the basis alone spares, of the deformation's multiply-adds,"]
    for name, spec in (("paper", BasisMotionSpec()), ("small", SMALL_BASIS_MOTION)):
        counted = motion_basis.multiply_adds(spec)
        basis, kept = (
            100 * counted[part] / counted["all"] for part in ("basis", "prepared")
        )
        lines.append(
            f"  {name} size: {basis:.1f} %, and {kept:.1f} % with the base network's "
            "share of the mean, which is kept here too"
        )
    return lines


def _record(rows, curve):
    from nerfies_jax.measure import clock

    points = [point._asdict() for point in curve.points]
    return {
        "machine": clock.machine(),
        "costs": rows,
        "spared": spared(),
        "knots": curve._replace(points=points)._asdict(),
    }


def _save(path, record, curve):
    from experiments.deformation_cost import knot_picture
    from nerfies_jax.capture.json_files import write_json

    write_json(path, record)
    picture = path.with_suffix(".png")
    knot_picture.save(picture, record["costs"], curve)
    console.say(f"figures: {path}\npicture: {picture}")


if __name__ == "__main__":
    main()
