"""Rendering of a camera path to numbered images and a video, one image at a time."""

import pathlib
from collections.abc import Iterator, Sequence

import numpy as np

from nerfies_jax.capture import images, video
from nerfies_jax.capture.extras import MissingExtra
from nerfies_jax.capture.json_files import replaced_folder
from nerfies_jax.evaluation import Renderer, to_uint8
from nerfies_jax.training.model import TrainState, View

VIDEO = "video.mp4"


def render(
    out: pathlib.Path,
    renderer: Renderer,
    state: TrainState,
    views: Sequence[View],
    rate: float,
) -> Iterator[int]:
    """Render views into a new folder, yielding after each image.

    The folder is written completely or not at all. No video is written if the extra
    `video` is not installed.

    Args:
      out: The folder.
      renderer: Renderer of the model, at the size of the images.
      state: The trained state.
      views: The view of each image.
      rate: Frames per second of the video.

    Yields:
      The number of images written.
    """
    with replaced_folder(out) as folder:
        paths = [folder / f"{number:04d}.png" for number in range(len(views))]
        for number, (path, view) in enumerate(zip(paths, views, strict=True), 1):
            images.write_png(path, to_uint8(np.asarray(renderer(state, view).color)))
            yield number
        try:
            video.library()
        except MissingExtra:
            return
        frames = (images.read_pixels(path) for path in paths)
        video.write_video(folder / VIDEO, frames, rate)
