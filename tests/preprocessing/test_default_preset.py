"""The preset that a capture calls for where the user names none."""

import dataclasses

import numpy as np
import pytest

from gaussians_jax import representation
from gaussians_jax.scene.presets import PRESETS
from nerfies_jax.evaluation import method_curves
from nerfies_jax.preprocessing import record, rigid_groups, usable_paths
from nerfies_jax.preprocessing.findings import (
    CERTAIN,
    LIGHT,
    MOTION,
    TRANSIENT,
    Finding,
    cannot_tell,
)
from nerfies_jax.training import specs
from tests.preprocessing import two_planes
from tests.preprocessing.test_tracks import MOVES

UNTRACKED = "spacetime-small"


@pytest.fixture(scope="module", autouse=True)
def one_cache(tmp_path_factory):
    """What a capture shows is found once for all tests of it, and nowhere else."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(representation, "CACHE", tmp_path_factory.mktemp("cache"))
        yield


def noisy():
    """Every image of its own: there is nothing to carry from one to the next."""
    capture = two_planes.make(frames=12)
    noise = np.random.default_rng(0).integers(0, 255, capture.images.shape, np.uint8)
    return dataclasses.replace(capture, images=noise)


@pytest.mark.parametrize(
    ("make", "preset", "words"),
    [
        (lambda: two_planes.make(**MOVES, frames=24), "splats-tracked-small", ""),
        (lambda: two_planes.make(frames=24), "splats-static-small", "nothing moves: "),
        (noisy, UNTRACKED, "only 0% of the moving pixels are near a track"),
    ],
)
def test_motion_is_chosen_by_what_tracks_say(make, preset, words):
    choice = representation.default_preset(make())
    assert choice.preset == preset
    assert words in "".join(choice.notes)
    spec = specs.override(PRESETS[preset], choice.overrides)
    # Nothing is fitted to tracks that are of no use.
    assert (spec.start.motion == "tracks") == (preset == "splats-tracked-small")


def test_what_moves_and_cannot_be_followed_is_no_still_scene(monkeypatch):
    monkeypatch.setattr(usable_paths, "LEAST_COVERAGE", 1.01)
    choice = representation.default_preset(two_planes.make(**MOVES, frames=24))
    assert choice.preset == UNTRACKED
    assert "of the moving pixels are near a track" in "".join(choice.notes)


def test_the_preset_is_the_best_curve_in_the_planned_time(monkeypatch):
    early, late = "splats-deformable-small start.motion=tracks", UNTRACKED
    curves = {
        early: {"seconds": [10, 100], "psnr": [25, 26]},
        late: {"seconds": [10, 100], "psnr": [20, 30]},
    }
    scenes = {"static": curves, "default": curves}
    monkeypatch.setattr(method_curves, "curves", lambda: scenes)
    for moves in (MOVES, {}):
        capture = two_planes.make(**moves, frames=24)
        for seconds, expected in ((20, early), (100, late)):
            choice = representation.default_preset(capture, seconds)
            preset, *overrides = expected.split()
            assert choice.preset == preset
            assert choice.overrides[: len(overrides)] == tuple(overrides)
            specs.override(PRESETS[preset], choice.overrides)


@pytest.mark.parametrize("stops", [1.0, 0.2])
def test_photographs_in_changing_light_get_an_appearance_of_each(stops, monkeypatch):
    capture = two_planes.make(frames=24)
    evidence = record.cached(capture, representation.CACHE / "evidence")
    apart = evidence._replace(unusable="the camera motion is discontinuous")
    findings = (
        cannot_tell(MOTION, ""),
        cannot_tell(TRANSIENT, ""),
        Finding(LIGHT, "", "", True, CERTAIN, {"drift_stops": stops}),
    )
    monkeypatch.setattr(representation.record, "cached", lambda *_: apart)
    monkeypatch.setattr(representation.inspection, "find", lambda *_: findings)
    choice = representation.default_preset(capture)
    preset = "splats-collection-small" if stops == 1 else UNTRACKED
    assert choice.preset == preset


@pytest.mark.parametrize("wanted", [False, True])
def test_photographs_are_static_if_the_inspection_is_certain(wanted, monkeypatch):
    capture = two_planes.make(frames=24)
    evidence = record.cached(capture, representation.CACHE / "evidence")
    apart = evidence._replace(unusable="the camera motion is discontinuous")
    findings = (Finding(MOTION, "none of 400 points moves", "", wanted, CERTAIN),)
    monkeypatch.setattr(representation.record, "cached", lambda *_: apart)
    monkeypatch.setattr(representation.inspection, "find", lambda *_: findings)
    choice = representation.default_preset(capture)
    assert choice.preset == (UNTRACKED if wanted else "splats-static-small")
    said = "nothing moves: none of 400 points moves" in choice.notes
    assert said is not wanted


def test_coverage_is_the_share_of_moving_pixels_near_known_paths():
    folder = representation.CACHE / "evidence"
    evidence = record.cached(two_planes.make(**MOVES, frames=24), folder)
    assert 0.5 < usable_paths.coverage(evidence) <= 1
    # Pixel by pixel, with one path that is known in a single frame too few.
    known = np.zeros_like(evidence.paths.known)
    known[0, :8], known[1, :5] = True, True
    paths = evidence.paths._replace(known=known)
    pixel = evidence.path_tracks.pixel[0]
    near = total = 0
    for frame, mask in enumerate(evidence.moving):
        for row, column in np.argwhere(mask):
            total += 1
            if frame < 8:
                away = np.floor(pixel[frame]) - [column, row]
                near += np.hypot(*away) <= usable_paths.NEAR_PX
    share = usable_paths.coverage(evidence._replace(paths=paths))
    np.testing.assert_allclose(share, near / total)


@pytest.mark.full
def test_a_scene_of_which_no_track_moves_is_static():
    capture = two_planes.make(frames=24)
    evidence = record.gather(capture)
    assert len(evidence.score) >= usable_paths.LEAST_TRACKS
    moving = np.zeros_like(evidence.moving)
    moving[:, :3] = True  # marked where flow fails, as at occlusions
    assert usable_paths.MARKED < moving.mean() < usable_paths.MOST_MARKED
    score = np.zeros_like(evidence.score)
    static = evidence._replace(moving=moving, score=score)
    assert usable_paths.unusable(static)
    assert usable_paths.is_static(static, capture.times)
    score[: 1 + len(score) // 200] = 1
    for change in (
        {"score": score},
        {"moving": np.ones_like(moving)},
        {"score": score[:9] * 0},
        {"unusable": "too little texture"},
    ):
        assert not usable_paths.is_static(static._replace(**change), capture.times)


@pytest.mark.parametrize(("bases", "overrides"), [(20, ("motion.bases=20",)), (8, ())])
def test_paths_of_many_things_get_more_bases(bases, overrides, monkeypatch):
    monkeypatch.setattr(rigid_groups, "enough", lambda *_: bases)
    choice = representation.default_preset(two_planes.make(**MOVES, frames=24))
    assert choice.overrides == overrides
    spec = specs.override(PRESETS[choice.preset], choice.overrides)
    assert spec.motion.bases == bases


@pytest.mark.parametrize(("a_knot", "knots"), [(3, 20), (0.8, 30), (0.1, 60)])
def test_long_videos_get_more_knots(a_knot, knots, monkeypatch):
    monkeypatch.setattr(representation, "FRAMES_A_KNOT", a_knot)
    choice = representation.default_preset(two_planes.make(**MOVES, frames=24))
    spec = specs.override(PRESETS[choice.preset], choice.overrides)
    assert spec.motion.knots == knots
    assert ("for 24 frames" in choice.notes) == (knots > 20)


@pytest.mark.parametrize(
    ("preset", "changes"),
    [
        ("splats-tracked-small", ()),
        ("splats-static-small", ()),
        (UNTRACKED, (representation.FROM_REST,)),
    ],
)
def test_larger_images_get_more_gaussians(preset, changes):
    spec = specs.override(PRESETS[preset], changes)
    assert representation.capacity(spec, (176, 132)) == ()
    assert representation.capacity(spec, (88, 66)) == ()
    larger = specs.override(spec, representation.capacity(spec, (352, 264)))
    assert larger.strategy.cap_max == 2 * spec.strategy.cap_max
    assert larger.init.points == 2 * spec.init.points
    moving = larger.start.moving_points / spec.start.moving_points
    assert moving == (2 if spec.start.motion == "tracks" else 1)


@pytest.mark.parametrize(("followed", "times"), [(0.9, 1), (0.125, 2), (0.01, 3)])
def test_what_is_followed_for_a_short_time_gets_more_gaussians(followed, times):
    spec = PRESETS["splats-tracked-small"]
    short = specs.override(spec, representation.capacity(spec, (176, 132), followed))
    assert short.init.points == spec.init.points
    assert short.start.moving_points == times * spec.start.moving_points
    more = short.start.moving_points - spec.start.moving_points
    assert short.strategy.cap_max == spec.strategy.cap_max + more


@pytest.mark.parametrize(
    ("seconds", "times"), [(20, 0.5), (30, 0.5), (120, 1), (480, 2), (5000, 3)]
)
def test_a_longer_time_gets_more_gaussians(seconds, times):
    spec = PRESETS["splats-tracked-small"]
    changes = representation.capacity(spec, (176, 132), 1.0, seconds)
    longer = specs.override(spec, changes)
    assert longer.strategy.cap_max == times * spec.strategy.cap_max
    assert longer.init.points == times * spec.init.points
    assert longer.start.moving_points == times * spec.start.moving_points
    assert (changes == ()) == (seconds == 120)
