"""Small captures of two textured planes, warped by homographies (no ray tracer)."""

import functools

import numpy as np
import scipy.ndimage as nd

from nerfies_jax.capture.capture import Capture, PointCloud
from nerfies_jax.geometry.camera import Camera

SIZE, FOCAL, FRAMES = (96, 72), 90.0, 12
FAR, NEAR = 2.0, 1.3  # z of the wall and of the card before it
CARD = 0.16  # half its side, scene units
PERIOD = 512  # texels of the textures
TEXELS_PER_UNIT = 100.0


@functools.cache
def texture(seed):
    """[PERIOD, PERIOD, 3] in [0.1, 0.9], detail of some three texels; it repeats."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(PERIOD, PERIOD, 3))
    fine, coarse = (nd.gaussian_filter(noise, (s, s, 0), mode="wrap") for s in (2, 6))
    mixed = fine / fine.std() + coarse / coarse.std()
    return np.clip(0.5 + 0.13 * mixed, 0.1, 0.9)


def paint(seed, x, y):
    at = np.stack([y, x]) * TEXELS_PER_UNIT
    channels = np.moveaxis(texture(seed), -1, 0)
    return np.stack(
        [nd.map_coordinates(one, at, order=1, mode="grid-wrap") for one in channels], -1
    )


def make(
    card=lambda time: (0.0, 0.0),
    gain=lambda time: 1.0,
    camera=lambda time: (0.35 * (time - 0.5), 0.08 * np.sin(5 * time), 0.0),
    frames=FRAMES,
    points=1500,
    shown=lambda time: True,
    blank=False,
    half=CARD,
    **changes,
) -> Capture:
    """Cameras look along +z at a wall with a card before it.

    `card` says where the card is at a time, `gain` the factor on linear light, `camera`
    the position, `shown` whether the card is there. `blank` paints everything gray;
    `half` is half the card's side.
    """
    width, height = SIZE
    times = np.linspace(0, 1, frames)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    grad = np.stack([x - width / 2, y - height / 2]) / FOCAL
    images = np.zeros((frames, height, width, 3), np.uint8)
    moving = np.zeros((frames, height, width), bool)
    depths = np.full((frames, height, width), FAR, np.float32)
    positions = np.array([camera(time) for time in times], np.float32)
    for row, time in enumerate(times):
        eye = positions[row].astype(float)
        wall = eye[:2, None, None] + grad * (FAR - eye[2])
        before = eye[:2, None, None] + grad * (NEAR - eye[2])
        on = before - np.reshape(card(time), (2, 1, 1))
        hit = (np.abs(on) < half).all(0) & shown(time)
        light = np.where(hit[..., None], paint(1, *on), paint(0, *wall)) ** 2.2
        if blank:
            light = np.full_like(light, 0.2)
        value = np.clip(light * gain(time), 0, 1) ** (1 / 2.2)
        images[row] = np.round(255 * value)
        moving[row], depths[row][hit] = hit, NEAR
    rng = np.random.default_rng(2)
    wall = rng.uniform((-1.2, -0.9, FAR), (1.2, 0.9, FAR), (points, 3))
    cloud = PointCloud(wall.astype(np.float32), np.zeros((points, 3), np.uint8))
    one = np.ones(frames, np.float32)
    settings = {
        "name": "two planes",
        "source": "test",
        "ids": tuple(f"{row:03d}" for row in range(frames)),
        "images": images,
        "cameras": Camera(
            np.tile(np.eye(3, dtype=np.float32), (frames, 1, 1)),
            positions,
            FOCAL * one,
            np.tile(np.array([width / 2, height / 2], np.float32), (frames, 1)),
            0 * one,
            one,
            np.zeros((frames, 3), np.float32),
            np.zeros((frames, 2), np.float32),
        ),
        "times": times.astype(np.float32),
        "train": np.arange(frames),
        "heldout": np.zeros(0, int),
        "near": 0.8,
        "far": 3.0,
        "warp_ids": np.arange(frames, dtype=np.int32),
        "appearance_ids": np.arange(frames, dtype=np.int32),
        "camera_ids": np.zeros(frames, np.int32),
        "points": cloud if points else None,
        "moving": moving,
        "depths": depths,
    }
    return Capture(**(settings | changes))


def swaying(time):
    """A card that moves up and down by half its side, and a little sideways."""
    return 0.03 * np.sin(6 * time), 0.09 * np.sin(8 * time)


def rod(turn: float, frames: int = 12, side: int = 56) -> Capture:
    """A dark rod across a ball before white, seen from all around, one view a time.

    The rod turns by `turn` rad over the video; the ball is at rest. Points of both are
    drawn as discs, so the outlines share no code with what reads them.
    """
    rng = np.random.default_rng(4)
    ball = rng.normal(size=(4000, 3))
    ball *= 0.4 / np.linalg.norm(ball, axis=1, keepdims=True)
    times = np.linspace(0, 1, frames)
    # Neighboring times lie far apart: no flow between them.
    angles = 2.4 * np.arange(frames)
    images = np.full((frames, side, side, 3), 255, np.uint8)
    turns, places = [], []
    for row, (time, angle) in enumerate(zip(times, angles, strict=True)):
        along = np.linspace(-1, 1, 400)[:, None]
        tilt = turn * (time - 0.5)
        bar = along * np.array([np.cos(tilt), np.sin(tilt), 0.0])
        points = np.concatenate([ball, bar])
        back = np.array([np.sin(angle), 0.3, np.cos(angle)])
        back /= np.linalg.norm(back)
        right = np.cross(np.array([0.0, 1.0, 0.0]), back)
        right /= np.linalg.norm(right)
        turned = np.stack([right, -np.cross(back, right), -back])
        eye = 4 * back
        inside = (points - eye) @ turned.T
        pixel = inside[:, :2] / inside[:, 2:] * 1.6 * side + side / 2
        dots = np.zeros((side, side), bool)
        dots[tuple(pixel[:, ::-1].astype(int).T)] = True
        images[row][nd.binary_dilation(dots, np.ones((3, 3)))] = 60
        turns.append(turned)
        places.append(eye)
    one = np.ones(frames, np.float32)
    return make(
        frames=frames,
        points=0,
        images=images,
        moving=None,
        depths=None,
        cameras=Camera(
            np.array(turns, np.float32),
            np.array(places, np.float32),
            1.6 * side * one,
            np.full((frames, 2), side / 2, np.float32),
            0 * one,
            one,
            np.zeros((frames, 3), np.float32),
            np.zeros((frames, 2), np.float32),
        ),
        near=2.0,
        far=6.0,
    )
