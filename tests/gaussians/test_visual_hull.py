"""Initial points inside the silhouettes of a static object."""

import dataclasses

import numpy as np
import pytest

from gaussians_jax.init import visual_hull
from nerfies_jax.geometry import camera as cameras
from tests import scenes

RADIUS, DISTANCE, SIZE, FOCAL = 0.4, 4.0, (40, 40), 80.0
COLOR, BACKGROUND = (200, 60, 20), (255, 255, 255)


def ball(**changes):
    """Twelve views of a ball at the origin, which covers a small part of the volume."""
    angle = np.arange(12) * np.pi / 6
    place = DISTANCE * np.stack(
        [np.cos(angle), 0.4 * np.sin(3 * angle), np.sin(angle)], axis=1
    )
    up = np.array([0.0, 1.0, 0.0])
    views = cameras.stack(
        [cameras.look_at(p, np.zeros(3), up, FOCAL, SIZE) for p in place]
    )
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    slope = np.hypot(x - SIZE[0] / 2, y - SIZE[1] / 2) / FOCAL
    images = np.full((12, *SIZE, 3), BACKGROUND, np.uint8)
    # The ball is in front of the pixels whose rays pass nearer to its center than its
    # radius.
    for image, position in zip(images, place, strict=True):
        sine = RADIUS / np.linalg.norm(position)
        image[slope < np.tan(np.arcsin(sine))] = COLOR
    capture = dataclasses.replace(
        scenes.tiny_capture(),
        ids=tuple(f"{row:02d}" for row in range(12)),
        images=images,
        cameras=views,
        times=np.zeros(12, np.float32),
        train=np.arange(12),
        heldout=np.arange(0),
        warp_ids=np.zeros(12, np.int32),
        appearance_ids=np.zeros(12, np.int32),
        camera_ids=np.zeros(12, np.int32),
        valid=None,
        moving=None,
        depths=None,
        flow=None,
        points=None,
        near=2.0,
        far=6.0,
        background=(1.0, 1.0, 1.0),
    )
    return dataclasses.replace(capture, **changes)


def sampled(capture, count=300):
    rng = np.random.default_rng(0)
    return visual_hull.hull_points(rng, capture, count, (capture.near, capture.far))


def test_points_lie_in_the_silhouettes_and_have_their_color():
    position, color = sampled(ball())
    assert position.shape == color.shape == (300, 3)
    away = np.linalg.norm(position, axis=1)
    # Silhouettes are wider by a pixel of 1/80 at distance 4 and by half a pixel of
    # rounding, and the hull of twelve views is up to a tenth larger than the ball.
    assert away.max() < 1.1 * RADIUS + 1.5 * DISTANCE / FOCAL
    assert np.median(away) > 0.5 * RADIUS
    center = away < 0.8 * RADIUS
    assert np.abs(255 * color[center] - COLOR).max() < 2


@pytest.mark.parametrize(
    "changes",
    [
        {"background": None},
        {"background": (0.5, 0.5, 0.5)},  # everything is in front of it
        {"times": np.linspace(0, 1, 12, dtype=np.float32)},
        {"images": np.full((12, *SIZE, 3), BACKGROUND, np.uint8)},
    ],
)
def test_there_is_no_hull_without_silhouettes_of_a_static_object(changes):
    assert sampled(ball(**changes)) is None


def test_silhouettes_without_a_common_volume_have_no_hull():
    """As of an object that moves, or of wrong cameras."""
    capture = ball()
    images = np.stack(
        [np.roll(one, 6 * row, 1) for row, one in enumerate(capture.images)]
    )
    assert sampled(dataclasses.replace(capture, images=images)) is None
