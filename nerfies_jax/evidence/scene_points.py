"""Points at rest: how many there are, where they lie, and what they are good for."""

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evidence import view_set
from nerfies_jax.evidence.findings import (
    BACKGROUND,
    CERTAIN,
    START,
    Finding,
    cannot_tell,
    judge,
)
from nerfies_jax.evidence.motion import Film
from nerfies_jax.evidence.view_set import MIN_POINTS, Views

CELLS = (8, 6)  # across and down: a picture is covered where a cell holds a point
COVERED = 0.5  # of the cells that show anything
# A point that a following frame's flow misses by so much is not where it should be.
AGREES_PX, AGREES_DEVIATIONS = 3.0, 4.0
DEPTH_KNOWN, DEPTH_AGREES = 0.05, 0.2  # shares of a depth: its deviation, its bound
STILL_SHARE = 0.8  # of the points that can be checked
MOST = 4000  # points that are looked at


def own_points(capture: Capture) -> np.ndarray:
    """At most `MOST` of the capture's points [points, 3]; empty where it has none."""
    if capture.points is None:
        return np.zeros((0, 3))
    position = capture.points.position.astype(np.float64)
    rng = np.random.default_rng(0)
    if len(position) > MOST:
        position = position[np.sort(rng.choice(len(position), MOST, replace=False))]
    return position


def followed_points(views: Views, films: list[Film]) -> np.ndarray:
    """Points at rest [points, 3] found by following pixels, at most `MOST`."""
    places = []
    for film in films:
        for one in film.centres:
            static = one.usable & ~one.moving & (one.fit.inverse_depth > 0)
            static &= one.fit.residual < 2 * one.noise_px
            static &= one.fit.count >= 0.75 * len(one.paths.views)
            depth = 1 / one.fit.inverse_depth[static]
            ray = view_set.rays(views, one.view)[static]
            places.append(views.position[one.view] + depth[:, None] * ray)
    points = np.concatenate(places) if places else np.zeros((0, 3))
    rng = np.random.default_rng(0)
    if len(points) > MOST:
        points = points[np.sort(rng.choice(len(points), MOST, replace=False))]
    return points


def coverage(views: Views, points: np.ndarray) -> float:
    """The share of cells of the pictures with anything filmed that hold a point."""
    across, down = CELLS
    width, height = views.size
    held = shown = 0
    for index in range(len(views.row)):
        pixel, depth = view_set.project(views, index, points)
        inside = view_set.in_picture(views, pixel, depth, 0)
        column = np.clip(pixel[inside, 0] * across / width, 0, across - 1).astype(int)
        line = np.clip(pixel[inside, 1] * down / height, 0, down - 1).astype(int)
        has = np.zeros((down, across), bool)
        has[line, column] = True
        lines = np.array_split(views.valid[index], down, axis=0)
        scene = np.array(
            [
                [cell.mean() > 0.5 for cell in np.array_split(one, across, axis=1)]
                for one in lines
            ]
        )
        held, shown = held + (has & scene).sum(), shown + scene.sum()
    return held / shown if shown else 0.0


def moving_coverage(views: Views, films: list[Film], points: np.ndarray) -> float:
    """The share of the moving pixels' cells that hold a point; NaN if nothing moves."""
    across, down = CELLS
    width, height = views.size
    held = shown = 0
    for film in films:
        for one in film.centres:
            if not one.moving.any():
                continue
            pixel, depth = view_set.project(views, one.view, points)
            inside = view_set.in_picture(views, pixel, depth)
            place = pixel[inside].astype(int)
            near = np.zeros((height, width), bool)
            near[place[:, 1], place[:, 0]] = True
            size = (height // down, width // across)
            line, column = np.nonzero(one.moving)
            cells = set(zip(line // size[0], column // size[1], strict=True))
            for i, j in cells:
                box = np.s_[i * size[0] : (i + 1) * size[0]]
                beside = np.s_[j * size[1] : (j + 1) * size[1]]
                held += (near[box, beside] & one.moving[box, beside]).any()
                shown += 1
    return held / shown if shown else np.nan


def start(capture: Capture, views: Views, films: list[Film], points) -> Finding:
    """Whether the capture's own points are enough to start Gaussians from."""
    threshold = f"{MIN_POINTS} points that cover {COVERED:.0%} of the pictures"
    count = 0 if capture.points is None else len(capture.points.position)
    if count == 0:
        evidence = "the capture has no points: Gaussians start at random"
        return Finding(START, evidence, threshold, False, CERTAIN, {"points": 0.0})
    covered = coverage(views, points)
    inside = moving_coverage(views, films, points)
    enough = judge(count, MIN_POINTS, np.sqrt(count))
    spread = judge(covered, COVERED, 0.02)
    # Both must hold; the less sure of two that agree, and whichever refuses.
    wanted, confidence = min(
        (enough, spread), key=lambda one: (one[0] is not False, one[1] == CERTAIN)
    )
    evidence = (
        f"{count} points in {covered:.0%} of the pictures' {CELLS[0]}x{CELLS[1]} cells"
    )
    numbers = {"points": float(count), "covered_share": covered}
    if np.isfinite(inside):
        numbers["moving_covered_share"] = float(inside)
        evidence += f", and on what moves in {inside:.0%} of its cells"
    return Finding(START, evidence, threshold, wanted, confidence, numbers)


def background(
    capture: Capture, views: Views, films: list[Film], points: np.ndarray
) -> Finding:
    """Whether the capture's points stay put, as the background prior needs."""
    threshold = f"{STILL_SHARE:.0%} of them within {AGREES_PX:g} px of the film's paths"
    if not len(points):
        evidence = "the capture has no points"
        return Finding(BACKGROUND, evidence, threshold, False, CERTAIN)
    seen, agree = np.zeros(len(points)), np.zeros(len(points))
    for film in films:
        for one in film.centres:
            which, stays = _stays(views, one, points)
            seen[which] += 1
            agree[which] += stays
    count = int((seen > 0).sum())
    if count < MIN_POINTS:
        return cannot_tell(
            BACKGROUND,
            f"{len(points)} points, but only {count} on pixels that can be followed",
            threshold,
        )
    # A point is where it should be if most frames say so: rims make single ones err.
    share = float((agree[seen > 0] > 0.5 * seen[seen > 0]).mean())
    # On what strays, not on what stays: 1 % and 2 % astray differ by a factor of two.
    moved, confidence = judge(
        1 - share, 1 - STILL_SHARE, np.sqrt(share * (1 - share) / count)
    )
    wanted = None if moved is None else not moved
    evidence = f"{share:.1%} of {count} points stay with the film's paths"
    return Finding(
        BACKGROUND, evidence, threshold, wanted, confidence, {"still_share": share}
    )


def _stays(views, centre, points):
    """Which points the followed pixels could check, and which of them agree.

    A point behind what the paths show is hidden there and checks nothing; one that is
    looked through is not where it should be. Without parallax the paths show no depth,
    and only tell whether the pixel stays where the point does.
    """
    pixel, depth = view_set.project(views, centre.view, points)
    inside = view_set.in_picture(views, pixel, depth)
    column, line = pixel[inside].astype(int).T
    which = np.flatnonzero(inside)
    points, depth = points[inside], depth[inside]
    shown = centre.fit.inverse_depth[line, column]
    parallax = centre.fit.parallax_px[line, column]
    deep = shown * parallax > centre.noise_px / DEPTH_KNOWN
    share = shown * depth  # one where the point lies on what is shown
    checked = centre.usable[line, column] & (~deep | (share < 1 + DEPTH_AGREES))
    through = deep & (share < 1 - DEPTH_AGREES)
    misses = []
    for at, other in enumerate(centre.paths.views):
        there, _ = view_set.project(views, other, points)
        followed = centre.paths.followed[at][line, column]
        miss = np.linalg.norm(there - centre.paths.place[at][line, column], axis=-1)
        misses.append(np.where(followed, miss, np.nan))
    if not checked.any():
        return which[:0], checked[:0]
    middle = np.nanmedian(np.array(misses)[:, checked], axis=0)
    # The pixel's own centre lies up to 0.7 px from the point.
    bound = max(AGREES_PX, AGREES_DEVIATIONS * centre.noise_px)
    return which[checked], (middle < bound) & ~through[checked]
