"""The margins that Sonata and MoBa-GS publish, beside those of the league."""

import itertools
from typing import NamedTuple

from experiments import markdown
from experiments.ablate import verdicts
from experiments.ablate.arms import Claim
from experiments.ablate.measures import MEASURES
from experiments.league import standings
from experiments.league.rows import LESS
from experiments.league.standings import Contest


class Means(NamedTuple):
    """What a paper's table says of one method, over its films."""

    psnr: float  # dB
    ssim: float | None = None  # where it is there
    lpips: float | None = None


class Table(NamedTuple):
    """One of a paper's tables of rivals."""

    paper: str
    films: str
    ours: str  # row of the league
    means: Means
    rivals: dict[str, Means]  # the same of other rows


DEFORMABLE, STATIC = "splats-deformable-small", "splats-static-small"
TABLES = (
    Table(
        *("Sonata", "NeRF-DS, 7 scenes", "sonata-small", Means(24.42, 0.856, 0.146)),
        {
            DEFORMABLE: Means(24.11, 0.852, 0.177),
            "sc-gs-small": Means(24.11, None, 0.140),
            "4dgs-small": Means(23.86, 0.837, 0.166),
            "adc-gs-small": Means(23.86, 0.828, 0.189),
            "nerf-ds-small": Means(23.60, 0.849, 0.182),
            "hypernerf-small": Means(23.45, 0.849, 0.199),
            "tineuvox-small": Means(21.61, 0.823, 0.278),
            STATIC: Means(20.29, 0.782, 0.292),
        },
    ),
    Table(
        *("Sonata", "HyperNeRF", "sonata-small", Means(25.78, 0.700, 0.265)),
        {
            "edgs-small": Means(25.70),
            "e-d3dgs-small": Means(25.43, 0.697, 0.231),
            "adc-gs-small": Means(25.31, 0.696, 0.284),
            "4dgs-small": Means(25.17, 0.686, 0.282),
            "tineuvox-small": Means(24.20, 0.616, 0.393),
            DEFORMABLE: Means(22.40, 0.598, 0.275),
            "hypernerf-small": Means(22.29, 0.598, 0.153),
            "nerfies-small": Means(22.23, None, 0.170),
        },
    ),
    Table(
        *("MoBa-GS", "NeRF-DS, 7 scenes", "moba-small", Means(24.14, 0.857, 0.197)),
        {
            "d-miso-small": Means(23.90, 0.851, 0.151),
            DEFORMABLE: Means(23.76, 0.848, 0.180),
            "motion-gs-small": Means(23.71, 0.831, 0.240),
            "4dgs-small": Means(22.54, 0.837, 0.212),
            "sc-gs-small": Means(22.25, 0.824, 0.203),
            STATIC: Means(20.29, 0.782, 0.292),
        },
    ),
    Table(
        *("MoBa-GS", "HyperNeRF", "moba-small", Means(22.73, 0.63)),
        {
            "d-miso-small": Means(22.47, 0.62),
            DEFORMABLE: Means(22.06, 0.59),
            "motion-gs-small": Means(20.96, 0.50),
            "sc-gs-small": Means(20.92, 0.63),
        },
    ),
)
READING = """\
## Beside the published margins

Mean PSNR (dB), SSIM and LPIPS (less is better) of a paper's method over those of
another method in the same table, and what the small presets of both make of it here:
the gain over the same seeds, ± its 95 % interval. *start* is what both motions start
from; *no depth* is Sonata without its depth term, which none of its rivals has and
which learns the exact depth of built-in films. LPIPS stands there as it was published
alone: it takes learned weights, which are downloads of their own (`--lpips-weights` of
`reconstruct` and `benchmark`), and the papers use two of them (VGG, and AlexNet in
Sonata's table of HyperNeRF). The papers' films, sizes and lengths are others, so this
says whether the order holds here, not whether they measured rightly. The two papers'
own runs of one rival on NeRF-DS lie 0.35 to 1.9 dB apart (Deformable 3DGS 24.11 in
Sonata and 23.76 in MoBa-GS, 4DGS 23.86 and 22.54, SC-GS 24.11 and 22.25), as much as
most of the margins; on HyperNeRF their protocols differ. Two means are not those of the
scenes beside them in the tables: 20.29 dB for 3D-GS (20.86, in both papers) and
Sonata's 24.11 for SC-GS (24.03)."""
STARTS = ("tracks", "rest")
PUBLISHED_COSTS = {
    "D-MiSo's time to train, over MoBa-GS'": "16",
    "frames a second": "163",
    "Gaussians": "39,000",
    "model MB": "11.3",
}
MEASURED = ("psnr", "ssim")  # of what is published
COSTS_READING = """\
### What it costs

MoBa-GS publishes what training and drawing cost on an A100, over the seven scenes of
NeRF-DS: 13.3 minutes against some 207 of D-MiSo, 163 frames a second (of a size that is
not told), 39,000 Gaussians, 11.3 MB. Here every row has the same seconds, so the first
line is the processor time of one step of D-MiSo over that of MoBa-GS, seed by seed, ±
the standard deviation over seeds. Cells of different machines are in it as they are,
those of `d-miso-small+rest` among them, which took more seconds than they were given
(their row under each film): of rows from rest it says little. In minutes to the end
there are also how many steps and how many Gaussians there were. The rest is of MoBa-GS
alone."""


def section(contests: list[Contest]) -> str:
    """The table, with two columns for each contest that has any of the pairs."""
    rows = []
    for table, start, without in itertools.product(TABLES, STARTS, ("", "+no-depth")):
        if without and table.ours not in LESS:
            continue
        for rival, means in table.rivals.items():
            words = [table.paper, table.films, f"`{table.ours}`", f"`{rival}`"]
            words.append(start + without.replace("+no-", ", no "))
            found = [
                _found(contest, table.ours, rival, start, without, measure)
                for contest in contests
                for measure in MEASURED
            ]
            rows.append([*words, _published(table.means, means), *found])
    if not any(any(row[6:]) for row in rows):
        return f"{READING}\n\nNo pair of these rows is there yet."
    heads = ("paper", "films", "method", "against", "start", "published")
    titles = [
        f"{contest.title}: {MEASURES[measure].heading}"
        for contest in contests
        for measure in MEASURED
    ]
    margins = markdown.table((*heads, *titles), rows, words=5)
    return "\n\n".join([READING, margins, COSTS_READING, _costs(contests)])


def _costs(contests):
    """What the rows cost that MoBa-GS publishes costs of, by start."""
    ours, rival = "moba-small", "d-miso-small"
    rows = []
    for start in STARTS:
        cells = [_costs_in(contest, ours, rival, start) for contest in contests]
        for number, (what, published) in enumerate(PUBLISHED_COSTS.items()):
            found = [cell[number] for cell in cells]
            rows.append([what, start, published, *found])
    heads = ("cost", "start", "published", *(contest.title for contest in contests))
    return markdown.table(heads, rows, words=2)


def _costs_in(contest, ours, rival, start):
    """In the order of `PUBLISHED_COSTS`; empty where there is no cell."""
    mine, other = _seeds(contest, ours, start), _seeds(contest, rival, start)
    times = [_step(other[s]) / _step(mine[s]) for s in mine.keys() & other.keys()]
    rates = [1000 / row["render_ms"] for row in mine.values()]
    counts = [row["gaussians"] for row in mine.values()]
    sizes = [row["model_mb"] for row in mine.values()]
    columns = zip((times, rates, counts, sizes), (2, 0, 0, 2), strict=True)
    return [markdown.over_seeds(x, digits) if x else "" for x, digits in columns]


def _seeds(contest, preset, start):
    name = _row(contest, preset, start)
    return {seed: x for (row, seed), x in contest.numbers.items() if row == name}


def _step(row):
    return row["train_cpu_seconds"] / row["steps"]


def _published(ours, rival):
    """As in "+0.31, +0.004, LPIPS -0.031", these two where both methods have them."""
    text = f"{ours.psnr - rival.psnr:+.2f}"
    if rival.ssim is not None:
        text += f", {ours.ssim - rival.ssim:+.3f}"
    if None not in (ours.lpips, rival.lpips):
        text += f", LPIPS {ours.lpips - rival.lpips:+.3f}"
    return text


def _found(contest, ours, rival, start, without, measure):
    better = _row(contest, ours, start) + without
    claim = Claim("", better, _row(contest, rival, start), (measure,))
    judged = verdicts.verdicts(contest.numbers, [claim])
    return standings.gain(judged[0]) if judged else ""


def _row(contest, preset, start):
    """The row of a preset with that start, which is the preset's own or beside it."""
    names = {name for name, _ in contest.numbers} | contest.missing.keys()
    other = f"{preset}+{start}"
    return other if other in names else preset
