"""What the numbers of a league say, film by film and length by length."""

import collections
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from experiments.ablate import results, verdicts
from experiments.ablate.measures import MEASURES

# What `verdicts` says of a gain, in a word.
SHORT = {
    "shows": "shows",
    "the opposite shows": "opposite",
    "no effect beyond the spread over seeds": "none",
}


class Contest(NamedTuple):
    """One film and length of training."""

    title: str
    film: str
    seconds: float | None  # None: the presets' own steps
    still: float | None  # the EPE of points that do not move
    numbers: dict[tuple[str, int], dict[str, float]]  # by row and seed
    missing: dict[str, list[int]]  # seeds by row
    reads: dict[str, list[str]]  # beside pictures, cameras and points
    stopped: list[str]  # cells that ended before their steps, in words
    cpus: dict[str, list[str]]  # cells by processor, in words
    revisions: collections.Counter[str]  # of the code that made them: how many cells


def length_of(seconds: float | None) -> str:
    """A length of training in words."""
    if seconds is None:
        return "the presets' own steps"
    return f"{seconds:g} processor seconds"


def of_stored(stored: Mapping[str, Any]) -> Contest:
    """A contest as a league.json has it."""
    numbers, missing, stopped, cpus = {}, {}, [], {}
    revisions = collections.Counter()
    for name, row in stored["rows"].items():
        for seed in stored["seeds"]:
            cell = row["cells"].get(str(seed))
            if cell is None:
                missing.setdefault(name, []).append(seed)
                continue
            known = results.read_numbers(cell["numbers"])
            numbers[name, seed] = {key: known.get(key, math.nan) for key in MEASURES}
            words = f"`{name}` (seed {seed})"
            cpus.setdefault(cell["cpu"], []).append(words)
            revisions[cell["revision"]] += 1
            if cell["stopped_by"] != "steps":
                stopped.append(f"{words}: {cell['stopped_by']}")
    return Contest(
        f"`{stored['film']}`, {length_of(stored['seconds'])}",
        stored["film"],
        stored["seconds"],
        stored["still"],
        numbers,
        missing,
        {name: row["reads"] for name, row in stored["rows"].items()},
        stopped,
        cpus,
        revisions,
    )


def best_of(contest: Contest) -> str:
    """The row of most PSNR among those with most seeds."""
    averages = means(contest)
    count = {name: len(seeds_of(contest, name)) for name in averages}
    most = max(count.values())
    full = [name for name in averages if count[name] == most]
    return max(full, key=lambda name: sortable(averages[name]["psnr"]))


def seeds_of(contest: Contest, name: str) -> list[int]:
    """The seeds of a row that are there."""
    return [seed for other, seed in contest.numbers if other == name]


def sortable(value: float) -> float:
    """What is not known below everything else."""
    return value if math.isfinite(value) else -math.inf


def means(contest: Contest) -> dict[str, dict[str, float]]:
    """Means over the seeds that are there, by row and measure."""
    names = dict.fromkeys(name for name, _ in contest.numbers)
    return {
        name: {key: mean_and_spread(contest, name, key)[0] for key in MEASURES}
        for name in names
    }


def mean_and_spread(contest: Contest, name: str, key: str) -> tuple[float, float]:
    """Over the seeds of a row; the spread of a single one is NaN."""
    rows = [row for (other, _), row in contest.numbers.items() if other == name]
    values = verdicts.values_of(rows, key)
    spread = float(values.std(ddof=1)) if len(values) > 1 else math.nan
    return float(values.mean()), spread


def gain(verdict: verdicts.Verdict) -> str:
    """As in "+1.20 ± 0.31, shows"; empty where nothing is known."""
    if not math.isfinite(verdict.gain):
        return ""
    digits = MEASURES[verdict.measure].digits
    says = SHORT.get(verdict.says, "one seed")
    text = f"{verdict.gain:+.{digits}f}"
    if math.isfinite(verdict.half_width):
        text += f" ± {verdict.half_width:.{digits}f}"
    return f"{text}, {says}"
