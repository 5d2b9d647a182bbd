"""The ablation's picture."""

import numpy as np
import pytest

from experiments.ablate import picture as ablate_picture
from tests import scenes

SHIFT = np.float32([0.012, 0.0, 0.016])  # 0.02 long


@pytest.mark.full
def test_the_picture_shows_how_far_points_are_from_where_they_should_be():
    capture, _, known = scenes.tiny_tracks()
    shown = ablate_picture.shown_row(known, capture)
    row = known.rows[shown]
    color = {"a": capture.images[row]}

    def apart(path):
        picture = ablate_picture.draw(
            capture,
            known,
            color,
            {"a": capture.depths[row]},
            {"a": path},
            {"a": ""},
            shown,
        )
        assert picture.shape[1] > 4 * ablate_picture.WIDTH
        return np.sum(np.all(picture == ablate_picture.APART, axis=-1))

    assert apart(known.path) == 0
    near, far = apart(known.path + SHIFT), apart(known.path + 4 * SHIFT)
    assert 0 < near < far
    assert apart(None) == apart(np.repeat(known.path[:, 3:4], known.path.shape[1], 1))
