"""Contact sheets: frames with what moves marked, and with tracks drawn."""

import cv2
import numpy as np
import scipy.ndimage as nd

from nerfies_jax.evaluation import pictures
from nerfies_jax.evidence.motion import Film
from nerfies_jax.evidence.record import MOVES, Evidence
from nerfies_jax.evidence.view_set import Views

SHOWN = 12  # frames on the sheet
MOVING, UNFOLLOWED = np.array([255, 40, 40]), np.array([70, 90, 140])
RIM = np.array([255, 255, 0])
FOLLOWED, DRAWN_WIDTH, TAIL = 8, 352, 8  # frames, px at least, frames of a tail
TRACKS = 250  # drawn in a frame: moving ones first
AT_REST, BY_ITSELF = (150, 200, 255), (255, 230, 0)


def sheet(views: Views, films: list[Film]) -> np.ndarray:
    """Frames with what moves in red under a yellow rim, and bluish what was not seen.

    Without films, the frames alone: there was nothing to follow.
    """
    centres = [centre for film in films for centre in film.centres]
    if not centres:
        rows = np.unique(np.linspace(0, len(views.row) - 1, SHOWN).round().astype(int))
        shown = [views.image[row] for row in rows]
        captions = [f"time {views.time[row]:.2f}" for row in rows]
        return pictures.contact_sheet(shown, captions)
    rows = np.unique(np.linspace(0, len(centres) - 1, SHOWN).round().astype(int))
    shown, captions = [], []
    for centre in (centres[row] for row in rows):
        picture = views.image[centre.view].astype(float)
        picture = _tinted(picture, ~centre.usable, UNFOLLOWED, 0.35)
        picture = _tinted(picture, centre.moving, MOVING, 0.45)
        rim = nd.binary_dilation(centre.moving) & ~centre.moving
        picture[rim] = RIM
        shown.append(picture.round().astype(np.uint8))
        share = centre.moving.mean()
        captions.append(f"time {views.time[centre.view]:.2f}: {share:.1%} moving")
    return pictures.contact_sheet(shown, captions)


def followed(views: Views, evidence: Evidence) -> np.ndarray:
    """Frames with what moves in red, and tracks with their tails.

    Yellow tracks move by themselves, blue ones are points at rest: their tails are the
    camera's motion.
    """
    frames = len(views.row)
    shown = np.unique(np.linspace(0, frames - 1, FOLLOWED).round().astype(int))
    times = -(-DRAWN_WIDTH // views.size[0])
    cells, captions = [], []
    for frame in shown:
        mask = evidence.moving[frame]
        picture = views.image[frame].astype(float)
        picture = _tinted(picture, mask, MOVING, 0.4).round().astype(np.uint8)
        picture = np.ascontiguousarray(picture.repeat(times, 0).repeat(times, 1))
        _draw_tracks(picture, evidence, frame, times)
        cells.append(picture)
        time, share = views.time[frame], mask.mean()
        captions.append(f"time {time:.2f}: {share:.1%} moving")
    return pictures.contact_sheet(cells, captions)


def _draw_tracks(picture, evidence, frame, times):
    tracks, moves = evidence.tracks, evidence.score > MOVES
    here = np.flatnonzero(tracks.seen[:, frame])
    chosen = [_spread(here[moves[here] == kind], TRACKS // 2) for kind in (False, True)]
    for row in np.concatenate(chosen):
        colour = BY_ITSELF if moves[row] else AT_REST
        tail = np.arange(max(0, frame - TAIL), frame + 1)
        # From the last frame in which it was not seen.
        gap = np.flatnonzero(~tracks.seen[row, tail])
        tail = tail[gap[-1] + 1 :] if len(gap) else tail
        line = np.round(tracks.pixel[row, tail] * times * 16).astype(np.int32)
        cv2.polylines(picture, [line], False, colour, 1, cv2.LINE_AA, shift=4)
        cv2.circle(picture, tuple(line[-1].tolist()), 24, colour, -1, cv2.LINE_AA, 4)


def _spread(rows, most):
    return rows[:: max(1, -(-len(rows) // most))]


def _tinted(picture, where, colour, share):
    return np.where(where[..., None], (1 - share) * picture + share * colour, picture)
