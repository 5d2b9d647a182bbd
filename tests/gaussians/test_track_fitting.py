"""`gj.fit_tracks` recovers rigid tracks made by SciPy, and refuses what it cannot."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gaussians_jax as gj
from gaussians_jax.motion.nodes import NodeMotionSpec
from gaussians_jax.motion.planes import PlaneMotionSpec
from gaussians_jax.motion.time_basis import TimeBasisSpec
from nerfies_jax.nn.planes import PlanesSpec
from tests import compilations

TIMES = np.linspace(0, 1, 10)
# Motions whose translations have the scene extent as unit.
EXTENTS = (
    TimeBasisSpec(count=2, depth=1, width=4),
    PlaneMotionSpec(
        planes=PlanesSpec(vertices=4, multiples=(1,), timestamps=4, features=2),
        width=4,
    ),
    NodeMotionSpec(nodes=5, depth=1, width=4, skips=(), links=3),
)


def rigid_tracks(rng, count=20):
    """[points, times, 3] of a body that turns by 1.5 rad and of one that shifts."""
    own = rng.normal(0, 0.3, (2, count, 3))
    turn = Rotation.from_rotvec(np.outer(TIMES, [0.3, -0.5, 1.4])).as_matrix()
    turning = np.einsum("tij,nj->nti", turn, own[0])
    shifting = own[1][:, None] + [2.0, 1.0, 0.0] + TIMES[:, None] * [0.0, 0.5, -1.0]
    return np.concatenate([turning, shifting])


@pytest.mark.full
@pytest.mark.parametrize(
    "motion",
    [gj.motion.SE3Bases(bases=3), TimeBasisSpec()],
    ids=["SE(3) bases", "basis"],
)
def test_rigid_tracks_are_recovered_where_they_are_hidden(motion, rng):
    """In any unit of time, and with wrong numbers where nothing is visible."""
    truth = rigid_tracks(rng)
    visible = rng.random(truth.shape[:2]) < 0.75
    tracks = np.where(visible[..., None], truth, 1e3)
    tracks[0, ~visible[0]] = np.nan
    times = 100 + 5 * TIMES
    fit = gj.fit_tracks(motion, tracks, visible, times, steps=600)
    error = np.linalg.norm(np.asarray(fit.positions(times)) - truth, axis=-1)
    assert error[visible].mean() < 0.01
    assert error[~visible].mean() < 0.03
    assert fit.error_after == pytest.approx(error[visible].mean(), abs=2e-3)
    assert fit.error_after < fit.error_before
    means = fit.params.rows["splats"].mean
    assert means.shape == (40, 3)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(fit.params))


@pytest.mark.full
@pytest.mark.parametrize("motion", EXTENTS, ids=lambda motion: type(motion).__name__)
def test_a_fit_in_another_unit_compiles_nothing(motion, rng, tmp_path):
    """The scene extent and the box are arguments of all programs."""
    tracks, counts = rigid_tracks(rng, 4), []
    with compilations.counted(tmp_path) as since:
        for scale in (1.0, 1.1):
            jax.clear_caches()
            fit = gj.fit_tracks(motion, scale * tracks, steps=2)
            fit.positions(TIMES[:2])
            counts.append(since())
    assert counts[0] > counts[1] == 0


TRACKS = np.zeros((4, 5, 3))
REFUSED = [
    (dict(motion="se3"), "motion is 'se3', which is no Motion: it has no apply"),
    (dict(tracks=np.zeros((4, 3))), r"tracks must have shape \[points, times, 3\]"),
    (dict(tracks=np.zeros((4, 1, 3))), r"at least two times, got \(4, 1, 3\)"),
    (dict(tracks=np.zeros((4, 5, 2))), r"got \(4, 5, 2\)"),
    (dict(tracks=np.zeros((0, 5, 3))), "visible at some time"),
    (dict(visible=np.ones((5, 4), bool)), r"bool of shape \(4, 5\)"),
    (dict(visible=np.ones((4, 5))), "got float64"),
    (dict(visible=np.arange(4)[:, None] * np.ones(5) > 0), r"1 of 4 .* \(rows \[0\]\)"),
    (dict(tracks=TRACKS * np.nan), "4 of 4 never are"),
    (dict(times=np.zeros(5)), "5 increasing numbers"),
    (dict(times=np.arange(4)), "5 increasing numbers"),
    (dict(steps=0), "steps must be at least 1"),
    (dict(learning_rate=0.0), "learning_rate must be positive"),
]


@pytest.mark.parametrize(("changes", "words"), REFUSED)
def test_wrong_arguments_are_refused_by_name(changes, words):
    arguments = dict(motion=gj.motion.SE3Bases(), tracks=TRACKS) | changes
    with pytest.raises(ValueError, match=words):
        gj.fit_tracks(**arguments)
