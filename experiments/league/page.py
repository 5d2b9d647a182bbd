"""The page of `experiments.league` in docs/results, and its picture."""

import collections
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments import markdown
from experiments.ablate import verdicts
from experiments.ablate.measures import MEASURES
from experiments.league import margins, rows, standings
from experiments.league.rows import JUDGED, against_best
from experiments.league.settings import League
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.evaluation import figures

QUALITIES = ("psnr", "ssim", "moving_psnr", "track_error", "depth_median")
COSTS = ("steps", "gaussians", "train_cpu_seconds", "train_seconds")
COSTS += ("compile_seconds", "render_ms", "model_mb")
READING = """\
## How to read

- *PSNR* (dB) and *SSIM* are those of held-out pictures, *moving* the PSNR of pixels
  that show what moves; *EPE* is how far points that are followed are from where they
  truly are, *depth* the median error of depth, both in scene units. A film that is no
  built-in scene has pictures alone.
- *reads* is what a row learns from beside pictures, cameras and points. In built-in
  films it is the exact depth, flow or mask of what moves, which other rows do not see.
- *CPU s* is what the lengths are of: seconds of all threads of a process with one core,
  without compiling, finding tracks and fitting the motion to them, which rows from
  tracks have on top. Seed 0 finds the steps that fit, give or take a tenth; the others,
  and rows that were made anew, make as many, on another or a busier machine in other
  seconds, which is most of the ±.
  *train s* is the same by the clock on the wall, *compile* what compiling takes without
  a cache, *frame ms* a held-out frame, *model MB* the file of a trained scene (of a
  field its parameters).
- Schedules stretch to the steps that a row gets; how many steps apart Gaussians grow
  does not, so that rows of dear steps also grow less often. Presets differ in what is
  not motion as well, in views a step and in how far apart growth is.
- ± is the standard deviation over seeds; without it there was one seed, and one seed
  has no spread to hold a difference against.
- *best* is the row of most PSNR among those with most seeds, however few these are. A
  gain over another row is the mean over the seeds that both have, each against itself,
  positive where the best is better, and ± there is its 95 % interval (Student, seeds
  paired): *shows* where it leaves zero out, *opposite* where it does against the best,
  *none* otherwise. The best was chosen by these numbers, and of so many comparisons one
  in twenty shows by chance: near rows are a tie.
- `+tracks` is a preset whose motion is fitted to tracks before training, `+rest` one
  that would be and is not, `+no-depth` one without its depth term.
- Not all cells are of one revision of the code: those are at the end of the page."""
WHOLE = League()


def page(stored: Mapping[str, Any]) -> str:
    """Everything below the docstring, from a league.json, however much is there."""
    contests = [standings.of_stored(one) for one in stored["contests"]]
    parts = [_progress(contests), READING]
    for contest in contests:
        parts.append(f"## {contest.title}")
        if contest.numbers:
            parts += _standings(contest)
        if contest.missing:
            parts.append(f"Not there: {_missing(contest)}.")
        if contest.stopped:
            stopped = ", ".join(contest.stopped)
            parts.append(f"Scored where they stopped before their steps: {stopped}.")
        longer = _longer(contest)
        if longer:
            parts.append(longer)
        if len(contest.cpus) > 1:
            parts.append(_machines(contest))
    parts.append(margins.section(contests))
    if any(contest.numbers for contest in contests):
        parts.append(_revisions(contests))
    return "\n\n".join(parts)


def _progress(contests):
    there = sum(len(contest.numbers) for contest in contests)
    missing = sum(map(len, (s for c in contests for s in c.missing.values())))
    seeds = sorted({seed for c in contests for _, seed in c.numbers})
    counted = f"**{there} of {there + missing} cells** (row, film, length and seed)"
    every = len(rows.suite().arms)
    whole = every * len(WHOLE.sources) * len(WHOLE.limits)
    parts = [f"{counted} that were asked for are there."]
    if missing:
        parts.append("What is missing is named below, and nothing is said of it.")
    if there:
        parts.append(f"Seeds so far: {', '.join(map(str, seeds))}.")
    if len(seeds) == 1:
        parts.append(
            "**One seed has no spread: no difference here is shown to be more than "
            "chance, and near rows have no order.**"
        )
    parts.append(f"The whole league is {whole * WHOLE.seeds:,} cells and any captures.")
    return " ".join([*parts, *_unasked(contests, every)])


def _unasked(contests, every):
    """Films, lengths and rows of the whole league without a cell, in sentences."""
    films = {contest.film for contest in contests if contest.numbers}
    lengths = {contest.seconds for contest in contests if contest.numbers}
    absent = [each for each in (*WHOLE.budgets, None) if each not in lengths]
    unseen = [f"`{name}`" for name in WHOLE.sources if name not in films]
    if unseen:
        yield f"No cell is of {' or '.join(unseen)}."
    for contest in contests:
        if len(contest.reads) < every:
            yield f"Of {contest.title}: {len(contest.reads)} of {every} rows."
    if absent:
        yield f"No cell is of {' or '.join(map(standings.length_of, absent))}."
    captures = [f"`{film}`" for film in sorted(films) if film not in WHOLE.sources]
    yield f"Captures: {', '.join(captures) or 'none'}."


def _revisions(contests):
    """With which code the cells were made, most first."""
    counted = sum((contest.revisions for contest in contests), collections.Counter())
    return (
        "## Revisions\n\n"
        "Cells by the revision of the code that made them, or (*before*) by the first "
        "that kept them; the changelog says what was mended since. "
        + ", ".join(
            f"`{_short(name)}` {count}" for name, count in counted.most_common()
        )
        + "."
    )


def _short(revision):
    """Enough of its name, and a plus where the code had changes."""
    name, plus, _ = revision.partition("+")
    return name[:14] + plus


def _longer(contest):
    """Rows whose first seed, which finds the steps, took more than it was to take."""
    took = {
        name: row["train_cpu_seconds"]
        for (name, seed), row in contest.numbers.items()
        if seed == 0 and contest.seconds is not None
    }
    over = {n: x for n, x in took.items() if x > 1.2 * contest.seconds}
    if not over:
        return ""
    most = sorted(over.items(), key=lambda one: -one[1])
    return (
        "Made anew over the steps that had been found before, the first seeds of these "
        "took longer by more than a fifth: "
        + ", ".join(f"`{n}` ({x:.0f} s)" for n, x in most)
        + "."
    )


def _machines(contest):
    """Which cells come from which processor: seconds are not of equal worth."""
    most = max(contest.cpus, key=lambda cpu: len(contest.cpus[cpu]))
    others = {cpu: cells for cpu, cells in contest.cpus.items() if cpu != most}
    words = [f"{cpu}: {', '.join(cells)}" for cpu, cells in others.items()]
    return f"All on one {most}, but for those on {'; on '.join(words)}."


def _missing(contest):
    """Rows without any cell by name, others with their seeds."""
    done = {name for name, _ in contest.numbers}
    return ", ".join(
        f"`{name}`" + (f" (seed {', '.join(map(str, seeds))})" if name in done else "")
        for name, seeds in contest.missing.items()
    )


def _standings(contest):
    """Rows from best to worst, what they cost, and the best against each."""
    means = standings.means(contest)
    order = sorted(means, key=lambda name: -standings.sortable(means[name]["psnr"]))
    best = standings.best_of(contest)
    parts = [_table(contest, order, QUALITIES)]
    if contest.still is not None:
        parts.append(f"Points that do not move have an EPE of {contest.still:.4f}.")
    parts.append(_table(contest, order, COSTS))
    others = [name for name in order if name != best]
    if others:
        parts.append(_against(contest, best, others))
    return parts


def _table(contest, order, names):
    table = []
    for name in order:
        cells = [f"`{name}`", ", ".join(contest.reads[name])]
        cells.append(str(len(standings.seeds_of(contest, name))))
        for key in names:
            mean, spread = standings.mean_and_spread(contest, name, key)
            cells.append(markdown.with_spread(mean, spread, MEASURES[key].digits))
        table.append(cells)
    heads = ("row", "reads", "seeds", *(MEASURES[key].heading for key in names))
    return markdown.table(heads, table, words=2)


def _against(contest, best, others):
    judged = verdicts.verdicts(contest.numbers, against_best(best, others))
    cells: dict[str, dict[str, str]] = {name: {} for name in others}
    for verdict in judged:
        cells[verdict.claim.worse][verdict.measure] = standings.gain(verdict)
    table = [
        [f"`{name}`", *(row.get(key, "") for key in JUDGED)]
        for name, row in cells.items()
    ]
    heads = [f"gain in {MEASURES[key].heading}" for key in JUDGED]
    count = {name: len(standings.seeds_of(contest, name)) for name in (best, *others)}
    full = sum(n == count[best] for n in count.values())
    among = "best"
    if full < len(count):
        among = f"best of the {full} rows with {count[best]} seeds"
    return markdown.table((f"{among}, `{best}`, against", *heads), table)


def draw(stored: Mapping[str, Any], path: pathlib.Path) -> None:
    """A panel for each film: PSNR of every row, a color for each length."""
    contests = [
        one for one in map(standings.of_stored, stored["contests"]) if one.numbers
    ]
    films = dict.fromkeys(contest.film for contest in contests)
    if not films:
        return
    tallest = max(len(standings.means(contest)) for contest in contests)
    figure = figures.new_figure(
        figsize=(5.2 * len(films), 1.2 + 0.22 * max(tallest, 4)),
        dpi=100,
        layout="constrained",
    )
    panels = figure.subplots(1, len(films), squeeze=False)[0]
    for film, panel in zip(films, panels, strict=True):
        _draw_film(panel, film, [c for c in contests if c.film == film])
    title = "held-out PSNR / dB: a dot for each seed, a bar for the mean"
    figure.suptitle(title, fontsize=9)
    with replaced_file(path) as partial:
        figure.savefig(partial, format="png")


def _draw_film(panel, film, contests):
    """Rows from worst to best of the longest length that has them."""
    latest = {}
    for contest in contests:
        latest |= {name: row["psnr"] for name, row in standings.means(contest).items()}
    order = sorted(latest, key=lambda name: standings.sortable(latest[name]))
    for number, contest in enumerate(contests):
        color = f"C{number}"
        for name in standings.means(contest):
            values = [
                contest.numbers[name, seed]["psnr"]
                for seed in standings.seeds_of(contest, name)
            ]
            height = order.index(name) + 0.22 * (number - (len(contests) - 1) / 2)
            panel.plot(values, [height] * len(values), ".", color=color, ms=4)
            panel.plot(np.mean(values), height, "|", color=color, ms=8)
        label = contest.title.partition(", ")[2]
        panel.plot([], [], ".", color=color, label=label)
    panel.set_yticks(range(len(order)), order, fontsize=7)
    panel.set_title(film)
    panel.legend(fontsize=7)
    panel.grid(alpha=0.3)
    panel.spines[["top", "right"]].set_visible(False)
