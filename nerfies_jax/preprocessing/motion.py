"""Motion of a scene: by tracks, or by outlines or features if tracking fails."""

import dataclasses

import numpy as np

from nerfies_jax.preprocessing import feature_matches, outlines, record, static_points
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
# "No" by features requires enough of them for this upper bound of their moving share,
# and no more moving points than wrong matches make. In 20 to 50 frames of built-in
# scenes at most 0.2 % of the points move if the scene is static, and 4.5 % or more if
# it is not (bounds of 1.3 and 6.4 %). In 20 frames of two real videos with moving
# objects 1.5 and 1.6 % move (bounds of 3.5 and 3.0 %).
FEATURES_FOR_NO, FALSE_POINTS, FALSE_FEATURES = 0.02, 2.0, 0.003


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
        if _flow_fails(views, evidence):
            return _by_features(views, finding)
    return finding


def _flow_fails(views, evidence):
    """Test if tracks fail because the frames differ too much, or are too few.

    Features tell nothing about motion that hides in errors of the cameras, and external
    masks and tracks show it.
    """
    if evidence.is_external or len(views.row) <= feature_matches.LEAST_MATCHES:
        return False
    if evidence.unusable or len(views.row) < MIN_FOR_NO:
        return True
    if record.carried(views, evidence.flow) < CARRIED_FOR_NO:
        return True
    return static_noise(evidence) <= CALM_PX and moving_share(evidence) < MOVING_SHARE


def _by_features(views, finding):
    """Decide that nothing moves if enough features match static points."""
    census = feature_matches.census(views)
    share = census.moving / max(census.points, 1e-9)
    text = (
        f"in overlapping views, features of {census.points:.0f} points match, of which "
        f"{share:.1%} move (at most {census.most_moving:.1%} with "
        f"{feature_matches.CONFIDENCE:.0%} confidence)"
    )
    numbers = finding.numbers | {
        "feature_points": census.points,
        "feature_moving_share": share,
        "feature_moving_share_most": census.most_moving,
    }
    few = census.moving <= max(FALSE_POINTS, FALSE_FEATURES * census.points)
    if few and census.most_moving < FEATURES_FOR_NO:
        threshold = f"{FEATURES_FOR_NO:.0%} of the features"
        return Finding(EFFECT, text, threshold, False, CERTAIN, numbers)
    return dataclasses.replace(
        finding, evidence=f"{finding.evidence}; {text}", numbers=numbers
    )


def _threshold():
    return f"{MOVING_SHARE:.1%} of the tracks"


def _by_tracks(views, evidence):
    shares, share = frame_shares(evidence), moving_share(evidence)
    masked_share, noise = float(evidence.moving.mean()), static_noise(evidence)
    error = FALSE_SHARE * max(1.0, noise / CALM_PX) ** 2
    moves, confidence = judge(share, MOVING_SHARE, error)
    reason = _why_not_no(views, evidence, noise) if moves is False else None
    if reason is not None:
        moves, confidence = None, CANNOT_TELL
    numbers = {
        "moving_share": share,
        "moving_share_most": float(shares.max()),
        "masked_share": masked_share,
        "noise_px": noise,
    }
    measurement = (
        f"{share:.1%} of the tracks (up to {shares.max():.1%} in a frame) and "
        f"{masked_share:.1%} of the pixels are on moving objects; static tracks have a "
        f"reprojection error of {noise:.2f} px"
    )
    if reason is not None:
        measurement += f"; {reason}"
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
    visible = evidence.tracks.visible
    moves = visible[evidence.score > MOVES].sum(0)
    return moves / np.maximum(visible.sum(0), 1)


def moving_share(evidence: Evidence) -> float:
    """Compute the share of moving tracks over all frames.

    Args:
      evidence: Preprocessing.

    Returns:
      The share.
    """
    length = evidence.tracks.visible.sum(1)
    return float(length[evidence.score > MOVES].sum() / max(length.sum(), 1))


def static_noise(evidence: Evidence) -> float:
    """Compute the median reprojection error of static tracks.

    Args:
      evidence: Preprocessing.

    Returns:
      The error in pixels, inf without static tracks.
    """
    static = evidence.score < MOVES
    if not static.any():
        return np.inf
    return float(np.median(static_points.miss(evidence.static_fit.take(static))))


def _why_not_no(views, evidence, noise):
    """Reason why motion may exist undetected, or None if it would be detected."""
    if noise > CALM_PX:
        return f"above {CALM_PX:g} px, slow motion cannot be detected"
    frames = len(views.row)
    if frames < MIN_FOR_NO:
        return f"fast motion cannot be tracked in {frames} frames"
    flow_share = record.carried(views, evidence.flow)
    if flow_share < CARRIED_FOR_NO:
        return f"fast objects may be in the {1 - flow_share:.0%} of pixels without flow"
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
