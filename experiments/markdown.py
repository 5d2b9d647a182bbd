"""Markdown of measured numbers."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def number(value: float | int | None, digits: int = 2) -> str:
    """Format a number with some decimals, or an empty cell if it is None."""
    if value is None or not math.isfinite(value):
        return ""
    return f"{value:,.{digits}f}"


def with_spread(mean: float, spread: float, digits: int) -> str:
    """Format mean and spread, as in "21.30 ± 0.12", or the mean alone if the spread is
    NaN.
    """
    cell = number(mean, digits)
    return f"{cell} ± {number(spread, digits)}" if cell and spread == spread else cell


def short(value: float | int | None) -> str:
    """Format three digits, as in 0.0123 or 1e-07, or an integer from a thousand on."""
    if value is None or not math.isfinite(value):
        return ""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], words: int = 1) -> str:
    """Format a table, leaving out columns that are empty in every row.

    Args:
      heads: Headings.
      rows: Cells.
      words: Number of leading text columns. The others are right-aligned numbers.

    Returns:
      Markdown.
    """
    rows = [[cell.replace("|", r"\|") for cell in row] for row in rows]
    columns = [k for k in range(len(heads)) if not k or any(row[k] for row in rows)]
    lines = [
        [heads[k] for k in columns],
        ["---" if k < words else "---:" for k in columns],
    ]
    lines += [[row[k] for k in columns] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def bullets(lines: Iterable[str]) -> str:
    """Format a list."""
    return "\n".join(f"- {line.strip()}" for line in lines)


def title_and_text(docstring: str | None) -> tuple[str, str]:
    """Split a docstring into a heading, its first line, and the rest."""
    title, _, text = (docstring or "").strip().partition("\n")
    return f"# {title.rstrip('.:')}", text.strip("\n")


def machine(about: Mapping[str, Any]) -> str:
    """Describe the machine of a measurement, as in "AMD EPYC, cpu, JAX 0.10.2"."""
    return f"{about['cpu']}, {about['backend']}, JAX {about['jax']}"
