"""The pages of docs/results, written from the numbers that are kept beside the code.

    python -m experiments.results                  # every page whose numbers are there
    python -m experiments.results effect_cost      # one
    python -m experiments.results benchmark --measured runs/benchmark/benchmark.json

Nothing is measured here. A page is what its study says of itself, and tables of the
kept file: `--measured FILE` keeps a new one first. A test holds every page against what
this writes.
"""

import dataclasses
import importlib
import json
import pathlib
import shutil
from typing import Any, NamedTuple

from experiments import cli, markdown
from nerfies_jax.runtime import console

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "results"
INDEX = """\
# Results

Every page is written from a file of this repository by `python -m experiments.results`,
and a test compares each page with its file. The command next to a page measures again.
If a page has rows of several captures or presets, the command was run once for each.
Its `--out` names the result, and `python -m experiments.results benchmark --measured
benchmark.json`, for example, stores that file and rewrites the page.

{pages}

{missing}Errors and costs of single formulas are in [numerics.md](../numerics.md), which
`python -m experiments.hard_cases --document docs/numerics.md` rewrites.

## Where to find what

- Comparison of all small presets, and the margins that the papers print:
  [league.md](league.md).
- Initialization from tracks, for four motions of splats:
[ablate_start.md](ablate_start.md).
- Parts of the default preset: [ablate_tracked.md](ablate_tracked.md).
- Parts of Sonata, MoBa-GS and Nerfies: [ablate_sonata.md](ablate_sonata.md),
  [ablate_moba.md](ablate_moba.md), [ablate_fields.md](ablate_fields.md), and on a real
  video [ablate_sonata_bookshelf.md](ablate_sonata_bookshelf.md),
  [ablate_moba_bookshelf.md](ablate_moba_bookshelf.md),
  [ablate_fields_bookshelf.md](ablate_fields_bookshelf.md).
- Pose refinement: [ablate_poses.md](ablate_poses.md), and on a real video
  [ablate_poses_bookshelf.md](ablate_poses_bookshelf.md).
- Choices that the papers leave open: [ablate_open.md](ablate_open.md).
- Discontinuous camera motion: [ablate_jumps.md](ablate_jumps.md).
- Entropy coding of ADC-GS' features: [ablate_rate.md](ablate_rate.md).
- Views per step on two cores: [ablate_views.md](ablate_views.md).
- Lazy elastic regularization: [ablate_lazy.md](ablate_lazy.md).
- Cost of deformation, solvers and local kernels:
  [deformation_cost.md](deformation_cost.md), [solver_table.md](solver_table.md),
  [kan_local.md](kan_local.md).
- Motion bases at equal rank: [motion_rank.md](motion_rank.md).

## Finished studies

These studies answered their question. Their pages and numbers stay, and their code is
in revision {revision} of this repository, which can run the command on each page.

{finished}
"""

MISSING = """\
These commands have no stored numbers yet:

{commands}

"""


class Study(NamedTuple):
    """Measurement of the numbers of one page, and the function that formats them."""

    module: str  # whose docstring opens the page
    page: str  # module with `page(stored)`, the rest of it, and `draw(stored, path)`
    measured: str  # the kept file
    command: str  # that measures


def _study(name, words="", module=None, page=None, measured=None):
    study = name if module is None else module
    return Study(
        f"experiments.{study}",
        f"experiments.{page or study}",
        measured or f"experiments/measured/{name}.json",
        f"python -m experiments.{study.removesuffix('.__main__')} {words}".strip(),
    )


def _package(name, words="", page="page", of=None, measured=None):
    folder = of or name
    return _study(name, words, f"{folder}.__main__", f"{folder}.{page}", measured)


def _suite(name, words):
    return _package(name, f"{words} --jobs 2", of="benchmark")


_BOOKSHELF = "CAPTURE --max-side 256 --heldout 8"
STUDIES = {
    "benchmark": _package("benchmark"),
    "effect_cost": _package(
        "effect_cost", measured="nerfies_jax/runs/effect_cost.json"
    ),
    "evidence": _package("evidence", "--scenes"),
    "ablate_fields": _suite("ablate_fields", "--suite fields --steps 600"),
    "ablate_fields_bookshelf": _suite(
        "ablate_fields_bookshelf", f"{_BOOKSHELF} --suite fields --steps 600"
    ),
    "ablate_tracked": _suite("ablate_tracked", "--suite tracked --steps 900"),
    "ablate_poses": _suite(
        "ablate_poses", "--scene pose-error --suite poses --steps 900"
    ),
    "ablate_poses_bookshelf": _suite(
        "ablate_poses_bookshelf", f"{_BOOKSHELF} --suite poses --steps 900"
    ),
    "ablate_sonata": _suite("ablate_sonata", "--suite sonata --steps 900"),
    "ablate_sonata_bookshelf": _suite(
        "ablate_sonata_bookshelf", f"{_BOOKSHELF} --suite sonata --steps 600"
    ),
    "ablate_moba": _suite("ablate_moba", "--suite moba --steps 900"),
    "ablate_moba_bookshelf": _suite(
        "ablate_moba_bookshelf", f"{_BOOKSHELF} --suite moba --steps 600"
    ),
    "speed": _package(
        "speed", "--job --beside CHECKOUT --yardstick PATH/run.py --out speed"
    ),
    "player_speed": _study(
        "player_speed", "PLAYER.html --gsplat INDEX.es.js --out player_speed.json"
    ),
    "faults": _package("faults", "--trials 200 --jobs 2"),
    "fuzz": _package("fuzz", "--mutations 1000000"),
    "mutants": _package("mutants", "--count 44"),
    "mutants_unseen": _package("mutants_unseen", "--count 24 --seed 1", of="mutants"),
}
# Studies that answered their question: the page and its numbers stay, without the code.
REVISION = "99f3f69"  # the last revision with all of them
FINISHED = (
    *("ablate_jumps", "ablate_lazy", "ablate_open", "ablate_rate", "ablate_start"),
    *("ablate_views", "accuracy_time", "appearance_codes", "camera_masks"),
    *("deformation_cost", "elastic_points", "field_speed", "frequency_gates"),
    *("kan_local", "league", "motion_rank", "nerf_speed", "raster_speed"),
    *("solver_table", "solver_table_poses", "spectral_bias", "transient_medium"),
)


@dataclasses.dataclass(frozen=True)
class Results:
    """Write pages of docs/results from the files of numbers that are kept."""

    pages: cli.Positional[tuple[str, ...]] = ()
    """Pages to write (default: every one with stored numbers)."""
    measured: pathlib.Path | None = None
    """File of a study, to store as the numbers of the one page named."""

    def __post_init__(self):
        unknown = [name for name in self.pages if name not in STUDIES]
        if unknown:
            raise ValueError(f"no page {unknown[0]!r}; there are {', '.join(STUDIES)}")
        if self.measured is not None and len(self.pages) != 1:
            raise ValueError("--measured is the file of one page: name that page")


@cli.command(Results)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    with cli.user_errors():
        if args.measured is not None:
            keep(args.pages[0], args.measured)
        written = {name: PAGES / f"{name}.md" for name in args.pages or kept()}
        for name, path in written.items():
            draw(name)
            _write(path, page(name))
            console.say(path)
        _write(PAGES / "README.md", index())
    return {"pages": {name: str(path) for name, path in written.items()}}


def _write(path, text):
    from nerfies_jax.capture.json_files import replaced_file

    with replaced_file(path) as partial:
        partial.write_text(text)


def _copy(source, path):
    from nerfies_jax.capture.json_files import replaced_file

    with replaced_file(path) as partial:
        shutil.copyfile(source, partial)


def kept() -> list[str]:
    """The pages whose numbers are there."""
    return [name for name, study in STUDIES.items() if (ROOT / study.measured).exists()]


def keep(name: str, measured: pathlib.Path) -> None:
    """Take what a study wrote as the numbers of a page, and its picture with it.

    ValueError where no page can be written from the file.
    """
    try:
        stored = json.loads(measured.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"--measured {measured}: not JSON ({error})") from None
    _check_of(name, stored, measured)
    try:
        _page_of(name, stored)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"--measured {measured}: not what {STUDIES[name].command} writes ({error})"
        ) from error
    _copy(measured, ROOT / STUDIES[name].measured)
    picture = measured.with_suffix(".png")
    if picture.exists():
        _copy(picture, PAGES / f"{name}.png")


def _check_of(name, stored, measured):
    """Raise ValueError if a file holds nothing, or results of another page."""
    if not isinstance(stored, dict) or not all(stored.values()):
        raise ValueError(f"--measured {measured}: holds no results; measure again")
    words = STUDIES[name].command.split()
    for option in ("--suite", "--scene"):
        if option in words:
            wanted = " ".join(words[words.index(option) :][:2])
            others = [x for x in stored.get("benchmarks", ()) if wanted not in x]
            if others:
                raise ValueError(
                    f"--measured {measured}: of {others[0]}, and the page {name} is of "
                    f"{wanted}"
                )


def page(name: str) -> str:
    """The page, from the kept numbers alone."""
    return _page_of(name, _stored(name))


def draw(name: str) -> None:
    """The page's picture, where it can be drawn from the kept numbers."""
    module = importlib.import_module(STUDIES[name].page)
    if hasattr(module, "draw"):
        module.draw(_stored(name), PAGES / f"{name}.png")


def index() -> str:
    """The list of pages."""
    there = kept()
    rows = [
        [f"[{name}.md]({name}.md)", f"`{study.command}`", f"`{study.measured}`"]
        for name, study in STUDIES.items()
        if name in there
    ]
    heads = ("page", "measured by", "kept in")
    missing = [f"`{s.command}`" for name, s in STUDIES.items() if name not in there]
    return INDEX.format(
        pages=markdown.table(heads, rows, words=3),
        missing=MISSING.format(commands=markdown.bullets(missing)) if missing else "",
        revision=REVISION,
        finished=markdown.bullets(
            f"[{name}.md]({name}.md), numbers in `docs/results/{name}.json`"
            for name in FINISHED
        ),
    )


def _stored(name) -> dict[str, Any]:
    path = ROOT / STUDIES[name].measured
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise ValueError(
            f"{path}: not there; measure with {STUDIES[name].command}, and name what "
            "it writes with --measured"
        ) from None


def _page_of(name, stored):
    study = STUDIES[name]
    title, text = markdown.title_and_text(importlib.import_module(study.module).__doc__)
    about = stored.get("machine") or stored["about"].get("machine") or stored["about"]
    parts = [title, text]
    if (PAGES / f"{name}.png").exists():
        parts.append(f"![{title.removeprefix('# ')}]({name}.png)")
    parts.append(importlib.import_module(study.page).page(stored))
    parts.append(
        f"Measured by `{study.command}` ({markdown.machine(about)}); the numbers are "
        f"in `{study.measured}`, and `python -m experiments.results {name}` wrote this "
        "page from them."
    )
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    main()
