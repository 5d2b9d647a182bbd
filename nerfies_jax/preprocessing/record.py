"""Preprocessing of a capture, computed once before any training and cached.

    evidence = record.gather(capture)

It consists of optical flow between neighboring frames, point tracks, masks and tracks
of moving objects with their 3D paths, and static points. It runs on the host, on one
core, without gradients.
"""

import contextlib
import math
import pathlib
from collections.abc import Callable

import numpy as np

from nerfies_jax.capture import cache, cache_files, pinholes
from nerfies_jax.capture import capture as captures
from nerfies_jax.capture.capture import Capture, CaptureError, PointCloud
from nerfies_jax.capture.external import ExternalResults
from nerfies_jax.preprocessing import (
    dense_flow,
    external_depth,
    external_resampling,
    lost_regions,
    patch_alignment,
    path_depths,
    paths,
    rest_points,
    segmentation,
    short_tracks,
    still_points,
    view_set,
)
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.record_file import Evidence, digest, load, save
from nerfies_jax.preprocessing.view_set import Views
from nerfies_jax.preprocessing.watch import (
    A_PATCH_FRAME,
    A_POINT_FRAME,
    A_SEARCHED_PIXEL,
    A_TRACK_FRAME,
    ENOUGH_WORK,
    Watch,
)
from nerfies_jax.runtime import console

SHORTEST_VIDEO = 6  # minimum number of frames of a video
MOVES = 0.5  # score above which a track is considered as moving
MOST_PATHS = 1500
# Regions over the width of an image, and the number of tracks in one that suffices.
CELLS, ENOUGH_IN_CELL = 12, 4
MOST_PIXELS = 16_000_000  # of all frames together, at 17 bytes each for their flow
# Minimum share of textured pixels with consistent flow. Below it the camera motion is
# discontinuous, and tracks are arbitrary.
LEAST_CARRIED = 0.4
# Shares of the budget above which a part is skipped.
FOR_WIDE_STEPS, FOR_TRACKS = 0.4, 0.5
FOR_POINTS = 0.8
LEAST_TEXTURED = 0.05  # minimum share of textured pixels
MOST_UNKEPT = 2  # records in memory: of training frames, and of all frames

_unkept: dict[pathlib.Path, "Evidence"] = {}  # records that could not be written
_told_of: dict[pathlib.Path, list[str]] = {}  # notes on records


def gather(
    capture: Capture,
    use_depths: bool = False,
    tell: Callable[[str], None] = lambda part: None,
    *,
    rough_cameras: bool = False,
    masks_only: bool = False,
) -> Evidence:
    """Preprocess a capture, in about 0.25 s per frame of 176x132 or 480x270.

    Parts beyond the budget of work (`capture.preprocessing`) are skipped. The budget
    counts work instead of time, so that the result does not depend on the machine.

    Args:
      capture: The capture. External results (`capture.external`) replace those computed
        here.
      use_depths: True to constrain paths by the depth maps of the capture, if any.
      tell: Called with the name of each part when it begins, and with skipped parts.
      rough_cameras: True if the cameras are only estimated from images that may show
        motion. Short tracks would take their errors for motion.
      masks_only: True to leave out 3D paths and dense static points, which take a fifth
        to a quarter of the time.

    Returns:
      The results, with the names of skipped parts.
    """
    with contextlib.closing(Watch(tell, capture.preprocessing * ENOUGH_WORK)) as watch:
        return _gathered(capture, use_depths, rough_cameras, masks_only, watch)


def _gathered(capture, use_depths, rough_cameras, masks_only, watch):
    watch.begin("flow")
    capture = pinholes.as_pinholes(capture)
    external = capture.external or ExternalResults(capture.size)
    factor = _factor(capture)
    capture = downscale(capture, factor)
    views = view_set.in_time_order(capture)
    images = dense_flow.leveled(views)
    flow = external_resampling.flow(external, views)
    # Images of one timestamp are no video: there is nothing to search twice for.
    is_video = np.ptp(views.time) > 0
    span = view_set.depth_span(capture, views) if is_video else None
    is_computed = flow is None
    if flow is None:
        flow = _flow(views, images, span, watch)
    least = short_tracks.USUAL
    if span is not None and not rough_cameras:
        least = short_tracks.lengths(views, span, carried(views, flow))
    if is_computed and least == short_tracks.SHORT:
        flow = _recovered(views, images, flow, watch)
    watch.begin("tracks")
    every = 1e-6 * A_TRACK_FRAME * tracking.work(views)
    few = not watch.has_room(FOR_TRACKS, "half of the tracks", every)
    watch.spend(every / 2 if few else 0.0)
    starts = tracking.grid(views, 2 if few else 1)
    tracks, first = _tracks(external, views, flow, images, starts, least)
    rest = rest_points.fit(views, tracks)
    watch.begin("moving")
    unusable = _unusable(views, flow)
    lengths = None if unusable or first else least
    mask = external_resampling.moving(external, views)
    moves = segmentation.segmented(views, flow, tracks, rest, lengths, watch, mask)
    score = moves.score
    watch.begin("paths")
    path_tracks = tracks.take(slice(0))
    if not unusable and not masks_only:
        own = tracks.take(slice(first, None))
        path_tracks = _moved(own, score[first:], moves, least.path, views.size)
    if not first:
        watch.spend(1e-6 * A_PATCH_FRAME * path_tracks.visible.size)
        path_tracks = patch_alignment.align(path_tracks, images, views.size)
        path_tracks = path_tracks.take(_are_long(path_tracks, least.path))
    still = np.flatnonzero(score < paths.AT_REST)
    static = tracks.take(still), rest.take(still)
    depths = path_depths.known(capture, external, views, static, use_depths)
    moved_paths = path_depths.fitted(
        capture, views, path_tracks, static, depths, watch, least.known
    )
    watch.begin("still")
    dense = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    points_work = 1e-6 * A_POINT_FRAME * still_points.work(views)
    if not masks_only and watch.has_room(
        FOR_POINTS, "dense static points", points_work
    ):
        dense = still_points.dense(views, flow, moves.mask)
    return Evidence(
        row=views.row,
        flow=_rounded(flow),
        moving=moves.mask,
        tracks=tracks,
        score=score,
        rest=rest,
        path_tracks=path_tracks,
        paths=moved_paths,
        least_known=least.known,
        still=dense,
        unusable=unusable,
        is_external=external.moving is not None or external.track_pixel is not None,
        factor=factor,
        left_out=watch.left_out,
        depth_miss=0.0 if external.depth is None else depths.total_miss,
        seconds=watch.seconds(),
    )


def _search_work(views, images):
    """Return the work of one search for flow."""
    return 1e-6 * A_SEARCHED_PIXEL * dense_flow.searched_pixels(views, images)


def _flow(views, images, span, watch):
    a_search = _search_work(views, images)
    watch.spend(2 * (len(views.row) - 1) * a_search)

    def room_for(count):
        what, each = "a second search for flow", dense_flow.SECOND_LOOK * a_search
        return watch.room_for(count, FOR_WIDE_STEPS, what, each)

    return dense_flow.between_neighbors(views, images, span, room_for)


def _recovered(views, images, flow, watch):
    """Search for the flow of lost regions, within the budget."""
    frames = lost_regions.pairs(views, flow)
    each = lost_regions.SEARCHES * _search_work(views, images)
    room = watch.room_for(len(frames), FOR_WIDE_STEPS, "flow of lost regions", each)
    return lost_regions.recovered(views, images, flow, frames[:room])


def _rounded(flow):
    """Round flow to half precision, in which it is cached, for identical results."""
    forward, backward = (
        side.astype(np.float16).astype(np.float32)
        for side in (flow.forward, flow.backward)
    )
    return flow._replace(forward=forward, backward=backward)


def _tracks(external, views, flow, images, starts, least):
    """Return all tracks, and the index of the first one whose path is computed.

    External tracks follow the computed ones, which are still needed for static points:
    other tools may have tracked only moving objects.
    """
    own = tracking.from_flow(views, flow, images, starts, least.track)
    others = external_resampling.tracks(external, views)
    if others is None:
        return own, 0
    return tracking.joined([own, others]), len(own.visible)


def _depth_note(evidence: Evidence) -> str:
    """Describe a doubtful agreement of external depth with static points."""
    if evidence.depth_miss <= external_depth.DOUBTFUL:
        return ""
    return (
        f"the external depth maps differ from the static points by "
        f"{evidence.depth_miss:.0%} (median). They are used with a low weight; up to "
        f"{external_depth.DOUBTFUL:.0%} is usual"
    )


def downscale(capture: Capture, factor: int) -> Capture:
    """Return the undistorted, reduced capture that preprocessing results refer to.

    Args:
      capture: The capture.
      factor: Integer reduction.

    Returns:
      The capture.
    """
    return captures.downscale(pinholes.as_pinholes(capture), factor)


def _factor(capture):
    width, height = capture.size
    return math.ceil(math.sqrt(len(capture.train) * width * height / MOST_PIXELS))


def _unusable(views, flow):
    frames = len(views.row)
    if frames < SHORTEST_VIDEO:
        return f"{frames} frames are too few for tracking"
    if np.ptp(views.time) == 0:
        return "all frames have the same time"
    textured = views.textured.mean()
    if textured < LEAST_TEXTURED:
        return f"only {textured:.1%} of the pixels have texture"
    share = carried(views, flow)
    if share < LEAST_CARRIED:
        return (
            f"only {share:.0%} of the textured pixels have consistent flow to the next "
            f"frame (at least {LEAST_CARRIED:.0%} are needed): the camera motion is "
            "discontinuous"
        )
    return ""


def carried(views: Views, flow: NeighborFlow) -> float:
    """Compute the share of textured pixels with consistent flow to the next frame.

    Args:
      views: The frames.
      flow: Their flow.

    Returns:
      The share.
    """
    shown = views.textured[:-1]
    return float((flow.forward_seen[:-1] & shown).sum() / max(shown.sum(), 1))


def _moved(tracks, score, moves, shortest, size):
    """Return the tracks of moving points, at most `MOST_PATHS`.

    Those that begin on the mask are used where the others are few, because they are
    less accurate.
    """
    tracks = tracks.take(_are_long(tracks, shortest) & (score > MOVES))
    more = moves.mask_tracks.take(
        _are_long(moves.mask_tracks, shortest) & (moves.mask_score > MOVES)
    )
    more = more.take(_are_sparse(more, tracks, size))
    both = tracking.joined([tracks, more])
    if len(both.start) <= MOST_PATHS:
        return both
    # Long tracks are preferred, and those in frames with few.
    chance = (both.visible / np.maximum(both.visible.sum(0), 1)).sum(1)
    rng = np.random.default_rng(0)
    which = rng.choice(len(chance), MOST_PATHS, replace=False, p=chance / chance.sum())
    return both.take(np.sort(which))


def _are_sparse(more, tracks, size):
    """Find those of `more` that have few `tracks` around them in most frames."""
    frames = more.visible.shape[1]
    rows = math.ceil(CELLS * size[1] / size[0])
    count = np.zeros((frames, rows, CELLS), int)

    def cells(one):
        place = one.pixel * (CELLS / size[0])
        row, column = tracking.pixel_of(place, (rows, CELLS))
        return np.broadcast_to(np.arange(frames), row.shape), row, column

    np.add.at(count, tuple(part[tracks.visible] for part in cells(tracks)), 1)
    few = (count[cells(more)] < ENOUGH_IN_CELL) & more.visible
    return few.sum(1) > 0.5 * more.visible.sum(1)


def _are_long(tracks, shortest):
    return tracks.visible.sum(1) >= min(shortest, tracks.visible.shape[1])


def cached(
    capture: Capture,
    folder: pathlib.Path,
    use_depths: bool = False,
    tell: Callable[[str], None] = lambda part: None,
    *,
    masks_only: bool = False,
) -> Evidence:
    """Preprocess a capture, or read its results from a cache.

    A distorted capture is undistorted first, so that both share one record. Processes
    that need the same record at once make it once. Above `cache.limit_bytes`, records
    that were not used for longest are removed. If `folder` cannot be written, this is
    reported and the record is kept in memory. Warnings list skipped parts, and external
    depth that hardly fits.

    Args:
      capture: The capture.
      folder: Cache folder.
      use_depths: As for `gather`.
      tell: As for `gather`.
      masks_only: As for `gather`.

    Returns:
      The results.
    """
    capture = pinholes.as_pinholes(capture)
    path = file_of(capture, folder, use_depths, masks_only)
    evidence = _unkept.get(path) or cache_files.read(path, load)
    if evidence is None:
        with cache_files.making(path):
            evidence = cache_files.read(path, load)
            if evidence is None:
                evidence = _made(path, capture, use_depths, tell, masks_only)
    cache_files.mark_used(path)
    if path not in _told_of:
        notes = [left_out_note(evidence), _depth_note(evidence)]
        _told_of[path] = [note for note in notes if note]
        for note in _told_of[path]:
            console.warn(f"{capture.path or capture.name}: {note}")
    return evidence


def _made(path, capture, use_depths, tell, masks_only):
    """Preprocess a capture and write the results to a file of the cache."""
    limit = cache.limit_bytes()
    evidence = gather(capture, use_depths, tell, masks_only=masks_only)
    try:
        save(path, evidence)
        cache_files.evict(path.parent, limit)
    except (OSError, CaptureError) as error:
        tell(f"results of preprocessing could not be cached: {error}")
        while len(_unkept) >= MOST_UNKEPT:
            _unkept.pop(next(iter(_unkept)))
        _unkept[path] = evidence
    return evidence


def left_out_note(evidence: Evidence) -> str:
    """Describe the skipped parts of preprocessing, with advice.

    Args:
      evidence: Preprocessing.

    Returns:
      The text, empty if nothing was skipped.
    """
    if not evidence.left_out:
        return ""
    return (
        f"Preprocessing skipped {evidence.left_out}, because its budget of work was "
        "spent. Increase the budget (preprocessing) to include it."
    )


def notes_on(capture: Capture, folder: pathlib.Path) -> list[str]:
    """List the notes of `cached` in this process on a capture.

    They are about parts that were skipped, and external depth that hardly fits.

    Args:
      capture: The capture.
      folder: Cache folder.

    Returns:
      The notes.
    """
    paths = (file_of(capture, folder, use_depths) for use_depths in (False, True))
    return list(
        dict.fromkeys(note for path in paths for note in _told_of.get(path, ()))
    )


def file_of(
    capture: Capture,
    folder: pathlib.Path,
    use_depths: bool = False,
    masks_only: bool = False,
) -> pathlib.Path:
    """Return the file in which `cached` stores a record.

    Args:
      capture: The capture.
      folder: Cache folder.
      use_depths: As for `gather`.
      masks_only: As for `gather`.

    Returns:
      Path of the file.
    """
    capture = pinholes.as_pinholes(capture)
    return folder / f"{digest(capture, use_depths, masks_only)}.npz"
