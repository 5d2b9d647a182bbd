"""Few rigid motions over time: against SciPy's splines and rotations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
from scipy.spatial.transform import Rotation

from gaussians_jax.core.splats import Gaussians
from gaussians_jax.motion import se3_bases
from gaussians_jax.motion.se3_bases import Bases, Poses, SE3BasesSpec
from tests.gradients import directional_error

BASES, KNOTS, COARSE, ROWS = 3, 6, 4, 5


@jax.jit
def moved(bases, logits, gaussians, time):
    return se3_bases.deform(se3_bases.at_time(bases, time), logits, gaussians)


def draw(dtype, turn=1.5, seed=0):
    rng = np.random.default_rng(seed)
    levels = [
        Poses(
            rng.uniform(-turn / 2, turn / 2, (BASES, knots, 3)).astype(dtype),
            rng.normal(0, 0.15, (BASES, knots, 3)).astype(dtype),
        )
        for knots in (KNOTS, COARSE)
    ]
    bases = Bases(*levels, rng.normal(size=(BASES, 3)).astype(dtype))
    logits = rng.normal(size=(ROWS, 1 + BASES)).astype(dtype)
    gaussians = Gaussians(
        mean=rng.normal(size=(ROWS, 3)).astype(dtype),
        quaternion=rng.normal(size=(ROWS, 4)).astype(dtype),
        scale=np.ones((ROWS, 3), dtype),
        opacity=np.full(ROWS, 0.5, dtype),
    )
    return bases, logits, gaussians


def splined(table, time):
    """Catmull-Rom as a Hermite spline with half the way between the neighbors."""
    knots = np.arange(len(table))
    around = np.concatenate([table[:1], table, table[-1:]])
    slope = (around[2:] - around[:-2]) / 2
    curve = scipy.interpolate.CubicHermiteSpline(knots, table, slope)
    return curve(time * (len(table) - 1))


@pytest.mark.parametrize("time", [0.0, 0.37, 0.4, 1.0])
def test_gaussians_move_by_the_mean_of_rigid_motions(dtype, time):
    bases, logits, gaussians = draw(dtype)
    carried = moved(bases, logits, gaussians, np.asarray(time, dtype))
    weights = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    expected = np.zeros((ROWS, 3))
    turns = np.zeros((ROWS, 3))
    for row in range(ROWS):
        mean = gaussians.mean[row].astype(float)
        expected[row] = mean
        for k in range(BASES):
            turn, shift = (
                splined(coarse[k], time) + splined(fine[k], time)
                for coarse, fine in zip(bases.coarse, bases.fine, strict=True)
            )
            center = bases.center[k]
            there = Rotation.from_rotvec(turn).apply(mean - center) + center + shift
            expected[row] += weights[row, 1 + k] * (there - mean)
            turns[row] += weights[row, 1 + k] * turn
    tolerance = 2e-6 if dtype == "float32" else 1e-13
    np.testing.assert_allclose(carried.mean, expected, atol=tolerance)
    w, *xyz = gaussians.quaternion.T.astype(float)
    own = Rotation.from_quat(np.stack([*xyz, w], -1))
    x, y, z, w = (Rotation.from_rotvec(turns) * own).as_quat().T
    same = np.abs(np.sum(np.stack([w, x, y, z], -1) * carried.quaternion, -1))
    np.testing.assert_allclose(same, 1, atol=tolerance)
    assert carried.mean.dtype == dtype


def test_one_spline_alone_is_that_spline():
    bases, *_ = draw("float32")
    at_time, time = jax.jit(se3_bases.at_time), np.float32(0.37)
    none = np.zeros((BASES, 0, 3), np.float32)
    alone = at_time(bases._replace(coarse=Poses(none, none)), time)
    still = jax.tree.map(np.zeros_like, bases.coarse)
    both = at_time(bases._replace(coarse=still), time)
    np.testing.assert_allclose(alone.turn, both.turn, rtol=1e-6)
    np.testing.assert_allclose(alone.offset, both.offset, atol=1e-6)


def test_slopes_are_those_of_differences(float64):
    bases, logits, gaussians = draw("float64")
    weights = np.random.default_rng(1).normal(size=(ROWS, 7))

    def value(bases, logits, mean, time):
        there = moved(bases, logits, gaussians._replace(mean=mean), time)
        return jnp.sum(weights * jnp.concatenate([there.mean, there.quaternion], -1))

    assert (
        directional_error(value, bases, logits, gaussians.mean, np.float64(0.47)) < 1e-7
    )


@pytest.mark.hard_cases
def test_bases_at_rest_move_nothing_at_all_and_have_slopes(dtype):
    bases, logits, gaussians = draw(dtype)
    rest = bases._replace(
        coarse=jax.tree.map(jnp.zeros_like, bases.coarse),
        fine=jax.tree.map(jnp.zeros_like, bases.fine),
    )
    time = np.asarray(0.3, dtype)
    np.testing.assert_array_equal(
        moved(rest, logits, gaussians, time).mean, gaussians.mean
    )
    slopes = jax.jit(
        jax.grad(lambda b: jnp.sum(moved(b, logits, gaussians, time).mean))
    )(rest)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
    for level in (slopes.coarse, slopes.fine):
        assert np.abs(level.turn).max() > 0.01
        assert np.abs(level.shift).max() > 0.01


@pytest.mark.hard_cases
def test_small_turns_keep_their_digits_far_from_the_origin(dtype):
    """R - 1 is not formed from R: a turn of 1e-6 about a center 1000 units away."""
    _bases, _, _gaussians = draw(dtype)
    center = np.full((1, 3), 1000, dtype)
    turn = np.full((1, KNOTS, 3), 1e-6, dtype)
    none = np.zeros((1, KNOTS, 3), dtype)
    one = Bases(Poses(turn, none), Poses(none, none), center)
    motion = jax.jit(se3_bases.at_time)(one, np.asarray(0.5, dtype))
    exact = np.cross(np.full(3, 1e-6), np.eye(3)).T
    # Of first order to 1e-12.
    np.testing.assert_allclose(motion.linear[0], exact, atol=2e-12)
    still = moved(
        one, np.array([[0, 50]], dtype), _at(center, dtype), np.asarray(0.5, dtype)
    )
    np.testing.assert_allclose(still.mean, center, rtol=1e-6)


def _at(mean, dtype):
    return Gaussians(
        mean, np.array([[1, 0, 0, 0]], dtype), np.ones((1, 3), dtype), np.ones(1, dtype)
    )


@pytest.mark.hard_cases
@pytest.mark.parametrize("size", [1e4, -1e4])
def test_decided_weights_have_finite_slopes(dtype, size):
    bases, logits, gaussians = draw(dtype)
    value = jax.jit(
        jax.grad(lambda x: jnp.sum(moved(bases, x, gaussians, x[0, 0] * 0).mean))
    )
    assert np.isfinite(value(np.asarray(size * logits, dtype))).all()


def test_a_new_motion_hardly_moves_what_stays():
    spec = SE3BasesSpec(bases=4, knots=5)
    bases = se3_bases.init(jax.random.key(0), spec)
    bases = bases._replace(fine=Poses(bases.fine.turn, bases.fine.shift + 1))
    _, _, gaussians = draw("float32")
    logits = se3_bases.init_logits(spec, ROWS)
    there = moved(bases, logits, gaussians, np.float32(0.5)).mean
    assert 0 < np.abs(there - gaussians.mean).max() < 1e-3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"bases": 0}, "bases=0"),
        ({"knots": 1}, "at least two"),
        ({"coarse_knots": 1}, "at least two"),
        ({"fine_rate": 1.5}, "lie in"),
        ({"logit_rate": 0.0}, "must be positive"),
        ({"warm_up": -1}, "must not be negative"),
        ({"learning_rate": 1e-6}, "the rate falls"),
    ],
)
def test_no_motion_of_nothing(changes, words):
    with pytest.raises(ValueError, match=words):
        SE3BasesSpec(**changes)
