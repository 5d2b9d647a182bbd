"""Write the pages of docs/results from the stored measurements.

    nerfies study results                  # every page with stored numbers
    nerfies study results effect_cost      # one
    nerfies study results benchmark --measured runs/benchmark/benchmark.json

Nothing is measured here. A page consists of the docstring of its command and of tables
of the stored file, which `--measured FILE` replaces first. The runs of a benchmark are
added to those in the stored file, and replace earlier ones of the same options. A test
compares every page with its file.
"""

import dataclasses
import importlib
import json
import pathlib
import shutil
from typing import NamedTuple

from experiments import cli, markdown
from nerfies_jax.runtime import console

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "results"
INDEX = """\
# Results

![PSNR against processor seconds of training](benchmark.png)

PSNR of held-out frames of built-in scenes, against processor seconds of training on one
core. All motions start from the same tracks. Each line is one schedule, so an earlier
point is below what a run of that length would reach ([benchmark.md](benchmark.md)).

`nerfies study results` writes every page from a file of this repository, and a
test compares each page with its file. The command next to a page measures again. If a
page has rows of several captures or presets, the command was run once for each.
`nerfies study results benchmark --measured benchmark.json`, for example, stores
the result of a command and rewrites its page.

{summaries}

{pages}

{missing}Errors and costs of single formulas are in [numerics.md](../numerics.md), which
`nerfies study hard_cases --document docs/numerics.md` rewrites.

## Finished studies

These studies answered their question. Their pages and numbers stay. The code of each is
in the revision of this repository that its page names, which can run the command on the
page. The numbers of a page NAME.md are in NAME.json.

{finished}
"""

MISSING = """\
These commands have no stored numbers yet:

{commands}

"""


class Study(NamedTuple):
    """A page: the command that measures, and the functions that format the result."""

    about: str  # subject of the page
    command: str  # words after `nerfies study`
    module: str  # of experiments, whose docstring opens the page
    page: str  # of experiments, with `page(results)`
    measured: str = ""  # the stored file, if it is not in experiments/measured
    figure: str = ""  # of experiments, with `draw(results, path)`
    # File of the library with what `advice(results)` of the same module selects.
    advice: str = ""

    @property
    def line(self) -> str:
        """The whole command."""
        return f"nerfies study {self.command}"


def _suite(about, words):
    command = f"benchmark {words} --jobs 2"
    return Study(about, command, "benchmark.__main__", "benchmark.page")


def _package(about, command):
    name = command.split()[0]
    return Study(about, command, f"{name}.__main__", f"{name}.page")


_REAL = "CAPTURE --max-side 256 --heldout 8 --suite"
STUDIES = {
    "benchmark": _package("quality of the default command", "benchmark")._replace(
        about="quality of the default command, and of methods over training time",
        figure="benchmark.curves",
        advice="nerfies_jax/evaluation/method_curves.json",
    ),
    "ablate_tracked": _suite(
        "parts of the default preset", "--suite tracked --steps 900"
    ),
    "ablate_sonata": _suite("parts of Sonata", "--suite sonata --steps 900"),
    "ablate_sonata_bookshelf": _suite(
        "the same on a real video", f"{_REAL} sonata --steps 600"
    ),
    "ablate_moba": _suite("parts of MoBa-GS", "--suite moba --steps 900"),
    "ablate_moba_bookshelf": _suite(
        "the same on a real video", f"{_REAL} moba --steps 600"
    ),
    "ablate_fields": _suite("parts of Nerfies", "--suite fields --steps 600"),
    "ablate_fields_bookshelf": _suite(
        "the same on a real video", f"{_REAL} fields --steps 600"
    ),
    "ablate_poses": _suite(
        "pose refinement", "--scene pose-error --suite poses --steps 900"
    ),
    "ablate_poses_bookshelf": _suite(
        "the same on a real video", f"{_REAL} poses --steps 900"
    ),
    "speed": _package("steps, frames, the rasterizer", "speed steps"),
    "effect_cost": Study(
        "cost of each effect",
        "speed effects",
        "speed.effects",
        "speed.effects_page",
        "nerfies_jax/runs/effect_cost.json",
    ),
    "growth": Study(
        "growth of time and memory with the size of a scene",
        "growth",
        "growth.__main__",
        "growth.page",
        figure="growth.page",
    ),
    "on_device": _package("tests and timings on an accelerator", "on_device"),
    "fuzz": _package("damaged files", "fuzz --mutations 1000000"),
    "mutants": _package("faults that the tests detect", "mutants --count 44"),
    "mutants_unseen": _package("the same, other faults", "mutants --count 24 --seed 1"),
}
# Studies that answered their question: the page and its numbers stay, without the code.
FINISHED = {
    "league": "comparison of all small presets, and margins that the papers print",
    "accuracy_time": "quality against training time",
    "evidence": "preprocessing of the built-in scenes, and optical flow methods",
    "ablate_start": "initialization from tracks, for four motions of splats",
    "ablate_open": "choices that the papers leave open",
    "ablate_jumps": "discontinuous camera motion",
    "ablate_rate": "entropy coding of ADC-GS' features",
    "ablate_views": "views per step on two cores",
    "ablate_lazy": "lazy elastic regularization",
    "appearance_codes": "appearance codes",
    "camera_masks": "masks for structure from motion",
    "deformation_cost": "cost of deformation, and of tables of it",
    "elastic_points": "samples of the elastic penalty",
    "field_speed": "speed of radiance fields",
    "frequency_gates": "frequency gates",
    "kan_local": "local kernels of KANs",
    "motion_rank": "motion bases at equal rank",
    "nerf_speed": "speed of NeRF",
    "raster_speed": "speed of the rasterizer",
    "solver_table": "solvers of bundle adjustment",
    "solver_table_poses": "solvers of poses",
    "spectral_bias": "spectral bias",
    "transient_medium": "transient media",
    "capture_checks": "consistency checks of good captures",
    "capture_cost": "memory of frames, cost of decoders",
    "faults": "signals, full disks, closed pipes",
    "player_speed": "frames of the browser player",
}
# Pages of `experiments` that compare the numbers of others, and have none of their own.
SUMMARIES = {"claims": "benchmark.claims"}
# The last revision with the code of each.
REVISIONS = dict.fromkeys(FINISHED, "99f3f69")
REVISIONS |= dict.fromkeys(
    ("capture_checks", "capture_cost", "faults", "player_speed"), "566f225"
)


@dataclasses.dataclass(frozen=True)
class Results:
    """Write pages of docs/results from stored measurements."""

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
        pages = {name: PAGES / f"{name}.md" for name in args.pages or stored_pages()}
        for name, path in pages.items():
            _draw(name)
            _advise(name)
            _write(path, page(name))
            console.say(path)
        for name, module in SUMMARIES.items():
            importlib.import_module(f"experiments.{module}").draw(PAGES / f"{name}.png")
            _write(PAGES / f"{name}.md", summary(name))
        _write(PAGES / "README.md", index())
    return {"pages": {name: str(path) for name, path in pages.items()}}


def _draw(name):
    """Draw the figure of a page, if it has one of its own."""
    if STUDIES[name].figure and path_of(name).exists():
        module = importlib.import_module(f"experiments.{STUDIES[name].figure}")
        module.draw(json.loads(path_of(name).read_text()), PAGES / f"{name}.png")


def _advise(name):
    """Write the file of the library that a page has, if there are numbers for it."""
    from nerfies_jax.capture.json_files import write_json

    study = STUDIES[name]
    if study.advice:
        module = importlib.import_module(f"experiments.{study.figure}")
        advice = module.advice(json.loads(path_of(name).read_text()))
        if advice:
            write_json(ROOT / study.advice, advice)


def _write(path, text):
    from nerfies_jax.capture.json_files import replaced_file

    with replaced_file(path) as partial:
        partial.write_text(text)


def _copy(source, path):
    from nerfies_jax.capture.json_files import replaced_file

    with replaced_file(path) as partial:
        shutil.copyfile(source, partial)


def path_of(name: str) -> pathlib.Path:
    """Return the path of the stored numbers of a page.

    Args:
      name: Name of the page.

    Returns:
      The path.
    """
    return ROOT / (STUDIES[name].measured or f"experiments/measured/{name}.json")


def stored_pages() -> list[str]:
    """List the pages with stored numbers.

    Returns:
      Their names.
    """
    return [name for name in STUDIES if path_of(name).exists()]


def keep(name: str, source: pathlib.Path) -> None:
    """Store a result as the numbers of a page.

    Benchmarks are added to the stored ones. Their methods replace those of the same
    options.

    Args:
      name: Name of the page.
      source: File of the result.

    Raises:
      ValueError: If no page can be written from the file.
    """
    try:
        record = json.loads(source.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"--measured {source}: not JSON ({error})") from None
    _check_of(name, record, source)
    try:
        _page_of(name, record)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(
            f"--measured {source}: not what {STUDIES[name].line} writes ({error!r})"
        ) from error
    path = path_of(name)
    if "benchmarks" in record and path.exists():
        _add(record, path)
    else:
        _copy(source, path)


def _add(record, path):
    from experiments.benchmark import verdicts
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.metrics import clock

    earlier = json.loads(path.read_text())
    record["benchmarks"] = verdicts.merge(earlier["benchmarks"], record["benchmarks"])
    record["machine"] = clock.beside(record["machine"], earlier["machine"])
    write_json(path, record)


def _check_of(name, record, source):
    """Raise ValueError if a file holds nothing, or results of another page."""
    # A number may be 0, as the seed of damaged files is.
    if not isinstance(record, dict) or not all(
        value or isinstance(value, int | float) for value in record.values()
    ):
        raise ValueError(f"--measured {source}: holds no results; measure again")
    words = STUDIES[name].command.split()
    for option in ("--suite", "--scene"):
        if option in words:
            option_words = " ".join(words[words.index(option) :][:2])
            others = [x for x in record.get("benchmarks", ()) if option_words not in x]
            if others:
                raise ValueError(
                    f"--measured {source}: of {others[0]}, and the page {name} is of "
                    f"{option_words}"
                )


def page(name: str) -> str:
    """Write a page from its stored numbers.

    Args:
      name: Name of the page.

    Returns:
      Markdown.
    """
    path = path_of(name)
    if not path.exists():
        raise ValueError(
            f"{path}: not there; measure with {STUDIES[name].line}, and name its "
            "result with --measured"
        )
    return _page_of(name, json.loads(path.read_text()))


def summary(name: str) -> str:
    """Write the page NAME.md of `SUMMARIES`."""
    return importlib.import_module(f"experiments.{SUMMARIES[name]}").page()


def index() -> str:
    """Write the list of pages.

    Returns:
      Markdown.
    """
    rows = [
        [f"[{name}.md]({name}.md)", study.about, f"`{study.line}`"]
        for name, study in STUDIES.items()
        if path_of(name).exists()
    ]
    stored_names = stored_pages()
    absent = [
        f"`{study.line}`" for name, study in STUDIES.items() if name not in stored_names
    ]
    return INDEX.format(
        summaries=markdown.bullets(
            f"[{name}.md]({name}.md): {summary(name).splitlines()[0][2:]}"
            for name in SUMMARIES
        ),
        pages=markdown.table(("page", "subject", "measured by"), rows, words=3),
        missing=MISSING.format(commands=markdown.bullets(absent)) if absent else "",
        finished=markdown.bullets(
            f"[{name}.md]({name}.md): {about}" for name, about in FINISHED.items()
        ),
    )


def _page_of(name, record):
    study = STUDIES[name]
    module = importlib.import_module(f"experiments.{study.module}")
    title, text = markdown.title_and_text(module.__doc__)
    about = record.get("machine") or record["about"]
    parts = [title, text]
    if (PAGES / f"{name}.png").exists():
        parts.append(f"![{title.removeprefix('# ')}]({name}.png)")
    parts.append(importlib.import_module(f"experiments.{study.page}").page(record))
    revision = record.get("revision")
    origin = markdown.machine(about) + (f", revision {revision}" if revision else "")
    stored_in = path_of(name).relative_to(ROOT)
    parts.append(
        f"Measured by `{study.line}` ({origin}); the numbers are in `{stored_in}`, and "
        f"`nerfies study results {name}` wrote this page from them."
    )
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    main()
