"""Hostile captures, and what every run must hold to however it starts.

Every change of the frames keeps their shapes, so that the program which is compiled for
a model once serves all of them; changes are made in NumPy, which compiles nothing.
`frames_of` gives frames that have every array which a change may want to fill.
"""

import contextlib
import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import rich.console

from nerfies_jax import evaluation
from nerfies_jax.training import checkpoint, loop
from nerfies_jax.training.checkpoint import Checkpoints
from nerfies_jax.training.loop import FitResult

QUIET = rich.console.Console(quiet=True)
BAD_STEP = re.compile(r"is not finite: (metric|params\.|optimizer\.|aux_state\.)")


def frames_of(capture, required_data=frozenset()):
    """The training frames in NumPy, masked; the mask may leave every pixel."""
    frames = jax.tree.map(np.asarray, evaluation.frames_of(capture, required_data))
    if frames.valid is None:
        frames = frames._replace(valid=np.ones(frames.images.shape[:3], bool))
    return frames


def _first(frames, *names):
    """The given arrays (a camera counts as one) with the first row in every place."""

    def repeat(leaf):
        return np.broadcast_to(leaf[:1], leaf.shape)

    return frames._replace(
        **{name: jax.tree.map(repeat, getattr(frames, name)) for name in names}
    )


def duplicated(frames):
    """One frame again and again: image, camera, time and codes."""
    names = [
        name
        for name in ("images", "cameras", "times", "appearance", "depths")
        if getattr(frames, name) is not None
    ]
    return _first(frames, *names)


def two_views(frames):
    """The first and the last frame by turns, in place of all."""
    rows = np.arange(len(frames.times)) % 2 * (len(frames.times) - 1)
    beside = dict(points=None, flow=None)
    selected = jax.tree.map(lambda leaf: leaf[rows], frames._replace(**beside))
    return selected._replace(points=frames.points, flow=frames.flow)


def unobserved(frames):
    """A frame without a valid pixel, and one whose left half was not observed."""
    half = frames.images.shape[2] // 2
    valid = frames.valid.copy()
    valid[0], valid[1, :, :half] = False, False
    return frames._replace(valid=valid)


def with_depths(value):
    """All depths that value, where the frames have depths at all."""

    def change(frames):
        if frames.depths is None:
            return frames
        return frames._replace(depths=np.full_like(frames.depths, value))

    return change


def unobserved_depth_nan(frames):
    """The left half of one frame not observed, its depth not a number."""
    half = frames.images.shape[2] // 2
    valid = frames.valid.copy()
    valid[1, :, :half] = False
    if frames.depths is None:
        return frames._replace(valid=valid)
    depths = frames.depths.copy()
    depths[1, :, :half] = np.nan
    return frames._replace(valid=valid, depths=depths)


CAPTURES = {
    "as recorded": lambda frames: frames,
    "black images": lambda frames: frames._replace(images=0 * frames.images),
    "one instant": lambda frames: _first(frames, "times"),
    "duplicated frames": duplicated,
    "two views": two_views,
    "unobserved frames": unobserved,
    "no depth known": with_depths(0.0),
    "constant depth": with_depths(2.0),
    "unobserved depth not a number": unobserved_depth_nan,
}


def sped_up(old, new, speed):
    """Parameters that moved so many times as far: all learning rates times `speed`."""
    return jax.tree.map(
        lambda before, after: before + speed * (after - before), old, new
    )


def on_device(tree):
    """Placed alike, whatever made them, so that all share one program."""
    return jax.device_put(tree, jax.devices()[0])


class Trained(NamedTuple):
    """How a run from a hostile start ended."""

    result: FitResult
    first: dict[str, float]  # metrics of the first step
    last: dict[str, float]  # mean metrics of the last chunk


def train(model, start, frames, folder=None, *, steps) -> Trained:
    """Fit, and hold the run to what every run promises.

    It completes its steps, or it stops with a message that names what went bad; either
    way nothing it returns, has written down or has on disk is not finite. Without a
    folder it writes no checkpoint, which takes as long as the run.
    """
    keep = contextlib.nullcontext()
    if folder is not None:
        keep = Checkpoints(folder, model.spec, keep=1000)
    with keep as checkpoints:
        result = loop.fit(
            model,
            start,
            frames,
            steps=steps,
            checkpoints=checkpoints,
            checkpoint_seconds=0.5,
            console=QUIET,
        )
    assert result.stopped_by in ("steps", "non-finite"), result.message
    if result.stopped_by == "non-finite":
        assert BAD_STEP.search(result.message), result.message
        assert result.steps < steps
    assert not not_finite(result.state), result.message
    for row in result.history.rows:
        assert np.isfinite(list(row.values())).all(), row
    if folder is not None:
        assert_checkpoints_finite(folder, model, result)
    rows = result.history.rows or ({},)
    return Trained(result, rows[0], rows[-1])


def assert_checkpoints_finite(folder, model, result):
    """Every checkpoint comes back whole and finite; the newest is what was returned."""
    saved = checkpoint.steps(folder)
    assert saved[-1] == result.steps
    for step in saved:
        restored = checkpoint.restore(folder, result.state, model.spec, step=step)
        assert not not_finite(restored.state), (step, not_finite(restored.state))
    newest, returned = map(numbers, (restored.state, result.state))
    assert newest.keys() == returned.keys()
    for name, array in newest.items():
        np.testing.assert_array_equal(array, returned[name], err_msg=name)


def numbers(tree):
    """The floating arrays of a pytree as NumPy ones, by their paths."""
    return {
        jax.tree_util.keystr(path): np.asarray(leaf)
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
        if jnp.issubdtype(leaf.dtype, jnp.inexact)
    }


def not_finite(tree):
    """Paths of the floating arrays that hold anything but finite numbers."""
    return [name for name, x in numbers(tree).items() if not np.isfinite(x).all()]
