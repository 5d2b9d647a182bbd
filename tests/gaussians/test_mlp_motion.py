"""The deformation network: the reference's values, blocks, warm-up, smoothing."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import splats as rows
from gaussians_jax.effects import deformation, mlp_motion
from gaussians_jax.effects.mlp_motion import Motion, MotionSpec, Offsets, SmoothingSpec
from gaussians_jax.splats import Gaussians, Params, Splats
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.nets.mlp import MLP, Layer
from nerfies_jax.training.effects import FrameCondition
from tests import gradients

SMALL = MotionSpec(
    position=EncodingSpec(3),
    time=EncodingSpec(2),
    depth=3,
    width=16,
    skips=(2,),
    block=8,
)


deform = jax.jit(mlp_motion.deform, static_argnums=1)


@functools.partial(jax.jit, static_argnums=(0, 1))
def strong(spec, dtype="float64", seed=0):
    """A field that moves things by about their own size."""
    params = mlp_motion.init(jax.random.key(seed), spec, jnp.dtype(dtype))
    keys = jax.random.split(jax.random.key(seed + 1), 3)
    heads = {
        name: Layer(0.1 * jax.random.normal(key, head.weight.shape, dtype), head.bias)
        for key, (name, head) in zip(keys, params.trunk.heads.items(), strict=True)
    }
    return params._replace(trunk=params.trunk._replace(heads=heads))


def some_gaussians(count, dtype="float64", seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians(
        mean=jnp.asarray(rng.normal(size=(count, 3)), dtype),
        quaternion=jnp.asarray(rng.normal(size=(count, 4)), dtype),
        scale=jnp.asarray(rng.uniform(0.1, 1, (count, 3)), dtype),
        opacity=jnp.asarray(rng.uniform(size=count), dtype),
    )


def reference_case(oracle_dir, name, dtype):
    """The published network's weights in our layout, its inputs and outputs."""
    with np.load(oracle_dir / "splatting" / f"d3dgs_deform_{name}.npz") as file:
        case = {key: file[key] for key in file.files}
    blender = name.startswith("blender1")
    spec = MotionSpec(
        time=EncodingSpec(6 if blender else 10), time_code=30 if blender else None
    )

    def layer(key, turned=False):
        weight = case[f"w_{key}.weight"].T
        if turned:  # the reference puts the input in front of the hidden features
            weight = np.concatenate([weight[-256:], weight[:-256]])
        bias = case[f"w_{key}.bias"]
        return Layer(jnp.asarray(weight, dtype), jnp.asarray(bias, dtype))

    hidden = tuple(layer(f"linear.{i}", turned=i == 5) for i in range(8))
    heads = {
        "mean": layer("gaussian_warp"),
        "quaternion": layer("gaussian_rotation"),
        "scale": layer("gaussian_scaling"),
    }
    time = MLP((layer("timenet.0"),), {"code": layer("timenet.2")}) if blender else None
    return spec, Motion(MLP(hidden, heads), time), case


@pytest.mark.parametrize("name", ["blender0_6dof0", "blender1_6dof0"])
def test_the_published_network_is_reproduced(name, oracle_dir, dtype):
    spec, params, case = reference_case(oracle_dir, name, dtype)

    def one(point, time):
        at_time = mlp_motion.fold_time(params, spec, time)
        offsets = mlp_motion.offsets_at_time(at_time, spec, point[None])
        return jax.tree.map(lambda leaf: leaf[0], offsets)

    point, time = (jnp.asarray(case[key], dtype) for key in ("x", "t"))
    offsets = jax.jit(jax.vmap(one))(point, time[:, 0])
    # The reference ran in float32, with sines of arguments up to 2000.
    for ours, key in zip(offsets, ("d_xyz", "d_rotation", "d_scaling"), strict=True):
        np.testing.assert_allclose(ours, case[key], atol=2e-5 * np.abs(case[key]).max())
        assert ours.dtype.name == dtype

    def loss(point, time):  # the one whose gradients are stored
        mean, quaternion, scale = one(point, time)
        return jnp.sum(mean**2) + jnp.sum(quaternion) * scale[0]

    grads = jax.jit(jax.vmap(jax.grad(loss, argnums=(0, 1))))(point, time[:, 0])
    for ours, key in zip(grads, ("g_x", "g_t"), strict=True):
        theirs = case[key].reshape(ours.shape)
        # Measured 4e-7 in float64; float32 rounds sines of 512 x and their factors 512.
        tolerance = {"float32": 2e-4, "float64": 2e-6}[dtype]
        np.testing.assert_allclose(ours, theirs, atol=tolerance * np.abs(theirs).max())


@pytest.mark.full
@pytest.mark.parametrize("count", [1, 17])
def test_blocks_change_nothing_but_memory(count, dtype):
    params = strong(SMALL, dtype)
    mean = some_gaussians(count, dtype).mean
    time = jnp.asarray(0.3, dtype)
    whole = dataclasses.replace(SMALL, block=1000)

    def total(params, spec):
        offsets = mlp_motion.deform(params, spec, mean, time)
        return sum(jnp.sum(leaf**2) for leaf in offsets), offsets

    run = jax.jit(jax.value_and_grad(total, has_aux=True), static_argnums=1)
    (_, blocked), grads = run(params, SMALL)
    (_, at_once), expected = run(params, whole)
    tolerance = {"float32": 2e-5, "float64": 1e-13}[dtype]
    for ours, theirs in zip(
        jax.tree.leaves((blocked, grads)),
        jax.tree.leaves((at_once, expected)),
        strict=True,
    ):
        scale = np.abs(theirs).max() + 1e-30
        np.testing.assert_allclose(ours / scale, theirs / scale, atol=tolerance)
    assert blocked.mean.shape == (count, 3)
    assert blocked.quaternion.shape == (count, 4)


def test_the_time_part_may_be_summed_once(float64):
    """Against the network fed with [position, time] for every Gaussian."""
    spec = dataclasses.replace(SMALL, time_code=5)
    params = strong(spec)
    mean, time = some_gaussians(6).mean, 0.7
    t = np.array(
        [time, *np.ravel([[np.sin(k * time), np.cos(k * time)] for k in (1, 2)])]
    )
    (first,), code = params.time.hidden, params.time.heads["code"]
    t = np.maximum(t @ first.weight + first.bias, 0) @ code.weight + code.bias
    x = np.asarray(mean)
    x = np.concatenate(
        [x] + [f(2**k * x) for k in range(3) for f in (np.sin, np.cos)], 1
    )
    inputs = np.concatenate([x, np.tile(t, (6, 1))], axis=1)
    hidden = inputs
    for index, layer in enumerate(params.trunk.hidden):
        if index == 2:
            hidden = np.concatenate([hidden, inputs], axis=1)
        hidden = np.maximum(hidden @ layer.weight + layer.bias, 0)
    offsets = deform(params, spec, mean, jnp.asarray(time))
    for name, head in params.trunk.heads.items():
        expected = hidden @ head.weight + head.bias
        np.testing.assert_allclose(getattr(offsets, name), expected, atol=1e-13)


def test_rows_beyond_the_active_blocks_are_still(float64):
    params = strong(SMALL)
    mean = some_gaussians(24).mean
    active = jnp.arange(24) < 9  # the last of three blocks of 8 is idle
    offsets = deform(params, SMALL, mean, jnp.asarray(0.5), active)
    full = deform(params, SMALL, mean, jnp.asarray(0.5))
    for ours, theirs in zip(offsets, full, strict=True):
        np.testing.assert_array_equal(ours[:16], theirs[:16])
        assert not np.asarray(ours[16:]).any()


@pytest.mark.hard_cases
def test_no_active_row_and_no_row_at_all(dtype):
    spec = dataclasses.replace(SMALL, depth=1, skips=())
    params = strong(spec, dtype)

    def deformed(params, mean, active):
        time = jnp.asarray(0.5, dtype)
        return mlp_motion.deform(params, spec, mean, time, active)

    def total(*args):
        return sum(jnp.sum(leaf) for leaf in deformed(*args))

    mean = np.asarray(some_gaussians(9, dtype).mean)
    grads = jax.jit(jax.grad(total))(params, mean, np.zeros(9, bool))
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(grads))
    nobody = jax.eval_shape(deformed, params, mean[:0], np.zeros(0, bool))
    assert nobody.quaternion.shape == (0, 4)


def test_gradients_of_the_field(float64):
    spec = dataclasses.replace(SMALL, time_code=5)
    mean = some_gaussians(5).mean

    def total(params, time):
        offsets = mlp_motion.deform(params, spec, mean, time)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in offsets)

    error = gradients.directional_error(
        total, strong(spec), jnp.asarray(0.4), step=1e-6
    )
    assert error < 1e-6


def test_no_gradient_reaches_the_means_through_the_field(float64):
    params = strong(SMALL)

    def total(mean):
        return jnp.sum(mlp_motion.deform(params, SMALL, mean, jnp.asarray(0.4)).mean)

    assert not np.asarray(jax.jit(jax.grad(total))(some_gaussians(5).mean)).any()


@pytest.mark.parametrize("rule", mlp_motion.SCALE_RULES)
def test_moving_gaussians(rule, float64):
    gaussians = some_gaussians(6)
    rng = np.random.default_rng(1)
    offsets = Offsets(*(jnp.asarray(rng.normal(size=(6, n))) for n in (3, 4, 3)))
    moved = mlp_motion.apply(gaussians, offsets, rule)
    np.testing.assert_allclose(moved.mean, gaussians.mean + offsets.mean)
    q = np.asarray(gaussians.quaternion)
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    np.testing.assert_allclose(moved.quaternion, q + offsets.quaternion)
    scale = np.asarray(gaussians.scale)
    expected = (
        scale + offsets.scale if rule == "linear" else scale * np.exp(offsets.scale)
    )
    np.testing.assert_allclose(moved.scale, expected)

    def total(gaussians, offsets):
        return sum(jnp.sum(x**2) for x in mlp_motion.apply(gaussians, offsets, rule))

    assert gradients.directional_error(total, gaussians, offsets) < 1e-7


@jax.jit
@functools.partial(jax.grad, argnums=(0, 1), has_aux=True)
def slopes_by_turn_and_scale(quaternion, scale, gaussians):
    still = jnp.zeros_like(gaussians.mean), jnp.zeros_like(quaternion)
    moved = mlp_motion.apply(
        gaussians._replace(quaternion=quaternion), Offsets(*still, scale), "log"
    )
    return jnp.sum(moved.quaternion) + jnp.sum(moved.scale**2), moved


@pytest.mark.hard_cases
@pytest.mark.parametrize("length", [0.0, 1e-30, 1e25])
def test_unusable_quaternions_and_wild_scales_stay_finite(length, dtype):
    gaussians = some_gaussians(2, dtype)
    quaternion = jnp.full((2, 4), length, dtype)
    wild = jnp.asarray([[100.0] * 3, [-100.0] * 3], dtype)
    grads, moved = slopes_by_turn_and_scale(quaternion, wild, gaussians)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((grads, moved)))
    np.testing.assert_allclose(
        np.linalg.norm(np.asarray(moved.quaternion, np.float64), axis=1), 1, rtol=1e-5
    )


def test_smoothing_fades_linearly_and_then_leaves_the_time_alone(dtype):
    spec = SmoothingSpec(first=0.1, steps=1000)
    keys = jax.random.split(jax.random.key(0), 4000)

    def noisy(step):
        noise = jax.vmap(
            lambda key: mlp_motion.smooth_time(
                key, spec, jnp.asarray(0.5, dtype), jnp.asarray(step), 50
            )
        )
        return np.asarray(noise(keys), np.float64) - 0.5

    # 4000 draws know a standard deviation to 1.1 %.
    np.testing.assert_allclose(noisy(0).std(), 0.1 / 50, rtol=0.05)
    np.testing.assert_allclose(noisy(750).std(), 0.1 / 50 / 4, rtol=0.05)
    assert not noisy(1000).any()
    assert not noisy(5000).any()


def scene_at(dtype="float32"):
    gaussians = some_gaussians(9, dtype)
    splats = Splats(
        gaussians.mean,
        jnp.log(gaussians.scale),
        gaussians.quaternion,
        jnp.zeros(9, dtype),
        jnp.zeros((9, 1, 3), dtype),
        jnp.zeros((9, 0, 3), dtype),
    )
    params = Params({"splats": splats}, {mlp_motion.NAME: strong(SMALL, dtype)})
    return params, rows.activate(splats)


def test_warm_up_is_a_branch_without_motion():
    spec = dataclasses.replace(SMALL, warm_up=10)
    field = mlp_motion.effect(spec, steps=100, frames=20)
    params, gaussians = scene_at()

    def moved(params, step):
        condition = FrameCondition(jnp.asarray(0.5), step=step, key=jax.random.key(0))
        return deformation.deform_in_training((field,), params, gaussians, condition)

    run = jax.jit(moved)
    before, after = run(params, jnp.asarray(9)), run(params, jnp.asarray(10))
    np.testing.assert_array_equal(before.mean, gaussians.mean)
    assert np.abs(after.mean - gaussians.mean).max() > 0.01

    def total(params, step):
        return jnp.sum(moved(params, step).mean)

    grad = jax.jit(jax.grad(total))
    nets = grad(params, jnp.asarray(9)).nets
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(nets))
    nets = grad(params, jnp.asarray(10)).nets
    assert any(np.asarray(leaf).any() for leaf in jax.tree.leaves(nets))
    # One compiled program holds both: a branch, not a select of two results.
    assert "conditional" in run.lower(params, jnp.asarray(9)).compile().as_text()


@pytest.mark.full
def test_a_trained_scene_has_neither_warm_up_nor_noise():
    field = mlp_motion.effect(SMALL, steps=100, frames=20)
    params, gaussians = scene_at()
    time = jnp.asarray(0.25)
    moved = jax.jit(field.deform)(params, gaussians, FrameCondition(time), None)
    motion = params.nets[mlp_motion.NAME]
    offsets = deform(motion, SMALL, gaussians.mean, time)
    expected = mlp_motion.apply(gaussians, offsets, SMALL.scale_rule)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6),
        moved,
        expected,
    )


@pytest.mark.full
def test_motion_sets_in_smoothly(dtype):
    @jax.jit
    def first_offsets(mean, time):
        params = mlp_motion.init(jax.random.key(0), MotionSpec(), jnp.dtype(dtype))
        return mlp_motion.deform(params, MotionSpec(), mean, time)

    mean = some_gaussians(50, dtype).mean
    offsets = first_offsets(mean, jnp.asarray(0.5, dtype))
    assert 0 < max(float(jnp.abs(leaf).max()) for leaf in offsets) < 5e-3
    assert {leaf.dtype.name for leaf in offsets} == {dtype}


def test_the_rate_falls_in_equal_ratios():
    field = mlp_motion.effect(MotionSpec(), steps=1000, frames=20)
    rates = [float(field.learning_rate(jnp.asarray(s))) for s in (0, 500, 1000, 4000)]
    middle = (8e-4 * 1.6e-6) ** 0.5
    np.testing.assert_allclose(rates, [8e-4, middle, 1.6e-6, 1.6e-6], rtol=1e-5)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"scale_rule": "cubic"}, "unknown scale_rule 'cubic'"),
        ({"block": 0}, "block >= 1"),
        ({"learning_rate_end": 0.0}, "both are positive"),
    ],
)
def test_settings_that_cannot_work_are_refused(setting, message):
    with pytest.raises(ValueError, match=message):
        MotionSpec(**setting)
    with pytest.raises(ValueError, match="steps >= 1"):
        SmoothingSpec(steps=0)
