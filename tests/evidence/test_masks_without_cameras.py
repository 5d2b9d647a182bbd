"""Masks for structure from motion, from pictures alone."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax.capture import images, synthetic
from nerfies_jax.evidence import masks_without_cameras


@pytest.mark.slow
def test_a_folder_gets_masks_that_are_black_on_what_moves(tmp_path):
    small = dataclasses.replace(
        synthetic.PRESETS["default"], size=(112, 84), frames=40, heldout_every=20
    )
    capture, _ = synthetic.make(small, seed=5)
    rows = capture.train
    film, masks = tmp_path / "film", tmp_path / "masks"
    film.mkdir()
    for row in rows:
        images.write_png(film / f"{row:03d}.png", capture.images[row])
    share = masks_without_cameras.write_masks(film, masks)
    read = [images.read_mask(masks / f"{row:03d}.png.png") for row in rows]
    masked, true = ~np.stack(read), capture.moving[rows]
    assert share == pytest.approx(masked.mean())
    assert true.mean() > 0.15
    assert masked[true].mean() > 0.5
    assert (~masked[~true]).mean() > 0.85


def test_too_few_pictures_say_how_many_it_takes(tmp_path):
    with pytest.raises(ValueError, match="0 pictures; what moves shows in more than 6"):
        masks_without_cameras.write_masks(tmp_path, tmp_path / "masks")
