"""Which solver should fit a latent code to a new frame, or the pose of its camera.

    python -m experiments.solver_table
    python -m experiments.solver_table --fit poses
    python -m experiments.solver_table --out solvers.json --steps 5 20 80 --frames 6

Codes: a network learns a few pictures of a moving, recolored pattern, one code each;
then it is frozen, and every solver of `training.fit` fits codes to pictures in between,
from the mean code, as the codes of held-out frames are fitted. Poses: points are seen
with noise by a camera a few degrees and a tenth of a unit away from where it is thought
to be; Levenberg-Marquardt (optimistix, by `refine_camera`) knows that the loss is a
sum of squares, the solvers for codes do not. The table shows, after at most so many
steps: the seconds a warm solve takes, how far its loss ends above the best that any
solver found for that frame, and how far from the best numbers. A solver that needs
fewer steps may still lose: each of its steps may evaluate the loss several times, which
only the seconds see.
"""

import dataclasses
import functools
import pathlib
from typing import Literal, NamedTuple

import jax
import numpy as np

from experiments import cli, markdown
from experiments.solver_table.problems import LEVENBERG, PROBLEMS, Problem
from nerfies_jax import console
from nerfies_jax.capture.json_files import write_json
from nerfies_jax.measure import clock
from nerfies_jax.training.fit import CODE_SOLVERS


@dataclasses.dataclass(frozen=True)
class Settings:
    """What to train and to time."""

    fit: Literal["codes", "poses"] = "codes"
    solvers: tuple[str, ...] | None = None  # all that can
    steps: tuple[int, ...] = (5, 10, 20, 50, 100, 200)  # at most so many
    frames: int = 4  # held out
    pictures: int = 16  # learned from
    training_steps: int = 2000
    pixels: int = 32  # of a side
    width: int = 64
    code_width: int = 8
    repeats: int = 5
    out: pathlib.Path | None = None  # JSON

    def __post_init__(self):
        cli.check_out_file(self.out)
        known = (*CODE_SOLVERS, *((LEVENBERG,) if self.fit == "poses" else ()))
        chosen = known if self.solvers is None else self.solvers
        if not chosen or not set(chosen) <= set(known):
            raise ValueError(f"solvers={self.solvers} must be among {known}")
        if not self.steps or min(self.steps) < 1:
            raise ValueError(f"--steps {self.steps}: numbers of at least 1")
        least = {"frames": 1, "repeats": 1, "pixels": 1, "pictures": 2}
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise ValueError(
                    f"--{name} {getattr(self, name)} must be at least {bound}"
                )


class SolverResult(NamedTuple):
    """One solver with so many steps at most, over all held-out frames."""

    solver: str
    max_steps: int
    steps: float  # median of what it took
    seconds: float  # median wall time of one warm solve
    cpu_seconds: float
    loss: float  # median, squared color
    excess: float  # worst, over the best known loss of its frame
    # Worst, of what was found to the best known: units of code; rad and scene units.
    distance: float
    converged: int  # frames


def table(task: Problem, settings: Settings) -> list[SolverResult]:
    """Every solver with every number of steps, best known results included."""
    fits, timings = {}, {}
    for max_steps in settings.steps:
        programs = {
            name: jax.jit(functools.partial(task.solvers[name], most=max_steps))
            for name in settings.solvers or task.solvers
        }
        for name, program in programs.items():
            fits[name, max_steps] = [program(picture) for picture in task.unseen]
        timed = clock.compare(
            {name: lambda p=p: p(task.unseen[0]) for name, p in programs.items()},
            repeats=settings.repeats,
            warm_up=1,
        )
        timings |= {(name, max_steps): timing for name, timing in timed.items()}
    losses = {
        key: np.array(
            [task.loss(f.value, x) for f, x in zip(row, task.unseen, strict=True)]
        )
        for key, row in fits.items()
    }
    best = np.stack(list(losses.values())).argmin(0)
    keys = list(fits)
    least = np.array([losses[keys[k]][i] for i, k in enumerate(best)])
    where = np.stack([fits[keys[k]][i].value for i, k in enumerate(best)])
    return [
        SolverResult(
            solver=name,
            max_steps=max_steps,
            steps=float(np.median([f.steps for f in row])),
            seconds=timings[name, max_steps].median,
            cpu_seconds=timings[name, max_steps].median_cpu,
            loss=float(np.median(losses[name, max_steps])),
            excess=float(np.max(losses[name, max_steps] - least)),
            distance=float(
                np.linalg.norm(np.stack([f.value for f in row]) - where, axis=1).max()
            ),
            converged=sum(bool(f.converged) for f in row),
        )
        for (name, max_steps), row in fits.items()
    ]


def text(rows: list[SolverResult], frames: int) -> str:
    """The table in plain text, a line for each solver."""
    head = (
        f"{'solver':<20}{'at most':>8}{'steps':>7}{'ms':>9}{'CPU ms':>9}"
        f"{'loss':>11}{'excess':>10}{'distance':>10}{'done':>7}"
    )
    lines = [
        f"{r.solver:<20}{r.max_steps:>8}{r.steps:>7.0f}{1e3 * r.seconds:>9.2f}"
        f"{1e3 * r.cpu_seconds:>9.2f}{r.loss:>11.3e}{r.excess:>10.1e}"
        f"{r.distance:>10.1e}{r.converged:>5}/{frames}"
        for r in sorted(rows, key=lambda r: (r.solver, r.max_steps))
    ]
    return "\n".join([head, *lines])


def page(stored) -> str:
    """The page in docs/results below the docstring, from what `--out` wrote."""
    heads = ("solver", "at most", "steps", "ms", "CPU ms", "loss", "excess")
    heads += ("distance", "converged")
    rows = [
        [
            row["solver"],
            str(row["max_steps"]),
            markdown.number(row["steps"], 0),
            markdown.number(1e3 * row["seconds"], 2),
            markdown.number(1e3 * row["cpu_seconds"], 2),
            *(markdown.short(row[name]) for name in ("loss", "excess", "distance")),
            f"{row['converged']} of {stored['about']['frames']}",
        ]
        for row in sorted(stored["rows"], key=lambda r: (r["solver"], r["max_steps"]))
    ]
    return f"## Fitting {stored['about']['fit']}\n\n{markdown.table(heads, rows)}"


@cli.command(Settings)
def main(settings):
    """Run the job of the command line."""
    task = PROBLEMS[settings.fit](settings)
    rows = table(task, settings)
    console.say(text(rows, settings.frames))
    about = dataclasses.asdict(settings) | {"out": None}
    record = {"about": about, "machine": clock.machine()}
    record["rows"] = [row._asdict() for row in rows]
    if settings.out:
        write_json(settings.out, record)
    return record


if __name__ == "__main__":
    main()
