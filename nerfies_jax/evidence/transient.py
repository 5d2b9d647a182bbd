"""Things that come and go between two frames: seen in one, nowhere in the next.

What moves is still somewhere near in the next frame, and what comes from behind
another thing comes out as a strip. What is no part of the scene, in captures whose
frames are photographs or whose film was cut together, is suddenly there or gone.
"""

import numpy as np
import scipy.ndimage as nd
import skimage.feature

from nerfies_jax.evidence import motion, optical_flow
from nerfies_jax.evidence.findings import TRANSIENT as EFFECT
from nerfies_jax.evidence.findings import Finding, cannot_tell, judge
from nerfies_jax.evidence.motion import Film
from nerfies_jax.evidence.view_set import Views

LOST_PX, LOST_SHARE = 1.0, 0.1  # forward and back must meet, of the way
LOST_COLOUR = 0.1  # half the contrast of a picture whose deviation is a fifth
OPENED_SHARE = 3 / 176  # of the picture's width: no strips
PATCH = 5  # pixels to each side
REACH_SHARES = (0.05, 0.15)  # of the width: how far what was lost is looked for
AROUND = 3  # pairs before and after: what jumps stands out among them
ALIKE = 0.7  # correlation of a patch with where it is found again
MOST_PATCHES = 40  # looked for, of a frame
# Of the pixels of both frames, beyond what pairs around lose. Built-in scenes in which
# nothing comes or goes lose up to 1.9 % once and 1.4 % twice, at 60 frames and at 40.
GONE_SHARE = 0.03
MIN_TIMES = 2  # it came and it went


def transient(views: Views, films: list[Film]) -> Finding:
    """Whether large parts of pictures are there in one frame and gone in the next."""
    threshold = (
        f"{GONE_SHARE:.0%} of a picture found nowhere near in the next, "
        f"{MIN_TIMES} times"
    )
    reason = motion.unusable(views, films)
    if reason is not None:
        return cannot_tell(EFFECT, reason, threshold)
    each = [jumps(views, film) for film in films]
    gone = np.concatenate(each)
    worst = np.sort(np.concatenate([_above_neighbours(one) for one in each]))[::-1]
    if len(worst) <= 2 * MIN_TIMES:
        return cannot_tell(EFFECT, f"only {len(worst)} pairs of frames", threshold)
    # What the other pairs lose is the noise of those that jump.
    usual = float(np.sort(gone)[: -2 * MIN_TIMES].mean())
    value = float(worst[MIN_TIMES - 1])
    wanted, confidence = judge(value, GONE_SHARE, usual)
    times = int((worst > GONE_SHARE).sum())
    if wanted is False and not _always_there(films):
        return cannot_tell(
            EFFECT,
            "nothing comes or goes at once, but what moves is there in less than half "
            "of the frames",
            threshold,
        )
    evidence = (
        f"between {times} of {len(gone)} pairs of frames parts of the picture come or "
        f"go (most: {worst[0]:.1%} of the pixels; usual: {usual:.2%})"
    )
    numbers = {
        "times": float(times),
        "largest_share": float(worst[0]),
        "usual_share": usual,
    }
    return Finding(EFFECT, evidence, threshold, wanted, confidence, numbers)


def _above_neighbours(gone):
    """What a pair loses beyond the median of its neighbours: a fast pan loses often."""
    above = []
    for at, one in enumerate(gone):
        beside = np.r_[gone[max(0, at - AROUND) : at], gone[at + 1 : at + 1 + AROUND]]
        above.append(max(0.0, one - float(np.median(beside))) if len(beside) else 0.0)
    return np.array(above)


def _always_there(films):
    """Whether something moves in most frames, or in none."""
    there = [one.moving.any() for film in films for one in film.centres]
    return np.mean(there) > 0.5 or not any(there)


def jumps(views: Views, film: Film) -> np.ndarray:
    """[pairs]: the lesser share of pixels that one frame shows and the other does not.

    The lesser of both directions: what comes hides what was there.
    """
    shares = []
    for at, flow in enumerate(film.flows):
        one, other = (int(film.sequence[at + step]) for step in (0, 1))
        shares.append(
            min(
                gone(views, one, other, flow.forward, flow.backward),
                gone(views, other, one, flow.backward, flow.forward),
            )
        )
    return np.array(shares)


def gone(views: Views, index: int, other: int, there, back) -> float:
    """The share of a frame's pixels whose surroundings are nowhere near in another."""
    lost = _lost(views, index, other, there, back)
    if not lost.any():
        return 0.0
    reach = _reach(views, there)
    tried = np.argwhere(lost & views.textured[index])
    if not len(tried):
        return 0.0
    rng = np.random.default_rng(index)
    if len(tried) > MOST_PATCHES:
        tried = tried[rng.choice(len(tried), MOST_PATCHES, replace=False)]
    picture = optical_flow.levelled(views.grey[index])
    target = optical_flow.levelled(views.grey[other])
    # The camera's own turn first: what is left is looked for around.
    shift = np.median(there.reshape(-1, 2), axis=0).round().astype(int)
    missing = sum(
        not _found(picture, target, line, column, shift, reach)
        for line, column in tried
    )
    return float(lost.mean() * missing / len(tried))


def _lost(views, index, other, there, back):
    """[height, width]: not on a path to the other frame, though it should be there."""
    width, height = views.size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
    end = grid + there
    gap = np.linalg.norm(there + optical_flow.sample(back, end), axis=-1)
    open_end = gap > LOST_PX + LOST_SHARE * np.linalg.norm(there, axis=-1)
    one, two = (optical_flow.levelled(views.grey[i]) for i in (index, other))
    colour = np.abs(one - optical_flow.sample(two[..., None], end)[..., 0])
    changed = nd.gaussian_filter(colour, 1.5) > LOST_COLOUR
    # Beyond the edge of the other picture under the common shift, and the patch's own.
    # What is near moves more than the rest, and leaves where the rest stays.
    rim = PATCH + _reach(views, there)
    common = grid + np.median(there.reshape(-1, 2), axis=0)
    bound = np.array([width - 1, height - 1]) - rim
    stays = ((common >= rim) & (common <= bound)).all(-1)
    bound = np.array([width - 1, height - 1]) - PATCH
    stays &= ((grid >= PATCH) & (grid <= bound)).all(-1)
    lost = (open_end | changed) & stays & views.valid[index]
    return nd.binary_opening(lost, iterations=max(1, round(OPENED_SHARE * width)))


def _reach(views, there):
    """How far from the common shift anything is looked for, px."""
    off = np.linalg.norm(there - np.median(there.reshape(-1, 2), axis=0), axis=-1)
    low, high = (share * views.size[0] for share in REACH_SHARES)
    return round(float(np.clip(2 * np.quantile(off, 0.9), low, high)))


def _found(picture, target, line, column, shift, reach):
    patch = picture[
        line - PATCH : line + PATCH + 1, column - PATCH : column + PATCH + 1
    ]
    span = reach + PATCH
    middle = line + shift[1], column + shift[0]
    low = [max(0, at - span) for at in middle]
    window = target[low[0] : middle[0] + span + 1, low[1] : middle[1] + span + 1]
    if min(window.shape) < 2 * PATCH + 1:
        return True  # out of the picture: nothing to be said
    return bool(skimage.feature.match_template(window, patch).max() > ALIKE)
