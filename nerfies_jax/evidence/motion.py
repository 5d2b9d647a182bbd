"""What moves by itself: how much of the picture, and how fast at least."""

import dataclasses

import numpy as np
import scipy.ndimage as nd

from nerfies_jax.evidence import depths, optical_flow, sweep, view_set
from nerfies_jax.evidence.findings import CANNOT_TELL, Finding, cannot_tell, judge
from nerfies_jax.evidence.findings import MOTION as EFFECT
from nerfies_jax.evidence.optical_flow import Paths, Step, StillFit
from nerfies_jax.evidence.view_set import Views

REACH = 8  # frames before and after: what moves 0.1 px a frame on shows in them
CENTRES = 12  # frames whose pixels are followed
MIN_FRAMES = 3  # of one camera: two tell depth, and nothing else
MIN_FOLLOWED = 4  # frames a pixel is followed to; fewer in shorter films
# A path that a still point misses by so much moves. Still scenes (built-in `static`
# and `specular`, any seed) leave 0.10 px in the median and 1.5 px in one pixel of a
# hundred, in slivers along the rims of things; opening by three pixels in a picture 176
# wide leaves 0.03 % of the pixels of all frames.
MOVES_PX, MOVES_DEVIATIONS = 1.5, 4.0
OPENED_SHARE = 3 / 176  # of the picture's width
MOVING_SHARE = 0.005  # of the pixels that can be followed; 30 times what is left
FALSE_SHARE = 0.001  # standard error: three times what still scenes leave
# Where even pixels at rest miss by more than this, slow motion hides in it: then "no"
# cannot be said.
CALM_PX = 2 * MOVES_PX / MOVES_DEVIATIONS
# Paths are of use where at least so many of the textured pixels can be followed.
FOLLOWED_SHARE, TEXTURED_SHARE = 0.3, 0.05
# And "no" needs nearly all of them, in films of some length: what moves too fast to be
# followed drops out. Still built-in scenes keep 0.9 to 0.99.
FOLLOWED_FOR_NO, MIN_FOR_NO = 0.8, 9


@dataclasses.dataclass(frozen=True)
class Centre:
    """One frame whose pixels were followed."""

    view: int
    paths: Paths
    fit: StillFit
    usable: np.ndarray  # [height, width] bool: textured, and followed far enough
    moving: np.ndarray  # [height, width] bool: opened
    noise_px: float  # median residual


@dataclasses.dataclass(frozen=True)
class Film:
    """Frames of one camera in order, the flow between them, and what was followed."""

    sequence: np.ndarray
    flows: list[Step]
    centres: list[Centre]


def films(views: Views, spans: tuple[float, float]) -> list[Film]:
    """Every camera's frames with their flow; cameras of too few frames are left out.

    `spans` are the nearest and the farthest z-depth, scene units.
    """
    long = [
        sequence
        for sequence in view_set.sequences(views)
        if len(sequence) >= MIN_FRAMES
    ]
    total = sum(len(sequence) for sequence in long)
    every_film = []
    for sequence in long:
        flows = optical_flow.steps(views, sequence)
        count = max(1, round(CENTRES * len(sequence) / total))
        ends = min(2, (len(sequence) - 1) // 2)  # followed one way only beyond
        at = np.linspace(ends, len(sequence) - 1 - ends, count).round().astype(int)
        centres = [follow(views, sequence, flows, one, spans) for one in np.unique(at)]
        every_film.append(Film(sequence, flows, centres))
    return _with_depths(views, every_film)


def _with_depths(views, every_film):
    """What other times look through moves as well."""
    centres = [one for film in every_film for one in film.centres]
    fits = [(one.view, one.fit, one.usable, one.noise_px) for one in centres]
    through = dict(
        zip(
            (one.view for one in centres),
            depths.looked_through(views, fits),
            strict=True,
        )
    )
    width = _opening(views)
    return [
        dataclasses.replace(
            film,
            centres=[
                dataclasses.replace(
                    one,
                    moving=one.moving
                    | nd.binary_opening(through[one.view], iterations=width),
                )
                for one in film.centres
            ],
        )
        for film in every_film
    ]


def _opening(views):
    return max(1, round(OPENED_SHARE * views.size[0]))


def follow(
    views: Views,
    sequence: np.ndarray,
    flows: list[Step],
    at: int | np.integer,
    spans: tuple[float, float],
) -> Centre:
    """One frame's pixels through its neighbours, against a still scene."""
    index = int(sequence[at])
    paths = optical_flow.follow(flows, sequence, at, REACH)
    fit = optical_flow.fit_still(views, index, paths, spans[0])
    enough = min(MIN_FOLLOWED, len(sequence) - 1)
    usable = views.textured[index] & (fit.count >= enough)
    noise = float(np.median(fit.residual[usable])) if usable.any() else np.inf
    strays = usable & (fit.residual > max(MOVES_PX, MOVES_DEVIATIONS * noise))
    strays = nd.binary_opening(strays, iterations=_opening(views))
    static = usable & (fit.residual < 2 * noise)
    moving = sweep.confirmed(views, index, paths, strays, static, spans)
    return Centre(index, paths, fit, usable, moving, noise)


def unusable(views: Views, every_film: list[Film]) -> str | None:
    """Why flow says nothing about this capture; None where it does."""
    centres = [centre for film in every_film for centre in film.centres]
    if not centres:
        return (
            f"no camera has {MIN_FRAMES} frames at different times to follow pixels "
            "through"
        )
    textured = np.array([views.textured[centre.view].mean() for centre in centres])
    if np.median(textured) < TEXTURED_SHARE:
        return f"only {np.median(textured):.1%} of the pixels have texture to follow"
    kept = _kept(views, centres)
    if kept < FOLLOWED_SHARE:
        return (
            f"views of neighbouring times are too far apart: {kept:.0%} of the "
            "textured pixels can be followed"
        )
    return None


def _kept(views, centres):
    """The share of the textured pixels that can be followed, in the median frame."""
    return np.median(
        [one.usable.sum() / max(views.textured[one.view].sum(), 1) for one in centres]
    )


def _why_not_no(views, every_film, noise):
    """Why motion may be there and not show; None where it would."""
    if noise > CALM_PX:
        return f"above {CALM_PX:g} px slow motion would not show"
    longest = max(len(film.sequence) for film in every_film)
    if longest < MIN_FOR_NO:
        return f"what moves far between {longest} frames cannot be followed"
    kept = _kept(views, [one for film in every_film for one in film.centres])
    if kept < FOLLOWED_FOR_NO:
        return f"what is fast may be among the {1 - kept:.0%} that cannot be followed"
    return None


def motion(views: Views, every_film: list[Film], spans: tuple[float, float]) -> Finding:
    """Whether anything moves by itself."""
    reason = unusable(views, every_film)
    threshold = f"{MOVING_SHARE:.1%} of the pixels that can be followed"
    if reason is not None:
        return cannot_tell(EFFECT, reason, threshold)
    centres = [centre for film in every_film for centre in film.centres]
    shares = np.array([one.moving.sum() / one.usable.sum() for one in centres])
    noise = float(np.median([one.noise_px for one in centres]))
    wanted, confidence = judge(float(shares.mean()), MOVING_SHARE, FALSE_SHARE)
    lost = _why_not_no(views, every_film, noise) if wanted is False else None
    if lost is not None:
        wanted, confidence = None, CANNOT_TELL
    numbers = {
        "moving_share": float(shares.mean()),
        "moving_share_most": float(shares.max()),
        "frames_with_motion_share": float((shares > MOVING_SHARE).mean()),
        "noise_px": noise,
    }
    evidence = (
        f"{shares.mean():.1%} of the pixels (up to {shares.max():.1%} of a frame) take "
        f"paths that no still point takes; the rest is explained to {noise:.2f} px"
    )
    if lost is not None:
        evidence += f"; {lost}"
    if wanted:
        speed = speeds(views, every_film, spans)
        numbers |= speed
        evidence += (
            f"; at least {speed['speed_px']:.2g} px "
            f"({speed['speed_units']:.2g} scene units) a frame in the median, "
            f"{speed['speed_px_fast']:.2g} px the fastest tenth"
        )
    return Finding(EFFECT, evidence, threshold, wanted, confidence, numbers)


def speeds(views: Views, every_film: list[Film], spans: tuple[float, float]) -> dict:
    """How fast the moving pixels move, at least: off what depth alone could do.

    From one frame to the next, in pixels of the small pictures and in scene units at
    the depth of the still scene around.
    """
    slow, units = [], []
    for film in every_film:
        place = {int(index): at for at, index in enumerate(film.sequence)}
        for one in film.centres:
            at = place[one.view]
            if at + 1 >= len(film.sequence) or not one.moving.any():
                continue
            other = int(film.sequence[at + 1])
            off = _off_epipolar(views, one, other, film.flows[at].forward, spans)
            static = one.usable & ~one.moving & (one.fit.inverse_depth > 0)
            depth = 1 / np.median(one.fit.inverse_depth[static]) if static.any() else 0
            slow.append(off[one.moving])
            units.append(off[one.moving] * depth / views.intrinsics[one.view][0, 0])
    if not slow:
        return {"speed_px": 0.0, "speed_px_fast": 0.0, "speed_units": 0.0}
    slow, units = np.concatenate(slow), np.concatenate(units)
    return {
        "speed_px": float(np.median(slow)),
        "speed_px_fast": float(np.quantile(slow, 0.9)),
        "speed_units": float(np.median(units)),
    }


def _off_epipolar(views, centre, other, flow, spans):
    """[height, width] px from where the flow leads to where a still point could be."""
    width, height = views.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    there = np.stack([x, y], -1) + flow
    ray = view_set.rays(views, centre.view)
    ends = []
    for depth in spans:
        point = views.position[centre.view] + depth * ray
        pixel, _ = view_set.project(views, other, point.reshape(-1, 3))
        ends.append(pixel.reshape(height, width, 2))
    near, far = ends
    along = far - near
    length_sq = (along**2).sum(-1)
    share = ((there - near) * along).sum(-1) / np.where(length_sq > 0, length_sq, 1)
    nearest = near + np.clip(share, 0, 1)[..., None] * along
    return np.linalg.norm(there - nearest, axis=-1)
