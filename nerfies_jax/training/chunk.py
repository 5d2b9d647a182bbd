"""Training steps as compiled scans."""

import functools
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from nerfies_jax.runtime import compiler, data_parallel, events, hosts
from nerfies_jax.training import frame_stream, matrix_flops, programs
from nerfies_jax.training.frame_stream import FrameStream, TrainingFrames, abstract
from nerfies_jax.training.model import Frames, Model, PyTree, TrainState

LENGTH = frame_stream.STEPS  # steps per scan
# A scan cannot be interrupted, so it has less work than this (two seconds of a core),
# or one step. Longer scans are faster, because each call allocates its memory from the
# system page by page. With `d-nerf-small` that takes 24 of 110 ms for a single step,
# and 2 of 87 ms per step for ten.
SCAN_FLOPS = 1e11
SHORTER = 5, 2, 1  # steps per scan if the steps are larger
FEW_STEPS = 100  # shorter runs use single steps


class Outcome(NamedTuple):
    """Scalars that a chunk of steps returns in addition to its state."""

    done: Any  # number of steps, up to and with the first non-finite metric
    metrics: Any  # means over the requested steps
    finite: Any  # True if all metrics and the state are finite
    step: Any


def scan_steps(
    step: Callable[[PyTree, PyTree], tuple[PyTree, dict[str, Array]]],
    state: PyTree,
    frames: PyTree,
    length: int,
) -> tuple[PyTree, dict[str, Array]]:
    """Run a number of steps as one scan.

    The function is pure if `step` is, and can be differentiated.

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


def _run_scan(step, length, state, frames, numbers):
    """Run a scan and compute its outcome.

    The complete state is checked once per scan. If only the parameters were checked, an
    overflowing second moment would go unnoticed: it leaves the parameters finite, but
    they never change again. The check takes 40 ms for 200 000 x 59 parameters, and 6 ms
    for the parameters alone.
    """
    state, metrics = scan_steps(
        lambda state, frames: step(state, frames, numbers), state, frames, length
    )
    finite = functools.reduce(
        jnp.logical_and,
        [jnp.isfinite(x) for x in metrics.values()],
        jnp.ones(length, bool),
    )
    all_finite = jnp.all(finite)
    steps = jnp.where(all_finite, length, 1 + jnp.argmin(finite))
    # Divided before summing, so that the sum does not overflow.
    mean = {name: jnp.sum(x / length) for name, x in metrics.items()}
    return state, Outcome(steps, mean, all_finite & _all_finite(state), state.step)


def _all_finite(tree):
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.inexact)]
    # isfinite(max(abs(x))) takes 12 ms instead of 40, but max ignores NaN on XLA:CPU.
    return functools.reduce(
        jnp.logical_and, [jnp.all(jnp.isfinite(x)) for x in leaves], jnp.asarray(True)
    )


def _strong(leaf):
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return leaf
    return lax.convert_element_type(leaf, leaf.dtype)


def _check_same(before, after):
    """Raise ValueError if a step changes the shape or dtype of an array."""
    old, old_structure = jax.tree_util.tree_flatten_with_path(before)
    new, new_structure = jax.tree_util.tree_flatten_with_path(after)
    if old_structure != new_structure:
        raise ValueError(
            f"Model.step must return a state of structure {old_structure}, but "
            f"returned {new_structure}"
        )
    for (path, x), (_, y) in zip(old, new, strict=True):
        if x.shape != y.shape or x.dtype != y.dtype:
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise ValueError(
                f"Model.step changes {name} from {x.dtype}{list(x.shape)} to "
                f"{y.dtype}{list(y.shape)}; only an event may change the shape of an "
                "array, and dtypes must not change"
            )


class Program:
    """Compiled training steps for arrays of fixed shapes: scans and single steps.

    Two programs are compiled: a scan of `length` steps (LENGTH, or fewer for expensive
    steps) and, only if there is a remainder, a single step. Results are therefore equal
    bit for bit wherever chunks of LENGTH end. (Scans of other lengths would have to be
    compiled, and a scan that skips steps copies the state for each of them.)

    Called with (state, frames, count) it returns the state and the `Outcome`. The state
    passed in is overwritten. If a step uses several devices, state and outcome are on
    the first of them and `frames` on all (`frame_stream.replicate`). If it uses the
    devices of several processes, process 0 sends each call to the others. Of a stream
    of frames, each scan gets the window of its steps.
    """

    def __init__(self, model: Model, state: TrainState, frames: Frames, steps: int):
        # Traced once for both lengths, because tracing takes most of the time.
        self._step = jax.jit(functools.partial(_step, model), inline=True)
        self._devices, self._options = model.devices, model.compiler_options
        self._numbers = model.numbers
        self._spans, self._steps = data_parallel.spans_hosts(), steps
        if self._spans:
            # Arrays of one device cannot be inputs beside those of several processes.
            self._numbers = jax.tree.map(_on_host, self._numbers)
        shapes = jax.tree.map(abstract, self._replicate(state))
        self._inputs = shapes, jax.tree.map(abstract, frames), self._numbers
        self._lowered: dict[int, jax.stages.Lowered] = {}  # by the number of steps
        self._programs: dict[int, jax.stages.Compiled] = {}
        self.length = 1 if steps < FEW_STEPS else self._longest_scan()
        self._lower(self.length)

    def _longest_scan(self):
        flops = self._flops()
        lengths = (n for n in (LENGTH, *SHORTER) if n * flops < SCAN_FLOPS)
        return next(lengths, 1)

    def _flops(self):
        """Return the FLOPs of a step by XLA, or of its matrix products if larger.

        XLA counts the body of a loop over micro-batches or slabs of pixels once.
        """
        xla_cost = self._lower(LENGTH).cost_analysis() or {}
        products = matrix_flops.count(self._step, *self._inputs).flops
        return max(products, xla_cost.get("flops", 0.0))

    def _lower(self, length):
        if length not in self._lowered:
            scan = functools.partial(_run_scan, self._step, length)
            scan = jax.jit(scan, donate_argnums=0)
            self._lowered[length] = scan.lower(*self._inputs)
        return self._lowered[length]

    def _replicate(self, state):
        return data_parallel.replicate(state, self._devices)

    def prepare(self, count: int) -> float:
        """Compile the programs that a number of steps needs.

        Args:
          count: Number of steps.

        Returns:
          Seconds of compilation, 0 if all programs were compiled.
        """
        missing = set(self._lengths(count)) - self._programs.keys()
        if not missing:
            return 0.0
        began = time.perf_counter()
        state, frames, _ = self._inputs
        leads = self._tell(hosts.COMPILE, state, frames, count)
        with events.stage("compiling the training step"):
            for length in missing:
                self._programs[length] = self._lower(length).compile(self._options)
        if leads:
            hosts.meet()
        return time.perf_counter() - began

    def _tell(self, kind, state, frames, count):
        leads = self._spans and hosts.leads()
        if leads:
            hosts.send_steps(kind, state, frames, self._steps, count)
        return leads

    def _lengths(self, count):
        scans, singles = divmod(count, self.length)
        return [self.length] * scans + [1] * singles

    def __call__(self, state: TrainState, frames: TrainingFrames, count: int):
        """Run `count` steps, or fewer if one is not finite."""
        self.prepare(count)
        self._tell(hosts.STEPS, state, self._inputs[1], count)
        state = self._replicate(state)
        if self._spans:
            hosts.meet()
        total: dict[str, float] = {}
        steps, outcome = 0, None
        for length in self._lengths(count):
            # The window has no other name here, so that it is freed after its steps.
            state, outcome = self._programs[length](
                state, _window(frames, state, length, count - steps), self._numbers
            )
            outcome = jax.device_get(outcome)
            steps += int(outcome.done)
            for name, mean in outcome.metrics.items():
                total[name] = total.get(name, 0.0) + mean * (length / count)
            if not outcome.finite:
                break
        assert outcome is not None, count
        state = data_parallel.first_copy(state, self._devices)
        if self._spans:
            hosts.remember(state)
        return state, outcome._replace(done=steps, metrics=total)


def _step(model, state, frames, numbers):
    return programs.with_numbers(model, numbers).step(state, frames)


def _on_host(leaf):
    return np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf


def _window(frames, state, length, left):
    """Return the frames of the next steps."""
    if isinstance(frames, FrameStream):
        return frames.window(state, length, left)
    return frames


def program(
    model: Model, state: TrainState, frames: TrainingFrames, steps: int
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
    frames = frame_stream.layout_of(frames)
    leaves, structure = jax.tree.flatten((state, frames))
    shapes = tuple((x.shape, x.dtype, x.sharding) for x in leaves)
    key = structure, shapes, steps >= FEW_STEPS
    if key in programs:
        return programs[key], 0.0
    began = time.perf_counter()
    with events.stage("tracing the training step"):
        programs[key] = Program(model, state, frames, steps)
    return programs[key], time.perf_counter() - began


def compile_program(
    model: Model, state: TrainState, frames: TrainingFrames, steps: int
) -> tuple[Program, TrainingFrames, float]:
    """Compile the scan of a run and return its program.

    Args:
      model: The model.
      state: Training state.
      frames: Training frames.
      steps: Number of steps of the whole run.

    Returns:
      The program, the frames on its devices, and the seconds of tracing and compiling.
    """
    scan_program, frames, seconds = _lower_program(model, state, frames, steps)
    return scan_program, frames, seconds + scan_program.prepare(scan_program.length)


def compiling(
    model: Model, state: TrainState, frames: TrainingFrames, steps: int
) -> Future[float]:
    """Compile the scan of a run in the background, for later use by `program`.

    Args:
      model: The model.
      state: Training state.
      frames: Training frames.
      steps: Number of steps of the whole run.

    Returns:
      A future of the seconds of tracing and compiling.
    """
    scan_program, _, seconds = _lower_program(model, state, frames, steps)
    return compiler.begun(lambda: seconds + scan_program.prepare(scan_program.length))


def _lower_program(model, state, frames, steps):
    _, frames = frame_stream.replicate(frames, model.devices)
    scan_program, seconds = program(model, state, frames, steps)
    return scan_program, frames, seconds


# Bounded, because the programs of a model hold 4,000 or more memory mappings, and Linux
# limits a process to 65,530.
@functools.lru_cache(maxsize=4)
def _programs(step):
    return {}
