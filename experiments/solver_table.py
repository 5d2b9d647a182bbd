"""Which solver should fit a latent code to a frame that was not learnt from.

    python -m experiments.solver_table
    python -m experiments.solver_table --out solvers.json --steps 5 20 80 --frames 6

A network learns a few pictures of a moving, recoloured pattern, one code each; then it
is frozen, and every solver of `training.fit` fits codes to pictures in between, from
the mean code, as the codes of held-out frames are fitted. The table shows, after at
most so many steps: the seconds a warm solve takes, how far its loss ends above the best
that any solver found for that frame, and how far from the best code. A solver that
needs fewer steps may still lose: each of its steps may evaluate the loss several times,
which only the seconds see.
"""

import dataclasses
import json
import pathlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from nerfies_jax.measure import clock
from nerfies_jax.nets import codes, encoding, mlp
from nerfies_jax.training.fit import CODE_SOLVERS, fit_code


@dataclasses.dataclass(frozen=True)
class Settings:
    """What to train and to time."""

    solvers: tuple[str, ...] = tuple(CODE_SOLVERS)
    steps: tuple[int, ...] = (5, 10, 20, 50, 100, 200)  # at most so many
    frames: int = 4  # held out
    pictures: int = 16  # learnt from
    training_steps: int = 2000
    pixels: int = 32  # of a side
    width: int = 64
    code_width: int = 8
    repeats: int = 5
    out: pathlib.Path | None = None  # JSON

    def __post_init__(self):
        unknown = set(self.solvers) - set(CODE_SOLVERS)
        if unknown or not self.solvers:
            raise ValueError(
                f"solvers={self.solvers} must be among {tuple(CODE_SOLVERS)}"
            )
        least = min((*self.steps, self.frames, self.repeats, self.pixels))
        if not self.steps or least < 1 or self.pictures < 2:
            raise ValueError(
                "a table needs steps, frames, repeats and pixels of at least 1 and at "
                f"least 2 pictures; got {self}"
            )


class Row(NamedTuple):
    """One solver with so many steps at most, over all held-out frames."""

    solver: str
    max_steps: int
    steps: float  # median of what it took
    seconds: float  # median wall time of one warm solve
    cpu_seconds: float
    loss: float  # median, squared colour
    excess: float  # worst, over the best known loss of its frame
    distance: float  # worst, of the code to the best known one; units of code
    converged: int  # frames


class Problem(NamedTuple):
    """A frozen network and pictures that it has not seen."""

    network: mlp.MLP
    spec: mlp.MLPSpec
    start: jax.Array  # [code]
    places: jax.Array  # [pixels, features]
    unseen: jax.Array  # [frames, pixels, 3]

    def loss(self, code, picture):
        return jnp.mean(
            (drawn(self.spec, self.network, self.places, code) - picture) ** 2
        )


def pattern(moments: np.ndarray, pixels: int) -> np.ndarray:
    """A blob on a circle, a plaid, a changing light: [moments, pixels², 3]."""
    axis = (np.arange(pixels) + 0.5) / pixels * 2 - 1
    x, y = (part.ravel() for part in np.meshgrid(axis, axis))
    angle = 2 * np.pi * moments[:, None]
    away = (x - 0.5 * np.cos(angle)) ** 2 + (y - 0.5 * np.sin(angle)) ** 2
    blob = np.exp(-away / 0.1)
    plaid = 0.5 + 0.25 * np.sin(4 * x) + 0.2 * np.cos(5 * y)
    light = 1 + 0.3 * np.sin(3 * angle)
    return np.stack([light * plaid, plaid + 0 * angle, blob], axis=-1)


def drawn(spec, network, places, code):
    inputs = jnp.concatenate(
        [places, jnp.broadcast_to(code, (len(places), len(code)))], axis=1
    )
    return mlp.apply(spec, network, inputs)["colour"]


def problem(settings: Settings) -> Problem:
    """Train the network and its codes; put the held-out moments between theirs."""
    known = np.arange(settings.pictures) / settings.pictures
    spread = np.linspace(0, settings.pictures - 1, settings.frames).astype(int)
    between = known[spread] + 0.5 / settings.pictures
    pictures = jnp.asarray(pattern(known, settings.pixels), jnp.float32)
    unseen = jnp.asarray(pattern(between, settings.pixels), jnp.float32)
    axis = (np.arange(settings.pixels) + 0.5) / settings.pixels * 2 - 1
    grid = np.stack([part.ravel() for part in np.meshgrid(axis, axis)], -1)
    waves = encoding.EncodingSpec(3)
    places = jax.vmap(lambda point: encoding.encode(waves, point, None))(
        jnp.asarray(grid, jnp.float32)
    )
    spec = mlp.MLPSpec(
        inputs=places.shape[1] + settings.code_width,
        depth=3,
        width=settings.width,
        heads=(("colour", mlp.HeadSpec(3)),),
        activation="softplus",
    )
    network_key, code_key = jax.random.split(jax.random.key(0))
    params = (
        mlp.init(spec, network_key),
        codes.init(code_key, settings.pictures, settings.code_width),
    )
    network, table = _train(spec, params, places, pictures, settings.training_steps)
    return Problem(network, spec, jnp.mean(table, axis=0), places, unseen)


def _train(spec, params, places, pictures, steps):
    rule = optax.adam(optax.cosine_decay_schedule(3e-3, steps))

    def loss(params):
        images = jax.vmap(lambda code: drawn(spec, params[0], places, code))(params[1])
        return jnp.mean((images - pictures) ** 2)

    def step(state, _):
        params, memory = state
        updates, memory = rule.update(jax.grad(loss)(params), memory)
        return (optax.apply_updates(params, updates), memory), None

    # optax adds its step count to floats
    with jax.numpy_dtype_promotion("standard"):
        state = params, rule.init(params)
        (params, _), _ = jax.jit(lambda state: jax.lax.scan(step, state, length=steps))(
            state
        )
    return params


def table(task: Problem, settings: Settings) -> list[Row]:
    """Every solver with every number of steps, best known results included."""
    fits, timings = {}, {}
    for max_steps in settings.steps:
        programs = {name: _program(task, name, max_steps) for name in settings.solvers}
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
        Row(
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


def _program(task, name, max_steps):
    # Far below what float32 reaches here, so that no solver stops for being content.
    return jax.jit(
        lambda picture: fit_code(
            lambda code: task.loss(code, picture), task.start, name, max_steps, 1e-6
        )
    )


def text(rows: list[Row], frames: int) -> str:
    head = (
        f"{'solver':<17}{'at most':>8}{'steps':>7}{'ms':>9}{'CPU ms':>9}"
        f"{'loss':>11}{'excess':>10}{'distance':>10}{'done':>7}"
    )
    lines = [
        f"{r.solver:<17}{r.max_steps:>8}{r.steps:>7.0f}{1e3 * r.seconds:>9.2f}"
        f"{1e3 * r.cpu_seconds:>9.2f}{r.loss:>11.3e}{r.excess:>10.1e}"
        f"{r.distance:>10.1e}{r.converged:>5}/{frames}"
        for r in sorted(rows, key=lambda r: (r.solver, r.max_steps))
    ]
    return "\n".join([head, *lines])


def main(settings: Settings) -> list[Row]:
    task = problem(settings)
    rows = table(task, settings)
    print(text(rows, settings.frames))
    if settings.out:
        about = dataclasses.asdict(settings) | {"out": str(settings.out)}
        record = {"about": about, "rows": [row._asdict() for row in rows]}
        settings.out.write_text(json.dumps(record, indent=1) + "\n")
    return rows


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
