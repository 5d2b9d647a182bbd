"""The page of `experiments.mutants` in docs/results."""

import collections

from experiments import markdown
from experiments.mutants.witnesses import CORE

HARMLESS, NOBODY = "nothing to notice", "nobody"
# What changes no result, though the source differs: (file, line after the change), why.
SAME: dict[tuple[str, str], str] = {}


def page(stored: dict) -> str:
    """The faults, which tests noticed each, and what became of those none noticed."""
    rows = stored["rows"]
    counts = collections.Counter(_fate(row) for row in rows)
    seen = sum(counts[name] for name in CORE)
    faults = len(rows) - counts[HARMLESS]
    heads = ("file and line", "before", "after", "noticed by")
    table = markdown.table(heads, [_cells(row) for row in rows], words=4)
    fates = markdown.bullets([f"{name}: {count}" for name, count in counts.items()])
    return (
        f"The default tests notice {seen} of {faults} faults "
        f"({100 * seen / max(faults, 1):.0f} %); so many by whom, of all {len(rows)}:"
        f"\n\n{fates}\n\n{table}"
    )


def _fate(row):
    if row["caught_by"]:
        return row["looked_in"]
    return HARMLESS if _key(row) in SAME else NOBODY


def _key(row):
    return row["at"].partition(":")[0], row["after"]


def _cells(row):
    tests = [test.partition("@")[0] for test in row["caught_by"]]
    told = ", ".join(f"`{test}`" for test in tests) or SAME.get(_key(row), NOBODY)
    return [row["at"], f"`{row['before']}`", f"`{row['after']}`", told]
