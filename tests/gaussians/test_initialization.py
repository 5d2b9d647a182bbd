"""Which points the first Gaussians stand on."""

import dataclasses

import numpy as np
import pytest

from gaussians_jax.init import points as initialization
from gaussians_jax.init.points import InitSpec
from tests.gaussians.test_refusals import capture_with

SPEC = InitSpec(points=10**4, random=70, extra_random=30)


def own_points(spec, capture):
    """How many of the capture's own points the start has; checks the count foretold."""
    position, color = initialization.initial_points(spec, capture, 0)
    assert (
        position.shape
        == color.shape
        == (initialization.initial_count(spec, capture), 3)
    )
    assert ((color >= 0) & (color <= 1)).all()
    if capture.points is None:
        return 0
    known = {tuple(point) for point in capture.points.position}
    return sum(tuple(point) in known for point in position)


@pytest.mark.parametrize(
    ("source", "points", "own", "random"),
    [
        ("auto", 150, 150, 30),
        ("auto", 99, 0, 70),
        ("auto", None, 0, 70),
        ("points", 1, 1, 30),
        ("random", 150, 0, 70),
    ],
)
def test_the_source_decides_whose_points_they_are(source, points, own, random):
    spec, capture = dataclasses.replace(SPEC, source=source), capture_with(points)
    assert own_points(spec, capture) == own
    assert initialization.initial_count(spec, capture) == own + random


def test_a_start_is_never_empty():
    spec = dataclasses.replace(SPEC, min_points=0)
    assert initialization.initial_count(spec, capture_with(0)) == 70
    assert own_points(spec, capture_with(0)) == 0
    assert own_points(spec, capture_with(1)) == 1


def test_random_points_stand_in_where_no_tracks_bring_what_moves():
    spec = InitSpec(points=100, extra_random=None)
    larger = dataclasses.replace(spec, extra_random=7)
    for tracked, most, extra in (
        (True, None, 0),
        (False, None, 50),
        (False, 120, 20),
        (False, 90, 0),
    ):
        settled = initialization.of_start(spec, tracked, most)
        assert settled.extra_random == extra
        assert initialization.of_start(larger, tracked, most) == larger
    assert own_points(spec, capture_with(150)) == 100
    assert initialization.initial_count(spec, capture_with(150)) == 150


def test_random_points_do_not_depend_on_the_points_of_the_capture():
    """Or a start "without structure from motion" would have some after all."""
    spec = dataclasses.replace(SPEC, source="random")
    first, second, third = (
        initialization.initial_points(spec, capture_with(points), seed)
        for points, seed in ((150, 0), (None, 0), (None, 1))
    )
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (first[0] != third[0]).any()
