"""Images that cost nothing against slow loops, and renders through a lens."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.capture import pinholes
from nerfies_jax.evaluation import baseline_images, moving_masks
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.rays import pixel_rays
from nerfies_jax.preprocessing import findings, motion, record
from nerfies_jax.runs import baselines_text
from nerfies_jax.training.model import Rendering, TrainState
from tests.preprocessing import two_planes

SIZE = (24, 18)
NOBODY = TrainState((), (), (), jnp.zeros((), jnp.int32), None)


def small_capture(frames=12, **changes):
    """A small capture in which every frame has its own level, every third held out."""
    rows = np.arange(frames)
    images = np.zeros((frames, *SIZE[::-1], 3), np.uint8)
    images += (10 * rows[:, None, None, None]).astype(np.uint8)
    bare = two_planes.make(frames=frames, points=0)
    return dataclasses.replace(
        bare,
        images=images,
        moving=None,
        depths=None,
        cameras=cameras.resize(bare.cameras, bare.size, SIZE),
        train=rows[rows % 3 != 1],
        heldout=rows[rows % 3 == 1],
        **changes,
    )


def test_neighbors_are_the_nearest_in_time_of_the_same_camera():
    capture = small_capture()
    assert sorted(baseline_images.neighbor_rows(capture, 4)) == [3, 5]
    assert list(baseline_images.neighbor_rows(capture, 10)) == [9, 11]
    # Of the camera's own frames, however far, if it has two; else of all.
    ids = np.zeros(12, np.int32)
    ids[[0, 4, 11]] = 1
    rig = dataclasses.replace(capture, camera_ids=ids)
    assert list(baseline_images.neighbor_rows(rig, 4)) == [0, 11]
    ids[11] = 0
    assert sorted(baseline_images.neighbor_rows(rig, 4)) == [3, 5]
    # By their times, not by their rows; of equally near ones the first.
    turned = dataclasses.replace(capture, times=capture.times[::-1].copy())
    assert sorted(baseline_images.neighbor_rows(turned, 1)) == [0, 2]
    still = dataclasses.replace(capture, times=np.zeros(12, np.float32))
    assert list(baseline_images.neighbor_rows(still, 4)) == [0, 2]


def test_a_mean_of_neighbors_is_of_those_that_observe_a_pixel():
    valid = np.ones((12, *SIZE[::-1]), bool)
    valid[3, :, :5] = False
    valid[[3, 5], 0] = False
    capture = small_capture(valid=valid)
    means = baseline_images.neighbor_means(capture, np.array([4, 7]))
    expected = np.full((*SIZE[::-1], 3), 40 / 255)
    expected[:, :5] = 50 / 255
    expected[0] = 0
    np.testing.assert_allclose(means.color[0], expected, atol=1e-6)
    np.testing.assert_allclose(means.color[1], 70 / 255, atol=1e-6)
    np.testing.assert_array_equal(means.known[0], expected[..., 0] > 0)
    assert means.known[1].all()
    at_once = dataclasses.replace(capture, times=np.zeros(12, np.float32))
    assert baseline_images.neighbor_means(at_once, capture.heldout) is None
    single = dataclasses.replace(capture, train=capture.train[:1])
    assert baseline_images.neighbor_means(single, capture.heldout) is None


def test_an_average_over_time_leaves_the_rest_of_a_view():
    capture, order = small_capture(), []

    def draw(state, view):
        level = float(view.time) + float(view.camera.position[0])
        order.append(float(view.time))
        shape = SIZE[::-1]
        color = np.full((*shape, 3), 2 * level, np.float32)
        return Rendering(color, np.ones(shape), np.ones(shape))

    rows = capture.heldout
    averages = baseline_images.time_averages(
        draw, NOBODY, capture, rows, frames=2, timestamps=3
    )
    np.testing.assert_array_equal(averages.places, [0, 3])
    times = capture.times[capture.train]
    times = times[[0, round((len(times) - 1) / 2), -1]]
    assert order == [t for t in times for _ in range(2)]  # an instant serves all views
    for place, color in zip(averages.places, averages.color, strict=True):
        position = capture.cameras.position[rows[place], 0]
        exact = np.mean(np.clip(2 * (times.astype(float) + position), 0, 1))
        np.testing.assert_allclose(color, exact, atol=1e-6)
    with pytest.raises(ValueError, match="frames=0 and timestamps=3"):
        baseline_images.time_averages(
            draw, NOBODY, capture, rows, frames=0, timestamps=3
        )


def test_a_run_below_a_baseline_is_told_what_to_do():
    numbers = {
        "heldout.psnr": 20.0,
        "baseline.neighbor_mean": 19.0,
        "baseline.static": 19.5,
    }
    numbers |= {"motion.gain": 0.5}
    assert baselines_text.warnings(numbers) == []
    assert "19.00 dB for the mean of the two" in baselines_text.lines(numbers)[0]
    assert "+0.50 dB" in baselines_text.lines(numbers)[1]
    assert baselines_text.warnings(numbers | {"motion.gain": -0.04}) == []
    (worse,) = baselines_text.warnings(numbers | {"motion.gain": -0.06})
    assert "0.06 dB less" in worse
    below, worse = baselines_text.warnings(
        numbers | {"baseline.neighbor_mean": 22.7, "motion.gain": -0.25}
    )
    assert "20.00 dB is below the 22.70 dB" in below
    assert "0.25 dB less" in worse
    assert "more steps" in below
    assert "splats-static" in worse
    assert "not initialized from tracks" in worse
    assert "train for more steps" not in worse
    (lost,) = baselines_text.warnings(numbers | {"motion.gain": -2.0}, 0.07)
    assert "only 7% of the moving pixels" in lost
    assert "was not followed" in lost
    (actual,) = baselines_text.warnings(numbers | {"motion.gain": -2.0}, 0.7)
    assert "not followed" not in actual
    assert baselines_text.lines({"heldout.psnr": 20.0}) == []
    assert baselines_text.warnings({"heldout.psnr": 20.0}) == []
    coded = numbers | {"heldout.psnr": 18.0}  # and 20 dB with fitted codes
    assert len(baselines_text.warnings(coded)) == 1
    assert baselines_text.warnings(coded | {"heldout.fitted_psnr": 20.0}) == []


def test_rays_through_a_lens_are_scored_but_where_it_has_none():
    capture = two_planes.make(frames=3)
    assert pinholes.scorable(capture) is capture
    lens = np.tile(np.float32([-0.2, 0.03, 0.0]), (3, 1))
    bent = dataclasses.replace(capture, cameras=capture.cameras._replace(radial=lens))
    assert pinholes.scorable(bent) is bent
    # A fold inside the image: beyond it no ray is bent there.
    lens = np.tile(np.float32([-3.0, 0.0, 0.0]), (3, 1))
    bent = dataclasses.replace(capture, cameras=capture.cameras._replace(radial=lens))
    scored = pinholes.scorable(bent)
    width, height = capture.size
    assert not scored.valid[0, 0, 0]
    assert scored.valid[0, height // 2, width // 2]
    assert "have no ray" in scored.notes[-1]


@pytest.fixture
def looked(tmp_path, monkeypatch):
    """Captures that are looked at: the upper left quarter moves from time 5/11 on.

    Where there are two cameras the capture is of no use.
    """
    looked_at = []

    def cached(capture, folder, masks_only):
        looked_at.append(capture)
        assert masks_only
        assert folder == tmp_path
        order = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
        wide = pinholes.canvas(capture)
        mask = np.zeros((len(order), *wide.size[::-1]), bool)
        quarter = wide.top + capture.size[1] // 2, wide.left + capture.size[0] // 2
        mask[:, : quarter[0], : quarter[1]] = True
        mask[capture.times[order] < np.float32(4.5 / 11)] = False
        jumps = len(np.unique(capture.camera_ids)) > 1
        return record.Evidence(
            **dict.fromkeys(record.Evidence._fields)
            | {"row": order, "moving": mask, "factor": 1}
            | {"unusable": "the camera jumps" if jumps else ""}
        )

    monkeypatch.setattr(record, "cached", cached)
    moves = findings.Finding(findings.MOTION, "", "", True, findings.CERTAIN)
    monkeypatch.setattr(motion, "motion", lambda *_: moves)
    width, height = two_planes.SIZE
    monkeypatch.setattr(moving_masks, "MAX_PIXELS", 12 * width * height // 4)
    return looked_at


def without_masks(**changes):
    """A capture of which one frame is held out."""
    capture = two_planes.make(frames=12, train=np.r_[0:5, 6:12], heldout=np.r_[5:6])
    return dataclasses.replace(capture, moving=None, **changes)


@pytest.mark.parametrize("lens", [False, True])
def test_masks_of_what_moves_come_from_all_frames(lens, looked, tmp_path):
    capture = without_masks()
    if lens:
        radial = np.tile(np.float32([-0.2, 0.03, 0.0]), (12, 1))
        bent = capture.cameras._replace(radial=radial)
        capture = dataclasses.replace(capture, cameras=bent)
    width, height = capture.size
    masked, note = moving_masks.with_masks(capture, tmp_path)
    assert looked[0].size == (width // 2, height // 2)
    assert len(looked[0].train) == 12
    moving = masked.moving[5]
    if lens:
        # The upper left quarter of undistorted pixels, which are larger than these.
        camera = cameras.take(capture.cameras, 5)
        straight = pinholes.pinhole(camera)
        rays = jax.jit(pixel_rays, static_argnums=1)(camera, capture.size)
        points = straight.position + rays.direction
        pixel, _ = jax.jit(cameras.project)(straight, points)
        expected = (np.asarray(pixel) < np.array([width, height]) / 2).all(-1)
        assert np.mean(moving != expected) < 0.02  # a mask of half the size
    else:
        expected = np.zeros((height, width), bool)
        expected[: height // 2, : width // 2] = True
        np.testing.assert_array_equal(moving, expected)
    assert f"({moving.mean():.1%} of the held-out" in note
    assert moving_masks.with_masks(masked, tmp_path) == (masked, "")


def test_nothing_moves_so_no_mask_is_evaluated(looked, tmp_path, monkeypatch):
    rest = findings.Finding(findings.MOTION, "0 of 9", "", False, findings.LIKELY)
    monkeypatch.setattr(motion, "motion", lambda *_: rest)
    capture = without_masks()
    masked, note = moving_masks.with_masks(capture, tmp_path)
    assert masked is capture
    assert note.endswith("because nothing moves: 0 of 9.")


def test_images_that_jump_between_cameras_are_followed_in_one(looked, tmp_path):
    ids = np.repeat(np.int32([1, 0]), 6)
    rig = without_masks(camera_ids=ids)
    masked, _ = moving_masks.with_masks(rig, tmp_path)
    assert [capture.ids for capture in looked] == [rig.ids, rig.ids[:6]]
    assert masked.moving[5].any()
    looked.clear()
    both = dataclasses.replace(rig, train=np.r_[0:5, 7:12], heldout=np.r_[5:7])
    masked, note = moving_masks.with_masks(both, tmp_path)
    assert len(looked) == 1
    assert masked is both
    assert note.startswith("Dynamic regions are not evaluated separately")
    assert note.endswith("tracking failed: the camera jumps.")
