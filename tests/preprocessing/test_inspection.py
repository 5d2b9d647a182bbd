"""What an inspection says of small captures whose truth is known."""

import dataclasses
import functools

import numpy as np
import pytest

from nerfies_jax.preprocessing import exposure, findings, motion, texture
from nerfies_jax.preprocessing import inspection as inspect_job
from nerfies_jax.preprocessing import stored as inspect_stored
from nerfies_jax.preprocessing.findings import CANNOT_TELL, CERTAIN, LIKELY
from tests.preprocessing import two_planes


@functools.cache
def still():
    return inspect_job.inspect(two_planes.make())


@functools.cache
def swaying_capture():
    return two_planes.make(card=two_planes.swaying)


@functools.cache
def swaying():
    return inspect_job.inspect(dataclasses.replace(swaying_capture(), moving=None))


def swaying_with(masks):
    """The findings about masks alone; what moves is already known."""
    inspected = swaying()
    capture = dataclasses.replace(swaying_capture(), moving=masks)
    finding = inspect_stored.masks(capture, inspected.evidence)
    return dataclasses.replace(inspected, findings=(finding,))


def verdict(inspection, effect):
    finding = inspection.finding(effect)
    return finding.wanted, finding.confidence


def test_a_still_scene_under_a_moving_camera_does_not_move():
    assert verdict(still(), "motion") == (False, CERTAIN)


def test_a_swaying_card_moves():
    assert verdict(swaying(), "motion") == (True, CERTAIN)


@pytest.mark.full
def test_cameras_that_take_turns_see_what_one_camera_sees():
    ids = np.arange(two_planes.FRAMES, dtype=np.int32)
    capture = dataclasses.replace(swaying_capture(), camera_ids=ids)
    assert inspect_job.inspect(capture).findings[0] == swaying().findings[0]


@pytest.mark.parametrize(
    ("share", "noise_px", "answer"),
    [
        (0.017, 0.3, (True, CERTAIN)),
        (0.017, 1.81, (None, CANNOT_TELL)),
        (0.0, 1.81, (None, CANNOT_TELL)),
        (0.2, 1.81, (True, CERTAIN)),
    ],
)
def test_what_points_at_rest_are_off_by_weakens_both_answers(share, noise_px, answer):
    inspected = still()
    tracks, static_fit = inspected.evidence.tracks, inspected.evidence.static_fit
    length = tracks.visible.sum(1)
    moves = np.cumsum(length) <= share * length.sum()
    residual = np.where(tracks.visible, noise_px, np.nan)
    evidence = inspected.evidence._replace(
        score=moves.astype(float),
        static_fit=static_fit._replace(residual=residual),
    )
    finding = motion.motion(inspected.views, evidence)
    assert (finding.wanted, finding.confidence) == answer


@pytest.mark.full
def test_a_static_camera_sees_motion_and_stillness():
    def fixed(time):
        return (0.0, 0.0, 0.0)

    moving = two_planes.make(card=two_planes.swaying, camera=fixed)
    assert verdict(inspect_job.inspect(moving), "motion") == (True, CERTAIN)
    quiet = two_planes.make(camera=fixed)
    assert verdict(inspect_job.inspect(quiet), "motion") == (False, CERTAIN)


@pytest.mark.full
def test_a_drifting_exposure_is_told_from_motion():
    capture = two_planes.make(gain=lambda time: 2 ** (0.5 * np.sin(7 * time)) / 1.5)
    inspected = inspect_job.inspect(capture)
    assert verdict(inspected, "appearance codes") == (True, CERTAIN)
    assert verdict(inspected, "motion") == (False, CERTAIN)
    times = np.linspace(0, 1, two_planes.FRAMES)
    truth = np.std(0.5 * np.sin(7 * times))
    stops = inspected.finding("appearance codes").numbers["drift_stops"]
    # The images are coded by a power of 1/2.2 and read as sRGB: some 3 % apart.
    assert stops == pytest.approx(truth, rel=0.06)


@pytest.mark.parametrize(
    ("drift", "noise", "wanted"),
    [(0.22, 0.3, True), (0.22, 0.1, True), (0.0, 0.3, False), (0.0, 0.02, False)],
)
def test_exposure_drift_is_separated_from_errors_of_single_groups(drift, noise, wanted):
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.normal(size=87))
    common = drift * (walk - walk.mean()) / walk.std()
    errors = noise * rng.normal(size=(exposure.GROUPS, 87, 3))
    errors[2, 20:] += 1.0  # an object hides this group for most of the video
    errors[4, :10] = np.nan
    actual, error = exposure.common_drift(common[None, :, None] + errors)
    assert abs(actual**2 - drift**2) < 0.02**2 + 3 * error * (actual + drift)
    decision, _ = findings.judge(actual, exposure.DRIFT_STOPS, error)
    assert decision is wanted


@pytest.mark.full
def test_an_even_exposure_is_seen_with_motion_and_without_points():
    assert verdict(swaying(), "appearance codes") == (False, CERTAIN)
    bare = inspect_job.inspect(two_planes.make(points=0))
    assert verdict(bare, "appearance codes") == (False, CERTAIN)
    assert verdict(bare, "start from points") == (False, CERTAIN)
    assert verdict(bare, "background points") == (False, CERTAIN)


def test_points_of_the_wall_are_fit_for_both_their_uses():
    assert verdict(still(), "start from points")[0]
    assert verdict(still(), "background points")[0]


@pytest.mark.full
def test_points_on_what_moves_are_no_background():
    capture = two_planes.make(card=two_planes.swaying)
    rng = np.random.default_rng(3)
    on_card = rng.uniform(-two_planes.CARD, two_planes.CARD, (1500, 3))
    on_card[:, 2] = two_planes.NEAR
    capture.points.position[:] = on_card
    assert verdict(inspect_job.inspect(capture), "background points") == (
        False,
        CERTAIN,
    )


@pytest.mark.parametrize(
    "capture",
    [
        {"frames": 2},
        # too fast to be followed
        pytest.param({"frames": 5, "card": two_planes.swaying}, marks=pytest.mark.full),
        pytest.param({"blank": True}, marks=pytest.mark.full),
    ],
    ids=["two frames", "five frames", "nothing to see"],
)
def test_what_cannot_be_seen_decides_nothing_and_says_why(capture):
    finding = inspect_job.inspect(two_planes.make(**capture)).finding("motion")
    assert (finding.wanted, finding.confidence) == (None, CANNOT_TELL)
    assert len(finding.evidence) > 20


def test_frames_of_one_time_ask_for_no_motion():
    times = np.zeros(two_planes.FRAMES, np.float32)
    capture = two_planes.make(card=two_planes.swaying, times=times)
    inspected = inspect_job.inspect(capture)
    assert verdict(inspected, "motion") == (False, CERTAIN)
    assert "same time" in inspected.finding("motion").evidence


@pytest.mark.full
def test_a_card_that_comes_and_goes_is_transient_and_one_that_sways_is_not():
    capture = two_planes.make(
        card=lambda time: (0.2 * (time - 0.5), 0.0),
        shown=lambda time: 0.2 < time < 0.45 or 0.6 < time < 0.85,
        half=0.26,
    )
    inspected = inspect_job.inspect(capture)
    assert verdict(inspected, "transient objects")[0] is True
    assert inspected.finding("transient objects").numbers["times"] == 4
    assert verdict(swaying(), "transient objects")[0] is False
    assert verdict(still(), "transient objects")[0] is False


@pytest.mark.full
def test_depth_is_held_against_parallax():
    capture = two_planes.make()
    scene = np.full(capture.images.shape[:3], two_planes.FAR, np.float32)
    wall = inspect_job.inspect(
        two_planes.make(shown=lambda time: False, depths=3.0 * scene)
    )
    finding = wall.finding("depth")
    assert (finding.wanted, finding.confidence) == (True, CERTAIN)
    assert finding.numbers["scale"] == pytest.approx(1 / 3, rel=0.02)
    x = np.linspace(0.5, 2, scene.shape[2], dtype=np.float32)
    bent = two_planes.make(shown=lambda time: False, depths=scene * x)
    wrong = inspect_stored.depth(bent, wall.views, wall.evidence)
    assert (wrong.wanted, wrong.confidence) == (False, CERTAIN)


def test_masks_are_held_against_what_moves():
    truth = swaying_capture().moving
    assert verdict(swaying_with(truth), "masks of what moves")[0] is True
    elsewhere = np.zeros_like(truth)
    elsewhere[:, :10] = True
    assert verdict(swaying_with(elsewhere), "masks of what moves") == (False, CERTAIN)
    assert verdict(swaying(), "masks of what moves") == (False, CERTAIN)


def test_a_lens_is_measured_in_pixels():
    capture = two_planes.make()
    width, height = two_planes.SIZE
    corner = np.hypot(width / 2, height / 2) / two_planes.FOCAL
    capture.cameras.radial[:, 0] = 0.1
    finding = inspect_stored.lens(capture)
    expected = 0.1 * corner**3 * two_planes.FOCAL
    assert finding.numbers["most_px"] == pytest.approx(expected, rel=1e-4)
    assert finding.wanted
    capture.cameras.radial[:, 0] = 0
    assert inspect_stored.lens(capture).wanted is False


@pytest.mark.parametrize("period_px", [4.0, 12.0])
def test_the_finest_detail_is_that_of_the_image(period_px):
    capture = two_planes.make()
    width, height = two_planes.SIZE
    wave = 0.5 + 0.3 * np.sin(2 * np.pi * np.arange(width) / period_px)
    gray = np.tile(wave, (two_planes.FRAMES, height, 1)).astype(np.float32)
    finding = texture.texture(capture, still().views._replace(gray=gray), 1)
    # A Hann window of 96 pixels smears a frequency by two lines of its spectrum.
    slack = 2 * period_px / width
    assert finding.numbers["finest_px"] == pytest.approx(period_px, rel=slack)
    halved = texture.texture(capture, still().views._replace(gray=gray), 2)
    assert halved.numbers["finest_px"] == 2 * finding.numbers["finest_px"]


@pytest.mark.parametrize("cycles", [0.1, 0.9, 7.0, 100.0])
def test_the_last_band_is_fast_enough_and_the_one_before_is_not(cycles):
    bands = texture.bands_for(cycles)
    assert 2 ** (bands - 1) >= 2 * np.pi * cycles or bands == 1
    assert bands == 1 or 2 ** (bands - 2) < 2 * np.pi * cycles


@pytest.mark.full
@pytest.mark.parametrize(
    ("turn", "answer"),
    [(0.0, (False, LIKELY)), (0.9, (True, CERTAIN))],
    ids=["at rest", "turning"],
)
def test_outlines_tell_motion_where_no_flow_can(turn, answer):
    capture = two_planes.rod(turn)
    finding = inspect_job.inspect(capture).finding("motion")
    assert (finding.wanted, finding.confidence) == answer
    assert "outlines" in finding.evidence


@pytest.mark.parametrize(
    ("value", "error", "answer"),
    [
        (3.0, 0.0, (True, CERTAIN)),
        (1.5, 0.0, (True, LIKELY)),
        (1.1, 0.0, (None, CANNOT_TELL)),
        (0.95, 0.0, (None, CANNOT_TELL)),
        (0.7, 0.0, (False, LIKELY)),
        (0.0, 0.0, (False, CERTAIN)),
        (3.0, 1.0, (None, CANNOT_TELL)),
        (0.0, 0.3, (False, LIKELY)),
        (float("nan"), 0.0, (None, CANNOT_TELL)),
        (3.0, float("inf"), (None, CANNOT_TELL)),
    ],
)
def test_confidence_is_the_distance_to_the_threshold(value, error, answer):
    assert findings.judge(value, 1.0, error) == answer
