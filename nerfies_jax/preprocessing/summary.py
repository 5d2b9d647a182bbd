"""Summary of preprocessing, in numbers and as text."""

from typing import NamedTuple

import numpy as np

from nerfies_jax.preprocessing import dense_points, record, rigid_groups
from nerfies_jax.preprocessing.record import MOVES, Evidence
from nerfies_jax.preprocessing.usable_paths import scene_unit
from nerfies_jax.preprocessing.view_set import Views
from nerfies_jax.preprocessing.watch import PARTS

# Relative deviation of the depth of a path above which its depth is that of its
# surroundings. Below half of this the depth is accurate.
UNCERTAIN = 0.3
# Relative deviation of the depth of static points above which there is no parallax.
NO_PARALLAX = 0.3
EXPLAINED = 0.01  # error of the paths of a rigid group, relative to the scene distance


class Summary(NamedTuple):
    """Numbers about preprocessing, NaN if there is nothing to measure."""

    frames: int
    size: tuple[int, int]  # after downsampling, px
    factor: int
    carried: float  # share of the textured pixels with consistent flow
    moving: float  # share of the pixels
    tracks: int
    track_frames: float  # median length
    moving_tracks: int
    paths: int
    path_deviation: float  # median relative deviation of the depth of paths
    rest_deviation: float  # median relative deviation of the depth of static tracks
    points: int  # dense static points
    groups: int  # of rigid motion
    group_miss: float  # median error of the paths, relative to the scene distance
    seconds: float  # processor time
    unusable: str


def of(views: Views, evidence: Evidence) -> Summary:
    """Summarize preprocessing.

    Args:
      views: The frames.
      evidence: Their preprocessing.

    Returns:
      The numbers.
    """
    tracks, paths = evidence.tracks, evidence.paths
    static = np.flatnonzero(evidence.score < MOVES)
    parallax = dense_points.depth_deviation(
        views, tracks.take(static), evidence.static_fit.take(static)
    )
    distance = scene_unit(evidence)
    groups, miss = 0, np.nan
    usable = paths.known.any(1)
    if usable.any():
        place, valid = paths.position[usable], paths.known[usable]
        groups, miss = rigid_groups.fewest(place, valid, EXPLAINED * distance)
    return Summary(
        frames=len(evidence.row),
        size=views.size,
        factor=evidence.factor,
        carried=record.carried(views, evidence.flow),
        moving=float(evidence.moving.mean()),
        tracks=len(evidence.score),
        track_frames=_median(tracks.visible.sum(1)),
        moving_tracks=int((evidence.score > MOVES).sum()),
        paths=len(evidence.paths.position),
        path_deviation=_median(paths.depth_deviation),
        rest_deviation=_median(parallax),
        points=len(evidence.static_cloud.position),
        groups=groups,
        group_miss=miss / distance,
        seconds=sum(evidence.seconds),
        unusable=evidence.unusable,
    )


def lines(summary: Summary, evidence: Evidence) -> list[str]:
    """Describe preprocessing as text.

    Args:
      summary: The numbers.
      evidence: Preprocessing.

    Returns:
      Lines of text.
    """
    width, height = summary.size
    smaller = f", downsampled {summary.factor} times" if summary.factor > 1 else ""
    parts = [
        f"{words} {seconds:.1f}"
        for words, seconds in zip(PARTS.values(), evidence.seconds, strict=True)
    ]
    duration = f"{summary.seconds:.0f} s of processor time: " + ", ".join(parts)
    sentences = [
        f"{summary.frames} frames of {width}x{height}{smaller}",
        f"{summary.carried:.0%} of the textured pixels have consistent flow to the "
        "next frame",
    ]
    if evidence.left_out:
        duration += f"; skipped, beyond the budget of work: {evidence.left_out}"
    if summary.unusable:
        return [*sentences, duration, f"motion is unknown: {summary.unusable}"]
    sentences += [
        f"{summary.moving:.1%} of the pixels show moving objects",
        f"{summary.tracks:,} tracks, visible in {summary.track_frames:.0f} frames "
        f"(median); {summary.moving_tracks:,} of them on moving objects",
    ]
    if summary.paths:
        sentences.append(f"{summary.paths:,} 3D paths: {_depth_text(summary)}")
        sentences.append(
            f"{summary.groups} group(s) of rigid motion explain the paths to "
            f"{summary.group_miss:.1%} of the scene distance"
        )
    sentences.append(f"{summary.points:,} dense static points{_static_text(summary)}")
    sentences.append(duration)
    if not summary.paths:
        sentences.append(
            "motion is unknown: no track of a moving object is long enough"
        )
    return sentences


def _depth_text(summary):
    share = summary.path_deviation
    if share > UNCERTAIN:
        return (
            "their depth cannot be estimated (the camera has no parallax, or moves "
            "like the objects), so the depth of their surroundings is used"
        )
    quality = "accurate" if share < UNCERTAIN / 2 else "rough"
    return f"their depth is {quality}, to {share:.1%} (median)"


def _static_text(summary):
    if summary.rest_deviation > NO_PARALLAX:
        return ": their depth is unknown, because the camera has no parallax"
    if not np.isfinite(summary.rest_deviation):
        return "; there are no static tracks"
    return f"; the depth of static tracks is accurate to {summary.rest_deviation:.1%}"


def _median(values):
    return float(np.median(values)) if len(values) else np.nan
