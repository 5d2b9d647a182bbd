"""What somebody looks at in a window: cameras, sizes, pictures; no window here."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from nerfies_jax.evaluation import pictures
from nerfies_jax.evaluation.pictures import Coloured
from nerfies_jax.evaluation.renderer import as_picture
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training.model import Rendering

CHANNELS = ("colour", "depth", "opacity", "motion")
MOVING_SECONDS = 0.1  # a picture may take while the view changes: ten a second
RESTING_SECONDS = 5.0  # and when it does not: nothing is answered while it is drawn
RUNGS = 4  # sizes, each half as long and high as the next
SHORTEST_SIDE_PX = 32


class Eye(NamedTuple):
    """From where somebody looks."""

    quaternion: tuple[float, ...]  # w x y z, world from camera; right, down, forward
    position: tuple[float, ...]  # scene units
    fov_rad: float  # vertical
    aspect: float  # width of the window over its height


class Look(NamedTuple):
    """What they want to see."""

    time: float  # in [0, 1]
    channel: str = "colour"  # one of `CHANNELS`
    without: tuple[str, ...] = ()  # effects left out
    appearance: int = 0  # id


def camera_of(eye: Eye, size: tuple[int, int]) -> Camera:
    """The camera whose picture of `size` shows what the window does, stretched to it.

    Its pixels are as wide as the window's aspect makes them, so that a window of any
    shape is filled by pictures of one size: each size is a program to compile.
    """
    width, height = size
    vertical_px = height / 2 / math.tan(eye.fov_rad / 2)
    focal_px = width / height / eye.aspect * vertical_px
    turn = Rotation.from_quat(eye.quaternion, scalar_first=True).as_matrix()
    one = cameras.pinhole(turn.T, eye.position, focal_px, size)
    return one._replace(pixel_aspect=np.float32(vertical_px / focal_px))


def ladder(full: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    """At most `RUNGS` sizes up to the full one, each about half as long as the next."""
    sizes = [full]
    while len(sizes) < RUNGS and min(sizes[0]) >= 2 * SHORTEST_SIDE_PX:
        width, height = sizes[0]
        sizes.insert(0, (width // 2, height // 2))
    return tuple(sizes)


def next_rung(
    seconds: Sequence[float | None], moving: bool, shown: int | None
) -> int | None:
    """Which size to draw next, coarsest first; None where there is nothing to do.

    `seconds` are what pictures of each size take, as far as known, and `shown` is the
    size of the last picture of this very view. While the view moves it is the finest
    that is quick enough; then finer ones follow as long as they can be waited for.
    """
    expected = _expected(seconds)
    quick = [rung for rung, each in enumerate(expected) if each <= MOVING_SECONDS]
    start = max(quick, default=0)
    if shown is None or shown < start:
        return start
    finer = shown + 1
    if moving or finer == len(expected) or expected[finer] > RESTING_SECONDS:
        return None
    return finer


def _expected(seconds):
    """What is not known takes as long for each pixel as the next coarser size."""
    expected = []
    for rung, known in enumerate(seconds):
        guess = 4 * expected[-1] if expected else 0.0
        # The coarsest must be tried; others wait until the one before them was.
        guess = math.inf if rung and seconds[rung - 1] is None else guess
        expected.append(guess if known is None else known)
    return expected


def as_channel(
    channel: str,
    rendering: Rendering,
    distance: np.ndarray | None = None,
    limits: tuple[float, float] | None = None,
) -> Coloured:
    """One of the `CHANNELS` of a rendering as a picture, and what its ends stand for.

    `distance` [height, width] is how far what each pixel shows has moved, scene units,
    for "motion". `limits` keep depth and motion comparable from picture to picture;
    those of motion grow.
    """
    if channel == "colour":
        return Coloured(as_picture(rendering.colour), 0.0, 1.0)
    if channel == "opacity":
        grey = np.repeat(as_picture(rendering.alpha)[..., None], 3, axis=-1)
        return Coloured(grey, 0.0, 1.0)
    if channel == "depth":
        return pictures.colour_depth(rendering.depth, rendering.alpha > 0.5, limits)
    if channel == "motion" and distance is not None:
        return pictures.colour_distance(distance, 0.0 if limits is None else limits[1])
    raise ValueError(f"channel {channel!r}: there are {', '.join(CHANNELS)}")
