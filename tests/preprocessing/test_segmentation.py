"""Masks of what moves, and the tracks that begin on them."""

import numpy as np

from nerfies_jax.preprocessing import (
    record,
    segmentation,
    static_points,
    tracks,
    view_set,
)
from nerfies_jax.preprocessing.short_tracks import USUAL
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.watch import ENOUGH_WORK, Watch
from tests.preprocessing.test_tracks import gathered


def half_lost():
    """Tracks of a grid without those on the lower half of the card, and that half."""
    capture, evidence = gathered()
    true = capture.moving[evidence.row]
    lower = true.copy()
    for frame, mask in enumerate(true):
        rows = np.flatnonzero(mask.any(1))
        lower[frame, : rows[len(rows) // 2]] = False
    row, column = tracks.pixel_of(evidence.tracks.pixel, true.shape[1:])
    on = lower[np.arange(len(true)), row, column] & evidence.tracks.visible
    return (
        view_set.in_time_order(capture),
        evidence,
        evidence.tracks.take(~on.any(1)),
        true,
        lower,
    )


def test_an_object_that_lost_half_of_its_tracks_is_completed():
    views, evidence, left, true, lower = half_lost()
    rest = static_points.fit(views, left)

    def segmented(lengths):
        watch = Watch(lambda part: None, ENOUGH_WORK)
        return segmentation.segmented(views, evidence.flow, left, rest, lengths, watch)

    by_grid, completed = segmented(None), segmented(USUAL)
    assert not len(by_grid.mask_tracks.start)
    assert by_grid.mask[lower].mean() < 0.75 < 0.85 < completed.mask[lower].mean()
    assert completed.mask[~true].mean() < 0.02
    assert len(completed.score) == len(left.start)
    # All but few of the tracks in addition follow the card, and its lower half as well.
    moving = completed.mask_tracks.take(completed.mask_score > record.MOVES)
    row, column = tracks.pixel_of(moving.pixel, true.shape[1:])
    frames = np.arange(len(true))
    assert true[frames, row, column][moving.visible].mean() > 0.95
    assert lower[frames, row, column][moving.visible].mean() > 0.2


def test_beyond_the_budget_no_track_is_added():
    views, evidence, left, true, _ = half_lost()
    told = []
    watch = Watch(told.append, 1e-6)
    watch.spend(1.0)
    rest = static_points.fit(views, left)
    found = segmentation.segmented(views, evidence.flow, left, rest, USUAL, watch)
    assert not len(found.mask_tracks.start)
    assert not len(found.mask_score)
    assert "more tracks of moving objects" in watch.left_out
    given = segmentation.segmented(views, evidence.flow, left, rest, USUAL, watch, true)
    assert not len(given.mask_tracks.start)
    np.testing.assert_array_equal(given.mask, true)


def paths_of(grid, begun):
    moves = segmentation.Moving(
        np.zeros((24, 96, 96), bool),
        np.ones(len(grid.start)),
        begun,
        np.ones(len(begun.start)),
    )
    return record._select_moving(grid, np.ones(len(grid.start)), moves, 10, (96, 96))


def tracks_at(center, count, first=0, last=24):
    rng = np.random.default_rng(0)
    pixel = rng.uniform(-3, 3, (count, 1, 2)).astype(np.float32) + np.float32(center)
    frame = np.arange(24)
    visible = np.tile((frame >= first) & (frame < last), (count, 1))
    return Tracks(np.full(count, first), pixel.repeat(24, 1), visible)


def test_tracks_are_added_where_those_of_the_grid_are_few():
    grid = tracks_at([20, 20], 30)
    near, far = tracks_at([20, 20], 20), tracks_at([70, 60], 20)
    chosen = paths_of(grid, Tracks(*map(np.concatenate, zip(near, far, strict=True))))
    assert len(chosen.start) == 50
    np.testing.assert_array_equal(chosen.pixel[30:], far.pixel)


def test_paths_are_spread_over_the_frames(monkeypatch):
    """Nine tracks of ten are visible in the first frames only."""
    monkeypatch.setattr(record, "MOST_PATHS", 100)
    early, late = tracks_at([20, 20], 900, last=12), tracks_at([20, 20], 100, first=12)
    grid = Tracks(*map(np.concatenate, zip(early, late, strict=True)))
    chosen = paths_of(grid, grid.take(slice(0)))
    assert len(chosen.start) == 100
    assert 0.3 < chosen.visible[:, -1].mean() < 0.6
