"""What a warp and its penalties cost in a training step.

    python -m experiments.nerf_speed
    python -m experiments.nerf_speed --rows static warp "warp + elastic" --repeats 9

One step of 256 rays with 64 + 64 samples, trunk 8x256, SE(3) warp 6x128, on the
built-in scene: the configuration in which the official code was measured. Its numbers
stand beside ours: they were taken on another day, so compare ratios and the
compiler's flops. Rows take turns; seconds are medians of processor time, because the
machine may be shared.
"""

import dataclasses
import pathlib

from experiments import cli, markdown
from nerfies_jax import console
from nerfies_jax.runs import platform

RAYS = 256
# CPU seconds over those of the warp, GFLOP and temporaries (MiB) of
# google/nerfies@1a38512 on JAX 0.10.2, CPU, float32.
OFFICIAL = {
    "static": (0.77, 172.7, 628),
    "translation": (0.98, 203.0, 860),
    "warp": (1.00, 203.2, 855),
    "warp + elastic, all samples": (1.37, 238.0, 867),
    "warp + background": (1.02, 212.9, 855),
    "warp + elastic, all samples, + background": (1.38, 247.8, 867),
}


@dataclasses.dataclass(frozen=True)
class NerfSpeed:
    """Time a step with and without a warp, elastic and background penalties."""

    rows: tuple[str, ...] = ()
    """Which rows (default: all)."""
    repeats: int = 5
    """Rounds of all rows."""
    out: pathlib.Path | None = None
    """Also write the figures here, as JSON."""
    device: str = "auto"
    """cpu, gpu, or whatever JAX finds."""

    def __post_init__(self):
        cli.check_out_file(self.out)
        if self.repeats < 1:
            raise ValueError(f"--repeats {self.repeats}: time at least once")


@cli.command(NerfSpeed)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        platform.start_jax(args.device, "all")
        unknown = set(args.rows) - set(specs())
        if unknown:
            raise ValueError(f"--rows {min(unknown)!r}: there are {', '.join(specs())}")
        rows = args.rows or tuple(specs())
    figures = measured(rows, args.repeats)
    console.say(table(figures))
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.measure import clock

    record = {"machine": clock.machine(), "rows": figures}
    if args.out is not None:
        write_json(args.out, record)
    return record


def specs():
    """The fields to time, by the name of their row."""
    from nerfies_jax.effects.background import BackgroundSpec
    from nerfies_jax.effects.elastic import ElasticSpec
    from nerfies_jax.effects.warp import WarpSpec
    from nerfies_jax.nets.encoding import EncodingSpec
    from nerfies_jax.radiance.template import TemplateSpec
    from nerfies_jax.spec import RadianceScene, SamplingSpec

    static = RadianceScene(
        steps=1000,
        rays=RAYS,
        sampling=SamplingSpec(64, 64),
        template=TemplateSpec(EncodingSpec(8), EncodingSpec(4), skips=(4,)),
    )
    # Annealed, so that every row pays for its window.
    warp = dataclasses.replace(static, warp=WarpSpec(anneal_steps=500))
    translation = dataclasses.replace(warp.warp, kind="translation")
    # The paper's: robust, on every coarse sample, and folds are free.
    parity = ElasticSpec(points=None, scaling="official", fold_cost=0.0)
    return {
        "static": static,
        "translation": dataclasses.replace(warp, warp=translation),
        "warp": warp,
        "warp + elastic": dataclasses.replace(warp, elastic=ElasticSpec()),
        "warp + elastic, all samples": dataclasses.replace(warp, elastic=parity),
        "warp + background": dataclasses.replace(warp, background=BackgroundSpec()),
        "warp + elastic + background": dataclasses.replace(
            warp, elastic=ElasticSpec(), background=BackgroundSpec()
        ),
        "warp + elastic, all samples, + background": dataclasses.replace(
            warp, elastic=parity, background=BackgroundSpec()
        ),
    }


def measured(rows: tuple[str, ...], repeats: int) -> dict[str, dict[str, float]]:
    """Processor and wall seconds, flops, temporaries and compile time of each row."""
    import jax

    from nerfies_jax import evaluation, scene
    from nerfies_jax.capture import synthetic
    from nerfies_jax.measure import clock

    capture = synthetic.cached(
        synthetic.PRESETS["default"], platform.CACHE / "scenes", 0
    )[0]
    # A program from the cache would not show what compiling it takes.
    jax.config.update("jax_enable_compilation_cache", False)
    figures, calls = {}, {}
    for name in rows:
        spec = specs()[name]
        model = scene.build(spec, scene.metadata_of(capture, spec))
        state = model.init(capture, jax.random.key(0))
        frames = evaluation.frames_of(capture, model.required_data)
        cost = clock.cost(model.step, state, frames)
        figures[name] = {
            "gflop": cost.flops / 1e9,
            "temporary_mib": cost.temporary_bytes / 2**20,
            "compile_seconds": cost.compile_seconds,
        }
        step = jax.jit(model.step)
        calls[name] = lambda step=step, state=state, frames=frames: step(state, frames)
    for name, timing in clock.compare(calls, repeats=repeats, warm_up=1).items():
        figures[name]["cpu_seconds"] = timing.median_cpu
        figures[name]["wall_seconds"] = timing.median
    return figures


def table(figures: dict[str, dict[str, float]]) -> str:
    """The rows as text; ratios to the warp, the official code's in brackets."""
    base = figures.get("warp", next(iter(figures.values())))
    lines = [
        f"{'':42s} {'CPU s':>6s} {'ratio':>13s} {'GFLOP':>15s} "
        f"{'MiB':>11s} {'compile s':>9s}"
    ]
    for name, row in figures.items():
        theirs = OFFICIAL.get(name)
        ratio, flop, memory = ("", "", "")
        if theirs is not None:
            ratio, flop, memory = (
                f"({theirs[0]:.2f})",
                f"({theirs[1]:.1f})",
                f"({theirs[2]})",
            )
        share = row["cpu_seconds"] / base["cpu_seconds"]
        lines.append(
            f"{name:42s} {row['cpu_seconds']:6.2f} {share:6.2f} {ratio:6s} "
            f"{row['gflop']:7.1f} {flop:7s} {row['temporary_mib']:5.0f} {memory:5s} "
            f"{row['compile_seconds']:9.1f}"
        )
    return "\n".join(lines)


def page(stored) -> str:
    """The page in docs/results below the docstring, from what `--out` wrote."""
    figures = stored["rows"]
    base = figures.get("warp", next(iter(figures.values())))["cpu_seconds"]
    rows = []
    for name, row in figures.items():
        ratio, flop, memory = OFFICIAL.get(name, (None, None, None))
        rows.append(
            [
                name,
                markdown.number(row["cpu_seconds"], 2),
                markdown.number(row["cpu_seconds"] / base, 2),
                markdown.number(ratio, 2),
                markdown.number(row["gflop"], 1),
                markdown.number(flop, 1),
                markdown.number(row["temporary_mib"], 0),
                markdown.number(memory, 0),
                markdown.number(row["compile_seconds"], 1),
            ]
        )
    heads = ("scene", "CPU s", "over warp", "official", "GFLOP", "official")
    heads += ("MiB", "official", "compile s")
    return markdown.table(heads, rows)


if __name__ == "__main__":
    main()
