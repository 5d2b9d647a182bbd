"""Training steps as compiled scans."""

import functools
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from nerfies_jax.runtime import compiler, data_parallel, events
from nerfies_jax.training import matrix_flops
from nerfies_jax.training.model import Frames, Model, PyTree, TrainState

LENGTH = 10  # steps of a scan
# A scan cannot be interrupted: it has less work than this (two seconds of a core), or
# a single step. Each call asks the system for its memory anew, page by page: of single
# steps of `d-nerf-small` that is 24 of 110 ms, of ten at once 2 of 87.
SCAN_FLOPS = 1e11
SHORTER = 5, 2, 1  # lengths of scans of larger steps
FEW_STEPS = 100  # a run of fewer has single steps


class Outcome(NamedTuple):
    """Scalars that a chunk of steps reports next to its state."""

    done: Any  # steps run, the first with a non-finite metric included
    metrics: Any  # means over the steps asked for
    finite: Any  # whether every metric was, and the state is
    step: Any


def scan_steps(
    step: Callable[[PyTree, PyTree], tuple[PyTree, dict[str, Array]]],
    state: PyTree,
    frames: PyTree,
    length: int,
) -> tuple[PyTree, dict[str, Array]]:
    """Run a number of steps as one scan.

    It is pure if `step` is, and it can be differentiated.

    Args:
      step: Pure function `step(state, frames) -> (state, metrics)`.
      state: State before the first step, a pytree of arrays.
      frames: Training frames, the same in all steps.
      length: Number of steps.

    Returns:
      The state after the last step, and each metric of all steps, [length].

    Raises:
      ValueError: If a step changes the shape or dtype of an array.
    """
    accumulate = jnp.result_type(float)

    def advance(state, _):
        new, metrics = step(state, frames)
        _check_same(state, new)
        metrics = {k: jnp.asarray(v).astype(accumulate) for k, v in metrics.items()}
        return jax.tree.map(_strong, new), metrics

    return lax.scan(advance, state, length=length)


def _run_scan(step, length, state, frames):
    """A scan and its outcome.

    The state is looked at as a whole, once: a second moment that overflows leaves the
    parameters finite, and a row that never moves again. Of 200 000 x 59 rows it takes
    40 ms, of the parameters alone 6.
    """
    state, metrics = scan_steps(step, state, frames, length)
    finite = functools.reduce(
        jnp.logical_and,
        [jnp.isfinite(x) for x in metrics.values()],
        jnp.ones(length, bool),
    )
    all_finite = jnp.all(finite)
    done = jnp.where(all_finite, length, 1 + jnp.argmin(finite))
    # Means, not sums: a hundred large metrics must not overflow together.
    mean = {name: jnp.sum(x / length) for name, x in metrics.items()}
    return state, Outcome(done, mean, all_finite & _all_finite(state), state.step)


def _all_finite(tree):
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.inexact)]
    # Not isfinite(max(abs(x))), in 12 ms for 40: XLA:CPU's max passes over NaN.
    return functools.reduce(
        jnp.logical_and, [jnp.all(jnp.isfinite(x)) for x in leaves], jnp.asarray(True)
    )


def _strong(leaf):
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return leaf
    return lax.convert_element_type(leaf, leaf.dtype)


def _check_same(before, after):
    """Raise ValueError naming the array whose shape or dtype a step changes."""
    old, old_structure = jax.tree_util.tree_flatten_with_path(before)
    new, new_structure = jax.tree_util.tree_flatten_with_path(after)
    if old_structure != new_structure:
        raise ValueError(
            f"Model.step returns a state of another structure, {new_structure}, than "
            f"it was given, {old_structure}"
        )
    for (path, x), (_, y) in zip(old, new, strict=True):
        if x.shape != y.shape or x.dtype != y.dtype:
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise ValueError(
                f"Model.step changes {name} from {x.dtype}{list(x.shape)} to "
                f"{y.dtype}{list(y.shape)}; only an event may "
                "change an array's shape, and nothing its dtype"
            )


class Program:
    """Compiled training steps for arrays of fixed shapes: scans and single steps.

    Two programs are compiled: one scan of `length` steps (LENGTH, or fewer for
    expensive steps), and, only if there is a remainder, a single step. A step therefore
    gives the same bits wherever chunks of LENGTH end. (A scan of each length would need
    its own compilation, and one that skips steps copies the state for each.)

    Called with (state, frames, count) it returns the state and the `Outcome`. The state
    passed in is overwritten. If a step works on several devices, state and outcome are
    on the first of them and `frames` on all (`data_parallel.replicate`).
    """

    def __init__(self, model: Model, state: TrainState, frames: Frames, steps: int):
        # Traced once for both lengths, which takes most of the time to lower.
        self._step = jax.jit(model.step, inline=True)
        self._devices, self._options = model.devices, model.compiler_options
        self._shapes = jax.tree.map(_abstract, (self._on_all(state), frames))
        self._lowered: dict[int, jax.stages.Lowered] = {}  # by the number of steps
        self._programs: dict[int, jax.stages.Compiled] = {}
        self.length = 1 if steps < FEW_STEPS else self._most_at_once()
        self._lower(self.length)

    def _most_at_once(self):
        flops = self._flops()
        fit = (n for n in (LENGTH, *SHORTER) if n * flops < SCAN_FLOPS)
        return next(fit, 1)

    def _flops(self):
        """Operations of a step: the larger of XLA's count and that of matrix products.

        A step in micro-batches, or in slabs of pixels, is split into parts.
        """
        counted = self._lower(LENGTH).cost_analysis() or {}
        products = matrix_flops.count(self._step, *self._shapes).flops
        return max(products, counted.get("flops", 0.0))

    def _lower(self, length):
        if length not in self._lowered:
            scan = functools.partial(_run_scan, self._step, length)
            scan = jax.jit(scan, donate_argnums=0)
            self._lowered[length] = scan.lower(*self._shapes)
        return self._lowered[length]

    def _on_all(self, state):
        return data_parallel.replicate(state, self._devices)

    def prepare(self, count: int) -> float:
        """Compile the programs that a number of steps needs.

        Args:
          count: Number of steps.

        Returns:
          Seconds of compilation, 0 if nothing was missing.
        """
        missing = set(self._lengths(count)) - self._programs.keys()
        if not missing:
            return 0.0
        began = time.perf_counter()
        with events.stage("compiling the training step"):
            for length in missing:
                self._programs[length] = self._lower(length).compile(self._options)
        return time.perf_counter() - began

    def _lengths(self, count):
        scans, singles = divmod(count, self.length)
        return [self.length] * scans + [1] * singles

    def __call__(self, state: TrainState, frames: Frames, count: int):
        """The state after `count` steps, or after one not finite, and the outcome."""
        self.prepare(count)
        state = self._on_all(state)
        total: dict[str, float] = {}
        done, outcome = 0, None
        for length in self._lengths(count):
            state, outcome = self._programs[length](state, frames)
            outcome = jax.device_get(outcome)
            done += int(outcome.done)
            for name, mean in outcome.metrics.items():
                total[name] = total.get(name, 0.0) + mean * (length / count)
            if not outcome.finite:
                break
        assert outcome is not None, count
        state = data_parallel.first_copy(state, self._devices)
        return state, outcome._replace(done=done, metrics=total)


def _abstract(leaf):
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)


def program(
    model: Model, state: TrainState, frames: Frames, steps: int
) -> tuple[Program, float]:
    """Return the program for the shapes of a state and frames, traced but not compiled.

    Args:
      model: The model, whose `step` is compiled.
      state: Training state.
      frames: Training frames.
      steps: Number of steps of the whole run.

    Returns:
      The program, and the seconds of tracing, 0 if it was cached.
    """
    programs = _programs(model.step)
    leaves, structure = jax.tree.flatten((state, frames))
    shapes = tuple((x.shape, x.dtype, x.sharding) for x in leaves)
    key = structure, shapes, steps >= FEW_STEPS
    if key in programs:
        return programs[key], 0.0
    began = time.perf_counter()
    with events.stage("tracing the training step"):
        programs[key] = Program(model, state, frames, steps)
    return programs[key], time.perf_counter() - began


def compiled(
    model: Model, state: TrainState, frames: Frames, steps: int
) -> tuple[Program, Frames, float]:
    """Return the program of a run with its scan compiled.

    Args:
      model: The model.
      state: Training state.
      frames: Training frames.
      steps: Number of steps of the whole run.

    Returns:
      The program, the frames as it takes them, and the seconds of tracing and
      compiling.
    """
    made, frames, seconds = _lowered(model, state, frames, steps)
    return made, frames, seconds + made.prepare(made.length)


def compiling(
    model: Model, state: TrainState, frames: Frames, steps: int
) -> Future[float]:
    """Compile the scan of a run in the background, for `compiled` or `program` to find.

    Args:
      model: The model.
      state: Training state.
      frames: Training frames.
      steps: Number of steps of the whole run.

    Returns:
      A future of the seconds of tracing and compiling.
    """
    made, _, seconds = _lowered(model, state, frames, steps)
    return compiler.begun(lambda: seconds + made.prepare(made.length))


def _lowered(model, state, frames, steps):
    frames = jax.tree.map(jnp.asarray, frames)
    frames = data_parallel.shared(frames, model.devices)
    made, seconds = program(model, state, frames, steps)
    return made, frames, seconds


# Each model's programs hold 4,000 mappings of memory and more, and Linux lets a process
# have 65,530.
@functools.lru_cache(maxsize=4)
def _programs(step):
    return {}
