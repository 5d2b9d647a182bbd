"""The contact sheet of an inspection: frames with what moves marked."""

import numpy as np
import scipy.ndimage as nd

from nerfies_jax.evaluation import pictures
from nerfies_jax.evidence.motion import Film
from nerfies_jax.evidence.view_set import Views

SHOWN = 12  # frames on the sheet
MOVING, UNFOLLOWED = np.array([255, 40, 40]), np.array([70, 90, 140])
RIM = np.array([255, 255, 0])


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


def _tinted(picture, where, colour, share):
    return np.where(where[..., None], (1 - share) * picture + share * colour, picture)
