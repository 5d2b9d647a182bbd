"""A basis of directions for each point against shared trajectories, at equal rank.

    python -m experiments.motion_rank
    python -m experiments.motion_rank --kinds scene wiggles --seeds 3 --out rank

Known trajectories of points are learned directly, without pictures, from some of the
times; the others are held out. Displacements are modeled as

- time basis:   sum_k c_ik b_k(t), K trajectories shared by all points (DynMF);
- separable:    V(p) w(t), K directions of each point, weights shared by all;
- moving basis: D(p, t) + V(p) w(p', t), `gaussians_jax.effects.motion_basis`;
- residual:     the same with the residual straight from the network, without a basis.

The first two are factorizations, and no fit of theirs can be better than a singular
value decomposition cut off at K (Eckart and Young 1936): the floors. Errors are shares
of the RMS displacement.
"""

import dataclasses
import pathlib
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments import cli
from experiments.motion_rank import report
from experiments.motion_rank import tracks as motion_tracks
from gaussians_jax.effects import motion_basis
from gaussians_jax.effects.motion_basis import SMALL_BASIS_MOTION, BasisMotionSpec
from nerfies_jax import console
from nerfies_jax.nets import encoding, mlp
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.nets.mlp import HeadSpec, MLPSpec
from nerfies_jax.runs import platform

TIME = EncodingSpec(5)
FACTOR_STEPS = 4  # for each step of the networks of p and t; they still take less time
# The factorizations reach their floors with it. For the networks of p and t 3e-3 is too
# slow: on "mixed", at K = 8, 0.21 against 0.08, and 0.29 against 0.11 without a basis.
RATES = dict.fromkeys(("time basis", "separable", "moving basis", "residual"), 1e-2)


@dataclasses.dataclass(frozen=True)
class MotionRank:
    """Tabulate the error of motion models at equal numbers of basis vectors."""

    kinds: tuple[str, ...] = ("rigid", "cloth", "mixed")
    """Trajectories: rigid, cloth, wiggles, mixed, scene."""
    counts: tuple[int, ...] = (1, 2, 4, 8, 16)
    """Basis vectors K."""
    seeds: int = 2
    """Draws of trajectories and of networks."""
    steps: int = 1000
    """Of Adam, four times as many for the factorizations; its rate falls to 1 %."""
    points: int = 128
    """Followed."""
    times: int = 48
    """Of which each fourth is held out."""
    batch: int = 8
    """Times in a step of the networks of p and t; the factorizations take all."""
    basis_form: str = "bounded"
    """Of the moving basis: bounded or free directions."""
    out: pathlib.Path | None = None
    """Folder for motion_rank.png and motion_rank.json."""
    device: str = "cpu"
    """cpu, gpu, or whatever JAX finds ("auto")."""

    def __post_init__(self):
        cli.check_out_folder(self.out)
        for name, least in (
            *(("seeds", 1), ("steps", 2), ("points", 4), ("times", 8), ("batch", 1)),
        ):
            if getattr(self, name) < least:
                raise ValueError(
                    f"--{name} {getattr(self, name)} must be at least {least}"
                )
        wrong = set(self.kinds) - set(motion_tracks.KINDS)
        if wrong or not self.kinds:
            raise ValueError(
                f"--kinds {' '.join(self.kinds)}: choose from "
                f"{', '.join(motion_tracks.KINDS)}"
            )
        if not self.counts or min(self.counts) < 1:
            raise ValueError(f"--counts {self.counts}: at least one, each at least 1")
        if self.basis_form not in motion_basis.BASIS_FORMS:
            raise ValueError(
                f"--basis-form {self.basis_form}: choose from "
                f"{', '.join(motion_basis.BASIS_FORMS)}"
            )


class RankResult(NamedTuple):
    """One model at one K: errors as shares of the RMS displacement, by seed."""

    kind: str
    model: str
    count: int | None  # None: has no basis
    learned: list[float]
    held_out: list[float]
    floor: list[float] | None  # what `learned` cannot go below
    seconds: float  # of processor time for one fit, without compiling


@cli.command(MotionRank)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        platform.start_jax(args.device)
        if args.out is not None:
            args.out.mkdir(parents=True, exist_ok=True)
    rows = table(args)
    console.say(report.text(rows))
    console.say(report.format_conclusions(rows))
    record = report.record(args, rows)
    if args.out is not None:
        report.write(args.out, record, rows)
    return record


def table(args: MotionRank) -> list[RankResult]:
    """Every model at every K, for every kind of trajectories."""
    rows = []
    fits = {}  # compiled once for each number of points, which a scene may lack
    for kind in args.kinds:
        drawn = [
            motion_tracks.make(kind, args.points, args.times, seed)
            for seed in range(args.seeds)
        ]
        for model in RATES:
            for count in (None,) if model == "residual" else args.counts:
                row = one_row(args, fits, kind, model, count, drawn)
                rows.append(row)
                console.say(report.progress(row))
    return rows


def one_row(args, fits, kind, model, count, drawn) -> RankResult:
    """Fit one model to every draw; `fits` keeps what is compiled."""
    learned, held_out, floor, seconds = [], [], [], []
    for seed, tracks in enumerate(drawn):
        keep = np.arange(len(tracks.times)) % 4 != 2
        known = tracks._replace(times=tracks.times[keep], moved=tracks.moved[:, keep])
        given = [jnp.asarray(part, jnp.float32) for part in (*known, tracks.times)]
        name = model, count, len(tracks.rest)
        if name not in fits:
            fits[name] = compiled_fit(args, model, count, given)
        began = time.process_time()
        predicted = np.asarray(fits[name](jax.random.key(seed), *given), np.float64)
        seconds.append(time.process_time() - began)
        size = np.sqrt(np.mean(np.sum(tracks.moved**2, axis=-1)))
        off = np.sum((predicted - tracks.moved) ** 2, axis=-1)
        learned.append(float(np.sqrt(np.mean(off[:, keep])) / size))
        held_out.append(float(np.sqrt(np.mean(off[:, ~keep])) / size))
        if model in FLOORS:
            floor.append(float(FLOORS[model](known.moved, count) / size))
    return RankResult(
        kind, model, count, learned, held_out, floor or None, float(np.median(seconds))
    )


def time_floor(moved: np.ndarray, count: int) -> float:
    """Least RMS error of any K trajectories shared by all points.

    [points, times, 3] is a matrix of one row for each point; Eckart and Young 1936.
    """
    return _cut_off(moved.reshape(len(moved), -1), count, moved[..., 0].size)


def separable_floor(moved: np.ndarray, count: int) -> float:
    """Least RMS error of any K functions of time shared by all points and axes."""
    matrix = np.swapaxes(moved, 1, 2).reshape(-1, moved.shape[1])
    return _cut_off(matrix, count, moved[..., 0].size)


def _cut_off(matrix, count, vectors):
    left = np.linalg.svd(np.asarray(matrix, np.float64), compute_uv=False)[count:]
    return float(np.sqrt(np.sum(left**2) / vectors))


FLOORS = {"time basis": time_floor, "separable": separable_floor}


class Fittable(NamedTuple):
    """A model of displacements: parameters, and what they say."""

    init: Any  # (key, points) -> parameters
    apply: Any  # (parameters, rest, times) -> [points, times, 3]


def compiled_fit(args: MotionRank, model: str, count: int | None, given):
    """The fit as a program: (key, rest, times, moved, all times) -> displacements."""
    chosen = model_of(model, count, args.basis_form)
    factors = model in FLOORS
    few = None if factors else args.batch
    steps = args.steps * (FACTOR_STEPS if factors else 1)
    rule = optax.adam(optax.exponential_decay(RATES[model], steps, 0.01))

    def fit(key, rest, times, moved, every_time):
        init_key, batch_key = jax.random.split(key)

        def loss(params, rows):
            predicted = chosen.apply(params, rest, times[rows])
            return jnp.mean(jnp.sum((predicted - moved[:, rows]) ** 2, axis=-1))

        def step(state, key):
            params, memory = state
            rows = jnp.arange(len(times))
            if few is not None:
                rows = jax.random.randint(key, (few,), 0, len(times))
            updates, memory = rule.update(jax.grad(loss)(params, rows), memory)
            return (optax.apply_updates(params, updates), memory), None

        params = chosen.init(init_key, len(rest))
        keys = jax.random.split(batch_key, steps)
        (params, _), _ = jax.lax.scan(step, (params, rule.init(params)), keys)
        return chosen.apply(params, rest, every_time)

    # optax adds its step count to floats
    with jax.numpy_dtype_promotion("standard"):
        return jax.jit(fit).lower(jax.random.key(0), *given).compile()


def model_of(model: str, count: int | None, basis_form: str = "bounded") -> Fittable:
    """One of the four models of `RATES`."""
    spec = dataclasses.replace(SMALL_BASIS_MOTION, count=count, basis_form=basis_form)
    if model == "time basis":
        return _time_basis(count)
    if model == "separable":
        return _separable(count, spec)
    return Fittable(
        lambda key, points: motion_basis.init(key, spec),
        lambda params, rest, times: _moved(params, spec, rest, times),
    )


def _moved(params, spec: BasisMotionSpec, rest, times):
    prepared = jax.vmap(lambda p: motion_basis.prepare_point(params, spec, p))(rest)

    def at(time):
        at_time = motion_basis.fold_time(params, spec, time)
        offsets = jax.vmap(
            lambda point, row: motion_basis.offsets_at_time(at_time, spec, point, row)
        )
        return offsets(rest, prepared).mean

    return jax.vmap(at, out_axes=1)(times)


def _functions(count):
    heads = (("value", HeadSpec(count)),)
    return MLPSpec(TIME.width(1), 2, 64, heads, (), "silu", "he")


def _of_time(spec, params, times):
    encoded = jax.vmap(lambda time: encoding.encode(TIME, time[None], None))(times)
    return mlp.apply(spec, params, encoded)["value"]


def _time_basis(count):
    spec = _functions(3 * count)

    def init(key, points):
        shares_key, key = jax.random.split(key)
        shares = jax.random.normal(shares_key, (points, count)) / count**0.5
        return shares, mlp.init(spec, key)

    def apply(params, rest, times):
        del rest  # every point has numbers of its own
        shares, network = params
        paths = _of_time(spec, network, times).reshape(len(times), count, 3)
        return jnp.einsum("pk,tkd->ptd", shares, paths)

    return Fittable(init, apply)


def _separable(count, moving: BasisMotionSpec):
    spec = _functions(count)
    # V alone, with a wider network: nothing else tells points apart.
    moving = dataclasses.replace(moving, basis_width=128, basis_form="free")

    def init(key, points):
        del points
        basis_key, key = jax.random.split(key)
        basis = mlp.init(motion_basis.basis_spec(moving), basis_key)
        return basis, mlp.init(spec, key)

    def apply(params, rest, times):
        basis, network = params

        def directions(point):
            encoded = encoding.encode(moving.position, point, None)
            return motion_basis.basis_vectors(basis, moving, encoded)

        weights = _of_time(spec, network, times)
        return jnp.einsum("pdk,tk->ptd", jax.vmap(directions)(rest), weights)

    return Fittable(init, apply)


if __name__ == "__main__":
    main()
