"""Compiled whole-frame renderer of a model, which caches intermediate results."""

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.runtime import events
from nerfies_jax.training import programs
from nerfies_jax.training.model import (
    Model,
    Rendering,
    Stages,
    Surveyed,
    TrainState,
    View,
)


class Renderer:
    """Whole-frame renderer of a model, compiled once for each shape of its state.

    If the model renders in stages, results are cached: those of the first stage and of
    a survey as long as the parameters are identical arrays, and those of the second
    stage for all views at the same timestamp.

    Args:
      model: The model.
      size: Width and height of the images in pixels.

    Attributes:
      size: Width and height of the images in pixels.
      seconds: Wall time of each frame, without compilation.
      cpu_seconds: Processor time of each frame, without compilation.
      newly_deformed: For each frame, whether the scene had to be deformed for it.
    """

    def __init__(self, model: Model, size: tuple[int, int]):
        self._model = model
        self._programs: dict[tuple, Any] = {}
        self._prepared = _Memo()
        self._deformed = _Memo()
        self.size = size
        self.seconds: list[float] = []
        self.cpu_seconds: list[float] = []
        self.newly_deformed: list[bool] = []

    def __call__(self, state: TrainState, view: View | tuple) -> Rendering:
        """Render one view, or the tuple that a variant renders in place of a view."""
        programs, inputs = self.compiled(state, view), _inputs(state, view)
        start, cpu_start = time.perf_counter(), time.process_time()
        rendering, is_new = self._draw(programs, *inputs)
        rendering = jax.device_get(rendering)
        self.seconds.append(time.perf_counter() - start)
        self.cpu_seconds.append(time.process_time() - cpu_start)
        self.newly_deformed.append(is_new)
        return rendering

    def compiled(self, state: TrainState, view: View | tuple) -> Any:
        """Return the compiled programs for a state and a view, compiling on first use.

        Args:
          state: Training state. Only its parameters and step are used.
          view: The view to render. Only its shapes are used.

        Returns:
          The compiled stages of the model.
        """
        inputs = _inputs(state, view)
        shapes = tuple(jax.typeof(leaf) for leaf in jax.tree.leaves(inputs))
        if shapes not in self._programs:
            with events.stage("compiling the renderer"):
                self._programs[shapes] = _compile(self._model, self.size, inputs)
        return self._programs[shapes]

    def _draw(self, programs, params, view, step):
        """Return the image, and whether the scene had to be deformed for it."""
        if isinstance(programs, Surveyed):
            survey, _ = self._prepared.get(
                params,
                np.asarray(step).tobytes(),
                lambda: programs.survey(params, step),
            )
            return programs.draw(params, survey, view, step), True
        if self._model.stages is None:
            return programs(params, view, step), True
        preparation, _ = self._prepared.get(
            params, None, lambda: programs.prepare(params)
        )
        timestamp = np.asarray(view.time).tobytes()
        deformation, is_new = self._deformed.get(
            params, timestamp, lambda: programs.deform(params, preparation, view.time)
        )
        return programs.draw(params, deformation, view, step), is_new

    def ms_per_frame(self, frames: int, cpu: bool = False) -> float:
        """Return the median time of the last frames in milliseconds.

        Frames at a new timestamp and further views at the same timestamp have separate
        medians, which are weighted by their counts. A single median would ignore the
        time of the deformation if most frames share it with another view.

        Args:
          frames: Number of frames, counted from the last.
          cpu: True for processor time, False for wall time.

        Returns:
          Milliseconds per frame.
        """
        seconds = np.asarray((self.cpu_seconds if cpu else self.seconds)[-frames:])
        is_new = np.asarray(self.newly_deformed[-frames:])
        parts = [seconds[is_new], seconds[~is_new]]
        total = sum(len(part) * np.median(part) for part in parts if len(part))
        return 1e3 * float(total) / len(seconds)


class _Memo:
    """Cache of the last result of a function of parameters and a key.

    The result is valid as long as every leaf is the identical array. References to the
    leaves are kept, so that no new array can reuse the identity of an old one. Nothing
    is cached for parameters that contain NumPy arrays, because these are mutable.
    """

    def __init__(self):
        self._leaves, self._key, self._result = None, None, None

    def get(self, params, key, compute):
        """Return the result, and whether it is new."""
        leaves, structure = jax.tree.flatten(params)
        if (
            self._leaves is not None
            and self._key == (key, structure)
            and all(a is b for a, b in zip(leaves, self._leaves, strict=True))
        ):
            return self._result, False
        self._leaves = self._result = None  # free memory before computing a new result
        result = compute()
        if all(isinstance(leaf, jax.Array) for leaf in leaves):
            self._leaves, self._key, self._result = leaves, (key, structure), result
        return result, True


def _float32(rendering):
    """Convert a rendering to float32 from any precision."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), rendering)


def _inputs(state, view):
    return state.params, view, state.step


def _compile(model, size, inputs):
    if model.surveyed is not None:
        return _compile_surveyed(model, size, inputs)
    if model.stages is not None:
        return _compile_stages(model, size, inputs)
    return _compile_render(model, size, inputs)


def _compile_surveyed(model, size, inputs):
    params, view, step = inputs

    def survey(model, params, step):
        return model.surveyed.survey(params, step)

    def draw(model, params, survey_output, view, step):
        return _float32(model.surveyed.draw(params, survey_output, view, size, step))

    lowered_survey = programs.Program(survey, model).lower(params, step)
    lowered_draw = programs.Program(draw, model).lower(
        params, lowered_survey.out_info, view, step
    )
    return Surveyed(*_compile_all(model, lowered_survey, lowered_draw))


def _compile_render(model, size, inputs):
    def render(model, params, view, step):
        return _float32(model.render(params, view, size, step))

    (program,) = _compile_all(model, programs.Program(render, model).lower(*inputs))
    return program


def _compile_stages(model, size, inputs):
    params, view, step = inputs

    def draw(model, params, deformation, view, step):
        return _float32(model.stages.draw(params, deformation, view, size, step))

    lowered_prepare = programs.Program(programs.prepare, model).lower(params)
    lowered_deform = programs.Program(programs.deform, model).lower(
        params, lowered_prepare.out_info, view.time
    )
    lowered_draw = programs.Program(draw, model).lower(
        params, lowered_deform.out_info, view, step
    )
    return Stages(*_compile_all(model, lowered_prepare, lowered_deform, lowered_draw))


def _compile_all(model, *lowered):
    return [
        functools.partial(program.compile(model.compiler_options), model.numbers)
        for program in lowered
    ]


def to_uint8(color: np.ndarray) -> np.ndarray:
    """Convert colors to 8 bits.

    Args:
      color: Colors in [0, 1], of any shape. Values outside are clipped.

    Returns:
      uint8 values of the same shape.
    """
    return np.round(np.clip(color, 0, 1) * 255).astype(np.uint8)
