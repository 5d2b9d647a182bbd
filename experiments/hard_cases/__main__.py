"""Errors and costs of formulas at their hard points, and of their textbook forms.

    nerfies study hard_cases
    nerfies study hard_cases --topics rotations splats --repeats 30
    nerfies study hard_cases --document docs/numerics.md   # rewrite its table

Every case sweeps a function to its singular point. The table shows the largest errors
of value, gradient and curvature of the textbook form and of the stable one compared
with 120-digit arithmetic, in float32 and float64, and the ratio of their times for
values and for gradients, from interleaved calls over many inputs away from the singular
point. Writes hard_cases.json.
"""

import dataclasses
import math
import pathlib
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments import cli
from experiments.hard_cases import case as hard_case
from experiments.hard_cases import (
    elastic,
    encodings,
    footprints,
    geometry,
    images,
    losses,
    motions,
    networks,
    quaternions,
    report,
    rotations,
    splats,
    volume,
)
from experiments.hard_cases.case import ORDERS, Case
from nerfies_jax.metrics import clock
from nerfies_jax.runs import platform, run_folder
from nerfies_jax.runtime import console

# The cases of each topic and, in tests/experiments/hard_cases, the file of their tests.
TOPICS = {
    "rotations": (rotations.CASES + quaternions.CASES, "test_rotations.py"),
    "elastic": (elastic.CASES, "test_elastic_cases.py"),
    "geometry": (geometry.CASES, "test_geometry_cases.py"),
    "encodings": (encodings.CASES, "test_encoding_cases.py"),
    "volume": (volume.CASES, "test_volume_cases.py"),
    "networks": (networks.CASES, "test_network_cases.py"),
    "losses": (losses.CASES + images.CASES, "test_loss_cases.py"),
    "motions": (motions.CASES, "test_motion_cases.py"),
    "splats": (footprints.CASES + splats.CASES, "test_splat_cases.py"),
}
JITTER = 1e-3  # of the timed inputs, so that rows differ


@dataclasses.dataclass(frozen=True)
class HardCases:
    """Measure errors and costs of formulas at their hard points."""

    topics: tuple[str, ...] = tuple(TOPICS)
    """Topics whose cases to measure."""
    cases: tuple[str, ...] = ()
    """Names of cases, or parts of names (default: all of the topics)."""
    numbers: int = 300_000
    """Numbers in the inputs of a timed call."""
    repeats: int = 15
    """Timed calls of each form, in turn. The table has the medians."""
    out: pathlib.Path | None = None
    """Folder for hard_cases.json (default: runs/hard_cases)."""
    document: pathlib.Path | None = None
    """Write the table into this Markdown file, between its two markers."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "cpu"
    """Device to compute on."""

    def __post_init__(self):
        if not self.topics or not set(self.topics) <= set(TOPICS):
            raise ValueError(
                f"--topics {' '.join(self.topics)}: choose from {', '.join(TOPICS)}"
            )
        if self.numbers < 1 or self.repeats < 1:
            raise ValueError(
                f"--numbers {self.numbers} and --repeats {self.repeats} are at least 1"
            )


class Outcome(NamedTuple):
    """Errors of one form in one precision, by order, at each point of the sweep."""

    stable: tuple[np.ndarray, ...]
    textbook: tuple[np.ndarray, ...]


class CaseResult(NamedTuple):
    """Measurements of one case."""

    case: Case
    test: str  # file and name of its test
    outcomes: dict[str, Outcome]  # by precision
    # Ratio of the times of the stable and the textbook form in float32, medians of
    # processor time; NaN if the two do not do the same work.
    value_cost: float
    gradient_cost: float


@cli.command(HardCases)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    with cli.user_errors():
        selection = select(args.topics, args.cases)
        folder = run_folder.new_run_folder(args.out, "hard_cases")
        if args.document is not None:
            report.parts(args.document)  # before the work
        platform.start_jax(args.device)
    rows = []
    for case, test in selection:
        rows.append(measure(case, test, args.numbers, args.repeats))
        console.say(report.block(rows[-1]))
    report.save_numbers(folder, rows, args)
    console.say(f"\n{report.summary(rows)}\nsaved in {folder}")
    if args.document is not None:
        report.renew(args.document, rows)
        console.say(f"renewed the table in {args.document}")
    return cli.stored(folder / "hard_cases.json")


def select(topics, names) -> list[tuple[Case, str]]:
    """Select cases of topics whose name contains one of `names`, with their tests."""
    selection = []
    for topic in topics:
        cases, test = TOPICS[topic]
        selection += [
            (case, f"hard_cases/{test}::test_held")
            for case in cases
            if not names or any(name in case.name for name in names)
        ]
    if not selection:
        existing = [case.name for topic in topics for case in TOPICS[topic][0]]
        raise ValueError(
            f"--cases {' '.join(names)}: no such case; there are {', '.join(existing)}"
        )
    return selection


def measure(case: Case, test: str, numbers: int, repeats: int) -> CaseResult:
    """Measure the errors in every precision, and the cost of the stable form."""
    outcomes = {}
    for dtype, bounds in case.bounds.items():
        inputs = hard_case.round_to(case.inputs, dtype)
        exact = [hard_case.truth(case, inputs, order) for order in range(len(bounds))]
        errors = {}
        for form in Outcome._fields:
            with jax.enable_x64(dtype == "float64"):
                result = hard_case.evaluate(
                    getattr(case, form), case.inputs, dtype, len(bounds)
                )
            errors[form] = tuple(
                hard_case.errors(case, result[order], exact[order], order)
                for order in range(len(bounds))
            )
        outcomes[dtype] = Outcome(**errors)
    return CaseResult(case, test, outcomes, *_costs(case, numbers, repeats))


def _costs(case, numbers, repeats):
    if not case.alike:
        return math.nan, math.nan
    usual = case.inputs[len(case.inputs) // 2] if case.timed is None else case.timed
    rows = max(1, numbers // len(usual))
    jitter = np.random.default_rng(0).uniform(-JITTER, JITTER, (rows, len(usual)))
    inputs = jnp.asarray(usual * (1 + jitter), jnp.float32)

    def total(function):
        return lambda x: jnp.sum(jax.vmap(function)(x))

    calls = {}
    for form in ("stable", "textbook"):
        function = getattr(case, form)
        value = jax.jit(jax.vmap(function))
        gradient = jax.jit(jax.grad(total(function)))
        calls[f"{form} value"] = lambda program=value: program(inputs)
        calls[f"{form} gradient"] = lambda program=gradient: program(inputs)
    times = clock.compare(calls, repeats=repeats)
    return tuple(
        times[f"stable {name}"].median_cpu / times[f"textbook {name}"].median_cpu
        for name in ORDERS[:2]
    )


if __name__ == "__main__":
    main()
