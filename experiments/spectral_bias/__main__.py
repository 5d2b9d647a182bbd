"""Which frequencies networks learn: RBF-KAN against MLPs, with and without encoding.

    python -m experiments.spectral_bias
    python -m experiments.spectral_bias --steps 6000 --seeds 5 --out bias

Networks of one size learn a sum of sinusoids from random points of [-1, 1] or of the
square, in as many steps, and again in as much processor time as the KAN took. Shown is
what is missing of each sinusoid, as a share of its amplitude, and the RMS error as a
share of the signal's. Every network's learning rate is the one of `rates` with the
least training loss in a run of `pilot` of the steps. PJRT_NPROC=1 and nothing else
on the core make the seconds comparable; this is set unless the environment says
otherwise.
"""

import bisect
import dataclasses
import math
import pathlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments import cli
from experiments.spectral_bias import report
from nerfies_jax import console
from nerfies_jax.nets import encoding, kan, mlp
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.nets.kan import KANSpec
from nerfies_jax.nets.mlp import HeadSpec, Layer, MLPSpec
from nerfies_jax.runs import platform

KINDS = ("kan", "relu", "softplus", "sine")
HEAD = (("value", HeadSpec(1)),)
# Sitzmann et al. 2020 (SIREN), arXiv:2006.09661: the first layer's weights are drawn
# from +-30 / inputs, the others' from +-sqrt(6 / inputs) once their factor of 30, which
# the paper puts beside the weights, is multiplied in.
SINE_FIRST = 30.0
TEST_POINTS = {1: 2048, 2: 96}  # of a side; whole periods of every sinusoid


@dataclasses.dataclass(frozen=True)
class SpectralBias:
    """Tabulate what networks miss of each sinusoid of a signal."""

    signals: tuple[str, ...] = ("1-D", "2-D")
    """Sums of five sinusoids of x, or of four of x and y."""
    steps: int = 2000
    """Of Adam, at equal numbers of steps; its rate falls to zero along a cosine."""
    seeds: int = 3
    """Initial networks of every kind."""
    rates: tuple[float, ...] = (3e-3, 1e-2, 3e-2)
    """Learning rates to choose from."""
    pilot: float = 0.25
    """Share of the steps in the runs that choose the rate; 1 is fairer and slower."""
    batch: int = 256
    """Random points of a step."""
    points: int | None = None
    """Fixed training points; None draws new ones in every step."""
    kinds: tuple[str, ...] = KINDS
    """Networks; the first one's time is what the others get."""
    out: pathlib.Path | None = None
    """Folder for spectral_bias.png and spectral_bias.json."""
    device: str = "cpu"
    """cpu, gpu, or whatever JAX finds ("auto")."""

    def __post_init__(self):
        cli.check_out_folder(self.out)
        for name, least in (("steps", 8), ("seeds", 1), ("batch", 1)):
            if getattr(self, name) < least:
                raise ValueError(
                    f"--{name} {getattr(self, name)} must be at least {least}"
                )
        if not 0 < self.pilot <= 1:
            raise ValueError(f"--pilot {self.pilot} is a share of the steps, 0 to 1")
        if self.points is not None and self.points < 1:
            raise ValueError(f"--points {self.points} must be at least 1")
        for name, known in (("signals", SIGNALS), ("kinds", KINDS)):
            wrong = set(getattr(self, name)) - set(known)
            if wrong or not getattr(self, name):
                raise ValueError(
                    f"--{name} {' '.join(getattr(self, name))}: choose from "
                    f"{', '.join(known)}"
                )
        if not self.rates or not all(0 < rate < math.inf for rate in self.rates):
            raise ValueError(f"--rates {self.rates} must be positive numbers")


class Signal(NamedTuple):
    """A sum of sinusoids of equal amplitudes, RMS one over the square."""

    waves: np.ndarray  # [components, dimensions] periods over [-1, 1]
    phase: np.ndarray  # [components] radians
    parameters: int  # of every network, as nearly as a width can
    bands: int  # of the encoding

    @property
    def amplitude(self) -> float:
        return math.sqrt(2 / len(self.waves))

    def __call__(self, points):
        turns = points @ jnp.asarray(self.waves.T, points.dtype)
        shifted = math.pi * turns + jnp.asarray(self.phase, points.dtype)
        return self.amplitude * jnp.sum(jnp.sin(shifted), axis=-1)


SIGNALS = {
    "1-D": Signal(
        np.array([[1.0], [3.0], [7.0], [15.0], [31.0]]),
        np.array([0.0, 0.7, 1.4, 2.1, 2.8]),
        1600,
        6,
    ),
    "2-D": Signal(
        np.array([[1.0, 1.0], [3.0, -2.0], [4.0, 5.0], [8.0, -7.0]]),
        np.array([0.0, 0.7, 1.4, 2.1]),
        7500,
        4,
    ),
}


class Network(NamedTuple):
    """One kind of network of about a given size."""

    init: Callable[[jax.Array], Any]
    apply: Callable[[Any, jax.Array], jax.Array]  # [points, dimensions] -> [points]
    width: int
    parameters: int


class Result(NamedTuple):
    """One network on one signal, over the seeds."""

    signal: str
    network: str
    parameters: int
    rate: float
    steps: int
    seconds: float  # of one run, processor time
    rmse: list[float]  # [seeds] of the signal's RMS
    missing: list[list[float]]  # [seeds][components] of each amplitude


def network(kind: str, encoded: bool, signal: Signal) -> Network:
    """The network whose number of parameters is nearest to the signal's budget."""
    dimensions = signal.waves.shape[1]
    waves = EncodingSpec(signal.bands, times_pi=True) if encoded else EncodingSpec(0)
    inputs = waves.width(dimensions)

    def size(width):
        return count_of(_spec(kind, inputs, width))

    above = bisect.bisect_left(range(256), signal.parameters, lo=4, key=size)
    width = min((above - 1, above), key=lambda w: abs(size(w) - signal.parameters))
    spec = _spec(kind, inputs, width)

    def apply(params, points):
        features = jax.vmap(lambda point: encoding.encode(waves, point, None))(points)
        of = kan.apply_heads if kind == "kan" else mlp.apply
        return of(spec, params, features)["value"][:, 0]

    return Network(lambda key: _init(spec, key), apply, width, size(width))


def _spec(kind, inputs, width):
    if kind == "kan":
        return KANSpec(inputs, (width, width), heads=HEAD)
    return MLPSpec(inputs, 3, width, HEAD, activation=kind, init="he")


def _init(spec, key):
    if isinstance(spec, KANSpec):
        return kan.init(key, spec)
    params = mlp.init(spec, key)
    if spec.activation != "sine":
        return params
    # "he" draws from +-sqrt(6 / inputs): right for all layers but the first.
    first = params.hidden[0]
    factor = SINE_FIRST / spec.inputs / math.sqrt(6 / spec.inputs)
    first = Layer(factor * first.weight, first.bias)
    return params._replace(hidden=(first, *params.hidden[1:]))


def count_of(spec: KANSpec | MLPSpec) -> int:
    """Parameters of a network."""
    shapes = jax.eval_shape(lambda key: _init(spec, key), jax.random.key(0))
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))


def trainer(model: Network, signal: Signal, batch: int, points: int | None = None):
    """A function (keys [lanes], rates [lanes], steps) -> (parameters, training loss)
    that trains as many networks side by side; the steps are traced.
    """
    draw = _drawing(signal.waves.shape[1], batch, points)
    adam = optax.scale_by_adam()

    def one(params, memory, key, rate, step):
        points = draw(jax.random.fold_in(key, step))
        truth = signal(points)
        loss, slope = jax.value_and_grad(
            lambda params: jnp.mean((model.apply(params, points) - truth) ** 2)
        )(params)
        direction, memory = adam.update(slope, memory)
        params = jax.tree.map(lambda p, d: p - rate * d, params, direction)
        return params, memory, loss

    def train(keys, rates, steps):
        params = jax.vmap(model.init)(keys)
        state = params, jax.vmap(adam.init)(params), jnp.zeros(len(keys))

        def step(index, state):
            params, memory, mean = state
            share = index.astype(jnp.float32) / steps.astype(jnp.float32)
            rate = rates * jnp.cos(0.5 * jnp.pi * share) ** 2
            params, memory, loss = jax.vmap(one, in_axes=(0, 0, 0, 0, None))(
                params, memory, keys, rate, index
            )
            # Over the last fiftieth or so of the run: one batch's loss is noise.
            return params, memory, mean + (loss - mean) * 50 / (steps + 49)

        params, _, mean = jax.lax.fori_loop(0, steps, step, state)
        return params, mean

    return train


def _drawing(dimensions, batch, points):
    def fresh(key, count=batch):
        return jax.random.uniform(key, (count, dimensions), minval=-1, maxval=1)

    if points is None:
        return fresh
    known = fresh(jax.random.key(3), points)
    return lambda key: jax.random.choice(key, known, (batch,))


def errors(
    apply: Callable[[jax.Array], jax.Array], signal: Signal
) -> tuple[jax.Array, jax.Array]:
    """RMS error as a share of the signal's, and what is missing of each sinusoid.

    The second is the amplitude of the residual's projection on sine and cosine of each
    frequency, as a share of the signal's amplitude: one for a network that does not see
    a frequency at all. On a grid of whole periods they are orthogonal.
    """
    points = grid(signal.waves.shape[1])
    residual = apply(points) - signal(points)
    angle = math.pi * points @ jnp.asarray(signal.waves.T, points.dtype)
    sine = 2 * jnp.mean(residual[:, None] * jnp.sin(angle), axis=0)
    cosine = 2 * jnp.mean(residual[:, None] * jnp.cos(angle), axis=0)
    return jnp.sqrt(jnp.mean(residual**2)), jnp.hypot(sine, cosine) / signal.amplitude


def grid(dimensions: int) -> jax.Array:
    """Points [points, dimensions] in [-1, 1), even and of whole periods."""
    side = TEST_POINTS[dimensions]
    axis = np.arange(side) / side * 2 - 1
    mesh = np.meshgrid(*[axis] * dimensions, indexing="ij")
    return jnp.asarray(np.stack(mesh, -1).reshape(-1, dimensions), jnp.float32)


def measure(
    args: SpectralBias, label: str, kind: str, encoded: bool, budget: float | None
) -> list[Result]:
    """One network: at equal steps and, if `budget` seconds are given, in that time."""
    signal = SIGNALS[label]
    model = network(kind, encoded, signal)
    train = trainer(model, signal, args.batch, args.points)
    lanes = max(args.seeds, len(args.rates))
    shapes = (
        jax.eval_shape(lambda: jax.random.split(jax.random.key(0), lanes)),
        jax.ShapeDtypeStruct((lanes,), jnp.float32),
        jax.ShapeDtypeStruct((), jnp.int32),
    )
    # optax adds its step count to floats
    with jax.numpy_dtype_promotion("standard"):
        compiled = jax.jit(train).lower(*shapes).compile()
    score = jax.jit(
        jax.vmap(lambda params: errors(lambda x: model.apply(params, x), signal))
    )
    tried = jnp.asarray(np.resize(args.rates, lanes), jnp.float32)
    same = jnp.stack([jax.random.key(1)] * lanes)
    _, loss = compiled(same, tried, jnp.asarray(max(round(args.pilot * args.steps), 2)))
    # A run that blew up is not the best.
    best = int(np.argmin(np.nan_to_num(np.asarray(loss), nan=np.inf)))
    rate, keys = tried[best], jax.random.split(jax.random.key(2), lanes)

    def run(steps):
        began = time.process_time()
        params, _ = compiled(keys, jnp.full(lanes, rate), jnp.asarray(steps))
        jax.block_until_ready(params)
        seconds = (time.process_time() - began) / lanes
        rmse, missing = (np.asarray(x)[: args.seeds] for x in score(params))
        name = kind + (" + encoding" if encoded else "")
        return Result(
            label,
            name,
            model.parameters,
            float(rate),
            steps,
            seconds,
            rmse.tolist(),
            missing.tolist(),
        )

    results = [run(args.steps)]
    if budget is not None:
        results.append(run(max(2, round(args.steps * budget / results[0].seconds))))
    return results


def all_results(args: SpectralBias) -> tuple[list[Result], list[Result]]:
    """Every network at equal steps, and in the first one's time."""
    equal_steps, equal_time = [], []
    for label in args.signals:
        budget = None
        for kind in args.kinds:
            for encoded in (False, True):
                results = measure(args, label, kind, encoded, budget)
                equal_steps.append(results[0])
                equal_time.append(results[-1])
                if budget is None:
                    budget = results[0].seconds
                console.say(report.progress(results))
    return equal_steps, equal_time


@cli.command(SpectralBias)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        if args.out is not None:
            args.out.mkdir(parents=True, exist_ok=True)
        platform.start_jax(args.device)
    results = dict(zip(("equal steps", "equal time"), all_results(args), strict=True))
    waves = {label: SIGNALS[label].waves for label in args.signals}
    console.say(report.tables(results, waves))
    console.say(report.format_conclusions(results))
    record = report.record(args, results, waves)
    if args.out is not None:
        report.write(args.out, record, results, waves)
    return record


if __name__ == "__main__":
    main()
