"""Contact sheet of frames with moving pixels marked and tracks overlaid."""

import cv2
import numpy as np

from nerfies_jax.preprocessing.record import MOVES, Evidence
from nerfies_jax.preprocessing.view_set import Views
from nerfies_jax.visualization import panels

MOVING = np.array([255, 40, 40])
# Number of frames, minimum width in px, and number of recent positions of a track.
FOLLOWED, DRAWN_WIDTH, TAIL = 8, 352, 8
TRACKS = 250  # maximum number of tracks in a frame
STATIC, BY_ITSELF = (150, 200, 255), (255, 230, 0)


def followed(views: Views, evidence: Evidence) -> np.ndarray:
    """Show frames with moving pixels in red, and tracks with their recent positions.

    Tracks of moving points are yellow. Tracks of static points are blue and show the
    camera motion. If tracking failed, only the frames are shown.

    Args:
      views: The frames.
      evidence: Their preprocessing.

    Returns:
      uint8 image, [height, width, 3].
    """
    frames = len(views.row)
    selection = np.unique(np.linspace(0, frames - 1, FOLLOWED).round().astype(int))
    if evidence.unusable:
        captions = [f"time {views.time[frame]:.2f}" for frame in selection]
        return panels.contact_sheet([views.image[f] for f in selection], captions)
    times = -(-DRAWN_WIDTH // views.size[0])
    cells, captions = [], []
    for frame in selection:
        mask = evidence.moving[frame]
        image = views.image[frame].astype(float)
        image = _tint(image, mask, MOVING, 0.4).round().astype(np.uint8)
        image = np.ascontiguousarray(image.repeat(times, 0).repeat(times, 1))
        _draw_tracks(image, evidence, frame, times)
        cells.append(image)
        time, share = views.time[frame], mask.mean()
        captions.append(f"time {time:.2f}: {share:.1%} moving")
    return panels.contact_sheet(cells, captions)


def _draw_tracks(image, evidence, frame, times):
    static = evidence.tracks.take(evidence.score <= MOVES)
    for tracks, color in ((static, STATIC), (evidence.path_tracks, BY_ITSELF)):
        rows = np.flatnonzero(tracks.visible[:, frame])
        for row in _spread(rows, TRACKS // 2):
            tail = np.arange(max(0, frame - TAIL), frame + 1)
            # Only frames since the track was last invisible.
            gap = np.flatnonzero(~tracks.visible[row, tail])
            tail = tail[gap[-1] + 1 :] if len(gap) else tail
            line = np.round(tracks.pixel[row, tail] * times * 16).astype(np.int32)
            cv2.polylines(image, [line], False, color, 1, cv2.LINE_AA, shift=4)
            cv2.circle(image, tuple(line[-1].tolist()), 24, color, -1, cv2.LINE_AA, 4)


def _spread(rows, most):
    return rows[:: max(1, -(-len(rows) // most))]


def _tint(image, mask, color, share):
    return np.where(mask[..., None], (1 - share) * image + share * color, image)
