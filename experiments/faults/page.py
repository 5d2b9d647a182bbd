"""The page of `experiments.faults` in docs/results."""

import collections

from experiments import markdown
from experiments.faults.inject import KINDS

ABOUT = {
    "splats": "`reconstruct`, static splats",
    "moving": "`reconstruct`, splats with a motion network",
    "field": "`reconstruct`, a radiance field",
    "prepare": "`prepare`: cameras of a clip by COLMAP",
    "export": "`export`, over an earlier sequence of files",
    "render": "`render`, over an earlier video and its images",
    "sweep": "`benchmark` with two processes",
}


def page(stored: dict) -> str:
    """Format the number of faults of each job, and its losses.

    Args:
      stored: The stored results.

    Returns:
      Markdown.
    """
    rows = [row for rows in stored["chains"].values() for row in rows]
    lost = [row for row in rows if row["lost"]]
    faults = [fault for each in KINDS.values() for fault in each]
    counts = collections.Counter((row["job"], row["fault"]) for row in rows)
    losses = collections.Counter(row["job"] for row in lost)
    heads = ("job", *faults, "all", "lost")
    table = []
    for job in ABOUT:
        numbers = [counts[job, fault] for fault in faults]
        cells = [str(number) for number in (*numbers, sum(numbers), losses[job])]
        table.append([ABOUT[job], *cells])
    sums = [sum(counts[job, fault] for job in ABOUT) for fault in faults]
    table.append(["all", *map(str, (*sums, len(rows), len(lost)))])
    codes = [[f"{fault}", _codes(rows, fault)] for fault in faults]
    parts = [
        f"Of {len(rows)} faults {len(lost)} lost anything.",
        markdown.table(heads, table),
        "Exit codes after each fault, with how often. A negative one is a death by the "
        "signal itself, before the command could install a handler; 0 is a job that "
        "completed all the same.",
        markdown.table(("fault", "exit codes"), codes, words=2),
    ]
    if lost:
        parts += [
            "What was lost:",
            markdown.bullets(
                f"{row['job']}, {row['fault']}: {row['lost']}" for row in lost
            ),
        ]
    return "\n\n".join(parts)


def _codes(rows, fault):
    counts = collections.Counter(row["code"] for row in rows if row["fault"] == fault)
    return ", ".join(f"{code} ({count})" for code, count in sorted(counts.items()))
