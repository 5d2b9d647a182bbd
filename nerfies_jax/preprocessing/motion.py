"""Motion of a scene: by tracks, or by outlines if tracking fails."""

import numpy as np

from nerfies_jax.preprocessing import outlines, record, rest_points
from nerfies_jax.preprocessing.findings import (
    CANNOT_TELL,
    CERTAIN,
    Finding,
    cannot_tell,
    judge,
)
from nerfies_jax.preprocessing.findings import MOTION as EFFECT
from nerfies_jax.preprocessing.record import MOVES, Evidence
from nerfies_jax.preprocessing.view_set import Views

# Share of moving tracks over all frames. Static built-in scenes have 0.03 %, and those
# with the least motion 4 %.
MOVING_SHARE = 0.005
FALSE_SHARE = 0.001  # standard error, three times the share in static scenes
# Reprojection error of static points above which slow motion cannot be excluded. Camera
# errors also make some static tracks look moving, proportional to their square.
CALM_PX = 0.75
# "No" requires a small mask, because pixels that cannot be tracked may move. Static
# videos have up to 0.8 % (`static` at 112x84 and 40 frames).
MASKED_FOR_NO = 0.01
# "No" also requires consistent flow for most textured pixels, and enough frames.
CARRIED_FOR_NO, MIN_FOR_NO = 0.8, 9


def motion(views: Views, evidence: Evidence) -> Finding:
    """Decide if anything moves.

    Args:
      views: The frames.
      evidence: Their preprocessing.

    Returns:
      The finding.
    """
    if np.ptp(views.time) == 0:
        return Finding(
            EFFECT,
            "all frames have the same timestamp",
            "two timestamps",
            False,
            CERTAIN,
        )
    if evidence.unusable:
        finding = cannot_tell(EFFECT, evidence.unusable, _threshold())
    else:
        finding = _by_tracks(views, evidence)
    if finding.wanted is None:
        shapes = outlines.outlines(views)
        if shapes is not None:
            return outlines.motion(views, shapes)
    return finding


def _threshold():
    return f"{MOVING_SHARE:.1%} of the tracks"


def _by_tracks(views, evidence):
    shares, share = frame_shares(evidence), moving_share(evidence)
    masked, noise = float(evidence.moving.mean()), rest_noise(evidence)
    error = FALSE_SHARE * max(1.0, noise / CALM_PX) ** 2
    moves, confidence = judge(share, MOVING_SHARE, error)
    lost = _why_not_no(views, evidence, noise) if moves is False else None
    if lost is not None:
        moves, confidence = None, CANNOT_TELL
    numbers = {
        "moving_share": share,
        "moving_share_most": float(shares.max()),
        "masked_share": masked,
        "noise_px": noise,
    }
    measurement = (
        f"{share:.1%} of the tracks (up to {shares.max():.1%} in a frame) and "
        f"{masked:.1%} of the pixels are on moving objects; static tracks have a "
        f"reprojection error of {noise:.2f} px"
    )
    if lost is not None:
        measurement += f"; {lost}"
    speed = speeds(views, evidence) if moves else {}
    if speed:
        numbers |= speed
        measurement += (
            f"; median speed {speed['speed_px']:.2g} px ({speed['speed_units']:.2g} "
            f"scene units) per frame, {speed['speed_px_fast']:.2g} px for the fastest "
            "tenth"
        )
    return Finding(EFFECT, measurement, _threshold(), moves, confidence, numbers)


def frame_shares(evidence: Evidence) -> np.ndarray:
    """Compute the share of moving tracks in each frame.

    Args:
      evidence: Preprocessing.

    Returns:
      Shares, [frames].
    """
    visible = evidence.tracks.seen
    moves = visible[evidence.score > MOVES].sum(0)
    return moves / np.maximum(visible.sum(0), 1)


def moving_share(evidence: Evidence) -> float:
    """Compute the share of moving tracks over all frames.

    Args:
      evidence: Preprocessing.

    Returns:
      The share.
    """
    length = evidence.tracks.seen.sum(1)
    return float(length[evidence.score > MOVES].sum() / max(length.sum(), 1))


def rest_noise(evidence: Evidence) -> float:
    """Compute the median reprojection error of static tracks.

    Args:
      evidence: Preprocessing.

    Returns:
      The error in pixels, inf without static tracks.
    """
    static = evidence.score < MOVES
    if not static.any():
        return np.inf
    return float(np.median(rest_points.miss(evidence.rest.take(static))))


def _why_not_no(views, evidence, noise):
    """Reason why motion may exist undetected, or None if it would be detected."""
    if noise > CALM_PX:
        return f"above {CALM_PX:g} px, slow motion cannot be detected"
    frames = len(views.row)
    if frames < MIN_FOR_NO:
        return f"fast motion cannot be tracked in {frames} frames"
    matched = record.carried(views, evidence.flow)
    if matched < CARRIED_FOR_NO:
        return f"fast objects may be in the {1 - matched:.0%} of pixels without flow"
    if evidence.moving.mean() > MASKED_FOR_NO:
        return "pixels that differ from the static scene may be too fast for tracking"
    return None


def speeds(views: Views, evidence: Evidence) -> dict[str, float]:
    """Measure the speed of paths from one frame to the next.

    Args:
      views: The frames.
      evidence: Their preprocessing.

    Returns:
      Speeds in scene units, and in pixels at their depth. Empty if no path is known.
    """
    paths = evidence.paths
    both = paths.known[:, 1:] & paths.known[:, :-1]
    if not both.any():
        return {}
    step = np.linalg.norm(np.diff(paths.position, axis=1), axis=-1)
    px = step * views.intrinsics[:-1, 0, 0] / paths.depth[:, :-1]
    return {
        "speed_px": float(np.median(px[both])),
        "speed_px_fast": float(np.quantile(px[both], 0.9)),
        "speed_units": float(np.median(step[both])),
    }
