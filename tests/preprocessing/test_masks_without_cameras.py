"""Masks for structure from motion, from images alone."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax.capture import images, synthetic
from nerfies_jax.preprocessing import masks_without_cameras


@pytest.mark.slow
def test_what_moves_is_found_in_a_folder_of_images(tmp_path):
    small = dataclasses.replace(
        synthetic.PRESETS["default"], size=(112, 84), frames=40, heldout_every=20
    )
    capture, _ = synthetic.make(small, seed=5)
    rows = capture.train
    folder = tmp_path / "images"
    folder.mkdir()
    for row in rows:
        images.write_png(folder / f"{row:03d}.png", capture.images[row])
    actual = masks_without_cameras.moving_in(folder)
    assert list(actual) == [f"{row:03d}.png" for row in rows]
    masked, true = np.stack(list(actual.values())), capture.moving[rows]
    assert true.mean() > 0.15
    assert masked[true].mean() > 0.5
    assert (~masked[~true]).mean() > 0.85


def test_too_few_images_say_how_many_it_takes(tmp_path):
    with pytest.raises(ValueError, match=r"0 images are too few .* more than 6"):
        masks_without_cameras.moving_in(tmp_path)
