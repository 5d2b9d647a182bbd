"""Compiled whole-frame renderer of a model, with its intermediate results cached."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.runtime import events
from nerfies_jax.training.model import (
    Model,
    Rendering,
    Surveyed,
    TrainState,
    View,
)


class Renderer:
    """Whole-frame renderer of a model, compiled once for each shape of its state.

    If the model renders in stages, results are reused: those of the first stage as long
    as the parameters are the very same arrays, and those of the second for all views of
    the same timestamp. A survey is kept with the parameters, too.
    """

    def __init__(self, model: Model, size: tuple[int, int]):
        self._model = model
        self._programs: dict[tuple, Any] = {}
        self._prepared = _Memo()
        self._deformed = _Memo()
        self.size = size  # width and height in pixels
        self.seconds: list[float] = []  # of every frame, without compiling
        self.cpu_seconds: list[float] = []  # the same, of the processor
        self.deformed_anew: list[bool] = []  # whether its instant was a new one

    def __call__(self, state: TrainState, view: View | tuple) -> Rendering:
        """Render one view, or the tuple that a variant renders in place of a view."""
        programs, inputs = self.compiled(state, view), _inputs(state, view)
        start, cpu_start = time.perf_counter(), time.process_time()
        rendering, anew = self._draw(programs, *inputs)
        rendering = jax.device_get(rendering)
        self.seconds.append(time.perf_counter() - start)
        self.cpu_seconds.append(time.process_time() - cpu_start)
        self.deformed_anew.append(anew)
        return rendering

    def compiled(self, state: TrainState, view: View | tuple) -> Any:
        """Return the compiled programs for a state and a view, compiling on first use.

        Args:
          state: Training state, of which parameters and step are read.
          view: The view to render, of which only the shapes matter.

        Returns:
          The compiled stages of the model.
        """
        inputs = _inputs(state, view)
        shapes = tuple(jax.typeof(leaf) for leaf in jax.tree.leaves(inputs))
        if shapes not in self._programs:
            with events.stage("compiling the renderer"):
                self._programs[shapes] = _compiled(self._model, self.size, inputs)
        return self._programs[shapes]

    def _draw(self, programs, params, view, step):
        """Return the image, and whether the scene had to be deformed anew for it."""
        if isinstance(programs, Surveyed):
            known, _ = self._prepared.get(
                params,
                np.asarray(step).tobytes(),
                lambda: programs.survey(params, step),
            )
            return programs.draw(params, known, view, step), True
        if self._model.stages is None:
            return programs(params, view, step), True
        prepared, _ = self._prepared.get(params, None, lambda: programs.prepare(params))
        instant = np.asarray(view.time).tobytes()
        deformed, anew = self._deformed.get(
            params, instant, lambda: programs.deform(params, prepared, view.time)
        )
        return programs.draw(params, deformed, view, step), anew

    def ms_per_frame(self, frames: int, cpu: bool = False) -> float:
        """Return the median time of the last frames in milliseconds.

        Frames at a new timestamp and further views of the same timestamp have separate
        medians, which are weighted by their counts. One median of all would leave out
        the deformation as soon as a second view shares it.

        Args:
          frames: Number of frames, counted from the last.
          cpu: True for processor time, False for wall time.

        Returns:
          Milliseconds per frame.
        """
        seconds = np.asarray((self.cpu_seconds if cpu else self.seconds)[-frames:])
        anew = np.asarray(self.deformed_anew[-frames:])
        parts = [seconds[anew], seconds[~anew]]
        total = sum(len(part) * np.median(part) for part in parts if len(part))
        return 1e3 * float(total) / len(seconds)


class _Memo:
    """The last result of a function of parameters and a key.

    It is valid as long as every leaf is the very same array. The leaves are held, so
    that no new array can be mistaken for an old one. NumPy arrays are mutable, so
    nothing is kept for parameters that contain one.
    """

    def __init__(self):
        self._leaves, self._key, self._result = None, None, None

    def get(self, params, key, compute):
        """The result, and whether it was computed now."""
        leaves, structure = jax.tree.flatten(params)
        if (
            self._leaves is not None
            and self._key == (key, structure)
            and all(a is b for a, b in zip(leaves, self._leaves, strict=True))
        ):
            return self._result, False
        self._leaves = self._result = None  # freed before the new one is made
        result = compute()
        if all(isinstance(leaf, jax.Array) for leaf in leaves):
            self._leaves, self._key, self._result = leaves, (key, structure), result
        return result, True


class _Programs(NamedTuple):
    """Compiled stages of a model."""

    prepare: Callable
    deform: Callable
    draw: Callable


def _float32(rendering):
    """Convert a rendering to float32, whatever precision it was computed in."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), rendering)


def _inputs(state, view):
    return state.params, view, state.step


def _compiled(model, size, inputs):
    if model.surveyed is not None:
        return _surveyed(model, size, inputs)
    return (_whole if model.stages is None else _staged)(model, size, inputs)


def _surveyed(model, size, inputs):
    params, view, step = inputs

    def draw(params, known, view, step):
        return _float32(model.surveyed.draw(params, known, view, size, step))

    survey = jax.jit(model.surveyed.survey).lower(params, step)
    drawn = jax.jit(draw).lower(params, survey.out_info, view, step)
    return Surveyed(*_all_compiled(model, survey, drawn))


def _whole(model, size, inputs):
    def render(params, view, step):
        return _float32(model.render(params, view, size, step))

    return jax.jit(render).lower(*inputs).compile(model.compiler_options)


def _staged(model, size, inputs):
    stages, (params, view, step) = model.stages, inputs

    def draw(params, deformed, view, step):
        return _float32(stages.draw(params, deformed, view, size, step))

    prepare = jax.jit(stages.prepare).lower(params)
    deform = jax.jit(stages.deform).lower(params, prepare.out_info, view.time)
    drawn = jax.jit(draw).lower(params, deform.out_info, view, step)
    return _Programs(*_all_compiled(model, prepare, deform, drawn))


def _all_compiled(model, *lowered):
    return [program.compile(model.compiler_options) for program in lowered]


def as_picture(color: np.ndarray) -> np.ndarray:
    """Convert colors to 8 bits.

    Args:
      color: Colors in [0, 1], of any shape. Values outside are clipped.

    Returns:
      uint8 values of the same shape.
    """
    return np.round(np.clip(color, 0, 1) * 255).astype(np.uint8)
