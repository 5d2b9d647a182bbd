"""What holds for every network that moves Gaussians."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import splats
from gaussians_jax.effects import deformation, kan_motion, mlp_motion, motion_basis
from gaussians_jax.effects.kan_motion import KanMotionSpec
from gaussians_jax.effects.mlp_motion import MotionSpec
from gaussians_jax.effects.motion_basis import BasisMotionSpec
from nerfies_jax.training.effects import FrameCondition
from tests import gradients
from tests.gaussians.motions import (
    FRAMES,
    MOTIONS,
    deformed,
    read_by,
    scene_of,
    strong,
)
from tests.gaussians.shared import (
    any_nonzero,
    close,
    full,
    jitted,
    put,
    rotations,
    same_bits,
    some_gaussians,
)

by_name = pytest.mark.parametrize("name", MOTIONS)


def total_of(name, spec=None):
    motion = MOTIONS[name]

    def total(params, reads, time, active=None):
        offsets = motion.deform(params, spec or motion.spec, reads, time, active)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in offsets), offsets

    return total


@by_name
def test_gradients_of_the_field(name, float64):
    """Of the parameters and the time, and of the codes that a row has of its own."""
    params, reads, time = strong(name), read_by(name, 5), put(0.4)

    def total(params, time, reads=reads):
        return total_of(name)(params, reads, time)[0]

    args = (params, time, reads) if name == "kan" else (params, time)
    # ReLU has kinks: the step is short.
    assert gradients.directional_error(total, *args, step=1e-6) < 1e-6


@pytest.mark.full
@by_name
@pytest.mark.parametrize("count", [0, 1, 17])
def test_blocks_change_nothing_but_memory(name, count, float64):
    params, reads, spec = strong(name), read_by(name, count), MOTIONS[name].spec

    def run(spec):
        total = total_of(name, spec)
        return jitted(jax.grad(total, has_aux=True))(params, reads, put(0.3))

    (grads, offsets), whole = run(spec), run(dataclasses.replace(spec, block=1000))
    close((grads, offsets), whole, 1e-13, least=1e-30)
    assert offsets[0].shape == (count, 3)


@by_name
def test_rows_beyond_the_active_blocks_are_still(name, dtype):
    params, reads = strong(name, dtype=dtype), read_by(name, 24, dtype)
    run = jitted(jax.grad(total_of(name), argnums=(0, 1), has_aux=True))

    def with_active(count):  # in blocks of 8
        return run(params, reads, np.asarray(0.5, dtype), np.arange(24) < count)

    every, some = with_active(24)[1], with_active(9)[1]
    for ours, theirs in zip(some, every, strict=True):
        np.testing.assert_array_equal(ours[:16], theirs[:16])
        assert not ours[16:].any()
        assert theirs[16:].any()
    assert not any_nonzero(with_active(0)[0])
    nobody = deformed[name](params, MOTIONS[name].spec, reads[:0], put(0.5, dtype))
    assert all(len(leaf) == 0 for leaf in nobody)


@by_name
def test_a_scene_moves_after_its_warm_up_without_noise_once_trained(name, float64):
    """What is prepared ahead is what is prepared in the step."""
    motion = MOTIONS[name]
    spec = dataclasses.replace(motion.spec, warm_up=10)
    effects = (motion.module.effect(spec, steps=100, frames=2),)
    params, time = scene_of(name, spec), put(0.5)
    network = params.nets[motion.module.NAME]

    def moved(params, step):
        canonical = splats.activate(params.rows["splats"])
        condition = FrameCondition(time, step=step, key=jax.random.key(0))
        gaussians = deformation.deform_in_training(
            effects, params, canonical, condition
        )
        return jnp.sum(jnp.sin(gaussians.mean)), (gaussians, canonical)

    @jax.jit
    def as_drawn(params):
        canonical = splats.activate(params.rows["splats"])
        reads = params.rows.get(kan_motion.NAME, canonical.mean)
        offsets = motion.deform(network, spec, reads, time, None)
        ready = deformation.prepare(effects, params)
        drawn = deformation.deform(effects, params, ready, time)
        return drawn, motion.apply(canonical, offsets)

    in_training = jax.jit(jax.grad(moved, has_aux=True))
    run = jitted(in_training)
    grads, (still, canonical) = run(params, np.int32(9))
    same_bits(still, canonical)
    assert not any_nonzero(grads.nets)
    drawn, expected = as_drawn(params)
    close(drawn, expected, 1e-13)
    grads, (noisy, _) = run(params, np.int32(10))
    if name == "basis":  # base, basis and weights
        assert all(map(any_nonzero, grads.nets[motion.module.NAME]))
    assert any_nonzero(grads.nets)
    assert (np.abs(noisy.mean - drawn.mean).max() > 1e-3) == (name != "kan")
    close(run(params, np.int32(50))[1][0], expected, 1e-13)
    # One compiled program holds both: a branch, not a select of two results.
    text = in_training.lower(params, np.int32(9)).compile().as_text()
    assert "conditional" in text


@pytest.mark.parametrize("name", ["kan", *full("basis")])
def test_moving_gaussians(name, float64):
    """Places and logarithms of scales add; rotation vectors turn as SciPy's do."""
    module, gaussians = MOTIONS[name].module, some_gaussians(6)
    drawn = np.random.default_rng(1).normal(size=(3, 6, 3))
    fields = module.Offsets._fields
    move, log_scale, turn = drawn
    named = {"log_scale": log_scale, "turn": turn}
    offsets = put(module.Offsets(*(named.get(field, move) for field in fields)))
    moved = jitted(module.apply)(gaussians, offsets)
    expected = rotations(gaussians.quaternion)
    expected = type(expected).from_rotvec(turn) * expected
    np.testing.assert_allclose(
        rotations(moved.quaternion).as_matrix(), expected.as_matrix(), atol=1e-14
    )
    np.testing.assert_allclose(moved.mean, np.asarray(gaussians.mean) + move)
    np.testing.assert_allclose(
        moved.scale, np.asarray(gaussians.scale) * np.exp(log_scale)
    )

    def total(gaussians, offsets):
        return sum(jnp.sum(jnp.sin(x)) for x in module.apply(gaussians, offsets))

    assert gradients.directional_error(total, gaussians, offsets) < 1e-7


@pytest.mark.parametrize(
    ("make", "first", "last"),
    [
        (functools.partial(mlp_motion.effect, MotionSpec()), 8e-4, 1.6e-6),
        (functools.partial(kan_motion.effect, KanMotionSpec()), 1.6e-4, 1.6e-5),
        (functools.partial(motion_basis.effect, BasisMotionSpec()), 8e-4, 1.6e-6),
    ],
)
def test_the_rate_falls_in_equal_ratios(make, first, last):
    rate = jitted(make(steps=1000, frames=FRAMES).learning_rate)
    rates = [rate(np.int32(step)) for step in (0, 500, 1000, 4000)]
    expected = [first, math.sqrt(first * last), last, last]
    np.testing.assert_allclose(rates, expected, rtol=1e-5)
