"""Points guessed where something hides what stands in every frame."""

import numpy as np
import pytest

from nerfies_jax.capture.capture import PointCloud
from nerfies_jax.preprocessing import hidden_points, view_set
from tests.preprocessing import two_planes

HOLE = 0.3  # half the side of what nothing shows, on the wall
SLOPE = 0.4  # of the wall's z, per unit to the right


def wall(x, y):
    return np.stack([x, y, 2 + SLOPE * x], -1)


def capture_before(hole=HOLE, front=False):
    """Views, points of a tilted wall around a hole, and a mask that hides the hole."""
    capture = two_planes.make(frames=12)
    views = view_set.in_time_order(capture)
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-1.6, 1.6, 200)]))
    shown = np.maximum(np.abs(x), np.abs(y)) > hole
    position = wall(x[shown], y[shown])
    red = np.clip(np.round(128 + 70 * x[shown]), 0, 255)
    if front:  # an edge at rest before the wall, along the left of the hole
        edge = np.stack([0.5 * x - 0.3, 0.5 * y, 0 * x + 1.0], -1)
        edge = edge[(edge[:, 0] > -0.22) & (edge[:, 0] < -0.14)]
        position = np.concatenate([position, edge])
        red = np.append(red, np.zeros(len(edge)))
    color = np.repeat(red[:, None], 3, 1).astype(np.uint8)
    inside = np.stack(np.meshgrid(*2 * [np.linspace(-HOLE, HOLE, 120)]), -1)
    inside = wall(*inside.reshape(-1, 2).T)
    moving = np.zeros(views.gray.shape, bool)
    for frame, mask in enumerate(moving):
        pixel, _ = view_set.project(views, frame, inside)
        row, column = np.clip(pixel[:, ::-1].astype(int).T, 0, [[71], [95]])
        mask[row, column] = True
    return views, PointCloud(position.astype(np.float32), color), moving


@pytest.mark.parametrize("front", [False, True])
def test_a_wall_goes_on_behind_what_moves(front):
    """Its plane and colors; an edge before it takes no part."""
    views, still, moving = capture_before(front=front)
    actual = hidden_points.behind(views, still, moving)
    x, y, z = actual.position.astype(float).T
    assert np.abs(z - wall(x, y)[:, 2]).max() < 0.03
    assert np.maximum(np.abs(x), np.abs(y)).max() < HOLE + 0.05
    true = np.round(128 + 70 * x)
    assert np.abs(actual.color[:, 0] - true).mean() < 3
    # Wherever the hole is looked at there is a point near; pixels by the edge show it.
    for frame in () if front else (0, 6, 11):
        pixel, _ = view_set.project(views, frame, actual.position)
        row, column = np.nonzero(moving[frame])
        hole = np.stack([column, row], -1) + 0.5
        apart = np.linalg.norm(hole[:, None] - pixel, axis=-1).min(1)
        assert apart.max() < 10


def test_nothing_is_guessed_where_points_are():
    views, still, moving = capture_before(hole=0.0)
    assert len(hidden_points.behind(views, still, moving).position) == 0


@pytest.mark.parametrize("points", [0, 5])
def test_few_points_tell_of_nothing(points):
    views, still, moving = capture_before()
    few = PointCloud(still.position[:points], still.color[:points])
    assert len(hidden_points.behind(views, few, moving).position) == 0
