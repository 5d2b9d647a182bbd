"""Motions that are rows times functions of time: against loops, SciPy and NumPy."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussians_jax.core.splats import Gaussians, Params
from gaussians_jax.init import motion_fit
from gaussians_jax.init.motion_fit import Paths, Points
from gaussians_jax.motion import polynomial as polynomial_motion
from gaussians_jax.motion import splines as spline_motion
from gaussians_jax.motion import time_basis
from gaussians_jax.motion.polynomial import FadingSpec, PolynomialMotionSpec
from gaussians_jax.motion.splines import SplineMotionSpec
from gaussians_jax.motion.time_basis import TimeBasisSpec
from gaussians_jax.scene import spec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training.effects import FrameCondition
from tests.gaussians.shared import put, rows_of, some_gaussians
from tests.gaussians.test_se3_bases import splined
from tests.gradients import directional_error

ROWS, EXTENT = 5, 2.0
SPECS = {
    "basis": TimeBasisSpec(
        count=3, time=EncodingSpec(2, times_pi=True), depth=1, width=4
    ),
    "polynomial": PolynomialMotionSpec(),
    "spline": SplineMotionSpec(knots=6),
}
MODULES = {
    "basis": time_basis,
    "polynomial": polynomial_motion,
    "spline": spline_motion,
}
by_name = pytest.mark.parametrize("name", SPECS)


@functools.cache
def effect_of(name):
    scene = spec.SplatScene(steps=100, motion=SPECS[name])
    return spec.motion_of(scene, spec.SceneMetadata(EXTENT, (0.0, 0.0, 0.0), 9))


@functools.cache
def moving(name):
    """(rows, nets, gaussians, time) -> Gaussians, through the seam."""
    effect, key = effect_of(name), MODULES[name].NAME

    @jax.jit
    def run(rows, nets, gaussians, time):
        params = Params({key: rows}, {key: nets})
        return effect.deform(params, gaussians, FrameCondition(time), None)

    return run


def random_basis(name, dtype, size=0.5):
    """Rows and networks that move things, and the Gaussians."""
    effect, rng = effect_of(name), np.random.default_rng(0)
    key, gaussians = jax.random.key(0), some_gaussians(ROWS, dtype)
    shapes = jax.eval_shape(lambda: tuple(effect.init(key, rows_of(gaussians))))
    draw = lambda leaf: size * rng.normal(size=leaf.shape)  # noqa: E731
    return put(jax.tree.map(draw, shapes), dtype), gaussians


def expected(name, rows, nets, time):
    """Shift, turn and share of the opacity of every row, in float64."""
    share = np.ones(ROWS)
    if name == "spline":
        shift, turn = (
            np.array([splined(row.astype(float), time) for row in leaf])
            for leaf in rows
        )
    elif name == "polynomial":
        since = time - rows.fading.time.astype(float)
        shift = np.zeros((ROWS, 3))
        for row in range(ROWS):
            for power in range(3):
                factor = since[row] ** (power + 1)
                shift[row] += factor * rows.shift[row, power].astype(float)
        turn = since[:, None] * rows.turn.astype(float)
        share = np.exp(-((since / np.exp(rows.fading.log_width.astype(float))) ** 2))
    else:
        angle = np.pi * time
        waves = [f(2**k * angle) for k in (0, 1) for f in (np.sin, np.cos)]
        features = np.array([time, *waves])
        for layer in nets.hidden:
            before = features @ layer.weight.astype(float) + layer.bias
            features = before / (1 + np.exp(-before))
        made = {
            k: (features @ head.weight.astype(float) + head.bias).reshape(3, 3)
            for k, head in nets.heads.items()
        }
        shift = EXTENT * np.einsum("nk,kc->nc", rows.astype(float), made["shift"])
        turn = np.einsum("nk,kc->nc", rows.astype(float), made["turn"])
    return shift, turn, share


@by_name
@pytest.mark.parametrize("time", [0.0, 0.37, 0.4, 1.0])
def test_gaussians_move_as_their_rows_say(name, time, dtype):
    (rows, nets), gaussians = random_basis(name, dtype)
    there = moving(name)(rows, nets, gaussians, put(time, dtype))
    host = jax.tree.map(np.asarray, (rows, nets, gaussians))
    shift, turn, share = expected(name, *host[:2], float(np.dtype(dtype).type(time)))
    tolerance = {"float32": 3e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(there.mean, host[2].mean + shift, atol=tolerance)
    np.testing.assert_allclose(there.opacity, host[2].opacity * share, atol=tolerance)
    np.testing.assert_array_equal(there.scale, host[2].scale)
    w, *xyz = host[2].quaternion.T.astype(float)
    own = Rotation.from_quat(np.stack([*xyz, w], -1))
    x, y, z, w = (Rotation.from_rotvec(turn) * own).as_quat().T
    same = np.abs(np.sum(np.stack([w, x, y, z], -1) * there.quaternion, -1))
    np.testing.assert_allclose(same, 1, atol=tolerance)
    assert {leaf.dtype for leaf in there} == {np.dtype(dtype)}


@by_name
def test_slopes_are_those_of_differences(name, float64):
    (rows, nets), gaussians = random_basis(name, "float64")
    weights = np.random.default_rng(1).normal(size=(ROWS, 8))

    def value(rows, nets, mean, opacity, time):
        changed = gaussians._replace(mean=mean, opacity=opacity)
        there = moving(name)(rows, nets, changed, time)
        parts = there.mean, there.quaternion, there.opacity[:, None]
        return jnp.sum(weights * jnp.concatenate(parts, -1))

    args = rows, nets, gaussians.mean, gaussians.opacity, put(0.47, "float64")
    assert directional_error(value, *args) < 1e-7


@pytest.mark.hard_cases
@by_name
@pytest.mark.parametrize("time", [0.0, 0.5, 1.0])
def test_what_starts_does_not_move_at_all_and_has_slopes(name, time, dtype):
    effect, gaussians = effect_of(name), some_gaussians(ROWS, dtype)
    rows, nets = jax.tree.map(
        lambda leaf: leaf.astype(dtype),
        tuple(effect.init(jax.random.key(0), rows_of(gaussians))),
    )
    run, time = moving(name), put(time, dtype)
    np.testing.assert_array_equal(run(rows, nets, gaussians, time).mean, gaussians.mean)
    slopes = jax.jit(jax.grad(lambda r: jnp.sum(run(r, nets, gaussians, time).mean)))(
        rows
    )
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(slopes)]
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert max(np.abs(leaf).max() for leaf in leaves) > 1e-3


@pytest.mark.hard_cases
@pytest.mark.parametrize("knots", [2, 3, 7])
def test_a_spline_is_at_its_knots_exactly(knots, dtype):
    """Where times are sums of rounded shares, too; and stays at the ends beyond."""
    table = np.random.default_rng(0).normal(size=(ROWS, knots, 3)).astype(dtype)
    rows = spline_motion.Splines(table, np.zeros_like(table))
    still = some_gaussians(ROWS, dtype)._replace(mean=np.zeros((ROWS, 3), dtype))
    run = jax.jit(spline_motion.deform)
    for knot, time in enumerate(np.linspace(0, 1, knots).astype(dtype)):
        there = run(rows, still, time).mean
        # The share of the way from the knot is of the order of an ulp of the time.
        ulps = 8 * knots * np.finfo(dtype).eps
        np.testing.assert_allclose(there, table[:, knot], atol=ulps)
    for time, knot in ((-0.3, 0), (1.5, -1)):
        there = run(rows, still, np.asarray(time, dtype)).mean
        np.testing.assert_array_equal(there, table[:, knot])


def test_sparsity_counts_the_trajectories_in_use(dtype):
    rows = np.array([[1, 0, 0], [2, -2, 0], [0, 0, 0], [5, 5, 5]], dtype)
    active = np.array([True, True, True, False])
    value = jax.jit(time_basis.sparsity)
    used = value(rows, active)
    rest = time_basis.REST
    exact = (1 / (1 + rest) + 4 / (2 + rest) + 0) / 3
    assert abs(used - exact) < {"float32": 1e-6, "float64": 1e-15}[dtype]
    assert used.dtype == dtype
    assert value(rows, ~active & active) == 0  # none there is


def test_slopes_of_sparsity_are_those_of_differences(float64):
    rows = np.random.default_rng(0).normal(size=(4, 3))
    active = np.array([True, False, True, True])

    def value(rows):
        return time_basis.sparsity(rows, jnp.asarray(active))

    assert directional_error(value, rows, step=1e-7) < 1e-6


def test_paths_are_followed_by_least_squares_in_closed_form():
    """Against one tall system solved by NumPy, for each point and coordinate."""
    rng, frames = np.random.default_rng(0), 12
    time = np.linspace(0, 1, frames)
    basis = time[:, None] ** np.arange(4)
    known = rng.uniform(size=(6, frames)) < 0.6
    position = rng.normal(5, 1, (6, frames, 3))
    position[~known] = np.nan
    paths = Paths(time, position, known, 1.0)
    fitted = motion_fit.combination(basis, paths)
    bend, drift = np.diff(basis, 2, axis=0), np.diff(basis, axis=0)
    for point in range(6):
        seen = known[point]
        ridge = np.sqrt(motion_fit.RIDGE * np.trace(basis.T @ basis)) * np.eye(4)
        tall = [motion_fit.BEND**0.5 * bend, motion_fit.DRIFT**0.5 * drift, ridge]
        tall = np.concatenate([basis[seen], *tall])
        middle = position[point, seen].mean(axis=0)
        right = np.zeros((len(tall), 3))
        right[: seen.sum()] = position[point, seen] - middle
        exact = np.linalg.lstsq(tall, right, rcond=None)[0]
        there = basis @ exact + middle
        # Squaring the system costs half of the digits.
        np.testing.assert_allclose(basis @ fitted[point], there, rtol=0, atol=1e-8)


def test_a_path_seen_once_stays_there_and_one_seen_never_is_finite():
    time = np.linspace(0, 1, 12)
    known = np.zeros((2, 12), bool)
    known[0, 4] = True
    position = np.where(known[..., None], [1.0, 2.0, 3.0], np.nan)
    for name in ("polynomial", "spline"):
        guess = effect_of(name).fit_to_paths(
            Paths(time, position, known, 1.0), jax.random.key(0)
        )
        start = Points(*guess.points)
        there = motion_fit.positions_at(effect_of(name), start, put(0.9, "float32"))
        np.testing.assert_allclose(there[0], [1, 2, 3], atol=1e-5)
        assert np.isfinite(there).all()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: TimeBasisSpec(count=0), "at least one trajectory"),
        (lambda: TimeBasisSpec(sparsity=0.0), "None disables"),
        (lambda: TimeBasisSpec(warm_up=-1), "must not be negative"),
        (lambda: TimeBasisSpec(coefficient_rate=1e-9), "the rate falls"),
        (lambda: TimeBasisSpec(width=0), "width >= 1"),
        (lambda: PolynomialMotionSpec(degree=0), "use a spline"),
        (lambda: PolynomialMotionSpec(warm_up=-1), "must not be negative"),
        (lambda: PolynomialMotionSpec(turn_rate=0.0), "positive and finite"),
        (lambda: FadingSpec(width=0.0), "width=0.0 must be positive"),
        (lambda: SplineMotionSpec(knots=1), "at least two"),
        (lambda: SplineMotionSpec(warm_up=-1), "must not be negative"),
        (lambda: SplineMotionSpec(learning_rate=1e-9), "the rate falls"),
    ],
)
def test_no_motion_of_nothing(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_opacity_without_fading_stays(dtype):
    plain = dataclasses.replace(SPECS["polynomial"], fading=None)
    rows = polynomial_motion.init(jax.random.key(0), plain, ROWS, np.dtype(dtype))
    gaussians = some_gaussians(ROWS, dtype)
    there = jax.jit(polynomial_motion.deform)(rows, gaussians, put(0.9, dtype))
    assert isinstance(there, Gaussians)
    np.testing.assert_array_equal(there.opacity, gaussians.opacity)
