"""Depth of other tools is aligned to the scene and to what moves."""

import functools

import numpy as np
import OpenEXR
import PIL.Image
import pytest

from nerfies_jax.preprocessing import (
    external_bodies,
    external_depth,
    paths,
    record,
    view_set,
)
from nerfies_jax.preprocessing.static_points import StaticPoints
from nerfies_jax.preprocessing.tracks import Tracks, pixel_of
from tests.preprocessing import two_planes
from tests.preprocessing.test_external import with_files
from tests.preprocessing.test_summary import card_points
from tests.preprocessing.test_tracks import MOVES, gathered


@pytest.mark.parametrize("inverse", [False, True])
def test_depths_of_any_scale_are_brought_to_the_points_at_rest(inverse):
    rng = np.random.default_rng(0)
    true = np.float32(rng.uniform(1, 4, (3, 20, 30)))
    external = 5 / true + 0.4 if inverse else 7 * true - 2
    external[:, :2] = np.nan
    pixel = np.float32(rng.uniform(0, (30, 20), (80, 1, 2)).repeat(3, 1))
    tracks = Tracks(np.zeros(80, int), pixel, np.ones((80, 3), bool))
    row, column = pixel_of(pixel, true.shape[1:])
    depth = true[np.arange(3), row, column].astype(float)
    depth[:8] *= 3  # points that are wrong
    rest = StaticPoints(None, None, depth)
    aligned = external_depth.aligned(external, tracks, rest)
    # The penalty of the offset is what is left.
    np.testing.assert_allclose(aligned.depth[:, 2:], true[:, 2:], rtol=0.03)
    assert np.isnan(aligned.depth[:, :2]).all()
    assert aligned.total_miss < 0.01
    assert (aligned.deviation(0.03) == 0.03).all()
    # The other kind, if it is asked for, fits worse.
    other = external_depth.aligned(external, tracks, rest, not inverse)
    assert other.total_miss > 5 * aligned.total_miss
    noise = np.float32(rng.uniform(1, 4, true.shape))
    worse = external_depth.aligned(noise, tracks, rest)
    assert worse.total_miss > external_depth.DOUBTFUL


def test_depth_that_tilts_over_the_image_is_straightened():
    rng = np.random.default_rng(0)
    shape = (2, 20, 30)
    true = np.float32(rng.uniform(1, 4, shape))
    x = np.linspace(-1, 1, 30)
    external = 5 / true + 0.4 + 0.5 * x  # a tilt of inverse depth
    pixel = np.float32(rng.uniform(0, (30, 20), (200, 1, 2)).repeat(2, 1))
    tracks = Tracks(np.zeros(200, int), pixel, np.ones((200, 2), bool))
    row, column = pixel_of(pixel, shape[1:])
    depth = true[np.arange(2), row, column].astype(float)
    aligned = external_depth.aligned(external, tracks, StaticPoints(None, None, depth))
    assert np.median(abs(aligned.depth / true - 1)) < 0.01  # 0.05 without the tilt
    assert aligned.total_miss < 0.01


@functools.cache
def card_and_wall():
    """Tracks of a card and of a wall, from truth, with the exact paths of the card."""
    capture, evidence = gathered()
    views = view_set.in_time_order(record.downscale(capture, evidence.factor))
    points = card_points(capture, evidence.row)
    start = points.visible.argmax(1)
    card = Tracks(start, np.float32(points.pixel), points.visible)
    still = evidence.score < 0.3
    static = evidence.tracks.take(still), evidence.static_fit.take(still)
    return views, card, paths.certain(views, card, points.position, 0.01), static


@pytest.mark.parametrize("certain", [True, False])
def test_a_body_whose_depth_is_off_gets_one_factor(certain):
    views, card, exact, static = card_and_wall()
    deviation = np.full(len(card.visible), 0.02 if certain else np.inf)
    alone = exact._replace(depth_deviation=deviation)
    measured = np.where(card.visible, 0.8 * exact.depth, np.nan)
    bodies = external_bodies.scaled(views, card, measured, alone, *static, 0.05)
    if certain:
        np.testing.assert_allclose(bodies.factor, 1.25, rtol=0.04)
        assert (bodies.deviation < 0.04).all()
    else:  # then the external depth is all that is known
        np.testing.assert_allclose(bodies.factor, 1)
        assert (bodies.deviation >= 0.1).all()


def test_a_body_is_in_front_of_what_it_hides():
    views, card, exact, static = card_and_wall()
    alone = exact._replace(depth_deviation=np.full(len(card.visible), np.inf))
    measured = np.where(card.visible, 2.5 * exact.depth, np.nan)  # behind the wall
    bodies = external_bodies.scaled(views, card, measured, alone, *static, 0.05)
    assert np.nanmedian(bodies.depth) < 1.05 * two_planes.FAR


@pytest.mark.full
def test_depth_that_hardly_fits_is_used_with_a_warning(tmp_path, capsys):
    video = two_planes.make(**MOVES, frames=24)
    rng = np.random.default_rng(0)
    # Errors that are independent from pixel to pixel, as no correction can remove.
    noise = np.exp(rng.normal(0, 0.25, video.depths.shape))
    np.savez(tmp_path / "d.npz", depths=video.depths * noise)
    capture = with_files(video, depths=tmp_path / "d.npz")
    for _ in range(2):  # from the cache too
        record._told_of.clear()
        evidence = record.cached(capture, tmp_path / "cache")
        assert external_depth.DOUBTFUL < evidence.depth_miss < external_depth.USABLE
        words = " ".join(capsys.readouterr().err.split())
        assert "differ from the static points by" in words
    assert record.notes_on(capture, tmp_path / "cache")
    assert len(evidence.paths.known)


@pytest.mark.full
def test_paths_lean_on_depths_given(tmp_path):
    capture, folders = two_planes.make(**MOVES, frames=24), {}
    for kind in ("exr", "png"):
        folders[kind] = tmp_path / kind
        folders[kind].mkdir()
        for row, name in enumerate(capture.ids):
            depth = (7 + 0.1 * row) * capture.depths[row]
            path = folders[kind] / f"{name}.{kind}"
            if kind == "exr":
                OpenEXR.File({}, {"Z": depth}).write(str(path))
            else:  # as depth cameras write it: millimeters, far below 16 bits
                stored = np.round(100 * depth).astype(np.uint16)
                PIL.Image.fromarray(stored).save(path)
    captures_of = {kind: with_files(capture, depths=folders[kind]) for kind in folders}
    exr, png = (captures_of[kind].external.depth for kind in folders)
    np.testing.assert_allclose(png / png.max(), exr / exr.max(), atol=1e-3)
    evidence = record.gather(captures_of["png"])
    own = gathered()[1]
    off, without = (
        np.abs(one.paths.depth[one.paths.known] - two_planes.NEAR).mean()
        for one in (evidence, own)
    )
    assert off < 0.5 * without
