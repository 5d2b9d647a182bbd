"""What the pictures of a capture say before any training, gathered once and kept.

    evidence = record.gather(capture)

Flow between neighbours in time, tracks, which of them and which pixels move, their
paths in space, and points that stand still: host side, one core, no gradients.
"""

import hashlib
import math
import pathlib
from typing import NamedTuple

import numpy as np
import scipy.ndimage as nd

from nerfies_jax.capture import capture as captures
from nerfies_jax.capture import pinholes
from nerfies_jax.capture.capture import Capture, PointCloud
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.evidence import (
    dense_flow,
    moving,
    paths,
    rest_points,
    still_points,
    view_set,
)
from nerfies_jax.evidence import tracks as tracking
from nerfies_jax.evidence.dense_flow import NeighbourFlow
from nerfies_jax.evidence.paths import Paths
from nerfies_jax.evidence.rest_points import RestPoints
from nerfies_jax.evidence.tracks import Tracks

VERSION = 2  # of the file; counts up whenever the same pictures would say otherwise
# A path has as many frames at least, and a film as many; fewer say nothing of motion.
SHORTEST_PATH, SHORTEST_FILM = 10, 6
MOVES = 0.5  # score from which a track counts as moving
MOST_PATHS = 1500
MOST_PIXELS = 16_000_000  # of all frames: 17 bytes each for the flow between them
# Where less of the pictures can be carried to the next frame, tracks are chance: a
# camera that jumps.
LEAST_CARRIED = 0.4


class Evidence(NamedTuple):
    """Of the frames to learn from, in order of time."""

    row: np.ndarray  # [frames] row of the capture
    flow: NeighbourFlow
    moving: np.ndarray  # [frames, height, width] bool
    tracks: Tracks
    score: np.ndarray  # [tracks] in 0..1: how certainly it moves
    rest: RestPoints  # of all tracks
    moved: np.ndarray  # [paths] which tracks have a path
    paths: Paths
    still: PointCloud
    unusable: str  # why tracks say nothing of the motion; empty where they do
    factor: int  # of the capture's pixels for one of these


def gather(capture: Capture, use_depths: bool = False) -> Evidence:
    """Everything; about 0.25 s a frame of 176x132 on one core.

    With `use_depths` paths lean on the capture's own depths where it has them.
    """
    factor = _factor(capture)
    capture = looked_at(capture, factor)
    views = view_set.in_time_order(capture)
    pictures = dense_flow.levelled(views)
    flow = dense_flow.between_neighbours(views, pictures)
    tracks = tracking.found(views, flow, pictures)
    rest = rest_points.fit(views, tracks)
    score = moving.track_scores(tracks, rest)
    mask = moving.mask(views, tracks, score)
    unusable = _unusable(views, flow)
    which = _moved(tracks, score) if not unusable else np.zeros(0, int)
    still = score < paths.AT_REST
    around = paths.depth_around(
        tracks.take(which),
        tracks.take(still),
        RestPoints(*(part[still] for part in rest)),
        capture.near,
    )
    measured = None
    if use_depths and capture.depths is not None:
        measured = _measured(capture, views, tracks.take(which))
    found = paths.least_acceleration(
        views, tracks.take(which), capture.near, around, measured
    )
    dense = still_points.dense(views, flow, mask)
    return Evidence(
        row=views.row,
        flow=flow,
        moving=mask,
        tracks=tracks,
        score=score,
        rest=rest,
        moved=which,
        paths=found,
        still=dense,
        unusable=unusable,
        factor=factor,
    )


def looked_at(capture: Capture, factor: int) -> Capture:
    """The capture in whose pixels evidence is given: pinholes, made smaller."""
    return captures.downscale(pinholes.as_pinholes(capture), factor)


def _factor(capture):
    width, height = capture.size
    return math.ceil(math.sqrt(len(capture.train) * width * height / MOST_PIXELS))


def _unusable(views, flow):
    frames = len(views.row)
    if frames < SHORTEST_FILM:
        return f"{frames} frames are too few to follow anything through"
    if np.ptp(views.time) == 0:
        return "all frames have the same time"
    shown = views.textured[:-1]
    carried = flow.forward_seen[:-1] & shown
    share = carried.sum() / max(shown.sum(), 1)
    if share < LEAST_CARRIED:
        return (
            f"only {share:.0%} of the textured pixels can be carried to the next frame "
            f"(at least {LEAST_CARRIED:.0%} are needed): the camera jumps"
        )
    return ""


def _moved(tracks, score):
    long = tracks.seen.sum(1) >= min(SHORTEST_PATH, tracks.seen.shape[1])
    which = np.flatnonzero(long & (score > MOVES))
    if len(which) > MOST_PATHS:
        # Long ones say most, but every place is to have some.
        chance = tracks.seen[which].sum(1).astype(float)
        rng = np.random.default_rng(0)
        which = rng.choice(which, MOST_PATHS, replace=False, p=chance / chance.sum())
    return np.sort(which)


def _measured(capture, views, tracks):
    """z-depths of the tracks where the capture has depth and it does not jump there."""
    found = np.full(tracks.seen.shape, np.nan)
    for frame, row in enumerate(views.row):
        here = np.flatnonzero(tracks.seen[:, frame])
        depth = steady_depth(capture.depths[row])
        at = tracking.pixel_of(tracks.pixel[here, frame], depth.shape)
        found[here, frame] = depth[at]
    return found


def steady_depth(depth: np.ndarray, jump: float = 0.06) -> np.ndarray:
    """z-depth where it is known and does not jump to a neighbour's; NaN elsewhere."""
    least, most = nd.minimum_filter(depth, 3), nd.maximum_filter(depth, 3)
    return np.where((least > 0) & (most - least < jump * depth), depth, np.nan)


def digest(capture: Capture, use_depths: bool = False) -> str:
    """Of all that `gather` looks at."""
    found = hashlib.blake2b(digest_size=12)
    found.update(f"evidence {VERSION} {use_depths}".encode())
    parts = [capture.images[capture.train], capture.times, capture.train]
    parts += [np.asarray([capture.near]), *capture.cameras]
    depths = capture.depths if use_depths else None
    parts += [part for part in (capture.valid, depths) if part is not None]
    for part in parts:
        part = np.ascontiguousarray(part)
        found.update(f"{part.dtype}{part.shape}".encode())
        found.update(part.data)
    return found.hexdigest()


def cached(
    capture: Capture, folder: pathlib.Path, use_depths: bool = False
) -> Evidence:
    """`gather`, or what it found before of the same pictures and cameras."""
    path = folder / f"{digest(capture, use_depths)}.npz"
    if path.exists():
        return load(path)
    evidence = gather(capture, use_depths)
    save(path, evidence)
    return evidence


def save(path: pathlib.Path, evidence: Evidence) -> None:
    """All of it in one file, whole or not at all; flow in half precision."""
    arrays = {}
    for name, part in evidence._asdict().items():
        if isinstance(part, tuple):
            arrays |= {f"{name}.{key}": value for key, value in part._asdict().items()}
        else:
            arrays[name] = np.asarray(part)
    for side in ("forward", "backward"):
        arrays[f"flow.{side}"] = arrays[f"flow.{side}"].astype(np.float16)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_file(path) as partial:
        np.savez(partial, **arrays)


def load(path: pathlib.Path) -> Evidence:
    """What `save` wrote."""
    kinds = {
        "flow": NeighbourFlow,
        "tracks": Tracks,
        "rest": RestPoints,
        "paths": Paths,
        "still": PointCloud,
    }
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    parts = {}
    for name in Evidence._fields:
        if name in kinds:
            fields = kinds[name]._fields
            parts[name] = kinds[name](*(arrays[f"{name}.{key}"] for key in fields))
        else:
            parts[name] = arrays[name]
    parts["unusable"], parts["factor"] = str(parts["unusable"]), int(parts["factor"])
    flow = parts["flow"]
    parts["flow"] = flow._replace(
        forward=flow.forward.astype(np.float32),
        backward=flow.backward.astype(np.float32),
    )
    return Evidence(**parts)
