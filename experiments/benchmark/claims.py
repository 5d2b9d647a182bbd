"""Do the margins that Sonata and MoBa-GS publish hold here?

A margin is the difference in PSNR between two methods in a table of a paper. Here it is
measured between the small presets of both, on the built-in scene `default` and on a
real video (`nrnerf_bookshelf`). This says whether the order holds at this size, and not
whether the papers measured correctly.
"""

import json
import pathlib
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from experiments import markdown
from experiments.benchmark import published, verdicts
from experiments.benchmark.suites import Claim

ROOT = pathlib.Path(__file__).resolve().parents[2]
LEAGUE = "docs/results/league.json"
RADAR_ABLATION = "experiments/measured/ablate_sonata.json"
CAPTURES = ("default", "nrnerf_bookshelf")
PSNR = "heldout.psnr"
HOLDS, FAILS, UNDECIDED, UNKNOWN = "holds", "does not", "undecided", "not measured"
FIELDS = ("tineuvox-small", "hypernerf-small", "nerf-ds-small", "nerfies-small")
# At the revisions of the league, these trained on two views per step and grew every 130
# steps. Sonata, MoBa-GS and deformable 3DGS had one view, and grew every 200.
TWO_VIEWS = (
    *("sc-gs-small", "4dgs-small", "edgs-small"),
    *("e-d3dgs-small", "d-miso-small", "motion-gs-small"),
)
READING = """\
- *published* is the margin in PSNR (dB), SSIM and LPIPS (where less is better), between
  means over the captures of the table. The papers' own runs of one method on NeRF-DS
  differ by 0.35 to 1.9 dB, which is as much as most margins.
- A *gain* is the mean difference in PSNR over the same three seeds, ± its 95 % interval
  (Student, seeds paired), on `default`; on `nrnerf_bookshelf`. The *mean* is that over
  both, as in the papers' tables. A margin *holds* if the interval is above 0 on every
  capture, and *does not* if it is below 0 on every capture. Others are *undecided*.
- **Not measured**: NeRF-DS and HyperNeRF themselves, presets of the papers' sizes, and
  LPIPS, whose weights are downloads of their own. Scores in SSIM are in the pages that
  are linked below.
- The runs are of several earlier revisions, which those pages name."""
COSTS = """\
MoBa-GS publishes times, sizes and frame rates on an A100, and that it needs no points
of structure from motion, for which it prints no margin. The league gives all methods
the same time, so the time to a quality is not measured. The ratio of the training times
is that of the processor time per step."""


class Gain(NamedTuple):
    """Difference in PSNR between two methods on one capture, over seeds."""

    mean: float  # dB
    half_width: float | None  # of its 95 % interval, None with one seed

    @property
    def sign(self) -> int:
        """Sign of the gain if the interval excludes 0, else 0."""
        if self.half_width is None or abs(self.mean) <= self.half_width:
            return 0
        return 1 if self.mean > 0 else -1


class Row(NamedTuple):
    """A published margin, with gains by capture for each kind of initialization."""

    paper: str
    other: str
    margin: str
    gains: tuple[dict[str, Gain], ...]
    reason: str

    @property
    def verdicts(self) -> list[str]:
        """Verdict for each kind of initialization."""
        return [verdict(gains.values()) for gains in self.gains]

    @property
    def why(self) -> str:
        """Reason, which begins with that of an undecided verdict from tracks."""
        words = [self.reason] if self.reason else []
        if self.verdicts[0] == UNDECIDED:
            signs = {gain.sign for gain in self.gains[0].values()}
            within = "within the spread over seeds"
            opposite = "opposite on the captures"
            words.insert(0, opposite if {1, -1} <= signs else within)
            if 0 in signs and len(signs) > 1:
                words[0] += " on one capture"
        return "; ".join(words)


def verdict(gains: Iterable[Gain]) -> str:
    """Judge a margin by its gains.

    Args:
      gains: A gain for each capture on which both methods ran.

    Returns:
      "holds" if every interval is above 0, "does not" if every one is below, "not
      measured" without gains, and "undecided" otherwise.
    """
    signs = {gain.sign for gain in gains}
    if not signs:
        return UNKNOWN
    return {1: HOLDS, -1: FAILS}.get(signs.pop() if len(signs) == 1 else 0, UNDECIDED)


def comparisons(league: Mapping[str, Any], notes: Mapping[str, str]) -> list[Row]:
    """Judge the margins over other methods.

    Args:
      league: Contents of docs/results/league.json.
      notes: Reason of the margin over deformable 3DGS, by preset of the paper.

    Returns:
      A row for each margin, with gains from tracks and from rest.
    """
    contests = {one["capture"]: one["rows"] for one in league["contests"]}
    contests = {capture: contests[capture] for capture in CAPTURES}
    rows = []
    for table in published.TABLES:
        for other, score in table.others.items():
            gains = tuple(
                {
                    capture: _compute_gain(
                        row_of(contest, table.preset, start),
                        row_of(contest, other, start),
                    )
                    for capture, contest in contests.items()
                }
                for start in ("tracks", "rest")
            )
            reason = _reason(table.preset, other, contests["default"], notes)
            margin = _margin(table.score, score)
            paper = f"{table.paper} ({table.captures})"
            rows.append(Row(paper, f"`{other}`", margin, gains, reason))
    return rows


def row_of(rows: Mapping[str, Any], preset: str, start: str) -> Any:
    """Return the row of a preset whose motion is initialized in a way.

    Args:
      rows: Rows of the league on one capture, by name.
      preset: Name of the preset.
      start: "tracks" or "rest".

    Returns:
      The row. A preset without motion has one for both.
    """
    return rows.get(f"{preset}+{start}", rows[preset])


def _compute_gain(better, worse):
    """Return the gain between two rows of the league over the seeds of both."""
    numbers = {
        (name, int(seed)): {PSNR: cell["numbers"]["psnr"]}
        for name, row in (("better", better), ("worse", worse))
        for seed, cell in row["cells"].items()
    }
    (one,) = verdicts.judge(numbers, [Claim("", "better", "worse", (PSNR,))])
    return Gain(one.gain, one.half_width)


def _margin(ours, theirs):
    """Format a published margin."""
    parts = [f"{ours.psnr - theirs.psnr:+.2f}"]
    if None not in (ours.ssim, theirs.ssim):
        parts.append(f"{ours.ssim - theirs.ssim:+.3f}")
    if None not in (ours.lpips, theirs.lpips):
        parts.append(f"LPIPS {ours.lpips - theirs.lpips:+.3f}")
    return ", ".join(parts)


def _reason(preset, other, rows, notes):
    """Name what the two presets differ in besides the motion."""
    steps, others = (row_of(rows, name, "tracks")["steps"] for name in (preset, other))
    in_time = f"{steps:,} steps on `default` against {others:,}"
    if other in FIELDS:
        return f"the field needs more time: {in_time}"
    if other == "splats-static-small":
        return f"little moves in the real video, and static steps are short: {in_time}"
    if other == "adc-gs-small":
        return f"ADC-GS has 1,000 anchors at this size: {in_time}"
    if other in TWO_VIEWS:
        return "the other trains on two views per step and grows more often"
    return notes[preset]


def parts(ablations: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    """Judge the margins over the method without a part.

    Args:
      ablations: Contents of the files of `published.ABLATIONS` by page.

    Returns:
      A row for each margin, with gains from tracks alone.
    """
    rows = []
    for ablation in published.ABLATIONS:
        for part in ablation.parts:
            gains = {}
            for capture, name in zip(CAPTURES, ablation.pages, strict=True):
                (benchmark,) = ablations[name]["benchmarks"].values()
                for one in benchmark["claims"]:
                    methods = (one["better"], one["worse"], one["metric"])
                    if methods == (part.better, part.worse, PSNR):
                        gains[capture] = Gain(one["gain"], one["half_width"])
            margin = _margin(ablation.score, part.score)
            rows.append(Row(ablation.paper, part.name, margin, (gains,), part.reason))
    return rows


def page() -> str:
    """Write the page from the stored measurements.

    Returns:
      Markdown.
    """
    league = _read(LEAGUE)
    pages = [page for one in published.ABLATIONS for page in one.pages]
    ablations = {name: _read(f"experiments/measured/{name}.json") for name in pages}
    of_parts = parts(ablations)
    margins = comparisons(league, _notes(ablations))
    title, text = markdown.title_and_text(__doc__)
    links = ", ".join(f"[{name}.md]({name}.md)" for name in pages)
    blocks = [
        title,
        text,
        f"**Of {len(margins)} margins over other methods, {_counts(margins, 0)} where "
        f"motion is initialized from tracks, and {_counts(margins, 1)} where it is "
        f"not. Of {len(of_parts)} margins over a method without one of its parts, "
        f"{_counts(of_parts, 0)}.**",
        READING,
        "## Margins over other methods",
        "Every preset trained for 90 processor seconds ([league.md](league.md)).",
        _table("compared with", margins, ("from tracks", "from rest")),
        "![Radar charts of Sonata's tables and of the same methods here](claims.png)",
        "The methods of Sonata's Table 1 and of its ablation, as published and here, "
        "with every axis from the lowest to the highest of them (as in its Figures 3 "
        "and 7). SC-GS is not in the first chart, because the table has no SSIM of it.",
        "## Margins over a method without one of its parts",
        f"Motion is initialized from tracks, and all methods of a page have the same "
        f"number of steps ({links}).",
        _table("without", of_parts, ("from tracks",)),
        "## Cost, and initialization without points",
        COSTS,
        _cost(league),
        _random(_read("docs/results/ablate_open.json")),
        "`nerfies study results` wrote this page from the files of the pages that it "
        "links.",
    ]
    return "\n\n".join(blocks) + "\n"


def draw(path: pathlib.Path) -> None:
    """Draw the figure of the page.

    Args:
      path: The PNG file.
    """
    from experiments.benchmark import radar

    radar.draw(_read(LEAGUE), _read(RADAR_ABLATION), path)


def _read(path):
    return json.loads((ROOT / path).read_text())


def _notes(ablations):
    """Name what the ablations say of the margins over deformable 3DGS."""
    losses = {
        (
            name,
            other,
        ): f"{methods[other]['mean'][PSNR] - methods['full']['mean'][PSNR]:.1f}"
        for name, results in ablations.items()
        for methods in (one["methods"] for one in results["benchmarks"].values())
        for other in ("no-neighbors", "no-alternation")
        if other in methods
    }
    by_capture = [
        " and ".join(losses[f"ablate_{name}{end}", other] for end in ("", "_bookshelf"))
        for name, other in (("sonata", "no-neighbors"), ("moba", "no-alternation"))
    ]
    eq_18, alternation = (f"{values} dB on the two captures" for values in by_capture)
    return {
        "sonata-small": "the weight of Eq. 18 is not printed, and that of these runs, "
        f"1, costs {eq_18}; today's is 0.01",
        "moba-small": f"same views and growth; alternation costs {alternation}",
    }


def _counts(rows, start):
    """Format the numbers of verdicts."""
    counts = Counter(row.verdicts[start] for row in rows)
    words = {HOLDS: "hold", FAILS: "do not", UNDECIDED: "are undecided"}
    words |= {UNKNOWN: "are not measured"}
    phrases = [f"{counts[key]} {text}" for key, text in words.items() if counts[key]]
    return " and ".join(
        [", ".join(phrases[:-1]), phrases[-1]] if phrases[1:] else phrases
    )


def _table(what, rows, starts):
    """Format rows with gains by capture, and a verdict for each initialization."""
    heads = ["paper", what, "published"]
    for start in starts:
        heads += [f"gain {start}", "mean", "verdict"]
    cells = []
    for row in rows:
        line = [row.paper, row.other, row.margin]
        for gains, row_verdict in zip(row.gains, row.verdicts, strict=True):
            line.append("; ".join(_cell(gains.get(capture)) for capture in CAPTURES))
            mean = statistics.fmean(gain.mean for gain in gains.values())
            line += [f"{mean:+.2f}", row_verdict]
        cells.append([*line, row.why])
    return markdown.table([*heads, "reason"], cells, words=len(heads) + 1)


def _cell(gain):
    if gain is None:
        return UNKNOWN
    interval = "" if gain.half_width is None else f" ± {gain.half_width:.2f}"
    return f"{gain.mean:+.2f}{interval}"


def _cost(league):
    """Format the published costs next to those of the small preset from tracks."""
    columns = []
    for capture in CAPTURES:
        (contest,) = (one for one in league["contests"] if one["capture"] == capture)
        ours, others = (
            {
                seed: cell["numbers"]
                for seed, cell in row_of(contest["rows"], name, "tracks")[
                    "cells"
                ].items()
            }
            for name in ("moba-small", "d-miso-small")
        )
        per_step = [
            _step_seconds(others[seed]) / _step_seconds(ours[seed]) for seed in ours
        ]
        columns.append(
            [
                per_step,
                [1000 / one["render_ms"] for one in ours.values()],
                [one["gaussians"] for one in ours.values()],
                [one["model_mb"] for one in ours.values()],
            ]
        )
    rows = [
        [
            name,
            f"{value:,}",
            *(_mean(column[k], digits) for column in columns),
            cost_verdict,
        ]
        for k, (name, value, digits, cost_verdict) in enumerate(published.COST)
    ]
    heads = ("cost", "published", *CAPTURES, "verdict")
    return markdown.table(heads, rows)


def _step_seconds(numbers):
    return numbers["train_cpu_seconds"] / numbers["steps"]


def _mean(values, digits):
    spread = statistics.stdev(values)
    return markdown.with_spread(statistics.fmean(values), spread, digits)


def _random(results):
    """Describe the gain of random points over those of structure from motion."""
    words = []
    for claim in results["about"]["claims"]:
        if claim["arms"][0].startswith("random") and claim["measure"] == "psnr":
            start = "rest" if "rest" in claim["arms"][0] else "tracks"
            gain = Gain(claim["gain"], claim["half_width"])
            words.append(f"{_cell(gain)} dB from {start} ({verdict([gain])})")
    return (
        "MoBa-GS with random points gains over points of structure from motion on "
        f"`default`: {' and '.join(words)} ([ablate_open.md](ablate_open.md))."
    )
