"""What trained scenes are measured by, against closed forms."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax.evaluation import protocol
from nerfies_jax.evaluation.protocol import PointTracks
from tests import scenes

SHIFT = np.float32([0.012, 0.0, 0.016])  # 0.02 long


def test_the_known_paths_are_those_of_points_seen_at_the_start():
    capture, truth, known = scenes.tiny_tracks()
    assert known.path.shape == (5, len(capture.train), 3)
    assert len(known.rows) == 2
    assert set(known.rows) <= set(capture.heldout)
    assert np.all(np.diff(capture.times[known.track_rows]) > 0)
    assert known.start == len(known.track_rows) // 2
    assert known.visible[:, known.start].all()
    for point, seen in zip(known.path, known.visible, strict=True):
        (track,) = np.flatnonzero((truth.track_canonical == point[0]).all(axis=1))
        np.testing.assert_array_equal(point, truth.track_world[track])
        np.testing.assert_array_equal(seen, truth.track_seen[track][known.track_rows])


def test_a_scaled_capture_has_its_paths_in_scene_units():
    capture, truth, known = scenes.tiny_tracks()
    other = dataclasses.replace(capture, scale=2.0, center=(0.1, 0.2, -0.3))
    scaled = protocol.ground_truth(other, truth, 2, 5)
    expected = 2 * (known.path - np.float32([0.1, 0.2, -0.3]))
    np.testing.assert_allclose(scaled.path, expected, atol=1e-6)


def test_the_truth_of_another_capture_is_refused():
    capture, truth, _ = scenes.tiny_tracks()
    with pytest.raises(ValueError, match="other frames than the capture"):
        protocol.ground_truth(capture, truth._replace(ids=truth.ids[1:]), 2, 5)


def test_tracks_are_scored_by_their_distance_at_all_instants_but_the_start():
    known = scenes.tiny_tracks()[2]
    known = known._replace(visible=np.ones_like(known.visible))
    answered = np.ones(known.visible.shape, bool)
    answered[0, 4:6] = False
    right = PointTracks(known.path, answered, 0.1, 0.2)
    later = answered[:, 1:].size  # all but one column
    numbers = protocol.score_tracks(known, right)
    assert numbers["tracks.epe"] == 0
    assert numbers["tracks.correct"] == 1
    assert numbers["tracks.lost"] == pytest.approx(2 / later)
    assert (numbers["tracks.drift"], numbers["tracks.strain"]) == (0.1, 0.2)
    wrong = right._replace(path=known.path + SHIFT)
    numbers = protocol.score_tracks(known, wrong)
    assert numbers["tracks.epe"] == pytest.approx(0.02, rel=1e-4)
    assert numbers["tracks.correct"] == 0
    # What cannot be seen is not scored.
    half = known.visible.copy()
    half[:, ::2] = False
    wrong.path[:, ::2] = 9.0
    numbers = protocol.score_tracks(known._replace(visible=half), wrong)
    assert numbers["tracks.epe"] == pytest.approx(0.02, rel=1e-4)
    away = np.linalg.norm(known.path - known.path[:, 3:4], axis=-1)
    away = np.delete(away, 3, axis=1)
    assert protocol.static_error(known) == pytest.approx(away.mean(), rel=1e-5)
    assert away.mean() > 1e-3
    nothing = protocol.score_tracks(known, None)
    assert np.isnan(list(nothing.values())).all()
