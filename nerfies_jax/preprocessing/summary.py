"""Summary of preprocessing, in numbers and in words."""

from typing import NamedTuple

import numpy as np

from nerfies_jax.preprocessing import record, rigid_groups, still_points
from nerfies_jax.preprocessing.record import MOVES, Evidence
from nerfies_jax.preprocessing.usable_paths import scene_unit
from nerfies_jax.preprocessing.view_set import Views
from nerfies_jax.preprocessing.watch import PARTS

# Above it a path's depth is that of what stands around it; half of it is a good depth.
UNCERTAIN = 0.3
# Deviation of the depth of points at rest, as a share: the video has no parallax.
NO_PARALLAX = 0.3
EXPLAINED = 0.01  # of the typical distance: a rigid group's paths are its motion


class Summary(NamedTuple):
    """Numbers about preprocessing, NaN where there is nothing to measure."""

    frames: int
    size: tuple[int, int]  # as looked at, px
    factor: int
    carried: float  # share of the textured pixels whose flow can be trusted
    moving: float  # share of the pixels
    tracks: int
    track_frames: float  # median length
    moving_tracks: int
    paths: int
    path_deviation: float  # median, of a path's depth, as a share of it
    rest_deviation: float  # median, of the depth of tracks at rest, as a share of it
    points: int  # dense, at rest
    groups: int  # of rigid motion
    group_miss: float  # median, of the paths, as a share of the typical distance
    seconds: float  # of the processor
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
    still = np.flatnonzero(evidence.score < MOVES)
    parallax = still_points.depth_deviation(
        views, tracks.take(still), evidence.rest.take(still)
    )
    distance = scene_unit(evidence)
    groups, miss = 0, np.nan
    kept = paths.known.any(1)
    if kept.any():
        place, known = paths.position[kept], paths.known[kept]
        groups, miss = rigid_groups.fewest(place, known, EXPLAINED * distance)
    return Summary(
        frames=len(evidence.row),
        size=views.size,
        factor=evidence.factor,
        carried=record.carried(views, evidence.flow),
        moving=float(evidence.moving.mean()),
        tracks=len(evidence.score),
        track_frames=_median(tracks.seen.sum(1)),
        moving_tracks=int((evidence.score > MOVES).sum()),
        paths=len(evidence.moved),
        path_deviation=_median(paths.depth_deviation),
        rest_deviation=_median(parallax),
        points=len(evidence.still.position),
        groups=groups,
        group_miss=miss / distance,
        seconds=sum(evidence.seconds),
        unusable=evidence.unusable,
    )


def lines(summary: Summary, evidence: Evidence) -> list[str]:
    """Describe preprocessing in sentences.

    Args:
      summary: The numbers.
      evidence: Preprocessing.

    Returns:
      Lines of text.
    """
    width, height = summary.size
    smaller = f", made {summary.factor} times smaller" if summary.factor > 1 else ""
    parts = [
        f"{words} {seconds:.1f}"
        for words, seconds in zip(PARTS.values(), evidence.seconds, strict=True)
    ]
    took = f"{summary.seconds:.0f} s of the processor: " + ", ".join(parts)
    sentences = [
        f"{summary.frames} frames of {width}x{height}{smaller}",
        f"{summary.carried:.0%} of the textured pixels can be carried to the next "
        "frame",
    ]
    if evidence.left_out:
        took += f"; left out, beyond the budget of work: {evidence.left_out}"
    if summary.unusable:
        return [*sentences, took, f"nothing to follow: {summary.unusable}"]
    sentences += [
        f"{summary.moving:.1%} of the pixels move by themselves",
        f"{summary.tracks:,} tracks, seen in {summary.track_frames:.0f} frames "
        f"(median); {summary.moving_tracks:,} of them move by themselves",
    ]
    if summary.paths:
        sentences.append(f"{summary.paths:,} paths in space: {_depth_words(summary)}")
        sentences.append(
            f"{summary.groups} group(s) of rigid motion explain the paths to "
            f"{summary.group_miss:.1%} of the distance"
        )
    sentences.append(f"{summary.points:,} dense points at rest{_rest_words(summary)}")
    sentences.append(took)
    if not summary.paths:
        sentences.append("nothing to follow: no track moves by itself for long enough")
    return sentences


def _depth_words(summary):
    share = summary.path_deviation
    if share > UNCERTAIN:
        return (
            "the film does not tell their depth (the camera gives no parallax, or "
            "moves at the pace of the things); it is that of what stands around"
        )
    sure = "certain" if share < UNCERTAIN / 2 else "rough"
    return f"their depth is {sure}, to {share:.1%} (median)"


def _rest_words(summary):
    if summary.rest_deviation > NO_PARALLAX:
        return ": the camera gives no parallax, so no depth can be told"
    if not np.isfinite(summary.rest_deviation):
        return "; no track stands still"
    return f"; the depth of tracks at rest is known to {summary.rest_deviation:.1%}"


def _median(values):
    return float(np.median(values)) if len(values) else np.nan
