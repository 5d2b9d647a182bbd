"""Findings about a capture's static points: their number, coverage and consistency."""

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.preprocessing import dense_points, static_points, view_set
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.dense_points import CENTERS, REACH
from nerfies_jax.preprocessing.findings import (
    BACKGROUND,
    CERTAIN,
    START,
    Finding,
    cannot_tell,
    judge,
)
from nerfies_jax.preprocessing.motion import static_noise
from nerfies_jax.preprocessing.record import Evidence
from nerfies_jax.preprocessing.view_set import MIN_POINTS, Views

CELLS = (8, 6)  # columns and rows. A cell is covered if it contains a point.
COVERED = 0.5  # share of the cells with observed pixels
# Maximum distance of a static point from its track: pixels of reduced images, more in
# larger images, and standard deviations.
AGREES_PX, AGREES_DEVIATIONS = 3.0, 4.0
LEAST_FOLLOWED = 4  # frames that a point is tracked to, fewer in shorter videos
LEAST_MOVING = 0.005  # of the pixels of a frame. Static scenes have up to 0.4 %.
# Maximum relative deviation of a known depth, and bound of its relative difference.
DEPTH_KNOWN, DEPTH_AGREES = 0.05, 0.2
STILL_SHARE = 0.8  # of the points that can be checked


def _coverage(views: Views, points: np.ndarray) -> float:
    """Compute the share of image cells with observed pixels that contain a point."""
    across, down = CELLS
    width, height = views.size
    hits = total = 0
    for index in range(len(views.row)):
        pixel, depth = view_set.project(views, index, points)
        inside = view_set.in_image(views, pixel, depth, 0)
        column = np.clip(pixel[inside, 0] * across / width, 0, across - 1).astype(int)
        line = np.clip(pixel[inside, 1] * down / height, 0, down - 1).astype(int)
        has = np.zeros((down, across), bool)
        has[line, column] = True
        lines = np.array_split(views.valid[index], down, axis=0)
        scene = np.array(
            [
                [cell.mean() > 0.5 for cell in np.array_split(row, across, axis=1)]
                for row in lines
            ]
        )
        hits, total = hits + (has & scene).sum(), total + scene.sum()
    return hits / total if total else 0.0


def _moving_coverage(views: Views, evidence: Evidence, points: np.ndarray) -> float:
    """Compute the share of cells with moving pixels that contain a point."""
    across, down = CELLS
    width, height = views.size
    size = height // down, width // across
    hits = total = 0
    for index in _sampled_frames(views):
        moving = evidence.moving[index]
        if moving.mean() < LEAST_MOVING:
            continue
        pixel, depth = view_set.project(views, index, points)
        inside = view_set.in_image(views, pixel, depth)
        place = pixel[inside].astype(int)
        near = np.zeros((height, width), bool)
        near[place[:, 1], place[:, 0]] = True
        line, column = np.nonzero(moving)
        for i, j in set(zip(line // size[0], column // size[1], strict=True)):
            box = np.s_[i * size[0] : (i + 1) * size[0]]
            beside = np.s_[j * size[1] : (j + 1) * size[1]]
            hits += (near[box, beside] & moving[box, beside]).any()
            total += 1
    return hits / total if total else np.nan


def _sampled_frames(views):
    last = len(views.row) - 1
    frames = np.linspace(0, last, min(CENTERS, last + 1)).round().astype(int)
    return np.unique(frames).tolist()


def start(
    capture: Capture, views: Views, evidence: Evidence, points: np.ndarray
) -> Finding:
    """Decide if the points of the capture are sufficient to initialize Gaussians.

    Args:
      capture: The capture.
      views: Its frames.
      evidence: Its preprocessing.
      points: Its points in scene units, [points, 3].

    Returns:
      The finding.
    """
    threshold = f"{MIN_POINTS} points that cover {COVERED:.0%} of the images"
    count = 0 if capture.points is None else len(capture.points.position)
    if count == 0:
        measurement = "the capture has no points: Gaussians are initialized at random"
        return Finding(START, measurement, threshold, False, CERTAIN, {"points": 0.0})
    coverage = _coverage(views, points)
    inside = _moving_coverage(views, evidence, points)
    enough = judge(count, MIN_POINTS, np.sqrt(count))
    spread = judge(coverage, COVERED, 0.02)
    # Both conditions must hold. The confidence is that of the less certain one.
    decision, confidence = min(
        (enough, spread),
        key=lambda judgment: (judgment[0] is not False, judgment[1] == CERTAIN),
    )
    measurement = (
        f"{count} points in {coverage:.0%} of the {CELLS[0]}x{CELLS[1]} cells of images"
    )
    numbers = {"points": float(count), "covered_share": coverage}
    if np.isfinite(inside):
        numbers["moving_covered_share"] = float(inside)
        measurement += f", and in {inside:.0%} of the cells with moving objects"
    return Finding(START, measurement, threshold, decision, confidence, numbers)


def background(views: Views, evidence: Evidence, points: np.ndarray) -> Finding:
    """Decide if the points of the capture are static, as the background prior needs.

    Args:
      views: The frames.
      evidence: Their preprocessing.
      points: Points in scene units, [points, 3].

    Returns:
      The finding.
    """
    threshold = f"{STILL_SHARE:.0%} of the points within {AGREES_PX:g} px of tracks"
    if not len(points):
        measurement = "the capture has no points"
        return Finding(BACKGROUND, measurement, threshold, False, CERTAIN)
    checks, agree = np.zeros(len(points)), np.zeros(len(points))
    if not evidence.unusable:
        for frame in _sampled_frames(views):
            which, stays = _stays(views, evidence, frame, points)
            checks[which] += 1
            agree[which] += stays
    count = int((checks > 0).sum())
    if count < MIN_POINTS:
        return cannot_tell(
            BACKGROUND,
            f"{len(points)} points, but only {count} on pixels that can be tracked",
            threshold,
        )
    # A point is static if most frames agree, because single frames may err at edges.
    share = float((agree[checks > 0] > 0.5 * checks[checks > 0]).mean())
    # Judged by the moving share, whose values 1 % and 2 % differ by a factor of two.
    moves, confidence = judge(
        1 - share, 1 - STILL_SHARE, np.sqrt(share * (1 - share) / count)
    )
    decision = None if moves is None else not moves
    measurement = f"{share:.1%} of {count} points agree with the tracks"
    numbers = {"still_share": share}
    return Finding(BACKGROUND, measurement, threshold, decision, confidence, numbers)


def _stays(views, evidence, frame, points):
    """Points that the flow around a frame can check, and those among them that agree.

    A point behind the surface that the flow shows is occluded and checks nothing. A
    point in front of it, which is looked through, is misplaced. Without parallax flow
    shows no depth, and only tests that the surface at the point stays with the point.
    """
    pixel, depth = view_set.project(views, frame, points)
    rows = np.flatnonzero(view_set.in_image(views, pixel, depth))
    span = slice(max(0, frame - REACH), frame + REACH + 1)
    near, at = dense_points.view_slice(views, span), frame - span.start
    starts = np.concatenate([np.full((len(rows), 1), at), pixel[rows]], axis=-1)
    flow = NeighborFlow(*(part[span] for part in evidence.flow))
    tracks = tracking.chain(flow, starts)
    enough = tracks.visible.sum(1) > min(LEAST_FOLLOWED, len(near.row) - 1)
    rows, tracks = rows[enough], tracks.take(enough)
    static_fit = static_points.fit(near, tracks)
    # One if the point lies on the visible surface.
    share = depth[rows] / static_fit.depth[:, at]
    deep = dense_points.depth_deviation(near, tracks, static_fit) < DEPTH_KNOWN
    can_check = ~deep | (share < 1 + DEPTH_AGREES)
    through = deep & (share < 1 - DEPTH_AGREES)
    misses = np.full(tracks.visible.shape, np.nan)
    for other in range(len(near.row)):
        there, _ = view_set.project(near, other, points[rows])
        miss = np.linalg.norm(there - tracks.pixel[:, other], axis=-1)
        misses[:, other] = np.where(tracks.visible[:, other], miss, np.nan)
    misses[:, at] = np.nan
    middle = np.nanmedian(misses, axis=1)
    bound = AGREES_PX * view_set.times_smaller(views)
    bound = max(bound, AGREES_DEVIATIONS * static_noise(evidence))
    return rows[can_check], (middle < bound)[can_check] & ~through[can_check]
