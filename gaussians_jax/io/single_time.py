"""A trained scene at single times, as Gaussians or as raw parameters for static files.

Means, rotations and scales are those of the time. Spherical harmonics are as trained
and do not rotate with the Gaussians, because `rendering` evaluates them in world
directions. A viewer therefore shows what this package renders.
"""

import math
import os
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.io import files
from nerfies_jax.capture import units
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.json_files import alike, replaced_folder
from nerfies_jax.runtime import events
from nerfies_jax.training import programs
from nerfies_jax.training.model import Model, TrainState

# Function from a time in [0, 1] to Gaussians.
At = Callable[[float], Gaussians]
MOST_STEP_PX = 0.1  # largest rounding error of float32 coordinates
NUMBERED = "frame_{:04d}"  # viewers play files whose names differ in a number only


def _check_time(time: float) -> None:
    """Refuse a time outside the capture."""
    if not 0 <= time <= 1:
        raise ValueError(f"time={time:g} must lie in [0, 1]")


def gaussians_at(model: Model, state: TrainState) -> At:
    """Return a function from normalized time to all Gaussians.

    Everything that does not depend on time is computed once, in this call.

    Args:
      model: The model.
      state: Its trained state.

    Returns:
      A host function of a time in [0, 1].

    Raises:
      ValueError: If the model is not a scene of Gaussians.
    """
    if model.stages is None:
        raise ValueError(
            "Gaussian files need a run of Gaussians; a radiance field has none, so "
            "export its cameras, images or tracks"
        )
    deform = programs.deformer(model)(state.params)
    dtype = state.params.rows["splats"].mean.dtype

    def at(time: float) -> Gaussians:
        _check_time(time)
        return deform(np.asarray(time, dtype))

    return at


def splats_at(model: Model, state: TrainState) -> Callable[[float], Splats]:
    """Return a function from normalized time to raw parameters, for files.

    The active Gaussians and their order are the same at all times.

    Args:
      model: The model.
      state: Its trained state.

    Returns:
      A host function of a time in [0, 1].
    """
    deformed_at, as_rows = gaussians_at(model, state), jax.jit(_as_rows)
    rows = written_rows(model, state)
    return lambda time: as_rows(rows, deformed_at(time))


def written_rows(model: Model, state: TrainState) -> Splats:
    """Return the raw parameters of the Gaussians that a file holds.

    Args:
      model: The model.
      state: Trained state.

    Returns:
      Raw parameters.
    """
    assert model.stages is not None
    assert model.stages.rows is not None
    return model.stages.rows(state.params)


def _as_rows(rows: Splats, gaussians: Gaussians) -> Splats:
    """Invert the activations of the deformed Gaussians."""
    canonical = splats.activate(rows)
    # Values that the motion does not change keep their trained parameters. The logit of
    # an opacity that rounds to 1 would be infinite, and that of 0 marks an inactive
    # Gaussian, which no motion changes.
    eps = jnp.finfo(gaussians.opacity.dtype).eps
    opacity = jnp.clip(gaussians.opacity, jnp.finfo(eps.dtype).tiny, 1 - eps)
    logit = jnp.log(opacity) - jnp.log1p(-opacity)
    smallest = math.exp(splats.LOG_SCALE_RANGE[0])
    # A linear scale rule may make scales negative, and rendering squares them.
    log_scale = jnp.log(jnp.maximum(jnp.abs(gaussians.scale), smallest))
    keeps_opacity = (gaussians.opacity == canonical.opacity) | ~splats.active_mask(rows)
    return rows._replace(
        mean=gaussians.mean,
        quaternion=gaussians.quaternion,
        log_scale=jnp.where(
            gaussians.scale == canonical.scale, rows.log_scale, log_scale
        ),
        opacity_logit=jnp.where(keeps_opacity, rows.opacity_logit, logit),
    )


def in_world(rows: Splats, capture: Capture) -> Splats:
    """Convert raw parameters to the units of the capture's files, on the host.

    A uniform scale changes no direction, so rotations and harmonics stay the same.

    Args:
      rows: Raw parameters in scene units.
      capture: The capture, whose scale is inverted.

    Returns:
      Raw parameters in world units.

    Raises:
      ValueError: If world coordinates are so large, like map coordinates, that float32
        would move Gaussians visibly.
    """
    mean = units.places_in("world", capture, np.asarray(rows.mean))
    step = units.float32_step(mean)
    step_px = units.in_pixels(capture, step * capture.scale)
    if step_px > MOST_STEP_PX:
        origin = ", ".join(f"{coordinate:.9g}" for coordinate in capture.center)
        raise ValueError(
            f"world coordinates reach {np.abs(mean).max():.4g}, where float32 has "
            f"steps of {step:.2g}, which are {step_px:.2g} pixels of this capture (at "
            f"most {MOST_STEP_PX}); write scene units instead, where world = scene * "
            f"{1 / capture.scale:.6g} + ({origin})"
        )
    log_scale = np.asarray(rows.log_scale, np.float64) - math.log(capture.scale)
    return rows._replace(
        mean=jnp.asarray(mean, rows.mean.dtype),
        log_scale=jnp.asarray(log_scale, rows.mean.dtype),
    )


def save_sequence(
    folder: str | os.PathLike,
    at: Callable[[float], Splats],
    count: int,
    suffix: str,
    save: Callable[[pathlib.Path, Splats], int] = files.save,
    *,
    overwrite: bool = False,
) -> np.ndarray:
    """Write numbered files of evenly spaced times, including 0 and 1.

    The folder is written completely or not at all.

    Args:
      folder: Folder to write.
      at: Function from time to raw parameters (`splats_at`).
      count: Number of files.
      suffix: File format, such as ".ply".
      save: Writes a file of raw parameters.
      overwrite: Replace an existing folder.

    Returns:
      The times.

    Raises:
      ValueError: If `count` is less than two.
    """
    if count < 2:
        raise ValueError(
            f"count={count} is not a sequence; use at least 2, or export a single time"
        )
    times = np.linspace(0, 1, count)
    names = [NUMBERED.format(number) + suffix for number in range(count)]
    stage = events.stage("writing Gaussians", count)
    with (
        replaced_folder(folder, overwrite, alike(folder, names)) as partial,
        stage as s,
    ):
        for name, time in zip(names, times, strict=True):
            save(partial / name, at(float(time)))
            s.advance()
    return times
