"""Moving points aligned with their first images by affine patches."""

import numpy as np
import pytest
import scipy.ndimage as nd

from nerfies_jax.preprocessing import patch_alignment
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.tracks import Tracks

SIZE, FRAMES, POINTS, CENTER = (64, 48), 9, 60, np.array([32.0, 24.0])
TURN, GROWTH = 0.9, 0.2  # rad, and log of the scale, over all frames


def warps(motion="turning"):
    """Linear map of each frame from the first one, [frames, 2, 2]."""
    share = np.linspace(0, 1, FRAMES)
    scale, angle = np.exp(GROWTH * share), TURN * share
    cos, sin, zero = scale * np.cos(angle), scale * np.sin(angle), 0 * share
    if motion == "tilting":  # about the vertical
        return np.stack([cos, zero, zero, scale], -1).reshape(-1, 2, 2)
    return np.stack([cos, -sin, sin, cos], -1).reshape(-1, 2, 2)


@pytest.fixture(scope="module")
def images():
    return images_of("turning")


def images_of(motion):
    """Enlarged images of a texture that turns about the center and grows."""
    noise = np.random.default_rng(0).normal(size=(192, 192))
    texture = nd.gaussian_filter(noise, 2.5)
    texture = 128 + 40 * texture / texture.std()
    x, y = np.meshgrid(np.arange(2 * SIZE[0]) + 0.5, np.arange(2 * SIZE[1]) + 0.5)
    offset = np.stack([x, y], -1) - 2 * CENTER
    enlarged = []
    for warp in warps(motion):
        source = offset @ np.linalg.inv(warp).T + 95.5
        enlarged.append(nd.map_coordinates(texture, [source[..., 1], source[..., 0]]))
    return np.clip(np.rint(enlarged), 0, 255).astype(np.uint8)


def tracks_of(points=POINTS, dtype=np.float32, drift_px=0.3, motion="turning"):
    """Tracks that drift off the points of the texture, and the true positions."""
    rng = np.random.default_rng(1)
    first = CENTER + rng.uniform(-13, 13, (points, 2))
    true = CENTER + np.einsum("fij,nj->nfi", warps(motion), first - CENTER)
    drift = rng.normal(0, drift_px, true.shape)
    drift[:, 0] = 0
    seen = np.ones((points, FRAMES), bool)
    return Tracks(np.zeros(points, int), (true + drift).astype(dtype), seen), true


def median_error(tracks, true):
    miss = np.linalg.norm(tracks.pixel[:, -1] - true[:, -1], axis=-1)
    return np.median(miss[tracks.visible[:, -1]])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_of_a_turning_body_keep_their_place_on_it(images, dtype):
    tracks, true = tracks_of(dtype=dtype)
    shifted = tracking.realigned(tracks, images, SIZE)
    warped = patch_alignment.align(tracks, images, SIZE)
    assert warped.pixel.dtype == dtype
    # Translated patches, which are turned by 50 degrees, do not reduce the drift.
    assert median_error(shifted, true) > 0.3
    # The rounding of gray levels and the warps from drifting tracks leave this much.
    assert median_error(warped, true) < 0.06
    assert warped.visible.mean() > 0.9
    np.testing.assert_array_equal(warped.pixel[:, 0], tracks.pixel[:, 0])


def test_points_of_a_tilting_plane_keep_their_place_on_it():
    """It gets narrower by a third, which no rotation and scale describes."""
    tracks, true = tracks_of(motion="tilting")
    images = images_of("tilting")
    assert median_error(tracking.realigned(tracks, images, SIZE), true) > 0.2
    warped = patch_alignment.align(tracks, images, SIZE)
    assert median_error(warped, true) < 0.06
    assert warped.visible.mean() > 0.9


def test_positions_that_do_not_resemble_the_patch_are_invisible(images):
    tracks, true = tracks_of()
    tracks.pixel[:, 5] += 6.0  # as behind something
    aligned = patch_alignment.align(tracks, images, SIZE)
    assert aligned.visible[:, 5].mean() < 0.2 < 0.9 < aligned.visible[:, 4].mean()
    assert (aligned.pixel[~aligned.visible] == 0).all()
    assert median_error(aligned, true) < 0.06


def test_a_drift_that_accumulates_is_corrected(images):
    """Up to 2.4 px in all, by 0.3 px from frame to frame."""
    tracks, true = tracks_of(drift_px=0)
    tracks.pixel[..., 0] += 0.3 * np.arange(FRAMES, dtype=np.float32)
    aligned = patch_alignment.align(tracks, images, SIZE)
    assert median_error(aligned, true) < 0.06
    assert aligned.visible.mean() > 0.95


def test_points_without_texture_stay_where_flow_leads(images):
    """Noise of gray levels would move them by more than half a pixel."""
    rng = np.random.default_rng(2)
    plain = np.clip(128 + rng.normal(0, 1.5, images.shape), 0, 255).astype(np.uint8)
    tracks, _ = tracks_of()
    aligned = patch_alignment.align(tracks, plain, SIZE)
    assert aligned.visible.all()
    step = np.linalg.norm(aligned.pixel - tracks.pixel, axis=-1)
    assert np.quantile(step, 0.95) < 0.1


def test_few_points_are_aligned_by_translation(images):
    tracks, true = tracks_of(points=2)
    aligned = patch_alignment.align(tracks, images[:2], SIZE)
    miss = np.linalg.norm(aligned.pixel[:, 1] - true[:, 1], axis=-1)
    assert (miss < 0.15).all()  # a turn by 6 degrees
    nothing = patch_alignment.align(tracks.take(slice(0)), images, SIZE)
    assert len(nothing.start) == 0
