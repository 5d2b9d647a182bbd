"""Dense optical flow between consecutive frames, in both directions.

It is computed by DIS of OpenCV (Kroeger et al. 2016, arXiv:1603.03590) on images
normalized to one mean and contrast. Only consecutive frames are compared, because
repetitive patterns are confused over longer intervals. Areas that are nevertheless lost
or change their motion abruptly are searched for again at the position predicted by
constant motion.
"""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np

from nerfies_jax.preprocessing import wide_steps
from nerfies_jax.preprocessing.view_set import Views
from nerfies_jax.runtime import events

# Small images are enlarged first. This reduces the median error at 176x132 from 0.10 px
# to 0.06 px in built-in scenes, whose flow is known.
ENLARGED_BELOW_PX, ENLARGED = 320, 2
# Forward and backward flow are consistent within half a pixel plus 2 % of their length.
CLOSED_PX, CLOSED_SHARE = 0.5, 0.02

# Cost of a second search in searches: one for each plane, and the comparison.
SECOND_LOOK = 8
# Side, relative to the width, of an area whose flow is searched for again if it is lost
# in a frame. Repetitive patterns are confused in some frames: the rotating cube of the
# built-in scenes lost all its tracks in one of them.
LOST_SHARE = 0.06
# Change of flow between frames, relative to the width, above which flow is compared
# with constant motion, which is used if its matching error is at most this multiple. A
# square on the fast cube has a side of 0.06.
JUMP_SHARE, AS_ALIKE = 0.03, 1.1


class NeighborFlow(NamedTuple):
    """Flow of each frame to the next and to the previous one in time.

    It starts at pixel centers and is in pixels right and down. `forward_valid` and
    `backward_valid` are True if both flows are consistent. The forward flow of the last
    frame and the backward flow of the first are zero and not valid.
    """

    forward: np.ndarray  # [frames, height, width, 2] float32
    forward_valid: np.ndarray  # [frames, height, width] bool
    backward: np.ndarray
    backward_valid: np.ndarray


def enlarged(views: Views) -> int:
    """Return the factor by which images are enlarged before they are compared.

    Args:
      views: The frames.

    Returns:
      An integer factor.
    """
    return ENLARGED if max(views.size) <= ENLARGED_BELOW_PX else 1


def leveled(views: Views, times: int | None = None) -> np.ndarray:
    """Normalize gray images to one mean and standard deviation, and enlarge them.

    Otherwise 79 % of the pixels of a video with varying exposure are marked as moving.

    Args:
      views: The frames.
      times: Factor of enlargement. None for `enlarged`.

    Returns:
      uint8 images, [frames, times height, times width].
    """
    gray = 255 * views.gray
    mean, spread = gray.mean((1, 2)), np.maximum(gray.std((1, 2)), 1e-3)
    z_scores = (gray - mean[:, None, None]) / spread[:, None, None]
    alike = np.clip(z_scores * np.median(spread) + np.median(mean), 0, 255)
    images = [np.rint(image).astype(np.uint8) for image in alike]
    times = enlarged(views) if times is None else times
    return np.stack([larger(image, times) for image in images])


def searched_pixels(views: Views, images: np.ndarray) -> int:
    """Return the number of pixels on the finest level of one search.

    Args:
      views: The frames.
      images: Their images from `leveled`.

    Returns:
      The number of pixels.
    """
    pixels = images[0].size
    return pixels if enlarged(views) > 1 else pixels // 4


def larger(image: np.ndarray, times: int) -> np.ndarray:
    """Enlarge an image.

    Args:
      image: uint8 image, [height, width].
      times: Integer factor.

    Returns:
      uint8 image, [times height, times width].
    """
    if times == 1:
        return image
    size = times * image.shape[1], times * image.shape[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)


def reduced(shift: np.ndarray, times: int) -> np.ndarray:
    """Convert flow between enlarged images to flow between the original images.

    Args:
      shift: Flow, [times height, times width, 2].
      times: Integer factor of the enlargement.

    Returns:
      Flow in pixels of the original images, [height, width, 2].
    """
    if times == 1:
        return shift
    size = shift.shape[1] // times, shift.shape[0] // times
    return cv2.resize(shift, size, interpolation=cv2.INTER_AREA) / times


def enlarged_flow(shift: np.ndarray, times: int) -> np.ndarray:
    """Convert flow to flow between enlarged images. Inverts `reduced`.

    Args:
      shift: Displacements in pixels, [height, width, 2].
      times: Integer enlargement of the images.

    Returns:
      Displacements in pixels of the enlarged images.
    """
    size = times * shift.shape[1], times * shift.shape[0]
    return times * cv2.resize(np.ascontiguousarray(shift), size)


def _smaller(image, times):
    size = image.shape[1] // times, image.shape[0] // times
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def dis(times: int) -> Callable[..., np.ndarray]:
    """Return a function that computes optical flow between enlarged images.

    Args:
      times: Integer factor of the enlargement.

    Returns:
      A function of two images and, optionally, an initial flow, all enlarged.
    """
    # Two instances, because in OpenCV 4.x a search with an initial flow affects the
    # results of later ones without.
    plain, from_guess = (
        cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM) for _ in range(2)
    )
    for search in (plain, from_guess):
        search.setFinestScale(0 if times > 1 else 1)

    def flow(first, second, guess=None):
        return (plain if guess is None else from_guess).calc(first, second, guess)

    return flow


def between_neighbors(
    views: Views,
    images: np.ndarray,
    span: tuple[float, float] | None = None,
    room_for: Callable[[int], int] = lambda count: count,
) -> NeighborFlow:
    """Compute the flow between all neighboring frames in both directions, and check it.

    Args:
      views: The frames.
      images: Their images from `leveled`.
      span: Nearest and farthest z-depth of the scene in scene units. If given, large
        displacements are searched for again, starting from the flow of a static scene.
      room_for: Function of the number of such searches, which returns the number of
        searches to do.

    Returns:
      The flow.
    """
    (width, height), frames = views.size, len(views.row)
    times = images.shape[2] // width
    searches = threading.local()  # one for each thread, because they have a state

    def search(*pair_and_guess):
        if not hasattr(searches, "flow"):
            searches.flow = dis(times)
        return searches.flow(*pair_and_guess)

    forward, backward = np.zeros((2, frames, height, width, 2), np.float32)

    def place(step):
        one, other = step
        return (forward if other > one else backward)[one]

    def first_look(step):
        one, other = step
        return reduced(search(images[one], images[other]), times)

    def second_look(step):
        pair = tuple(images[frame] for frame in step)
        return wide_steps.improved(
            views,
            tuple(_smaller(image, times) for image in pair),
            step,
            place(step),
            lambda guess: reduced(search(*pair, enlarged_flow(guess, times)), times),
            span,
        )

    ahead = [(frame, frame + 1) for frame in range(frames - 1)]
    steps = ahead + [(after, before) for before, after in ahead]
    # 118 flows of 176x132 take 8.5 s on one core, 4.9 s on two, and 6.1 s with the
    # threads of OpenCV.
    with ThreadPoolExecutor(cv2.getNumThreads()) as threads:

        def search_all(name, steps, look):
            with events.stage(name, len(steps)) as stage:
                for step, shift in zip(steps, threads.map(look, steps), strict=True):
                    place(step)[:] = shift
                    stage.advance()

        search_all("flow between neighboring frames", steps, first_look)
        wide = [
            step
            for step in steps
            if span is not None and wide_steps.is_wide(views, step, place(step))
        ]
        wide = wide[: room_for(len(wide))]
        if wide:
            search_all("second look at wide steps", wide, second_look)
    checked_flow = checked(forward, backward)
    for frame in range(1, frames - 1):
        if _is_lost(checked_flow, frame) or _jumps(checked_flow, frame):
            _continue_motion(checked_flow, frame, images, search)
    return checked_flow


def checked(forward: np.ndarray, backward: np.ndarray) -> NeighborFlow:
    """Check the consistency of forward and backward flow.

    Args:
      forward: Flow to the next frame, [frames, height, width, 2].
      backward: Flow to the previous frame, [frames, height, width, 2].

    Returns:
      The flow, with masks of consistent pixels.
    """
    forward_valid, backward_valid = np.zeros((2, *forward.shape[:3]), bool)
    for frame in range(len(forward) - 1):
        ahead, behind = forward[frame], backward[frame + 1]
        forward_valid[frame] = closed(ahead, behind)
        backward_valid[frame + 1] = closed(behind, ahead)
    return NeighborFlow(forward, forward_valid, backward, backward_valid)


def _is_lost(flow, frame):
    """Test if a coherent area was tracked to a frame but not beyond it."""
    return _covers_patch(flow.backward_valid[frame] & ~flow.forward_valid[frame])


def _jumps(flow, frame):
    """Test if a coherent area changes its motion abruptly at a frame."""
    change = np.linalg.norm(flow.forward[frame] + flow.backward[frame], axis=-1)
    valid = flow.backward_valid[frame] & flow.forward_valid[frame]
    return _covers_patch(valid & (change > JUMP_SHARE * change.shape[1]))


def _covers_patch(area):
    side = 2 * round(LOST_SHARE * area.shape[1] / 2) + 1
    # Areas at the border do not count, because they leave the image.
    outside = {"borderType": cv2.BORDER_CONSTANT, "borderValue": 0}
    return cv2.erode(np.uint8(area), np.ones((side, side)), **outside).any()


def _continue_motion(flow, frame, images, search):
    """Search again, starting from constant motion, and keep flow that is consistent."""
    height, width = flow.forward.shape[1:3]
    times = images.shape[2] // width

    def search_from(one, other, guess):
        guess = enlarged_flow(guess, times)
        return reduced(search(images[one], images[other], guess), times)

    ahead = search_from(frame, frame + 1, -flow.backward[frame])
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height))
    at = x - ahead[..., 0], y.astype(np.float32) - ahead[..., 1]
    behind = search_from(frame + 1, frame, -cv2.remap(ahead, *at, cv2.INTER_LINEAR))
    small = [_smaller(images[index], times) for index in (frame, frame + 1)]
    for start, shift, valid, new, other in (
        (frame, flow.forward, flow.forward_valid, ahead, behind),
        (frame + 1, flow.backward, flow.backward_valid, behind, ahead),
    ):
        old, pair = shift[start], small if start == frame else small[::-1]
        disagrees = np.linalg.norm(new - old, axis=-1) > JUMP_SHARE * width
        alike = wide_steps.unlike(pair, new) < AS_ALIKE * wide_steps.unlike(pair, old)
        better = closed(new, other) & (~valid[start] | (disagrees & alike))
        shift[start][better], valid[start][better] = new[better], True


def closed(flow: np.ndarray, reverse: np.ndarray) -> np.ndarray:
    """Find the pixels where forward and backward flow are consistent.

    Args:
      flow: Flow in pixels, [height, width, 2].
      reverse: Flow in the opposite direction, [height, width, 2].

    Returns:
      Booleans [height, width], True if `reverse` leads from the end of `flow` to its
      start.
    """
    height, width = flow.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height))
    to = (x + flow[..., 0], y.astype(np.float32) + flow[..., 1])
    # Positions outside of the image are never consistent.
    reverse_at_end = cv2.remap(
        reverse, *to, cv2.INTER_LINEAR, borderValue=(1e3, 1e3, 1e3, 1e3)
    )
    gap = np.linalg.norm(flow + reverse_at_end, axis=-1)
    return gap < CLOSED_PX + CLOSED_SHARE * np.linalg.norm(flow, axis=-1)
