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


def reader(views: int) -> Callable[[Any, Any, Frames], tuple[Int[Array, " views"]]]:
    """Return the function `Model.reads` of a scene of splats.

    Args:
      views: Number of views per step.

    Returns:
      The function, of the key, the number of completed steps and the frames.
    """

    def read(key, step, frames):
        visits = step * views + np.arange(views, dtype=np.int32)
        choose = jax.vmap(shuffled_row, (None, 0, None))
        return (choose(key, visits, len(frames.times)),)

    return read
