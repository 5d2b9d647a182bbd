"""Write down what settings cost: lines, fronts, metrics and what got worse."""

import math
import pathlib
from collections.abc import Mapping, Sequence

import jax

from experiments import asked
from experiments.ablate import report, verdicts
from experiments.ablate.arms import Claim
from experiments.ablate.measures import MEASURES
from experiments.accuracy_time.axes import AXES
from nerfies_jax import console
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.evaluation import figures, protocol
from nerfies_jax.measure import clock
from nerfies_jax.measure.clock import Metric
from nerfies_jax.training import specs

# What is drawn: qualities above each other, costs beside each other.
QUALITIES = ("psnr", "ssim", "moving_psnr", "depth_median", "track_error")
COSTS = ("render_ms", "peak_mb", "parameters")  # beside the seconds of training
TITLES = {
    "psnr": "PSNR of held-out frames / dB",
    "ssim": "SSIM",
    "moving_psnr": "PSNR of what moves / dB",
    "depth_median": "median depth error / scene units",
    "track_error": "end-point error / scene units",
    "train_seconds": "seconds of training",
    "train_cpu_seconds": "processor seconds of training",
    "render_ms": "milliseconds a frame",
    "peak_mb": "peak memory / MB",
    "parameters": "parameters (4 bytes each in the file)",
}
SPLAT_COLOR, FIELD_COLOR = "#0a5fb4", "#c4501b"


def write(job, args, finished) -> list[Metric]:
    """accuracy_time.json, front.png and fronts.png; prints the lines of every axis."""
    numbers = {key: kept.numbers for key, kept in finished.items()}
    static = protocol.static_error(job.known)
    console.say(f"\n{job.capture.name}, every setting trained {job.budgets[0].title}:")
    for name in args.axes:
        console.say(f"\n{AXES[name].question} ({name}, against {AXES[name].base})")
        console.say(
            "\n".join(axis_lines(AXES[name], numbers)) or "    nothing finished"
        )
    for line in report.remarks(finished):
        console.say(line)
    means = averages(numbers)
    seconds = training_seconds()
    for cost in (seconds, "render_ms"):
        names = front(means, "psnr", cost)
        console.say(f"\nfront of PSNR against {TITLES[cost]}:")
        for name in names:
            row = means[name]
            console.say(f"    {row[cost]:9.1f}  {row['psnr']:.2f} dB  {name}")
    metrics = report.metrics(numbers, static)
    about = {
        "capture": job.capture.name,
        "settings": asked.without_places(args),
        "arms": {name: specs.as_json(job.suite.arms[name]) for name in job.names},
        "machine": clock.machine(),
    }
    clock.write_metrics(job.out / "accuracy_time.json", metrics, about)
    of = job.capture.name
    save_fronts(job.out / "front.png", of, means, ("psnr",), (seconds, COSTS[0]))
    shown = [q for q in QUALITIES if any(math.isfinite(r[q]) for r in means.values())]
    save_fronts(job.out / "fronts.png", of, means, shown, (seconds, *COSTS))
    console.say(f"\n{job.out / 'front.png'}, fronts.png and accuracy_time.json")
    return metrics


def training_seconds() -> str:
    """The measure of training time that compares: the processor's, on a CPU.

    A setting has one core to itself, so that this is what it would take there; by the
    wall clock, it counts the jobs beside it.
    """
    on_cpu = jax.default_backend() == "cpu"
    return "train_cpu_seconds" if on_cpu else "train_seconds"


def averages(numbers: verdicts.Numbers) -> dict[str, dict[str, float]]:
    """Means over the seeds, by setting and measure; NaN where none is known."""
    means = {}
    for name in dict.fromkeys(arm for arm, _ in numbers):
        rows = [row for (arm, _), row in numbers.items() if arm == name]
        means[name] = {
            measure: float(verdicts.values_of(rows, measure).mean())
            for measure in MEASURES
        }
    return means


def axis_lines(axis, numbers: verdicts.Numbers) -> list[str]:
    """One line for each finished setting: quality against the base, and its price."""
    means = averages(numbers)
    base, seconds = means.get(axis.base), training_seconds()
    lines = []
    for name in axis.settings:
        row = means.get(name)
        if row is None:
            continue
        words = [_quality(name, axis.base, measure, numbers, row)
                 for measure in ("psnr", "moving_psnr", "track_error")
                 if math.isfinite(row[measure])]  # fmt: skip
        if base is None or name == axis.base:
            price = f"{row[seconds]:.0f} s, {row['render_ms']:.0f} ms a frame"
        else:
            price = (
                f"{row[seconds] / base[seconds]:.2f} of the training "
                f"time, {row['render_ms'] / base['render_ms']:.2f} of a frame's"
            )
        lines.append(f"    {name:24s} {', '.join(words)}; {price}")
    return lines


def _quality(name, base, measure, numbers, row):
    """As in "PSNR 23.1 (+0.4: beyond the spread)"."""
    heading = {"psnr": "PSNR", "moving_psnr": "moving", "track_error": "EPE"}[measure]
    value = f"{heading} {row[measure]:.{MEASURES[measure].digits}f}"
    if name == base:
        return value
    claim = Claim("", name, base, (measure,))
    verdict = verdicts.verdicts(numbers, [claim])
    if not verdict or not math.isfinite(verdict[0].gain):
        return value
    gain, half = verdict[0].gain, verdict[0].half_width
    sign = -1 if MEASURES[measure].direction == "lower" else 1
    change = f"{sign * gain:+.{MEASURES[measure].digits}f}"
    if math.isnan(half):
        return f"{value} ({change}, one seed)"
    return f"{value} ({change}, {'same' if abs(gain) <= half else 'differs'})"


def front(
    means: Mapping[str, Mapping[str, float]], quality: str, cost: str
) -> list[str]:
    """Settings that no other beats in both, cheapest first.

    A setting without one of the two numbers is left out; of equals the first stays.
    """
    sign = -1 if MEASURES[quality].direction == "lower" else 1
    known = [
        (row[cost], -sign * row[quality], place, name)
        for place, (name, row) in enumerate(means.items())
        if math.isfinite(row[cost]) and math.isfinite(row[quality])
    ]
    best, unbeaten = math.inf, []
    for _, loss, _, name in sorted(known):
        if loss < best:
            best = loss
            unbeaten.append(name)
    return unbeaten


def save_fronts(
    path: pathlib.Path,
    capture: str,
    means: Mapping[str, Mapping[str, float]],
    qualities: Sequence[str],
    costs: Sequence[str],
) -> None:
    """A panel for each pair: all settings as dots, the front as a line with names."""
    rows, columns = len(qualities), len(costs)
    size = (5.4 * columns, 4.0 * rows)
    figure = figures.new_figure(figsize=size, dpi=100, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False)
    for quality, line in zip(qualities, panels, strict=True):
        for cost, panel in zip(costs, line, strict=True):
            _draw_front(panel, means, quality, cost)
    figure.suptitle(
        f"{capture}: settings (blue splats, orange fields) and the front "
        "that none beats in both",
        fontsize=10,
    )
    with replaced_file(path) as partial:
        figure.savefig(partial)


def _draw_front(panel, means, quality, cost):
    for row in means.values():
        if math.isfinite(row[cost]) and math.isfinite(row[quality]):
            splats = math.isfinite(row["gaussians"])
            color = SPLAT_COLOR if splats else FIELD_COLOR
            panel.plot(row[cost], row[quality], "o", color=color, markersize=4)
    names = front(means, quality, cost)
    for name in set(means) - set(names):
        row = means[name]
        if name.endswith("-small") and math.isfinite(row[cost] + row[quality]):
            panel.annotate(
                name.removesuffix("-small"),
                (row[cost], row[quality]),
                xytext=(4, -2),
                textcoords="offset points",
                fontsize=6,
                color="#8b949e",
            )
    xs = [means[name][cost] for name in names]
    ys = [means[name][quality] for name in names]
    panel.plot(xs, ys, "-", color="#59636e", linewidth=1, zorder=0)
    for number, (name, x, y) in enumerate(zip(names, xs, ys, strict=True)):
        panel.annotate(
            name,
            (x, y),
            xytext=(4, -9 if number % 2 else 5),
            textcoords="offset points",
            fontsize=7,
        )
    if xs and max(xs) > 0:
        panel.set_xscale("log")
    panel.set_xlabel(TITLES[cost])
    panel.set_ylabel(TITLES[quality])
    if MEASURES[quality].direction == "lower":
        panel.invert_yaxis()  # better is up everywhere
    panel.grid(alpha=0.3)
    panel.spines[["top", "right"]].set_visible(False)
