"""Sonata's motion: its equation, what is prepared, switches, its hard cases."""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform

from gaussians_jax import splats as rows
from gaussians_jax.effects import deformation, kan_motion
from gaussians_jax.effects.kan_motion import KanMotion, KanMotionSpec, Offsets
from gaussians_jax.splats import Gaussians, Params, Splats
from nerfies_jax.measure import clock
from nerfies_jax.nets import kan, mlp
from nerfies_jax.training.effects import FrameCondition
from tests import gradients

SMALL = KanMotionSpec(embedding=6, time_code=4, hidden=(5,), kernels=3, block=8)
AS_MLP = dataclasses.replace(SMALL, hidden=(5, 4), network="mlp", mlp_width=7)
FRAMES = 9
NETWORKS = pytest.mark.parametrize("spec", [SMALL, AS_MLP], ids=["kan", "mlp"])


def strong(spec, dtype="float64"):
    """A field that moves things by about their own size; every bias is drawn too."""
    shapes = jax.eval_shape(
        lambda key: kan_motion.init(key, spec, FRAMES), jax.random.key(0)
    )
    rng = np.random.default_rng(0)
    return jax.tree.map(
        lambda leaf: jnp.asarray(0.5 * rng.normal(size=leaf.shape), dtype), shapes
    )


def embeddings(count, dtype="float64"):
    drawn = np.random.default_rng(1).normal(size=(count, SMALL.embedding))
    return jnp.asarray(drawn, dtype)


def together(params, spec, embedding, time, active=None):
    """As in a training step: prepared and used in one program."""
    prepared = kan_motion.prepare(params, spec, embedding, active)
    return kan_motion.deform(params, spec, time, prepared, active)


uncached = jax.jit(together, static_argnums=1)


def some_gaussians(count, dtype="float64", seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians(
        mean=jnp.asarray(rng.normal(size=(count, 3)), dtype),
        quaternion=jnp.asarray(rng.normal(size=(count, 4)), dtype),
        scale=jnp.asarray(rng.uniform(0.1, 1, (count, 3)), dtype),
        opacity=jnp.asarray(rng.uniform(size=count), dtype),
    )


def scene_of(spec, dtype="float64", count=9):
    gaussians = some_gaussians(count, dtype)
    splats = Splats(
        gaussians.mean,
        jnp.log(gaussians.scale),
        gaussians.quaternion,
        jnp.zeros(count, dtype),
        jnp.zeros((count, 1, 3), dtype),
        jnp.zeros((count, 0, 3), dtype),
    )
    name = kan_motion.NAME
    return Params(
        {"splats": splats, name: embeddings(count, dtype)}, {name: strong(spec, dtype)}
    )


@functools.partial(jax.jit, static_argnums=0)
def whole_network(spec, field, inputs):
    apply = kan.apply if spec.network == "kan" else mlp.apply
    return apply(kan_motion.field_spec(spec), field, inputs)


@NETWORKS
def test_offsets_are_those_of_the_whole_network(spec, dtype):
    """Equation 11, every Gaussian's network fed [embedding, time code]."""
    params, codes = strong(spec, dtype), embeddings(11, dtype)
    assert params.times.shape == (5, 4)
    for time in (0.0, 0.3, 1.0):
        offsets = uncached(params, spec, codes, jnp.asarray(time, dtype))
        table = np.asarray(params.times, np.float64)
        code = [np.interp(4 * time, np.arange(5), column) for column in table.T]
        inputs = np.concatenate([codes, np.tile(code, (11, 1))], axis=1)
        expected = whole_network(spec, params.field, jnp.asarray(inputs, dtype))
        assert sorted(expected) == sorted(Offsets._fields)
        for name, value in expected.items():
            tolerance = {"float32": 2e-5, "float64": 1e-13}[dtype]
            ours = getattr(offsets, name)
            assert ours.dtype == dtype
            np.testing.assert_allclose(ours, value, atol=tolerance)


@pytest.mark.full
@NETWORKS
def test_prepared_once_is_prepared_every_time(spec, dtype):
    params, codes = strong(spec, dtype), embeddings(11, dtype)
    prepared = jax.jit(kan_motion.prepare, static_argnums=1)(params, spec, codes)
    deform = jax.jit(kan_motion.deform, static_argnums=1)
    for time in (0.0, 0.61):
        cached = deform(params, spec, jnp.asarray(time, dtype), prepared)
        fresh = uncached(params, spec, codes, jnp.asarray(time, dtype))
        for one, other in zip(cached, fresh, strict=True):
            scale = np.abs(other).max()
            tolerance = {"float32": 1e-6, "float64": 1e-15}[dtype]
            np.testing.assert_allclose(one, other, atol=tolerance * scale)


@NETWORKS
def test_gradients_of_the_field(spec, float64):
    def total(params, embedding, time):
        offsets = together(params, spec, embedding, time)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in offsets)

    # ReLU has kinks: the step is short.
    error = gradients.directional_error(
        total, strong(spec), embeddings(9), jnp.asarray(0.4), step=1e-6
    )
    assert error < 1e-6


@pytest.mark.full
def test_blocks_change_nothing_but_memory(float64):
    params, codes = strong(SMALL), embeddings(17)

    def total(params, codes, spec):
        offsets = together(params, spec, codes, jnp.asarray(0.3))
        return sum(jnp.sum(leaf**2) for leaf in offsets), offsets

    run = jax.jit(jax.grad(total, (0, 1), has_aux=True), static_argnums=2)
    blocked = run(params, codes, SMALL)
    at_once = run(params, codes, dataclasses.replace(SMALL, block=1000))
    for ours, theirs in zip(
        jax.tree.leaves(blocked), jax.tree.leaves(at_once), strict=True
    ):
        scale = np.abs(theirs).max() + 1e-30
        np.testing.assert_allclose(ours / scale, theirs / scale, atol=1e-13)


def test_rows_beyond_the_active_blocks_are_still(float64):
    params, codes = strong(SMALL), embeddings(24)
    time = jnp.asarray(0.5)
    active = jnp.arange(24) < 9  # the last of three blocks of 8 is idle
    full = uncached(params, SMALL, codes, time)
    for ours, theirs in zip(
        uncached(params, SMALL, codes, time, active), full, strict=True
    ):
        np.testing.assert_array_equal(ours[:16], theirs[:16])
        assert not np.asarray(ours[16:]).any()


@jax.jit
def slopes_of_sum(params, codes, time, active):
    """Slopes of the sum of all offsets in parameters, codes and time."""

    def total(params, codes, time):
        offsets = together(params, SMALL, codes, time, active)
        return sum(jnp.sum(leaf) for leaf in offsets)

    return jax.grad(total, (0, 1, 2))(params, codes, time)


@pytest.mark.hard_cases
def test_no_active_row_and_no_row_at_all(dtype):
    params, time = strong(SMALL, dtype), np.asarray(0.5, dtype)
    grads = slopes_of_sum(params, embeddings(9, dtype), time, np.zeros(9, bool))
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(grads))
    nobody = jax.eval_shape(
        lambda codes: together(params, SMALL, codes, jnp.asarray(time)),
        embeddings(0, dtype),
    )
    assert all(leaf.shape == (0, 3) for leaf in nobody)


@pytest.mark.parametrize("off", ["position", "scale", "rotation"])
def test_a_residual_that_is_off_has_no_parameters_and_moves_nothing(off, float64):
    spec = dataclasses.replace(SMALL, **{off: False})
    params, gaussians = strong(spec), some_gaussians(3)
    head = {"position": "position", "scale": "log_scale", "rotation": "turn"}[off]
    assert sorted(params.field.heads) == sorted({*Offsets._fields} - {head})
    offsets = uncached(params, spec, embeddings(3), jnp.asarray(0.2))
    assert getattr(offsets, head) is None
    moved = kan_motion.apply(gaussians, offsets)
    same = {"position": "mean", "scale": "scale", "rotation": "quaternion"}
    for name, leaf in same.items():
        before, after = getattr(gaussians, leaf), getattr(moved, leaf)
        assert (before is after) == (name == off)


@pytest.mark.full
def test_heads_that_are_off_cost_nothing():
    def flops(spec):
        args = strong(spec, "float32"), embeddings(16, "float32"), jnp.float32(0.3)
        return clock.cost(
            lambda params, *rest: together(params, spec, *rest), *args
        ).flops

    alone = dataclasses.replace(SMALL, scale=False, rotation=False)
    assert flops(alone) < flops(SMALL)


def test_motion_starts_at_zero_and_does_not_stay_there():
    """Heads of zero have slopes; through them the rest gets its own a step later."""
    params = kan_motion.init(jax.random.key(0), SMALL, FRAMES)
    codes = kan_motion.init_embedding(jax.random.key(1), SMALL, jnp.zeros((9, 3)))

    def total(params, codes):
        offsets = together(params, SMALL, codes, jnp.asarray(0.3))
        return sum(jnp.sum((leaf - 1) ** 2) for leaf in offsets), offsets

    run = jax.jit(jax.grad(total, (0, 1), has_aux=True))
    grads, offsets = run(params, codes)
    assert not any(np.asarray(leaf).any() for leaf in offsets)
    assert all(np.asarray(leaf).any() for leaf in jax.tree.leaves(grads[0].field.heads))
    assert not np.asarray(grads[1]).any()
    params = jax.tree.map(lambda p, grad: p - 0.01 * grad, params, grads[0])
    grads, _ = run(params, codes)
    assert all(np.asarray(row).any() for row in grads[1])
    assert np.asarray(grads[0].times).any()


@pytest.mark.parametrize("waves", [None, 2.0])
def test_first_embeddings_have_the_promised_spread(dtype, waves):
    mean = jax.random.normal(jax.random.key(1), (2000, 3)).astype(dtype)
    spec = KanMotionSpec(waves=waves)
    codes = kan_motion.init_embedding(jax.random.key(0), spec, mean)
    assert codes.shape == (2000, 32)
    assert codes.dtype == dtype
    # 64 000 independent draws; as waves there are 32 of them.
    assert abs(np.std(codes) / 0.1 - 1) < (0.02 if waves is None else 0.15)
    assert abs(np.mean(codes)) < (0.002 if waves is None else 0.03)


@pytest.mark.full
def test_codes_as_waves_start_alike_where_gaussians_are_near():
    spec = KanMotionSpec(waves=2.0)
    mean = jax.random.normal(jax.random.key(1), (500, 3))
    near = mean + 0.01 * jax.random.normal(jax.random.key(2), mean.shape)
    both = kan_motion.init_embedding(
        jax.random.key(0), spec, jnp.concatenate([mean, near])
    )
    apart = np.linalg.norm(both[:500] - both[500:], axis=1)
    others = np.linalg.norm(both[:500] - np.roll(both[:500], 1, axis=0), axis=1)
    assert np.median(apart) < 0.05 * np.median(others)
    times = kan_motion.init(jax.random.key(0), spec, 100).times
    steps = np.linalg.norm(np.diff(times, axis=0), axis=1)
    assert np.median(steps) < 0.2 * np.linalg.norm(times[0] - times[25])


def test_codes_as_waves_are_finite_where_all_gaussians_are_in_one_place(dtype):
    spec = KanMotionSpec(waves=2.0)
    for count in (1, 5):
        mean = jnp.full((count, 3), 0.3, dtype)
        codes = kan_motion.init_embedding(jax.random.key(0), spec, mean)
        assert np.isfinite(codes).all()


@pytest.mark.parametrize(
    "spec",
    [
        KanMotionSpec(),
        kan_motion.SMALL_KAN_MOTION,
        dataclasses.replace(SMALL, scale=False, base=False),
        dataclasses.replace(SMALL, trainable_kernels=True),
    ],
)
def test_the_mlp_has_as_many_parameters(spec):
    learnt = kan_motion.field_spec(spec)
    other = kan_motion.field_spec(dataclasses.replace(spec, network="mlp"))
    for network, init in ((learnt, kan.init), (other, mlp.init)):
        shapes = jax.eval_shape(
            lambda key, init=init, network=network: init(network, key),
            jax.random.key(0),
        )
        counted = sum(leaf.size for leaf in jax.tree.leaves(shapes))
        assert kan_motion.parameter_count(network) == counted
    goal = kan_motion.parameter_count(learnt)
    found, wider, narrower = (
        abs(kan_motion.parameter_count(dataclasses.replace(other, width=w)) - goal)
        for w in (other.width, other.width + 1, other.width - 1)
    )
    assert found <= min(wider, narrower)
    assert other.depth == len(spec.hidden)
    assert other.inputs == learnt.inputs
    assert other.heads == learnt.heads


def test_moving_gaussians(float64):
    gaussians = some_gaussians(6)
    rng = np.random.default_rng(1)
    offsets = Offsets(*(jnp.asarray(rng.normal(size=(6, 3))) for _ in range(3)))
    moved = kan_motion.apply(gaussians, offsets)
    np.testing.assert_allclose(moved.mean, gaussians.mean + offsets.position)
    np.testing.assert_allclose(
        moved.scale, np.asarray(gaussians.scale) * np.exp(offsets.log_scale)
    )

    def rotation(wxyz):
        return scipy.spatial.transform.Rotation.from_quat(
            np.roll(wxyz, -1, axis=1).copy()
        )

    turn = scipy.spatial.transform.Rotation.from_rotvec(np.array(offsets.turn))
    expected = (turn * rotation(np.asarray(gaussians.quaternion))).as_matrix()
    found = rotation(np.asarray(moved.quaternion)).as_matrix()
    np.testing.assert_allclose(found, expected, atol=1e-14)

    def total(gaussians, offsets):
        return sum(jnp.sum(x**2 + x) for x in kan_motion.apply(gaussians, offsets))

    assert gradients.directional_error(total, gaussians, offsets) < 1e-7


@pytest.mark.hard_cases
def test_unusable_quaternions_and_wild_residuals_stay_finite(dtype):
    gaussians = some_gaussians(4, dtype)
    lengths = np.asarray([0.0, 1e-30, 1e25, 1.0], dtype)
    gaussians = gaussians._replace(quaternion=np.tile(lengths[:, None], (1, 4)))
    wild = jnp.asarray([[100.0] * 3, [-100.0] * 3, [0.0] * 3, [1e4] * 3], dtype)

    def total(gaussians, wild):
        moved = kan_motion.apply(gaussians, Offsets(wild, wild, wild))
        return jnp.sum(moved.quaternion) + jnp.sum(moved.scale), moved

    grads, moved = jax.jit(jax.grad(total, (0, 1), has_aux=True))(gaussians, wild)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((grads, moved)))
    length = np.linalg.norm(np.asarray(moved.quaternion, np.float64), axis=1)
    np.testing.assert_allclose(length, 1, rtol=1e-5)


@pytest.mark.full
@pytest.mark.hard_cases
def test_equal_and_wild_embeddings_have_finite_slopes(dtype):
    params, active = strong(SMALL, dtype), np.ones(9, bool)
    codes = np.asarray(embeddings(9, dtype))
    for scale, time in itertools.product((0.0, 1e-20, 1e4), (0.0, 1.0, 2.0)):
        drawn = codes * codes.dtype.type(scale)
        grads = slopes_of_sum(params, drawn, np.asarray(time, dtype), active)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))
        assert np.asarray(grads[1]).any()


def test_the_effect_moves_a_scene_and_leaves_it_alone_in_its_warm_up(float64):
    spec = dataclasses.replace(SMALL, warm_up=10)
    params = scene_of(spec)
    effects = (kan_motion.effect(spec, steps=100, frames=FRAMES),)
    canonical = rows.activate(params.rows["splats"])
    time = jnp.asarray(0.3)

    @jax.jit
    def in_training(step):
        condition = FrameCondition(time, step=step, key=jax.random.key(0))
        return deformation.deform_in_training(effects, params, canonical, condition)

    for before, after in zip(canonical, in_training(jnp.asarray(9)), strict=True):
        np.testing.assert_array_equal(before, after)
    moved = in_training(jnp.asarray(10))
    offsets = uncached(
        params.nets[kan_motion.NAME], spec, params.rows[kan_motion.NAME], time
    )
    expected = kan_motion.apply(canonical, offsets)
    prepared = jax.jit(lambda params: deformation.prepare(effects, params))(params)
    deformed = jax.jit(lambda *args: deformation.deform(effects, *args))(
        params, prepared, time
    )
    for one, other, truth in zip(moved, deformed, expected, strict=True):
        np.testing.assert_allclose(one, truth, atol=1e-13)
        np.testing.assert_allclose(other, truth, atol=1e-13)


def test_the_effect_tells_its_rows_networks_and_rates():
    filled = kan_motion.effect(SMALL, steps=100, frames=FRAMES)
    points = np.zeros((12, 3))
    first = rows.from_points(points, points)
    assert filled.init_rows(jax.random.key(0), first).shape == (12, 6)
    nets = jax.eval_shape(filled.init, jax.random.key(0))
    assert isinstance(nets, KanMotion)
    assert nets.times.shape == (math.ceil(FRAMES / 2), 4)
    np.testing.assert_allclose(filled.row_learning_rate(jnp.asarray(50)), 2.5e-3)
    for step, rate in ((0, 1.6e-4), (50, 1.6e-4 / math.sqrt(10)), (100, 1.6e-5)):
        np.testing.assert_allclose(
            filled.learning_rate(jnp.asarray(step)), rate, rtol=1e-5
        )


def test_one_frame_has_one_code():
    params = kan_motion.init(jax.random.key(0), SMALL, 1)
    assert params.times.shape == (1, 4)
    with pytest.raises(ValueError, match="frames=0"):
        kan_motion.init(jax.random.key(0), SMALL, 0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"embedding": 0}, "embedding=0"),
        ({"time_code": 0}, "time_code=0"),
        ({"hidden": ()}, r"hidden=\(\)"),
        ({"block": 0}, "block=0"),
        ({"warm_up": -1}, "warm_up=-1"),
        ({"network": "cnn"}, "unknown network 'cnn'"),
        ({"mlp_width": 8}, "network='mlp' only"),
        ({"position": False, "scale": False, "rotation": False}, "all off"),
        ({"spread": 0.0}, "equal codes stay equal"),
        ({"learning_rate": 1e-5, "learning_rate_end": 1e-4}, "the rate falls"),
        ({"embedding_rate": 0.0}, "embedding_rate=0.0"),
        ({"kernels": 1}, "two centres"),
    ],
)
def test_wrong_specs_are_refused(change, said):
    with pytest.raises(ValueError, match=said):
        dataclasses.replace(SMALL, **change)
