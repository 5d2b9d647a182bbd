"""What a run can afford beside its training."""

import pytest

from nerfies_jax.runs import budget


def test_a_quick_renderer_is_evaluated_as_asked():
    assert budget.evaluations(0.02, 20.0, 4) == (4, 20.0)


@pytest.mark.parametrize("frame_seconds", [0.02, 0.4, 0.6, 1.0, 1.9, 2.1, 10.0, 300.0])
def test_evaluations_stay_a_tenth_of_the_training(frame_seconds):
    frames, every = budget.evaluations(frame_seconds, 20.0, 4)
    assert 1 <= frames <= 4
    assert every >= 20.0
    assert frames * frame_seconds <= 0.1 * every * (1 + 1e-9)
    if every > 20.0:
        assert frames == 1  # breaks grow only when no frame is left to save


def test_a_zero_of_the_clock_is_no_division():
    assert budget.evaluations(0.0, 20.0, 4) == (4, 20.0)
    assert budget.scored_frames(0.0, 7) == 7
    assert budget.video(0.0, (176, 132)).frames == 96


def test_all_frames_are_scored_where_time_allows_and_eight_otherwise():
    assert budget.scored_frames(0.5, 40) == 40
    assert budget.scored_frames(12.0, 40) == 20
    assert budget.scored_frames(1000.0, 40) == 8
    assert budget.scored_frames(1000.0, 5) == 5


@pytest.mark.parametrize("frame_seconds", [0.01, 0.47, 1.0, 1.8, 1.9, 5.0, 20.0])
def test_a_video_fits_its_time_and_plays_four_seconds(frame_seconds):
    video = budget.video(frame_seconds, (176, 132))
    assert 24 <= video.frames <= 96
    smaller = 176 // video.size[0]
    assert video.size == (176 // smaller, 132 // smaller)
    assert video.frames * frame_seconds / smaller**2 <= 45.0
    assert video.frames / video.rate == pytest.approx(4.0)
    if frame_seconds * 24 <= 45:
        assert smaller == 1  # fewer frames before smaller ones


def test_a_video_is_not_made_too_small_to_see():
    video = budget.video(1e4, (100, 80))
    assert video.size == (50, 40)
    assert video.frames == 24


@pytest.mark.parametrize("frame_seconds", [0.0, 0.01, 0.1, 0.5, 1.0, 30.0])
@pytest.mark.parametrize("size", [(176, 132), (4000, 3000)])
def test_averages_over_time_keep_to_their_time_and_memory(frame_seconds, size):
    frames, times = budget.static_renders(frame_seconds, 15, size)
    assert 2 <= frames <= 15
    assert 4 <= times <= 16
    assert frames * size[0] * size[1] <= max(10_000_000, 2 * size[0] * size[1])
    # Two frames at four times are drawn, whatever they take.
    assert frames * times * frame_seconds <= max(30.0, 8 * frame_seconds)
    if frame_seconds <= 0.1 and size == (176, 132):
        assert (frames, times) == (15, 16)
    assert budget.static_renders(frame_seconds, 1, size)[0] == 1
