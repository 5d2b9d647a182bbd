"""Captures in coordinates of a map, millions of meters, keep their precision."""

import dataclasses
import functools

import numpy as np
import pytest

from nerfies_jax.capture import (
    colmap_writer,
    formats,
    nerfies_format,
    transforms_writer,
    world_points,
)
from tests.capture.test_camera_files import SIZE, hand_made

UTM = (500_000.123, 4_649_776.456, 120.789)
WRITERS = {
    "transforms": functools.partial(transforms_writer.write, units="world"),
    "colmap": functools.partial(colmap_writer.write, units="world"),
    "nerfies": nerfies_format.write,
}


def pixels(capture, world):
    place = (world - np.array(capture.center)) * capture.scale
    return {
        name.removeprefix("images_"): world_points.pixels_of(
            capture.cameras, row, place.astype(np.float32), SIZE
        )[0]
        for row, name in enumerate(capture.ids)
    }


@pytest.mark.parametrize("kind", WRITERS)
def test_an_export_comes_back_within_a_thousandth_of_a_pixel(kind, tmp_path):
    capture = dataclasses.replace(hand_made(False, frames=20), center=UTM)
    WRITERS[kind](capture, tmp_path / "out")
    read = formats.load(tmp_path / "out")
    points = np.float64(capture.points.position)
    world = points / capture.scale + np.array(UTM)
    before, after = pixels(capture, world), pixels(read, world)
    assert before.keys() == after.keys()
    for name, pixel in before.items():
        np.testing.assert_allclose(after[name], pixel, atol=1e-3)
    back = np.float64(read.points.position) / read.scale + np.array(read.center)
    off = np.abs(back[:, None] - world).max(-1).min(1)  # COLMAP's have another order
    assert off.max() < 1e-5
