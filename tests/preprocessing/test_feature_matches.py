"""Motion told by features of photographs that have no order."""

import dataclasses
import functools

import numpy as np
import pytest

from nerfies_jax.preprocessing import feature_matches, motion, view_set
from nerfies_jax.preprocessing.findings import CANNOT_TELL, CERTAIN
from nerfies_jax.preprocessing.record import Evidence
from tests.preprocessing import two_planes

PHOTOGRAPHS = 20


def _place(time):
    """A viewpoint of a grid of 5x4, in a random order."""
    order = np.random.default_rng(3).permutation(PHOTOGRAPHS)
    cell = order[round(time * (PHOTOGRAPHS - 1))]
    return 0.14 * (cell % 5 - 2), 0.14 * (cell // 5 - 1.5), 0.02 * (cell % 3)


def _elsewhere(time):
    """A place of the card of its own in each photograph."""
    return np.random.default_rng(round(100 * time)).uniform(-0.2, 0.2, 2)


@pytest.fixture
def sharp(monkeypatch):
    monkeypatch.setattr(two_planes, "SIZE", (192, 144))
    monkeypatch.setattr(two_planes, "FOCAL", 180.0)
    monkeypatch.setattr(feature_matches, "MOST_FEATURES", 400)
    return functools.partial(two_planes.make, camera=_place, frames=PHOTOGRAPHS)


def _finding(capture):
    views = view_set.in_time_order(capture)
    nothing = Evidence(**dict.fromkeys(Evidence._fields))
    evidence = nothing._replace(unusable="no flow", is_external=False)
    return motion.motion(views, evidence)


def test_20_photographs_without_motion_are_certainly_static(sharp):
    finding = _finding(sharp())
    assert (finding.wanted, finding.confidence) == (False, CERTAIN)
    assert finding.numbers["feature_moving_share_most"] < motion.FEATURES_FOR_NO


def test_20_photographs_with_a_card_that_is_moved_are_not_static(sharp):
    finding = _finding(sharp(card=_elsewhere))
    assert (finding.wanted, finding.confidence) == (None, CANNOT_TELL)
    assert "no flow; in overlapping views" in finding.evidence


def test_few_features_do_not_tell_that_nothing_moves(sharp):
    assert _finding(sharp(blank=True)).wanted is None
    few = feature_matches.Census(points=100.0, moving=0.0)
    # The rule of three.
    np.testing.assert_allclose(few.most_moving, -np.log(0.05) / 100)
    assert few.most_moving > motion.FEATURES_FOR_NO
    assert feature_matches.Census(0.0, 0.0).most_moving == 1


def test_an_image_that_matches_no_other_has_no_part_in_the_count(sharp):
    capture = sharp()
    images = np.array(capture.images)
    images[3] = np.random.default_rng(0).integers(0, 256, images[3].shape)
    finding = _finding(dataclasses.replace(capture, images=images))
    assert (finding.wanted, finding.confidence) == (False, CERTAIN)
