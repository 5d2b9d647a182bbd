"""Masks of moving pixels, and more tracks that begin on them.

Tracks on a grid are few on small objects, and are aligned by translation, which loses
most of their positions on objects that turn: 64 % of those of a backpack that is turned
in the hand, half of which was then not in the mask. Tracks that begin on the mask are
denser, and only chained, for `patch_alignment`. They extend the mask, and have paths
where tracks on the grid are few (`record`).
"""

from typing import NamedTuple

import cv2
import numpy as np

from nerfies_jax.preprocessing import (
    dense_points,
    moving,
    photo_consistency,
    static_points,
    view_set,
)
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.short_tracks import SHORT, Lengths
from nerfies_jax.preprocessing.static_points import StaticPoints
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.view_set import Views
from nerfies_jax.preprocessing.watch import (
    A_COMPARED_PIXEL,
    A_POINT_FRAME,
    A_TRACK_FRAME,
    Watch,
)

# Rounds of tracks from the mask and a mask from these tracks, and the distance of their
# starts from its border at a width of 176 px. Flow drags static pixels beside an object
# along: with starts at the border, 82 % of the mask of scene `articulated` move, with
# these 88 % (92 % without more tracks), and it contains 97 % of what moves (95 %).
ROUNDS, RIM_PX = 2, 2.0
# Shares of the budget above which colors are not compared, and no tracks are added.
FOR_COLORS, FOR_MORE = 0.6, 0.6


class Moving(NamedTuple):
    """Moving pixels and tracks."""

    mask: np.ndarray  # [frames, height, width] bool
    score: np.ndarray  # [tracks] in [0, 1], confidence that they move
    mask_tracks: Tracks  # that begin on the mask, in addition
    mask_score: np.ndarray  # [mask_tracks] in [0, 1]


class _Colors(NamedTuple):
    """Reduced images, and what their colors tell."""

    views: Views
    times: int  # by which they are reduced
    odds: np.ndarray  # [frames, height, width] log odds that a pixel moves


def segmented(
    views: Views,
    flow: NeighborFlow,
    tracks: Tracks,
    static_fit: StaticPoints,
    lengths: Lengths | None,
    watch: Watch,
    mask: np.ndarray | None = None,
) -> Moving:
    """Segment what moves by tracks and colors, or by a mask.

    Args:
      views: The frames.
      flow: Their flow.
      tracks: Tracks of a grid, or of the user.
      static_fit: The static points that fit them best.
      lengths: Minimum lengths of tracks that begin on the mask. None for no such
        tracks.
      watch: Work budget.
      mask: Moving pixels, [frames, height, width] bool, if they are known.

    Returns:
      Pixels and tracks.
    """
    if mask is None:
        return _by_tracks(views, flow, tracks, static_fit, lengths, watch)
    mask_tracks = tracks.take(slice(0))
    if lengths:
        mask_tracks = _tracks_on(views, flow, mask, lengths, watch)
    score, mask_score = (moving.share_on(each, mask) for each in (tracks, mask_tracks))
    return Moving(mask, score, mask_tracks, mask_score)


def _by_tracks(views, flow, tracks, static_fit, lengths, watch):
    mask_tracks = tracks.take(slice(0))
    score = moving.track_scores(tracks, static_fit)
    share, colors = _colors(views, flow, tracks, score, watch)
    mask = _mask(views, colors, share)
    for _ in range(ROUNDS if lengths else 0):
        mask_tracks = _tracks_on(views, flow, mask, lengths, watch)
        if not len(mask_tracks.start):
            break
        points = static_points.fit(views, mask_tracks)
        all_tracks = tracking.joined([tracks, mask_tracks])
        all_fits = tracking.joined([static_fit, points])
        score = moving.track_scores(all_tracks, all_fits, len(tracks.start))
        mask = _mask(views, colors, _votes(colors, all_tracks, score))
    count, mask_count = len(tracks.start), len(mask_tracks.start)
    return Moving(
        mask,
        moving.settled(tracks, score[:count], mask),
        mask_tracks,
        moving.settled(mask_tracks, score[count:][:mask_count], mask),
    )


def _tracks_on(views, flow, mask, lengths, watch):
    """Chain tracks from the pixels of a mask, but not from its rim."""
    every = 1 if lengths == SHORT else tracking.EVERY_FRAMES
    side = 2 * round(RIM_PX * moving.image_scale(mask.shape[2])) + 1
    inside = [cv2.erode(np.uint8(frame), np.ones((side, side))) for frame in mask]
    starts = tracking.grid_on(np.stack(inside) > 0, every)
    work = 1e-6 * A_TRACK_FRAME * len(starts) * len(views.row)
    if not watch.has_room(FOR_MORE, "more tracks of moving objects", work):
        starts = starts[:0]
    return tracking.long_enough(tracking.chain(flow, starts), lengths.track)


def _colors(views, flow, tracks, score, watch):
    """Return the votes of tracks, and the evidence of colors, at a reduced size."""
    times = view_set.times_smaller(views)
    colors = _Colors(view_set.smaller(views, times), times, np.zeros(0))
    share = _votes(colors, tracks, score)
    odds = np.zeros(share.shape, np.float32)
    work = 1e-6 * A_POINT_FRAME * dense_points.work(views)
    work += 1e-6 * A_COMPARED_PIXEL * views.valid.size
    if watch.has_room(FOR_COLORS, "colors for detecting moving objects", work):
        may_move = _enlarge(moving.may_move(share), views.size)
        static_cloud = dense_points.dense(views, flow, may_move)
        odds = photo_consistency.log_odds(colors.views, static_cloud)
    return share, colors._replace(odds=odds)


def _votes(colors, tracks, score):
    near = tracks._replace(pixel=tracks.pixel / colors.times)
    return moving.votes(colors.views, near, score)


def _mask(views, colors, share):
    masks = moving.mask(colors.views, share, colors.odds)
    return _enlarge(masks, views.size) & views.valid


def _enlarge(masks, size):
    if masks.shape[:0:-1] == tuple(size):
        return masks
    full_masks = [cv2.resize(np.float32(mask), size) > 0.5 for mask in masks]
    return np.stack(full_masks)
