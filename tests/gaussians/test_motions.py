"""What holds for every network that moves Gaussians."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core import splats
from gaussians_jax.motion import deformation
from gaussians_jax.motion import kan as kan_motion
from gaussians_jax.motion.basis import BasisMotionSpec
from gaussians_jax.motion.kan import KanMotionSpec
from gaussians_jax.motion.mlp import MotionSpec
from nerfies_jax.training.effects import FrameCondition
from tests import gradients
from tests.gaussians import bound
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
    """Of the parameters, the time, and what is read where its slopes are not cut."""
    params, reads, time = strong(name), read_by(name, 5), put(0.4)
    spec = MOTIONS[name].spec
    if name == "basis":
        spec = dataclasses.replace(spec, detach=False)

    def total(params, time, reads=reads):
        return total_of(name, spec)(params, reads, time)[0]

    args = (params, time) if name == "mlp" else (params, time, reads)
    # ReLU has kinks: the step is short.
    assert gradients.directional_error(total, *args, step=1e-6) < 1e-6


@pytest.mark.parametrize("name", ["mlp", *full("basis")])
def test_no_gradient_reaches_the_means_through_the_field(name, float64):
    slopes = jitted(jax.grad(total_of(name), argnums=1, has_aux=True))
    assert not slopes(strong(name), read_by(name, 5), put(0.4))[0].any()


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "count"), [("mlp", 0), ("mlp", 17), ("kan", 17), ("basis", 1)]
)
def test_blocks_change_nothing_but_memory(name, count, float64):
    params, reads, spec = strong(name), read_by(name, count), MOTIONS[name].spec

    def run(spec):
        total = total_of(name, spec)
        return jitted(jax.grad(total, has_aux=True))(params, reads, put(0.3))

    (grads, offsets), whole = run(spec), run(dataclasses.replace(spec, block=1000))
    close((grads, offsets), whole, 1e-13, least=1e-30)
    assert offsets[0].shape == (count, 3)


@pytest.mark.parametrize("name", ["basis", *full("mlp", "kan")])
def test_rows_beyond_the_active_blocks_are_still(name, dtype):
    params, reads = strong(name, dtype=dtype), read_by(name, 24, dtype)
    every, some = (
        deformed[name](
            params, MOTIONS[name].spec, reads, np.asarray(0.5, dtype), active
        )
        for active in (np.ones(24, bool), np.arange(24) < 9)  # in blocks of 8
    )
    for ours, theirs in zip(some, every, strict=True):
        np.testing.assert_array_equal(ours[:16], theirs[:16])
        assert not ours[16:].any()
        assert theirs[16:].any()


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", ["mlp", *full("kan", "basis")])
def test_no_active_row_and_no_row_at_all(name, dtype):
    params, reads = strong(name, dtype=dtype), read_by(name, 9, dtype)
    slopes = jitted(jax.grad(total_of(name), argnums=(0, 1), has_aux=True))
    time = np.asarray(0.5, dtype)
    assert not any_nonzero(slopes(params, reads, time, np.zeros(9, bool)))
    run = functools.partial(MOTIONS[name].deform, params, MOTIONS[name].spec)
    nobody = jax.eval_shape(run, reads[:0], time)
    assert all(len(leaf) == 0 for leaf in nobody)


def scene_and_effect(name):
    motion, params = MOTIONS[name], scene_of(name)
    spec = dataclasses.replace(motion.spec, warm_up=10)
    return params, (bound.record(spec, frames=2),)


@pytest.mark.parametrize("name", ["kan", *full("mlp", "basis")])
def test_a_trained_scene_is_drawn_from_what_was_prepared_without_noise(name, float64):
    motion, (params, effects) = MOTIONS[name], scene_and_effect(name)

    @jitted
    def render(params, time):
        ready = deformation.prepare(effects, params)
        canonical = splats.activate(params.rows["splats"])
        return deformation.deform(effects, params, ready, time), canonical

    rows, canonical = render(params, np.asarray(0.5))
    reads = params.rows.get(kan_motion.NAME, canonical.mean)
    network = params.nets[motion.module.NAME]
    offsets = deformed[name](network, motion.spec, reads, np.asarray(0.5))
    close(rows, jitted(motion.apply)(canonical, offsets), 1e-13)


@pytest.mark.full
@pytest.mark.parametrize("name", ["basis", "mlp", "kan"])
def test_a_scene_in_training_moves_with_noise_after_its_warm_up(name, float64):
    params, effects = scene_and_effect(name)

    def moved(params, step, key):
        canonical = splats.activate(params.rows["splats"])
        condition = FrameCondition(jnp.asarray(0.5), step=step, key=key)
        gaussians = deformation.deform_in_training(
            effects, params, canonical, condition
        )
        return jnp.sum(jnp.sin(gaussians.mean)), (gaussians, canonical)

    run = jax.jit(jax.grad(moved, has_aux=True))
    key, other = jax.random.key(0), jax.random.key(1)
    program = run.lower(params, np.int32(9), key).compile()
    # One compiled program holds both: a branch, not a select of two results.
    assert "conditional" in program.as_text()
    grads, (still, canonical) = program(params, np.int32(9), key)
    same_bits(still, canonical)
    assert not any_nonzero(grads.nets)
    grads, (noisy, _) = program(params, np.int32(10), key)
    network = grads.nets[MOTIONS[name].module.NAME]
    parts = (network.times, network.field) if name == "kan" else network
    assert all(map(any_nonzero, parts)) == (name != "mlp")  # it has no code of time
    assert any_nonzero(network)
    late, same = (program(params, np.int32(50), k)[1][0] for k in (key, other))
    same_bits(late, same)
    apart = np.abs(np.asarray(noisy.mean) - np.asarray(late.mean)).max()
    assert (apart > 1e-3) == (name != "kan")


@pytest.mark.parametrize("name", ["kan", *full("basis")])
def test_moving_gaussians(name, float64):
    """Places and logarithms of scales add; rotation vectors turn as SciPy's do."""
    module, gaussians = MOTIONS[name].module, some_gaussians(6)
    samples = np.random.default_rng(1).normal(size=(3, 6, 3))
    fields = module.Offsets._fields
    move, log_scale, turn = samples
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
    ("spec", "first", "last"),
    [
        (MotionSpec(), 8e-4, 1.6e-6),
        (KanMotionSpec(), 1.6e-4, 1.6e-5),
        (BasisMotionSpec(), 8e-4, 1.6e-6),
    ],
)
def test_the_rate_falls_in_equal_ratios(spec, first, last):
    rate = jitted(bound.motion(spec, 1000, frames=FRAMES).learning_rate)
    rates = [rate(np.int32(step)).shared for step in (0, 500, 1000, 4000)]
    expected = [first, math.sqrt(first * last), last, last]
    np.testing.assert_allclose(rates, expected, rtol=1e-5)
