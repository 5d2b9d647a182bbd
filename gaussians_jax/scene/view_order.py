"""Order in which the steps of splats visit the training frames."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Int, Key

from nerfies_jax.training.model import Frames

ORDER = 2**32 - 1  # stream of the run's PRNG key, like those in `growth`


def shuffled_row(
    key: Key[Array, ""], step: Int[Array, ""], frames: int
) -> Int[Array, ""]:
    """Choose the frame of a step. Each epoch visits all frames once, in a new order.

    Args:
      key: PRNG key of the run.
      step: Number of frames visited so far.
      frames: Number of frames.

    Returns:
      Index of the frame.
    """
    epoch = jax.random.fold_in(jax.random.fold_in(key, ORDER), step // frames)
    return jax.random.permutation(epoch, frames)[step % frames]


def row_of_view(
    key: Key[Array, ""],
    step: Int[Array, ""],
    view: int | Int[Array, ""],
    views: int,
    frames: int,
) -> Int[Array, ""]:
    """Choose the frame of a view of a step.

    Args:
      key: PRNG key of the run.
      step: Number of completed steps.
      view: Index of the view in the step.
      views: Number of views per step.
      frames: Number of frames.

    Returns:
      Index of the frame.
    """
    return shuffled_row(key, step * views + view, frames)


def reader(views: int) -> Callable[[Any, Any, Frames], tuple[Int[Array, " views"]]]:
    """Return the function `Model.reads` of a scene of splats.

    Args:
      views: Number of views per step.

    Returns:
      The function, of the key, the number of completed steps and the frames.
    """

    def read(key, step, frames):
        choose = jax.vmap(row_of_view, (None, None, 0, None, None))
        each = np.arange(views, dtype=np.int32)
        return (choose(key, step, each, views, len(frames.times)),)

    return read
