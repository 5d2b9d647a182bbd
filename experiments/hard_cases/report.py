"""Tables, figures and the page of `experiments.hard_cases`."""

import re

import numpy as np

from experiments.hard_cases.case import ORDERS
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.metrics import clock
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.visualization import figures

BEGIN = "<!-- begin: python -m experiments.hard_cases -->"
END = "<!-- end: python -m experiments.hard_cases -->"
LEAST, MOST = 1e-18, 1e6  # errors outside are drawn at the edge of a figure
COLORS = {"stable": "#0a5fb4", "textbook": "#c4501b"}
LINES = {"float32": "-", "float64": "--", "bfloat16": ":"}


def worst(values) -> float:
    """Return the largest error of a sweep, infinite if any is not finite."""
    return float(np.max(values))


def number(values) -> str:
    """Format the worst error: 0, 3e-07, or not finite and the worst finite one."""
    finite = [value for value in values if np.isfinite(value)]
    largest = max(finite, default=0.0)
    shown = "0" if largest == 0 else f"{largest:.0e}"
    if len(finite) == len(values):
        return shown
    return f"not finite, {shown}" if finite else "not finite"


def block(row) -> str:
    """Lines for one case: errors by precision, then the cost."""
    lines = [f"\n{row.case.name}: {row.case.breaks}"]
    for dtype, outcome in row.outcomes.items():
        for name, ours, theirs in zip(ORDERS, *outcome, strict=False):
            at = row.case.at[int(np.argmax(ours))]
            lines.append(
                f"  {dtype:8s} {name:9s} textbook {number(theirs):>18s}   ours "
                f"{number(ours):>6s}  (worst at {row.case.axis} = {at:g})"
            )
    lines.append(f"  time of ours / textbook, value and gradient: {costs(row)}")
    return "\n".join(lines)


def costs(row) -> str:
    """Format costs, as in "0.21, 0.47"."""
    if not row.case.alike:
        return "not comparable"
    return f"{row.value_cost:.2f}, {row.slope_cost:.2f}"


def summary(rows) -> str:
    """Summarize the table in two sentences."""
    broken = sum(
        any(worst(x) > 1e-2 for o in row.outcomes.values() for x in o.textbook)
        for row in rows
    )
    verdict = (
        f"{broken} of {len(rows)} textbook forms are wrong by more than one per cent "
        f"somewhere, in value or derivative."
    )
    timed = [row for row in rows if row.case.alike]
    if not timed:
        return verdict
    value = np.median([row.value_cost for row in timed])
    slope = np.median([row.slope_cost for row in timed])
    dear = max(timed, key=lambda row: row.slope_cost)
    return (
        f"{verdict}\nMedian time of ours over the textbook's: value {value:.2f}, "
        f"gradient {slope:.2f}; dearest gradient {dear.slope_cost:.2f} "
        f"({dear.case.name})."
    )


def table(rows) -> str:
    """The table of docs/numerics.md."""
    lines = [
        "| case | what breaks in the textbook form | formula used; switch | worst "
        "error f32: textbook → ours | f64 | time of ours / textbook: value, gradient "
        "| test |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [
            row.case.name,
            row.case.breaks,
            f"{row.case.formula}; {row.case.switch}",
            *(_errors(row.outcomes.get(dtype)) for dtype in ("float32", "float64")),
            costs(row),
            f"`{row.test}[{row.case.name}-…]`",
        ]
        lines.append(
            "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"
        )
    return "\n".join(lines)


def _errors(outcome):
    if outcome is None:
        return "not held"
    return "; ".join(
        f"{name} {number(theirs)} → {number(ours)}"
        for name, ours, theirs in zip(ORDERS, *outcome, strict=False)
    )


def parts(path) -> tuple[str, str]:
    """Split a document at the markers of the table.

    Raises:
      ValueError: If it does not have both markers.
    """
    text = path.read_text() if path.is_file() else ""
    match = re.search(f"(.*{BEGIN}\n)(.*)({END}.*)", text, re.DOTALL)
    if match is None:
        raise ValueError(
            f"--document {path}: no such file, or not both of the lines {BEGIN} and "
            f"{END} in it"
        )
    return match[1], match[3]


def renew(path, rows) -> None:
    """Replace the table between the markers, atomically."""
    before, behind = parts(path)
    machine = clock.machine()
    about = (
        f"Measured with JAX {machine['jax']} on {machine['cpu']}, "
        f"{machine['xla_cores'] or machine['cores']} core(s): processor time of "
        "interleaved calls in float32."
    )
    with replaced_file(path) as file:
        file.write_text(f"{before}\n{about}\n\n{table(rows)}\n\n{behind}")


def save_numbers(folder, rows, args) -> None:
    """All numbers as metrics, to hold a later run against."""
    metrics = []
    for row in rows:
        key = row.case.name.replace(" ", "_")
        for dtype, outcome in row.outcomes.items():
            for name, ours, theirs in zip(ORDERS, *outcome, strict=False):
                stem = f"{key}.{dtype}.{name}"
                metrics.append(Metric(f"{stem}.ours", worst(ours), "", "lower"))
                metrics.append(Metric(f"{stem}.textbook", worst(theirs), "", "lower"))
        measured = {"value": row.value_cost, "gradient": row.slope_cost}
        for name, cost in measured.items() if row.case.alike else ():
            metrics.append(Metric(f"{key}.{name}_cost", cost, "", "lower", 0.25))
    about = {"numbers": args.numbers, "repeats": args.repeats, **clock.machine()}
    clock.write_metrics(folder / "hard_cases.json", metrics, about)


def save_figure(folder, row) -> None:
    """Errors over the sweep, one panel for value, slope and curvature."""
    orders = row.case.orders
    figure = figures.new_figure(figsize=(4.2 * orders, 3.4), layout="constrained")
    panels = figure.subplots(1, orders, squeeze=False)[0]
    places = np.arange(len(row.case.at))
    for order, panel in enumerate(panels):
        for dtype, outcome in row.outcomes.items():
            for form, errors in zip(("stable", "textbook"), outcome, strict=True):
                if order < len(errors):
                    shown = np.clip(errors[order], LEAST, MOST)
                    panel.semilogy(
                        places,
                        shown,
                        LINES[dtype],
                        color=COLORS[form],
                        marker=".",
                        label=f"{'ours' if form == 'stable' else form}, {dtype}",
                    )
        panel.set_title(ORDERS[order], loc="left", fontsize=10)
        panel.set_xlabel(row.case.axis)
        every = max(1, len(places) // 7)
        panel.set_xticks(places[::every])
        panel.set_xticklabels(
            [f"{x:.3g}" for x in row.case.at[::every]], rotation=40, fontsize=8
        )
        panel.set_ylim(LEAST / 3, MOST * 3)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("error / largest entry of the truth")
    panels[-1].legend(fontsize=7)
    figure.suptitle(f"{row.case.name} (top edge: not finite)", fontsize=11)
    name = re.sub(r"[^a-z0-9]+", "-", row.case.name.lower()).strip("-")
    with replaced_file(folder / f"{name}.png") as file:
        figure.savefig(file, dpi=110, format="png")
