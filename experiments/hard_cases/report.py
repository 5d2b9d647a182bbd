"""Tables and the page of `experiments.hard_cases`."""

import re

import numpy as np

from experiments.hard_cases.case import ORDERS
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.metrics import clock
from nerfies_jax.metrics.clock import Metric

BEGIN = "<!-- begin: nerfies study hard_cases -->"
END = "<!-- end: nerfies study hard_cases -->"


def number(values) -> str:
    """Format the worst error: 0, 3e-07, or not finite and the worst finite one."""
    finite = [value for value in values if np.isfinite(value)]
    largest = max(finite, default=0.0)
    text = "0" if largest == 0 else f"{largest:.0e}"
    if len(finite) == len(values):
        return text
    return f"not finite, {text}" if finite else "not finite"


def block(row) -> str:
    """Format the lines of one case: errors by precision, then the cost."""
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
    return f"{row.value_cost:.2f}, {row.gradient_cost:.2f}"


def summary(rows) -> str:
    """Summarize the table in two sentences."""
    broken_count = sum(
        any(np.max(x) > 1e-2 for o in row.outcomes.values() for x in o.textbook)
        for row in rows
    )
    verdict = (
        f"{broken_count} of {len(rows)} textbook forms are wrong by more than one per "
        f"cent somewhere, in value or derivative."
    )
    timed_rows = [row for row in rows if row.case.alike]
    if not timed_rows:
        return verdict
    value = np.median([row.value_cost for row in timed_rows])
    gradient = np.median([row.gradient_cost for row in timed_rows])
    costly = max(timed_rows, key=lambda row: row.gradient_cost)
    return (
        f"{verdict}\nMedian time of ours over the textbook's: value {value:.2f}, "
        f"gradient {gradient:.2f}; most expensive gradient {costly.gradient_cost:.2f} "
        f"({costly.case.name})."
    )


def table(rows) -> str:
    """Format the table of docs/numerics.md."""
    lines = [
        "| case | failure of the textbook formula | formula used and switch point | "
        "worst error in f32: textbook → ours | in f64: textbook → ours | cost: ours / "
        "textbook for value, gradient | test |",
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
        return "not measured"
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
        f"{machine['xla_cores'] or machine['cores']} core(s). Costs are ratios "
        "of processor times of interleaved calls in float32."
    )
    with replaced_file(path) as file:
        file.write_text(f"{before}\n{about}\n\n{table(rows)}\n\n{behind}")


def save_numbers(folder, rows, args) -> None:
    """Write all numbers as metrics, to compare later runs with."""
    metrics = []
    for row in rows:
        key = row.case.name.replace(" ", "_")
        for dtype, outcome in row.outcomes.items():
            for name, ours, theirs in zip(ORDERS, *outcome, strict=False):
                stem = f"{key}.{dtype}.{name}"
                metrics.append(Metric(f"{stem}.ours", float(np.max(ours)), "", "lower"))
                metrics.append(
                    Metric(f"{stem}.textbook", float(np.max(theirs)), "", "lower")
                )
        cost_ratios = {"value": row.value_cost, "gradient": row.gradient_cost}
        for name, cost in cost_ratios.items() if row.case.alike else ():
            metrics.append(Metric(f"{key}.{name}_cost", cost, "", "lower", 0.25))
    about = {"numbers": args.numbers, "repeats": args.repeats, **clock.machine()}
    clock.write_metrics(folder / "hard_cases.json", metrics, about)
