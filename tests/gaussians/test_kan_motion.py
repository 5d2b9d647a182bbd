"""Sonata's motion: its equation, what is prepared, switches, its hard cases."""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core import splats as rows
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Params
from gaussians_jax.motion import codes as motion_codes
from gaussians_jax.motion import kan as kan_motion
from gaussians_jax.motion.kan import KanMotion, KanMotionSpec, Offsets
from nerfies_jax.nn import kan, mlp
from nerfies_jax.training.effects import PenaltyContext
from tests.gaussians import bound
from tests.gaussians.motions import FRAMES, MOTIONS, deformed, read_by, strong
from tests.gaussians.motions import KAN as SMALL
from tests.gaussians.shared import (
    any_nonzero,
    finite,
    full,
    jitted,
    put,
    rows_of,
    some_gaussians,
)

AS_MLP = dataclasses.replace(SMALL, hidden=(5, 4), network="mlp", mlp_width=7)
NETWORKS = pytest.mark.parametrize("spec", [SMALL, *full(AS_MLP)], ids=["kan", "mlp"])
uncached = deformed["kan"]


@NETWORKS
def test_offsets_are_those_of_the_whole_network(spec, dtype):
    """Equation 11, every Gaussian's network fed [embedding, time code]."""
    params, codes = strong("kan", spec, dtype), read_by("kan", 11, dtype)
    assert params.times.shape == (5, 4)
    apply = kan.apply_heads if spec.network == "kan" else mlp.apply
    whole = jitted(functools.partial(apply, kan_motion.field_spec(spec)))
    for time in (0.0, 0.3, 1.0):
        offsets = uncached(params, spec, codes, np.asarray(time, dtype))
        table = np.asarray(params.times, np.float64)
        code = [np.interp(4 * time, np.arange(5), column) for column in table.T]
        inputs = np.concatenate([codes, np.tile(code, (11, 1))], axis=1)
        expected = whole(params.field, inputs.astype(dtype))
        assert sorted(expected) == sorted(Offsets._fields)
        for name, value in expected.items():
            tolerance = {"float32": 2e-5, "float64": 1e-13}[dtype]
            ours = getattr(offsets, name)
            assert ours.dtype == dtype
            np.testing.assert_allclose(ours, value, atol=tolerance)


TWO = dataclasses.replace(SMALL, coarser=2, grow_until=100)


def test_a_coarse_and_a_fine_network_add_what_they_read_of_one_table(float64):
    """Each like a motion of one network, of a table resampled to what it reads."""
    params, codes = strong("kan", TWO), read_by("kan", 11)
    params = params._replace(rows=np.full(1, 4.0))
    own = np.linspace(0, 1, 5)
    for time in (0.0, 0.3, 1.0):
        offsets = uncached(params, TWO, codes, put(time))
        total = dict.fromkeys(Offsets._fields, 0.0)
        for field, read in ((params.coarse, 3), (params.field, 4)):
            few = np.linspace(0, 1, read)
            code = [
                np.interp(time, few, np.interp(few, own, column))
                for column in np.asarray(params.times).T
            ]
            alone = KanMotion(np.tile(code, (5, 1)), field)
            part = uncached(alone, SMALL, codes, put(time))
            for name, value in part._asdict().items():
                total[name] = total[name] + value
        for name, value in total.items():
            np.testing.assert_allclose(getattr(offsets, name), value, atol=1e-12)


def test_two_networks_have_an_event_and_prices_and_one_has_neither():
    spec = dataclasses.replace(TWO, smoothness=0.5, opacity=0.25)
    motion = bound.motion(spec, 1000, frames=FRAMES)
    own = strong("kan", spec, "float32")
    assert motion.project(own, 0).rows == 3
    assert motion.project(own, 60).rows == 4
    assert motion.project_steps == (50, 100)
    scene = Params({"splats": rows_of(some_gaussians(3, np.float32), np.zeros(3))}, {})
    context = PenaltyContext(None, None, None, scene)
    params = MotionParams(None, own)
    terms = motion.loss(params, context)
    np.testing.assert_allclose(terms["opacity"].value, 0.5, rtol=1e-6)
    bend = np.diff(own.times, 2, axis=0)
    np.testing.assert_allclose(terms["smoothness"].value, np.mean(bend**2), rtol=1e-5)
    assert (terms["smoothness"].weight, terms["opacity"].weight) == (0.5, 0.25)
    for name in terms:
        less = dataclasses.replace(spec, **{name: 0.0})
        rest = bound.motion(less, 1000, frames=FRAMES).loss(params, context)
        assert rest.keys() == terms.keys() - {name}
    plain = bound.motion(SMALL, 1000, frames=FRAMES)
    assert (plain.loss(params, context), plain.project_steps) == ({}, ())
    one, two = (
        jax.tree.leaves(kan_motion.init(jax.random.key(0), each, FRAMES))
        for each in (SMALL, spec)
    )
    assert len(one) < len(two)


@pytest.mark.parametrize("off", ["position", "scale", "rotation"])
def test_a_residual_that_is_off_has_no_parameters_and_moves_nothing(off, float64):
    spec = dataclasses.replace(SMALL, **{off: False})
    params, gaussians = strong("kan", spec), some_gaussians(3)
    head = {"position": "position", "scale": "log_scale", "rotation": "turn"}[off]
    assert sorted(params.field.heads) == sorted({*Offsets._fields} - {head})
    run = functools.partial(MOTIONS["kan"].deform, params, spec)
    shapes = jax.eval_shape(run, read_by("kan", 3), put(0.2))
    assert getattr(shapes, head) is None
    offsets = jax.tree.map(lambda leaf: np.ones(leaf.shape), shapes)
    moved = jitted(kan_motion.apply)(gaussians, offsets)
    same = {"position": "mean", "scale": "scale", "rotation": "quaternion"}
    for name, leaf in same.items():
        before, after = getattr(gaussians, leaf), getattr(moved, leaf)
        assert np.array_equal(before, after) == (name == off)


@pytest.mark.full
def test_motion_starts_at_zero_and_does_not_stay_there():
    """Heads of zero have slopes; through them the rest gets its own a step later."""

    @jitted
    def start(key):
        codes = motion_codes.init_embedding(key, SMALL, jnp.zeros((9, 3)))
        return kan_motion.init(key, SMALL, FRAMES), codes

    def total(params, codes):
        offsets = MOTIONS["kan"].deform(params, SMALL, codes, jnp.float32(0.3))
        return sum(jnp.sum((leaf - 1) ** 2) for leaf in offsets), offsets

    run = jitted(jax.grad(total, (0, 1), has_aux=True))
    params, codes = start(jax.random.key(0))
    grads, offsets = run(params, codes)
    assert not any_nonzero(offsets)
    assert all(leaf.any() for leaf in jax.tree.leaves(grads[0].field.heads))
    assert not grads[1].any()
    params = jax.tree.map(lambda p, grad: p - np.float32(0.01) * grad, params, grads[0])
    grads, _ = run(params, codes)
    assert grads[1].any(axis=1).all()
    assert grads[0].times.any()


first_codes = jitted(motion_codes.init_embedding, static_argnums=1)
WAVES = KanMotionSpec(waves=2.0)


@pytest.mark.parametrize("waves", [None, 2.0])
def test_first_embeddings_have_the_promised_spread(dtype, waves, rng):
    mean = rng.normal(size=(2000, 3)).astype(dtype)
    codes = first_codes(jax.random.key(0), KanMotionSpec(waves=waves), mean)
    assert codes.shape == (2000, 32)
    assert codes.dtype == dtype
    # 64 000 independent draws; as waves there are 32 of them.
    assert abs(np.std(codes) / 0.1 - 1) < (0.02 if waves is None else 0.15)
    assert abs(np.mean(codes)) < (0.002 if waves is None else 0.03)


def test_codes_as_waves_start_alike_where_gaussians_are_near(rng):
    mean = rng.normal(size=(1000, 3))
    near = mean + 0.01 * rng.normal(size=(1000, 3))
    every = np.concatenate([mean, near]).astype(np.float32)
    codes, near = np.split(first_codes(jax.random.key(0), WAVES, every), 2)
    apart = np.linalg.norm(codes - near, axis=1)
    others = np.linalg.norm(codes - np.roll(codes, 1, axis=0), axis=1)
    assert np.median(apart) < 0.05 * np.median(others)
    times = jitted(lambda key: kan_motion.init(key, WAVES, 100).times)(
        jax.random.key(0)
    )
    steps = np.linalg.norm(np.diff(times, axis=0), axis=1)
    assert np.median(steps) < 0.2 * np.linalg.norm(times[0] - times[25])


@pytest.mark.hard_cases
def test_codes_as_waves_are_finite_where_all_gaussians_are_in_one_place(dtype):
    mean = np.full((5, 3), 0.3, dtype)
    assert finite(first_codes(jax.random.key(0), WAVES, mean))


@pytest.mark.parametrize(
    "changes", [{}, dict(scale=False, base=False, trainable_kernels=True)]
)
def test_the_mlp_has_as_many_parameters(changes):
    spec = KanMotionSpec(**changes)
    learned = kan_motion.field_spec(spec)
    other = kan_motion.field_spec(dataclasses.replace(spec, network="mlp"))
    inits = (
        (learned, functools.partial(kan.init, spec=learned)),
        (other, functools.partial(mlp.init, other)),
    )
    for network, run in inits:
        shapes = jax.eval_shape(run, jax.random.key(0))
        counted = sum(leaf.size for leaf in jax.tree.leaves(shapes))
        assert kan_motion.parameter_count(network) == counted
    goal, width = kan_motion.parameter_count(learned), other.width
    chosen, wider, narrower = (
        abs(kan_motion.parameter_count(dataclasses.replace(other, width=w)) - goal)
        for w in (width, width + 1, width - 1)
    )
    assert chosen <= min(wider, narrower)
    assert (other.depth, other.heads) == (len(spec.hidden), learned.heads)
    if not spec.trainable_kernels:
        splines = kan_motion.field_spec(dataclasses.replace(spec, network="bspline"))
        assert splines == dataclasses.replace(learned, basis="bspline")


@pytest.mark.hard_cases
def test_unusable_quaternions_and_wild_residuals_stay_finite(dtype):
    gaussians = some_gaussians(4, dtype)
    lengths = np.asarray([0.0, 1e-30, 1e25, 1.0], dtype)
    gaussians = gaussians._replace(quaternion=np.tile(lengths[:, None], (1, 4)))
    wild = np.asarray([[100.0] * 3, [-100.0] * 3, [0.0] * 3, [1e4] * 3], dtype)

    def total(gaussians, wild):
        moved = kan_motion.apply(gaussians, Offsets(wild, wild, wild))
        return jnp.sum(moved.quaternion) + jnp.sum(moved.scale), moved

    grads, moved = jitted(jax.grad(total, (0, 1), has_aux=True))(gaussians, wild)
    assert finite((grads, moved))
    length = np.linalg.norm(moved.quaternion.astype(float), axis=1)
    np.testing.assert_allclose(length, 1, rtol=1e-5)


@pytest.mark.full
@pytest.mark.hard_cases
def test_equal_and_wild_embeddings_have_finite_slopes(dtype):
    params, codes = strong("kan", dtype=dtype), np.asarray(read_by("kan", 9, dtype))

    @jitted
    @functools.partial(jax.grad, argnums=(0, 1, 2))
    def slopes_of_sum(params, codes, time):
        offsets = MOTIONS["kan"].deform(params, SMALL, codes, time)
        return sum(jnp.sum(leaf) for leaf in offsets)

    for scale, time in itertools.product((0.0, 1e-20, 1e4), (0.0, 1.0, 2.0)):
        scaled = codes * codes.dtype.type(scale)
        grads = slopes_of_sum(params, scaled, np.asarray(time, dtype))
        assert finite(grads)
        assert grads[1].any()


def test_the_effect_tells_its_rows_networks_and_rates():
    filled = bound.motion(SMALL, frames=FRAMES)
    first = rows.from_points(np.zeros((12, 3)), np.zeros((12, 3)))
    embedding, nets = jitted(filled.init)(jax.random.key(0), first)
    assert embedding.shape == (12, 6)
    assert isinstance(nets, KanMotion)
    assert not any_nonzero(nets.field.heads)  # no motion yet
    assert nets.times.any()
    assert nets.times.shape == (math.ceil(FRAMES / 2), 4)
    rates = filled.learning_rate(jnp.int32(50))
    np.testing.assert_allclose(rates.per_gaussian, 2.5e-3)
    one = jax.eval_shape(lambda key: kan_motion.init(key, SMALL, 1), jax.random.key(0))
    assert one.times.shape == (1, 4)
