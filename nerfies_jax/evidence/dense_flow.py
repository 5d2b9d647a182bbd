"""Dense flow between neighboring frames that follow each other in time, both ways.

OpenCV's DIS (Kroeger et al. 2016, arXiv:1603.03590) on pictures brought to one mean and
contrast. Only neighbors are compared: over longer gaps patterns that repeat are taken
for each other. Where an area is lost even so, or jumps, it is looked for where its last
motion would take it.
"""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np

from nerfies_jax import events
from nerfies_jax.evidence import wide_steps
from nerfies_jax.evidence.view_set import Views

# Small pictures are enlarged first: 0.06 px of median error for 0.10 at 176x132, where
# the built-in scenes' flow is known.
ENLARGED_BELOW_PX, ENLARGED = 320, 2
# Forward and back must meet: within half a pixel and a fiftieth of the way.
CLOSED_PX, CLOSED_SHARE = 0.5, 0.02

# Searches that a second look at a wide step takes: one for each plane, and comparing.
SECOND_LOOK = 8
# Of the width: the side of an area whose flow is looked for again where it was carried
# to a frame and is lost there. Patterns that repeat are taken for each other in some
# frames: the turning cube of the built-in scenes lost all its tracks in one of them.
LOST_SHARE = 0.06
# Of the width, from one frame to the next: what turns that sharply is looked at again,
# and goes on as it came where that looks as alike. A checker of the fast cube is 0.06.
JUMP_SHARE, AS_ALIKE = 0.03, 1.1


class NeighborFlow(NamedTuple):
    """Flow of each frame to the next and to the previous one in time.

    From pixel centers, in pixels right and down; `seen` where going there and back ends
    at the start. The last frame has no next one, the first none before: zero, unseen.
    """

    forward: np.ndarray  # [frames, height, width, 2] float32
    forward_seen: np.ndarray  # [frames, height, width] bool
    backward: np.ndarray
    backward_seen: np.ndarray


def enlarged(views: Views) -> int:
    """How many times larger than the views' own the pictures are compared."""
    return ENLARGED if max(views.size) <= ENLARGED_BELOW_PX else 1


def leveled(views: Views, times: int | None = None) -> np.ndarray:
    """[frames, height, width] uint8: gray pictures of one mean and spread, enlarged.

    Without it a film of varying exposure has 79 % of its pixels marked as moving.
    """
    gray = 255 * views.gray
    mean, spread = gray.mean((1, 2)), np.maximum(gray.std((1, 2)), 1e-3)
    scaled = (gray - mean[:, None, None]) / spread[:, None, None]
    alike = np.clip(scaled * np.median(spread) + np.median(mean), 0, 255)
    pictures = [np.rint(one).astype(np.uint8) for one in alike]
    times = enlarged(views) if times is None else times
    return np.stack([larger(one, times) for one in pictures])


def searched_pixels(views: Views, pictures: np.ndarray) -> int:
    """Pixels of the finest level of one search between such pictures."""
    pixels = pictures[0].size
    return pixels if enlarged(views) > 1 else pixels // 4


def larger(picture: np.ndarray, times: int) -> np.ndarray:
    """A picture [height, width] uint8 with so many pixels for one of its own."""
    if times == 1:
        return picture
    size = times * picture.shape[1], times * picture.shape[0]
    return cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)


def reduced(shift: np.ndarray, times: int) -> np.ndarray:
    """Flow [height, width, 2] between enlarged pictures, in pixels of their own."""
    if times == 1:
        return shift
    size = shift.shape[1] // times, shift.shape[0] // times
    return cv2.resize(shift, size, interpolation=cv2.INTER_AREA) / times


def enlarged_flow(shift: np.ndarray, times: int) -> np.ndarray:
    """Flow [height, width, 2] in px, as between pictures that are enlarged so much.

    [times height, times width, 2], in pixels of those; `reduced` is the way back.
    """
    size = times * shift.shape[1], times * shift.shape[0]
    return times * cv2.resize(np.ascontiguousarray(shift), size)


def _smaller(picture, times):
    size = picture.shape[1] // times, picture.shape[0] // times
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def dis(times: int) -> Callable[..., np.ndarray]:
    """Finds flow between pictures that were enlarged so many times.

    A third argument is a guess of it, in pixels of the enlarged pictures.
    """
    # Two: after a search from a guess, OpenCV 4.x finds something else without one.
    plain, guided = (
        cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM) for _ in range(2)
    )
    for search in (plain, guided):
        search.setFinestScale(0 if times > 1 else 1)

    def flow(one, other, guess=None):
        return (plain if guess is None else guided).calc(one, other, guess)

    return flow


def between_neighbors(
    views: Views,
    pictures: np.ndarray,
    span: tuple[float, float] | None = None,
    room_for: Callable[[int], int] = lambda count: count,
) -> NeighborFlow:
    """Flow between all frames that follow each other, both ways, and checked.

    `pictures` are the views' as `leveled` makes them. With `span`, the nearest and
    farthest z-depth, wide steps are looked at again from where a still scene would be,
    the first ones of them if there is no `room_for` all.
    """
    (width, height), frames = views.size, len(views.row)
    times = pictures.shape[2] // width
    searches = threading.local()  # one for each thread: it works in its own memory

    def search(*pair_and_guess):
        if not hasattr(searches, "own"):
            searches.own = dis(times)
        return searches.own(*pair_and_guess)

    forward, backward = np.zeros((2, frames, height, width, 2), np.float32)

    def place(step):
        one, other = step
        return (forward if other > one else backward)[one]

    def first_look(step):
        one, other = step
        return reduced(search(pictures[one], pictures[other]), times)

    def second_look(step):
        pair = tuple(pictures[frame] for frame in step)
        return wide_steps.improved(
            views,
            tuple(_smaller(picture, times) for picture in pair),
            step,
            place(step),
            lambda guess: reduced(search(*pair, enlarged_flow(guess, times)), times),
            span,
        )

    ahead = [(frame, frame + 1) for frame in range(frames - 1)]
    steps = ahead + [(after, before) for before, after in ahead]
    # 118 flows of 176x132: 8.5 s on one core; 4.9 on two, 6.1 by OpenCV's own threads.
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
        if _lost(checked_flow, frame) or _jumps(checked_flow, frame):
            _go_on(checked_flow, frame, pictures, search)
    return checked_flow


def checked(forward: np.ndarray, backward: np.ndarray) -> NeighborFlow:
    """Flow [frames, height, width, 2] to the next and the previous frame, as `closed`.

    The last frame's forward flow and the first one's backward flow are not seen.
    """
    forward_seen, backward_seen = np.zeros((2, *forward.shape[:3]), bool)
    for frame in range(len(forward) - 1):
        there, back = forward[frame], backward[frame + 1]
        forward_seen[frame] = closed(there, back)
        backward_seen[frame + 1] = closed(back, there)
    return NeighborFlow(forward, forward_seen, backward, backward_seen)


def _lost(flow, frame):
    """Whether a coherent area was carried to a frame and not from there."""
    return _covers_patch(flow.backward_seen[frame] & ~flow.forward_seen[frame])


def _jumps(flow, frame):
    """Whether a coherent area leaves a frame otherwise than it came."""
    turned = np.linalg.norm(flow.forward[frame] + flow.backward[frame], axis=-1)
    both = flow.backward_seen[frame] & flow.forward_seen[frame]
    return _covers_patch(both & (turned > JUMP_SHARE * turned.shape[1]))


def _covers_patch(area):
    side = 2 * round(LOST_SHARE * area.shape[1] / 2) + 1
    # Nothing lies outside: strips at the border leave the picture.
    outside = {"borderType": cv2.BORDER_CONSTANT, "borderValue": 0}
    return cv2.erode(np.uint8(area), np.ones((side, side)), **outside).any()


def _go_on(flow, frame, pictures, search):
    """Look again, from the guess that all goes on as it came; keep what closes."""
    height, width = flow.forward.shape[1:3]
    times = pictures.shape[2] // width

    def again(one, other, guess):
        guess = enlarged_flow(guess, times)
        return reduced(search(pictures[one], pictures[other], guess), times)

    there = again(frame, frame + 1, -flow.backward[frame])
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height))
    at = x - there[..., 0], y.astype(np.float32) - there[..., 1]
    back = again(frame + 1, frame, -cv2.remap(there, *at, cv2.INTER_LINEAR))
    small = [_smaller(pictures[index], times) for index in (frame, frame + 1)]
    for here, shift, seen, new, other in (
        (frame, flow.forward, flow.forward_seen, there, back),
        (frame + 1, flow.backward, flow.backward_seen, back, there),
    ):
        old, pair = shift[here], small if here == frame else small[::-1]
        apart = np.linalg.norm(new - old, axis=-1) > JUMP_SHARE * width
        alike = wide_steps.unlike(pair, new) < AS_ALIKE * wide_steps.unlike(pair, old)
        better = closed(new, other) & (~seen[here] | (apart & alike))
        shift[here][better], seen[here][better] = new[better], True


def closed(there: np.ndarray, back: np.ndarray) -> np.ndarray:
    """[height, width]: where `back` leads from the end of `there` to its start."""
    height, width = there.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height))
    to = (x + there[..., 0], y.astype(np.float32) + there[..., 1])
    # Outside nothing leads back.
    back_there = cv2.remap(
        back, *to, cv2.INTER_LINEAR, borderValue=(1e3, 1e3, 1e3, 1e3)
    )
    gap = np.linalg.norm(there + back_there, axis=-1)
    return gap < CLOSED_PX + CLOSED_SHARE * np.linalg.norm(there, axis=-1)
