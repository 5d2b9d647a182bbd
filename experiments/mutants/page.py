"""The page of `experiments.mutants` in docs/results."""

import collections

from experiments import markdown

NOTICED, HARMLESS, NOBODY = "noticed", "nothing to notice", "nobody"
# What changes no result, though the source differs: (file, line after the change), why.
SAME: dict[tuple[str, str], str] = {
    (
        "nerfies_jax/capture/frames.py",
        'return tuple((1, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts)',
    ): "words and numbers alternate and are never compared",
}


def page(results: dict) -> str:
    """Format the faults, the tests that notice each, and those that none notices."""
    rows = results["rows"]
    counts = collections.Counter(map(_fate, rows))
    faults = len(rows) - counts[HARMLESS]
    heads = ("file and line", "before", "after", "noticed by")
    table = markdown.table(heads, [_cells(row) for row in rows], words=4)
    share = 100 * counts[NOTICED] / max(faults, 1)
    seed = "No test was written because of these: so much of any faults is noticed."
    if results["seed"] == 0:
        seed = "Core was strengthened until it noticed most of these."
    same = f"; {counts[HARMLESS]} more change no result" if counts[HARMLESS] else ""
    return (
        f"The default tests notice {counts[NOTICED]} of {faults} faults ({share:.0f} %)"
        f"{same}. {seed} Of the tests that notice a fault up to three are named."
        f"\n\n{table}"
    )


def _fate(row):
    if row["caught_by"]:
        return NOTICED
    return HARMLESS if _key(row) in SAME else NOBODY


def _key(row):
    return row["at"].partition(":")[0], row["after"]


def _cells(row):
    tests = [test.partition("@")[0] for test in row["caught_by"]]
    witnesses = ", ".join(f"`{test}`" for test in tests) or SAME.get(_key(row), NOBODY)
    return [row["at"], f"`{row['before']}`", f"`{row['after']}`", witnesses]
