"""Depth, flow, track and path errors against NumPy, SciPy and known motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation

from nerfies_jax.metrics import geometry_quality as quality
from tests import gradients

EXACT = {"float32": 3e-6, "float64": 1e-13}


def depths(rng, dtype, unknown=True):
    truth = rng.uniform(1, 5, (9, 7))
    depth = truth * rng.uniform(0.6, 1.6, truth.shape)
    if unknown:
        truth[0], truth[1, 0], depth[2, 0] = 0, np.nan, np.inf
    mask = rng.random(truth.shape) > 0.2
    return depth.astype(dtype), truth.astype(dtype), mask


def known_of(depth, truth, mask):
    """In NumPy: seen, and with a depth on both sides."""
    return mask & (truth > 0) & np.isfinite(depth)


depth_errors = jax.jit(quality.depth_errors)
align_depth = jax.jit(quality.align_depth)
track_errors = jax.jit(quality.track_errors, static_argnums=3)


def test_depth_errors_and_alignment_are_those_of_numpy(dtype, rng):
    depth, truth, mask = depths(rng, dtype)
    known = known_of(depth, truth, mask)
    d, t = (x[known].astype(np.float64) for x in (depth, truth))
    errors, line = depth_errors(depth, truth, mask), align_depth(depth, truth, mask)
    assert errors.abs_rel == pytest.approx(np.mean(abs(d - t) / t), rel=EXACT[dtype])
    rmse = np.sqrt(np.mean((d - t) ** 2))
    assert errors.rmse == pytest.approx(rmse, rel=EXACT[dtype])
    right = np.mean(np.maximum(d / t, t / d) < 1.25)
    assert errors.within_delta == pytest.approx(right, rel=EXACT[dtype])
    assert float(errors.pixels) == known.sum()
    grad, intercept = np.polyfit(d, t, 1)
    assert line.scale == pytest.approx(grad, rel=10 * EXACT[dtype])
    assert line.shift == pytest.approx(intercept, rel=10 * EXACT[dtype])
    assert line.determined


@pytest.mark.hard_cases
def test_negative_depth_is_wrong_and_no_depth_is_no_answer(dtype):
    truth = np.asarray([2.0, 2.0], dtype)
    errors = depth_errors(np.asarray([-2.0, 2.0], dtype), truth)
    assert (float(errors.abs_rel), float(errors.within_delta)) == (1.0, 0.5)
    empty = depth_errors(truth, np.zeros_like(truth))
    assert np.all(np.isnan(empty[:3]))
    assert empty.pixels == 0


@pytest.mark.hard_cases
def test_exact_depth_has_a_finite_gradient(dtype):
    truth = np.asarray([2.0, 3.0, 0.0, np.nan], dtype)

    def total(depth, truth):
        return sum(quality.depth_errors(depth, truth)[:2])

    grad = np.asarray(jax.jit(jax.grad(total))(truth, truth))
    assert np.all(np.isfinite(grad))
    assert np.all(grad[2:] == 0)


@pytest.mark.hard_cases
def test_alignment_survives_a_large_offset_and_reports_a_constant(dtype, rng):
    truth = rng.uniform(1, 3, 200).astype(dtype)
    # Steps of 2^-12, so that 1000 + offset is exact in float32.
    steps = (np.round(truth * 4096) / 4096).astype(dtype)
    line = jax.tree.map(np.asarray, align_depth(1000 + steps, steps))
    # The mean of 1000 carries 6e-5 in float32; normal equations about 0 lose it all.
    assert abs(line.scale - 1) < {"float32": 1e-6, "float64": 1e-12}[dtype]
    assert line.determined
    flat = align_depth(np.full(200, 1000.1, dtype), truth)
    assert not flat.determined
    assert float(flat.scale) == 0
    assert float(flat.shift) == pytest.approx(np.mean(truth, dtype=np.float64))


def test_flow_errors_are_those_of_a_slow_loop(dtype, rng):
    truth = rng.normal(size=(6, 8, 2)) * 40
    flow = truth + rng.normal(size=truth.shape) * 3
    truth[0, 0] = np.nan
    errors = jax.jit(quality.flow_errors)(flow.astype(dtype), truth.astype(dtype))
    distance = np.linalg.norm(flow - truth, axis=-1)[np.isfinite(truth[..., 0])]
    length = np.linalg.norm(truth, axis=-1)[np.isfinite(truth[..., 0])]
    assert errors.endpoint == pytest.approx(distance.mean(), rel=EXACT[dtype])
    wrong = (distance > 3) & (distance > 0.05 * length)
    assert 0 < wrong.mean() < 1
    assert errors.outliers == pytest.approx(wrong.mean(), rel=EXACT[dtype])
    assert errors.pixels == distance.size


@pytest.mark.hard_cases
def test_missing_flow_is_wrong_and_equal_flow_has_gradient_zero(dtype):
    truth = np.asarray([[1.0, 0.0], [0.0, 2.0]], dtype)
    missing = truth.copy()
    missing[0, 0] = np.nan

    def endpoint(flow, truth):
        errors = quality.flow_errors(flow, truth)
        return errors.endpoint, errors

    slope_and_errors = jax.jit(jax.grad(endpoint, has_aux=True))
    _, errors = slope_and_errors(missing, truth)
    assert np.isinf(errors.endpoint)
    assert float(errors.outliers) == 0.5
    grad, _ = slope_and_errors(truth, truth)
    assert not np.any(grad)


@pytest.mark.parametrize("axes", [2, pytest.param(3, marks=pytest.mark.full)])
def test_track_errors_count_visible_points(axes, dtype, rng):
    truth = rng.uniform(0, 100, (5, 6, axes))
    tracks = truth + rng.normal(size=truth.shape) * 3
    visible = rng.random((5, 6)) > 0.3
    tracks[~visible] = np.nan
    inputs = tracks.astype(dtype), truth.astype(dtype)
    errors = track_errors(*inputs, visible, 5.0)
    distance = np.linalg.norm(tracks - truth, axis=-1)[visible]
    assert errors.endpoint == pytest.approx(distance.mean(), rel=10 * EXACT[dtype])
    assert 0 < errors.correct < 1
    assert errors.correct == pytest.approx((distance < 5).mean(), rel=EXACT[dtype])
    assert int(errors.points) == visible.sum()
    # a point that is not there is not correct, and a threshold is positive
    assert track_errors(*inputs, np.ones((5, 6), bool), 1e9).correct < 1
    with pytest.raises(ValueError, match=r"threshold=0\.0 must be positive"):
        track_errors(*inputs, visible, 0.0)


def test_gradients_agree_with_central_differences(float64, rng):
    depth, truth, mask = depths(rng, "float64", unknown=False)
    mask = jnp.asarray(mask)

    def total(depth, truth):
        line = quality.align_depth(depth, truth, mask)
        errors = quality.depth_errors(line.scale * depth + line.shift, truth, mask)
        flows = (x.reshape(-1, 3)[:, :2] for x in (depth, truth))
        return errors.abs_rel + errors.rmse + quality.flow_errors(*flows).endpoint

    assert gradients.directional_error(total, depth, truth) < 1e-6


def motion(rng, scale=2.5, distance=1.0):
    rotation = Rotation.random(random_state=3).as_matrix()
    return scale, rotation, distance * rng.normal(size=3)


@pytest.mark.parametrize("scaled", [True, False])
def test_alignment_is_the_minimum_scipy_finds(scaled, rng):
    points = rng.normal(size=(12, 3))
    scale, rotation, shift = motion(rng)
    truth = scale * points @ rotation.T + shift + 0.3 * rng.normal(size=points.shape)
    alignment = quality.align_points(points, truth, scaled)

    def residual(x):
        size = np.exp(x[6]) if scaled else 1.0
        moved = size * points @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:6]
        return (moved - truth).ravel()

    start = np.r_[Rotation.from_matrix(rotation).as_rotvec(), shift, 0.0]
    best = scipy.optimize.least_squares(residual, start, xtol=1e-15, ftol=1e-15)
    mine = (
        alignment.scale * points @ alignment.rotation.T + alignment.translation - truth
    )
    assert np.sum(mine**2) == pytest.approx(2 * best.cost, rel=1e-9)
    assert np.linalg.det(alignment.rotation) == pytest.approx(1)
    assert (alignment.rank, alignment.determined) == (3, True)


@pytest.mark.hard_cases
@pytest.mark.parametrize("distance", [1.0, 1e6])
def test_a_known_motion_comes_back_from_far_away(distance, rng):
    points = rng.normal(size=(30, 3)) + distance
    scale, rotation, shift = motion(rng, distance=distance)
    truth = scale * points @ rotation.T + shift
    alignment = quality.align_points(points, truth, True)
    # float32 gives a scale of 2.5028 and a rotation 6e-3 off at 1e6.
    assert alignment.scale == pytest.approx(scale, rel=1e-8)
    np.testing.assert_allclose(alignment.rotation, rotation, atol=1e-8)
    assert alignment.determined
    assert quality.path_errors(points, truth, with_scale=False).rmse > 0.1
    points[4] += 0.5
    errors = quality.path_errors(points, truth)
    assert 0 < errors.median < errors.rmse < errors.largest


@pytest.mark.hard_cases
@pytest.mark.parametrize(("kind", "rank"), [("point", 0), ("line", 1), ("plane", 2)])
def test_degenerate_paths_are_finite_and_say_so(kind, rank, rng):
    axes = np.eye(3)[:rank]
    points = rng.normal(size=(8, rank)) @ axes + 7.0
    scale, rotation, shift = motion(rng)
    truth = scale * points @ rotation.T + shift
    errors = quality.path_errors(points, truth)
    # A line fits perfectly under many rotations: the residual alone reveals nothing.
    assert errors.rmse < 1e-12
    assert errors.alignment.rank == rank
    assert errors.alignment.determined == (rank == 2)
    assert np.all(np.isfinite(errors.alignment.rotation))
    assert errors.alignment.scale == pytest.approx(scale if rank else 1.0)


@pytest.mark.hard_cases
def test_a_mirrored_path_is_never_explained_by_a_reflection(rng):
    points = rng.normal(size=(10, 3)) * [3, 2, 1]
    alignment = quality.align_points(points, points * [1, 1, -1], True)
    assert np.linalg.det(alignment.rotation) == pytest.approx(1)
    assert quality.path_errors(points, points * [1, 1, -1]).rmse > 0.1
    # Mirrored with equal spreads, the axis of the flip is anybody's guess.
    cube = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    assert not quality.align_points(cube, -cube, True).determined


def rotations(rng, frames):
    return Rotation.random(frames, random_state=5).as_matrix()


def test_relative_errors_ignore_the_world_and_see_a_wrong_step(rng):
    true_rotation, true_position = rotations(rng, 6), rng.normal(size=(6, 3))
    _, world, shift = motion(rng)
    same = true_rotation @ world.T, true_position @ world.T + shift
    errors = quality.relative_errors(*same, true_rotation, true_position, stride=2)
    assert errors.translation_rmse < 1e-12
    assert errors.rotation_deg < 1e-6
    turn = Rotation.from_rotvec(np.radians([0, 0, 8.0])).as_matrix()
    wrong = same[0].copy()
    wrong[5] = turn @ wrong[5]  # only the last of five steps is wrong
    errors = quality.relative_errors(wrong, same[1], true_rotation, true_position)
    assert errors.rotation_deg == pytest.approx(8 / 5)
    assert errors.translation_rmse < 1e-12
    shifted = same[1] + np.outer(np.arange(6) == 5, [0.3, 0, 0])
    errors = quality.relative_errors(same[0], shifted, true_rotation, true_position)
    assert errors.translation_rmse == pytest.approx(0.3 / np.sqrt(5))


@pytest.mark.hard_cases
@pytest.mark.parametrize("angle", [0, 1e-12, 1e-7, 1.0, np.pi - 1e-9, np.pi])
def test_rotation_angles_are_exact_near_zero_and_pi(angle):
    axis = np.array([1, -2, 2]) / 3
    rotation = np.stack([np.eye(3), Rotation.from_rotvec(angle * axis).as_matrix()])
    still, stays = np.zeros((2, 3)), np.stack([np.eye(3)] * 2)
    errors = quality.relative_errors(rotation, still, stays, still)
    assert np.radians(errors.rotation_deg) == pytest.approx(angle, rel=1e-8, abs=1e-15)


def test_wrong_paths_are_refused():
    three, turns = np.zeros((3, 3)), np.zeros((3, 3, 3))
    hole = three + np.array([[0], [np.nan], [0]])
    for call, words in (
        (lambda: quality.path_errors(three, three[:2]), "got 3 and 2"),
        (lambda: quality.path_errors(hole, three), r"points\[1\]=\[nan"),
        (
            lambda: quality.path_errors(three[:0], three[:0]),
            r"at least one point, got \(0, 3\)",
        ),
        (
            lambda: quality.relative_errors(turns, three, turns, three, 3),
            "stride=3 must be at least 1",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            call()
