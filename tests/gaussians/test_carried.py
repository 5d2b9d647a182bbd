"""Gaussians that rows carry, and triangles: against loops in NumPy and SciPy."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussians_jax.core import faces, splats
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params
from gaussians_jax.init.points import InitSpec
from gaussians_jax.io import files, single_time
from gaussians_jax.motion import carried, deformation
from gaussians_jax.motion.carried import Carried, CarriedSpec, TurnSpec
from gaussians_jax.motion.mlp import MotionSpec
from gaussians_jax.optim import densification
from gaussians_jax.optim.mcmc import MCMCStrategySpec
from gaussians_jax.scene import scene, variants
from nerfies_jax import evaluation
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training import loop
from nerfies_jax.training.effects import FrameCondition
from tests import scenes
from tests.gaussians.shared import jitted, put, rotations, rows_of, some_gaussians
from tests.gradients import directional_error

ROWS, EACH, NAME = 5, 3, carried.NAME
SPEC = CarriedSpec(count=EACH, turns=TurnSpec(time=EncodingSpec(1)))
EXACT = {"float32": 1e-5, "float64": 1e-13}


def rows_and_own(dtype, count=EACH):
    """Rows, and what they carry, of random numbers."""
    rng = np.random.default_rng(1)
    rows = rows_of(some_gaussians(ROWS, dtype), opacity_logit=0.3, rest=3)
    rows = rows._replace(sh_dc=put(rng.normal(size=(ROWS, 1, 3)), dtype))
    widths = (3,), (3,), (4,), (), (1, 3), (3, 3)
    own = (0.5 * rng.normal(size=(ROWS, count, *width)) for width in widths)
    return rows, put(Carried(*own), dtype)


def params_of(dtype):
    rows, own = rows_and_own(dtype)
    init = carried.effect(SPEC, 100, 0).init
    net = jax.eval_shape(lambda: init(jax.random.key(0), rows).shared)
    rng = np.random.default_rng(2)
    net = put(jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), net), dtype)
    return Params({"splats": rows, NAME: own}, {NAME: net})


def host(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf).astype(float), tree)


def turn_of(wxyz):
    return Rotation.from_quat(np.roll(wxyz, -1))


def by_hand(params, moved, time):
    """Mean, rotation, scale and opacity of each, one after the other, in float64."""
    own, layer = params.rows[NAME], params.nets[NAME].heads["turn"]
    rows, children = params.rows["splats"], []
    for n in range(ROWS):
        core = turn_of(moved.quaternion[n])
        for k in range(EACH):
            quaternion = own.quaternion[n, k] / np.linalg.norm(own.quaternion[n, k])
            reads = np.concatenate([quaternion, [time, np.sin(time), np.cos(time)]])
            turn = Rotation.from_rotvec(reads @ layer.weight + layer.bias)
            logit = rows.opacity_logit[n] + own.opacity_logit[n, k]
            children.append(
                (
                    moved.mean[n] + core.apply(moved.scale[n] * own.offset[n, k]),
                    core * turn * turn_of(quaternion),
                    moved.scale[n] * np.exp(own.log_scale[n, k]),
                    1 / (1 + np.exp(-logit)),
                )
            )
    return [*zip(*children, strict=True)]


def same_turn(actual, expected, atol):
    apart = (rotations(actual) * Rotation.concatenate(expected).inv()).magnitude()
    # A quaternion keeps an angle to the root of what it keeps of its cosine.
    np.testing.assert_allclose(apart, 0, atol=atol)


@pytest.mark.parametrize("time", [0.0, 0.7])
def test_what_is_carried_follows_its_row_and_turns_by_itself(time, dtype):
    params, moved = params_of(dtype), some_gaussians(ROWS, dtype, seed=4)
    effect = carried.effect(SPEC, 100, 0)

    def run(params, moved, time):
        condition = FrameCondition(time)
        derived = effect.derive_rows(params, None)
        return effect.derive(params, derived, moved, condition)

    actual = jitted(run)(params, moved, put(time, dtype))
    mean, turn, scale, opacity = by_hand(host(params), host(moved), time)
    np.testing.assert_allclose(actual.mean, mean, atol=EXACT[dtype])
    np.testing.assert_allclose(actual.scale, scale, rtol=EXACT[dtype])
    np.testing.assert_allclose(actual.opacity, opacity, rtol=EXACT[dtype])
    same_turn(actual.quaternion, turn, atol=10 * EXACT[dtype])
    assert {leaf.dtype for leaf in actual} == {np.dtype(dtype)}


def test_rows_of_what_is_carried_are_what_is_drawn_at_rest(dtype):
    params = params_of(dtype)
    rows, own = params.rows["splats"], params.rows[NAME]
    still = jitted(carried.canonical_children)(rows, own)
    static = jitted(splats.activate)(still)
    stood = jitted(carried.pose_children)(own, None, still, splats.activate(rows))
    for one, other in zip(static, stood, strict=True):
        np.testing.assert_allclose(one, other, rtol=EXACT[dtype], atol=EXACT[dtype])
    looks = np.asarray(rows.sh_rest)[:, None] + np.asarray(own.sh_rest)
    np.testing.assert_array_equal(still.sh_rest, looks.reshape(-1, 3, 3))


@pytest.mark.full
def test_slopes_of_what_is_carried_are_those_of_differences(float64):
    params, moved = params_of("float64"), some_gaussians(ROWS, "float64", seed=4)
    weights = np.random.default_rng(1).normal(size=(ROWS * EACH, 11))

    def value(params, moved, time):
        children = carried.follow(params, SPEC, moved, time)
        leaves = [
            children.mean,
            children.quaternion,
            children.scale,
            children.opacity[:, None],
        ]
        return jnp.sum(weights * jnp.concatenate(leaves, axis=1))

    assert directional_error(value, params, moved, put(0.4, "float64")) < 1e-7


def test_cores_moved_by_hand_take_along_what_they_carry(float64):
    params, cores = params_of("float64"), some_gaussians(ROWS, "float64", seed=4)
    run = jitted(lambda cores: carried.follow(params, SPEC, cores, put(0.4)))
    before = run(cores)
    turn, shift = Rotation.from_rotvec([0.3, -1, 0.4]), np.array([1.0, 2, 3])
    both = turn * rotations(cores.quaternion)
    edited = cores._replace(
        mean=put(2 * turn.apply(np.array(cores.mean)) + shift),
        quaternion=put(np.roll(both.as_quat(), 1, axis=1)),
        scale=2 * cores.scale,
    )
    after = run(edited)
    np.testing.assert_allclose(
        after.mean, 2 * turn.apply(np.array(before.mean)) + shift, atol=1e-12
    )
    same_turn(after.quaternion, turn * rotations(before.quaternion), atol=1e-7)
    np.testing.assert_allclose(after.scale, 2 * before.scale, rtol=1e-12)
    # One core alone: the others' are where they were, to the bit.
    alone = cores._replace(mean=cores.mean.at[2].add(1.0))
    moved = np.any(run(alone).mean != before.mean, axis=1).reshape(ROWS, EACH)
    np.testing.assert_array_equal(moved.any(axis=1), np.arange(ROWS) == 2)


def finite_slopes(own, rows, cores):
    """What is drawn, after a look at all slopes."""

    def run(own, rows, cores):
        return carried.pose_children(
            own, None, carried.canonical_children(rows, own), cores
        )

    def total(*args):
        return sum(jnp.sum(leaf) for leaf in run(*args))

    slopes = jitted(jax.grad(total, argnums=(0, 1, 2)))(own, rows, cores)
    actual = jitted(run)(own, rows, cores)
    for leaf in jax.tree.leaves((actual, slopes)):
        assert np.isfinite(leaf).all()
    return actual, slopes


@pytest.mark.hard_cases
def test_a_core_of_no_size_has_all_in_its_middle(dtype):
    rows, own = rows_and_own(dtype)
    cores = some_gaussians(ROWS, dtype)._replace(scale=put(np.zeros((ROWS, 3)), dtype))
    actual, _ = finite_slopes(own, rows, cores)
    np.testing.assert_array_equal(actual.mean, np.repeat(cores.mean, EACH, axis=0))
    np.testing.assert_array_equal(actual.scale, 0)


@pytest.mark.hard_cases
def test_a_core_without_a_direction_has_the_axes_of_the_world(dtype):
    rows, own = rows_and_own(dtype)
    cores = some_gaussians(ROWS, dtype)
    cores = cores._replace(quaternion=put(np.zeros((ROWS, 4)), dtype))
    actual, _ = finite_slopes(own, rows, cores)
    places = np.asarray(cores.mean)[:, None] + np.asarray(cores.scale)[:, None] * own[0]
    np.testing.assert_allclose(actual.mean, places.reshape(-1, 3), atol=EXACT[dtype])


@pytest.mark.hard_cases
def test_one_in_the_middle_with_nothing_of_its_own_is_the_row(dtype):
    rows, own = rows_and_own(dtype, count=1)
    own = jax.tree.map(jnp.zeros_like, own)  # a turn of zero is the identity
    cores = splats.activate(rows)
    actual, slopes = finite_slopes(own, rows, cores)
    np.testing.assert_array_equal(actual.mean, cores.mean)
    np.testing.assert_array_equal(actual.scale, cores.scale)
    np.testing.assert_array_equal(actual.opacity, cores.opacity)
    same_turn(actual.quaternion, rotations(cores.quaternion), atol=10 * EXACT[dtype])
    assert np.abs(slopes[0].offset).max() > 0  # it leaves the middle where it is asked


@pytest.mark.hard_cases
def test_an_inactive_row_carries_inactive_ones_without_a_slope(dtype):
    rows, own = rows_and_own(dtype)
    own = own._replace(opacity_logit=put(np.full((ROWS, EACH), 200.0), dtype))
    rows = splats.deactivate(rows, jnp.arange(ROWS) == 1)
    still = jax.jit(carried.canonical_children)(rows, own)
    active = splats.active_mask(still).reshape(ROWS, EACH)
    np.testing.assert_array_equal(active.all(axis=1), np.arange(ROWS) != 1)
    actual, slopes = finite_slopes(own, rows, splats.activate(rows))
    np.testing.assert_array_equal(actual.opacity.reshape(ROWS, EACH)[1], 0)
    np.testing.assert_array_equal(slopes[0].opacity_logit[1], 0)


# Triangles --------------------------------------------------------------------------


def games(corners):
    """Rotation and scales of one triangle, by Gram and Schmidt in float64."""
    first, second = corners[1] - corners[0], corners[2] - corners[0]
    one = first / np.linalg.norm(first)
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal)
    rest = second - (second @ normal) * normal - (second @ one) * one
    rest /= np.linalg.norm(rest)
    turn = Rotation.from_matrix(np.stack([normal, one, rest], axis=1))
    return turn, np.linalg.norm(first), second @ rest


def test_a_triangle_is_the_gaussian_of_games(dtype):
    corners = np.random.default_rng(3).normal(size=(9, 3, 3)).astype(dtype)
    flat, opaque = put(np.full(9, 1e-3), dtype), put(np.full(9, 0.5), dtype)
    actual = jitted(faces.gaussians)(put(corners), flat, opaque)
    turn, long, wide = zip(*map(games, corners.astype(float)), strict=True)
    scale = np.stack([np.full(9, 1e-3), long, wide], axis=1)
    np.testing.assert_allclose(actual.scale, scale, rtol=EXACT[dtype])
    np.testing.assert_array_equal(actual.mean, corners[:, 0])
    same_turn(actual.quaternion, turn, atol=10 * EXACT[dtype])


def test_corners_of_gaussians_give_the_gaussians_again(float64):
    cores = some_gaussians(6, "float64")

    def there_and_back(cores):
        return faces.gaussians(faces.corners(cores), cores.scale[:, 0], cores.opacity)

    actual = jitted(there_and_back)(cores)
    np.testing.assert_allclose(actual.scale, cores.scale, rtol=1e-12)
    same_turn(actual.quaternion, rotations(cores.quaternion), atol=1e-7)
    weights = np.random.default_rng(1).normal(size=(6, 7))

    def value(corners):
        made = faces.gaussians(corners, cores.scale[:, 0], cores.opacity)
        return jnp.sum(weights * jnp.concatenate([made.quaternion, made.scale], -1))

    gaussians = np.random.default_rng(5).normal(size=(6, 3, 3))
    assert directional_error(value, gaussians, step=1e-6) < 1e-6


ALONG = np.array([1.0, 2.0, -2.0]) / 3
DEGENERATE = {  # the two edges, and how long and how wide the face is
    "a point": (0 * ALONG, 0 * ALONG, 0, 0),
    "a line": (2 * ALONG, -3 * ALONG, 2, 0),
    "no first edge": (0 * ALONG, 3 * ALONG, 0, 3),
    "no second edge": (2 * ALONG, 0 * ALONG, 2, 0),
    "tiny": (1e-25 * ALONG, 2e-25 * np.array([2, -2, -1]) / 3, 1e-25, 2e-25),
    "all but a line": (ALONG, ALONG + 1e-4 * np.array([2, -2, -1]) / 3, 1, 1e-4),
}


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", DEGENERATE)
def test_a_degenerate_triangle_is_a_gaussian(name, dtype):
    first, second, long, wide = DEGENERATE[name]
    corners = put(np.stack([0 * first, first, second])[None], dtype)
    one = put(np.ones(1), dtype)

    def total(corners):
        made = faces.gaussians(corners, one, one)
        return jnp.sum(made.quaternion) + jnp.sum(made.scale)

    made = jitted(faces.gaussians)(corners, one, one)
    np.testing.assert_allclose(made.scale[0, 1:], [long, wide], rtol=1e-3, atol=0)
    axes = rotations(made.quaternion).as_matrix()[0]
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-6)
    if long:
        np.testing.assert_allclose(axes[:, 1], first / long, atol=1e-6)
    if name != "tiny":  # whose axes turn by 1e25 rad for a scene unit
        assert np.isfinite(jitted(jax.grad(total))(corners)).all()


# Whole scenes -----------------------------------------------------------------------

TINY = dataclasses.replace(
    scenes.TINY_SPLATS,
    init=InitSpec(random=60, min_points=1000),
    motion=MotionSpec(
        EncodingSpec(1), EncodingSpec(1), None, 1, 8, (), warm_up=4, smoothing=None
    ),
    carried=SPEC,
)


@functools.cache
def trained():
    capture = scenes.tiny_capture()
    model = scene.build(TINY, scene.metadata_of(capture))
    start = model.init(capture, jax.random.key(0))
    frames = evaluation.frames_of(capture, model.required_data)
    return model, start, loop.fit(model, start, frames, steps=30).state


@pytest.mark.slow
def test_rows_that_carry_grow_train_and_are_drawn_by_what_they_carry(tmp_path):
    model, start, state = trained()
    before, after = model.counts(start), model.counts(state)
    assert after["rows"] > before["rows"] == 60
    assert after["gaussians"] == EACH * after["rows"]
    own = state.params.rows[NAME]
    for leaf, first in zip(own, start.params.rows[NAME], strict=True):
        assert np.isfinite(leaf).all()
        assert leaf.size == 0 or np.any(np.asarray(leaf)[:60] != np.asarray(first)[:60])
    # What a file holds is what is drawn.
    rows = single_time.splats_at(model, state)(0.5)
    assert files.save(tmp_path / "scene.ply", rows) == after["gaussians"]
    gaussians = single_time.gaussians_at(model, state)(0.5)
    np.testing.assert_allclose(rows.mean, gaussians.mean, atol=1e-6)


@pytest.mark.slow
def test_rows_that_stand_still_carry_what_stands_still():
    model, _, state = trained()
    faster = variants.without_static(model, state, 0.0)
    view = evaluation.view_of(scenes.tiny_capture(), 1)
    size = scenes.tiny_capture().size
    whole, quick = (
        jax.jit(one.render, static_argnums=2)(params, view, size, state.step)
        for one, params in (
            (model, state.params),
            (faster.model, faster.state.params),
        )
    )
    np.testing.assert_allclose(quick.color, whole.color, atol=1e-5)
    hidden, _ = variants.without_moving(model, state, 1e-3)
    left = splats.active_mask(model.stages.rows(hidden.params)).reshape(-1, EACH)
    np.testing.assert_array_equal(left.all(axis=1), left.any(axis=1))


def test_a_row_counts_the_mean_slope_of_what_is_seen_of_it():
    rng = np.random.default_rng(0)
    rows = rows_of(some_gaussians(ROWS, "float32"))
    slope = put(rng.normal(size=(ROWS * EACH, 2)), "float32")
    visible = rng.uniform(size=(ROWS, EACH)) < 0.6
    visible[1] = False
    radius = rng.uniform(1, 9, (ROWS, EACH)).astype(np.float32)
    stats = densification.observe(
        densification.empty_stats(rows),
        slope,
        put(visible.ravel()),
        put(radius.ravel()),
        (20, 10),
    )
    for row in range(ROWS):
        seen = np.flatnonzero(visible[row])
        norms = np.linalg.norm(np.asarray(slope)[EACH * row + seen] * [10, 5], axis=1)
        assert int(stats.views[row]) == int(len(seen) > 0)
        np.testing.assert_allclose(
            stats.grad2d[row], norms.mean() if len(seen) else 0, rtol=1e-5
        )
        assert stats.radius_px[row] == (radius[row, seen].max() if len(seen) else 0)


def test_scenes_that_cannot_carry_are_refused():
    plan = MCMCStrategySpec(cap_max=100)
    capture = scenes.tiny_capture()
    metadata = scene.metadata_of(capture)
    model = scene.build(dataclasses.replace(TINY, strategy=plan), metadata)
    with pytest.raises(ValueError, match="carried=none"):
        model.init(capture, jax.random.key(0))

    def nothing(*_):
        raise AssertionError

    second = SplatRecord("second", derive=nothing, derive_rows=nothing)
    with pytest.raises(ValueError, match="carried and second both define"):
        scene.build(TINY, metadata, (second,))
    with pytest.raises(ValueError, match="'half' has only one of derive and"):
        deformation.check_derived((SplatRecord("half", derive=nothing),))
