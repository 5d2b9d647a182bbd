"""Paths told apart into rigid bodies, and how these move."""

import numpy as np
import pytest
import scipy.spatial.transform
from scipy.sparse.linalg import ArpackNoConvergence

from nerfies_jax.preprocessing import rigid_groups


def two_bodies():
    """[40, 20, 3] points of a body that turns by 300 degrees and of one that shifts."""
    rng = np.random.default_rng(2)
    angle = np.linspace(0, np.deg2rad(300), 20)
    turns = scipy.spatial.transform.Rotation.from_rotvec(
        angle[:, None] * [0, 0, 1]
    ).as_matrix()
    body = rng.normal(0, 0.1, (20, 3))
    turning = np.einsum("tij,nj->nti", turns, body) + np.array([0.5, 0, 2])
    other = rng.normal(0, 0.1, (20, 1, 3)) + np.linspace(0, 0.4, 20)[:, None] * [
        0,
        1,
        0,
    ]
    return np.concatenate([turning, other + np.array([-0.5, 0, 2])]), angle


def test_two_bodies_are_told_apart_and_their_motions_found():
    position, angle = two_bodies()
    known = np.ones(position.shape[:2], bool)
    # No point of the first body lives through the video.
    for row in range(20):
        known[row, (row % 10) + 8 :] = False
        known[row, : max(0, row % 10 - 2)] = False
    known[0:2, 6:] = True
    known[10:16, 8:] = True
    label = rigid_groups.labels(position, known, 2)
    assert (label == np.repeat(label[[0, 20]], 20)).all()
    assert label[0] != label[20]
    bodies = rigid_groups.motion(position, known, label, 10)
    canonical, _ = rigid_groups.centers(position, known, bodies)
    np.testing.assert_allclose(canonical, position[:, 10], atol=1e-6)
    turn = rigid_groups.rotation_vectors(bodies.rotation, 10)[label[0]]
    np.testing.assert_allclose(turn[:, 2], angle - angle[10], atol=1e-6)


def test_procrustes_leaves_out_what_strays():
    rng = np.random.default_rng(3)
    source = rng.normal(size=(30, 3))
    true = scipy.spatial.transform.Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix()
    target = source @ true.T + [1, 2, 3]
    target[:3] += 5
    rotation, shift = rigid_groups.procrustes(source, target)
    np.testing.assert_allclose(rotation, true, atol=0.02)
    np.testing.assert_allclose(shift, [1, 2, 3], atol=0.05)


@pytest.mark.hard_cases
def test_identical_paths_are_one_body():
    position = np.repeat(np.linspace(0, 1, 12)[None, :, None], 5, axis=0) * [1, 0, 0]
    label = rigid_groups.labels(position, np.ones((5, 12), bool), 2)
    bodies = rigid_groups.motion(position, np.ones((5, 12), bool), label, 6)
    assert np.isfinite(bodies.rotation).all()
    assert np.isfinite(bodies.shift).all()


def test_bodies_are_told_apart_where_iterations_give_up(monkeypatch):
    def give_up(*_, **__):
        raise ArpackNoConvergence("no convergence", np.zeros(0), np.zeros((0, 0)))

    monkeypatch.setattr(rigid_groups, "eigsh", give_up)
    position, _ = two_bodies()
    known = np.ones(position.shape[:2], bool)
    label = rigid_groups.labels(position, known, 2)
    assert (label == np.repeat(label[[0, 20]], 20)).all()
    assert label[0] != label[20]
    assert rigid_groups.fewest(position, known, 1e-6) == (2, pytest.approx(0, abs=1e-6))


@pytest.mark.parametrize(
    ("counts", "share", "wanted"),
    [((1, 2, 4), 0.8, 2), ((1, 2), 0.8, 2), ((2, 4), 0.8, 2), ((1, 4), 0.0, 1)],
)
def test_no_more_bodies_are_asked_for_than_explain_the_paths(
    counts, share, wanted, rng
):
    position, _ = two_bodies()
    position = position + rng.normal(0, 1e-3, position.shape)  # what tracks are off by
    known = np.ones(position.shape[:2], bool)
    assert rigid_groups.enough(position, known, counts, share) == wanted
