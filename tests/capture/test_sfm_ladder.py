"""Which camera model is tried next, and which reconstruction is kept."""

import itertools
import math

import numpy as np
import pytest

from nerfies_jax.capture import sfm_ladder as ladder

GOOD = ladder.Summary(
    ladder.FREE, 80, 80, 3000, 0.5, 6.0, (1.0, 1.0), aspect=1.0, folds=False
)
FAULTS = {
    "28 of 80 images": {"placed": 28},
    "error of 2.00 px": {"error_px": 2.0},
    "angle of 0.8 degrees": {"angle_deg": 0.8},
    "focal length of 5.00": {"focal": (5.0, 5.0)},
    "of 0.20 to 1.00": {"focal": (0.2, 1.0)},
    "focal length of nan": {"focal": (math.nan, math.nan)},
    "factor 2.62": {"aspect": 2.62},
    "folds": {"folds": True},
}


@pytest.mark.parametrize(("text", "fault"), FAULTS.items())
def test_each_fault_is_named_and_leads_to_the_next_camera_model(text, fault):
    assert ladder.faults(GOOD) == []
    bad = GOOD._replace(**fault)
    (named,) = ladder.faults(bad)
    assert text in named
    assert ladder.next_rung([GOOD]) is None
    assert ladder.next_rung([bad]) == ladder.RADIAL


@pytest.mark.parametrize(
    ("cameras", "rungs"),
    [
        ("auto", [ladder.FREE, ladder.RADIAL, ladder.HELD, ladder.EACH]),
        ("one", [ladder.FREE, ladder.RADIAL, ladder.HELD]),
        ("each", [ladder.EACH, ladder.HELD]),
    ],
)
def test_models_are_tried_in_order_until_one_succeeds(cameras, rungs):
    results = []
    while (rung := ladder.next_rung(results, cameras)) is not None:
        assert ladder.next_rung([*results, GOOD._replace(rung=rung)], cameras) is None
        results.append(GOOD._replace(rung=rung, placed=20))
    assert [result.rung for result in results] == rungs


def test_a_spread_of_single_focal_lengths_asks_for_a_camera_for_each_image():
    zoom = GOOD._replace(spread=0.3)
    assert ladder.next_rung([zoom]) == ladder.EACH
    assert ladder.next_rung([zoom], "one") is None
    each = zoom._replace(rung=ladder.EACH, spread=0.0, placed=20)
    assert ladder.next_rung([zoom, each]) is None


def test_the_best_of_any_two_results_follows_the_order_of_the_criteria():
    """All pairs of results that differ in any of the criteria."""
    rungs = (ladder.FREE, ladder.HELD, ladder.EACH)
    values = itertools.product(
        rungs, (0, 28, 79, 80), (400, 3000), (0.3, 0.5), (1.0, 4.0), (False, True)
    )
    results = [
        GOOD._replace(
            rung=rung,
            placed=placed,
            points=points,
            error_px=error,
            focal=(focal, 1.2 * focal if rung.each else focal),
            folds=folds,
        )
        for rung, placed, points, error, focal, folds in values
    ]
    for first, second in itertools.product(results, repeat=2):
        row = ladder.best([first, second])
        chosen, other = (first, second) if row == 0 else (second, first)
        if other.placed == 0 or chosen.placed == 0:
            assert chosen.placed >= other.placed
            continue
        assert row == 0 or chosen != other
        if other.rung.each and not chosen.rung.each:
            continue  # below
        implausible = [bool(ladder.implausible_lens(x)) for x in (chosen, other)]
        assert implausible[0] <= implausible[1]
        if implausible[0] < implausible[1]:
            continue
        assert chosen.placed >= other.placed - 1
        if chosen.placed > other.placed + 1:
            continue
        assert chosen.error_px <= other.error_px
        assert chosen.error_px < other.error_px or chosen.points >= other.points


def test_a_camera_for_each_image_must_show_a_zoom():
    each = GOOD._replace(rung=ladder.EACH, error_px=0.3, points=5000)
    assert ladder.best([GOOD, each._replace(focal=(1.0, 1.02))]) == 0
    assert ladder.best([GOOD, each._replace(focal=(1.0, 1.6))]) == 1
    steady = each._replace(focal=(1.0, 1.6), error_px=0.45)
    assert ladder.best([GOOD, steady]) == 0
    assert ladder.best([GOOD._replace(placed=40), steady]) == 1


def test_a_distortion_that_folds_inside_the_image_is_recognized():
    rng = np.random.default_rng(0)
    outcomes = set()
    for _ in range(200):
        k1, k2 = rng.uniform(-0.6, 0.4), rng.uniform(-0.3, 0.3)
        corner = rng.uniform(0.3, 1.2)
        # In s = r², the derivative of r (1 + k1 r² + k2 r⁴) is 1 + 3 k1 s + 5 k2 s².
        roots = np.roots([5 * k2, 3 * k1, 1])
        squares = [x.real for x in roots if abs(x.imag) < 1e-9 and x.real > 0]
        reached = np.inf
        if squares:
            radius = min(squares) ** 0.5
            reached = radius * (1 + k1 * radius**2 + k2 * radius**4)
        folds = ladder.folds_inside([k1, k2], corner)
        outcomes.add(folds)
        if abs(reached - corner) > 1e-4:
            assert folds == (reached < corner), (k1, k2, corner)
    assert outcomes == {False, True}


def test_the_choice_is_explained_and_a_weak_focal_length_is_doubted():
    assert ladder.notes(GOOD, [GOOD], [80]) == []
    lost = GOOD._replace(placed=28, focal=(5.0, 5.0))
    held = GOOD._replace(rung=ladder.HELD, focal=(1.1, 1.1))
    why, doubt, pieces = ladder.notes(held, [lost, held], [80, 12, 5])
    assert why.startswith("camera model: focal length held while registering")
    assert "28 of 80 images" in why
    assert "focal length of 5.00 image sides" in why
    assert doubt.startswith("doubtful")
    assert "1.10 image sides" in doubt
    assert "12, 5 images" in pieces
    each = GOOD._replace(rung=ladder.EACH, focal=(1.0, 1.6))
    _, doubt = ladder.notes(each, [GOOD, each], [80])
    assert doubt.startswith("doubtful: the focal length and the distance")
    _, doubt = ladder.notes(lost, [lost, held._replace(placed=0)], [28])
    assert doubt.startswith("doubtful: focal length of 5.00")
