"""The deformation network: the reference's values, blocks, warm-up, smoothing."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.motion import mlp as mlp_motion
from gaussians_jax.motion.mlp import Motion, MotionSpec, Offsets, SmoothingSpec
from nerfies_jax.nn import mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import Layer
from tests import gradients
from tests.gaussians.motions import MLP as SMALL
from tests.gaussians.motions import deformed, strong
from tests.gaussians.shared import finite, full, jitted, put, some_gaussians
from tests.oracles import networks


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
        return put(Layer(weight, bias), dtype)

    hidden = tuple(layer(f"linear.{i}", turned=i == 5) for i in range(8))
    heads = {
        "mean": layer("gaussian_warp"),
        "quaternion": layer("gaussian_rotation"),
        "scale": layer("gaussian_scaling"),
    }
    time = (
        mlp.MLP((layer("timenet.0"),), {"code": layer("timenet.2")})
        if blender
        else None
    )
    return spec, Motion(mlp.MLP(hidden, heads), time), case


@pytest.mark.parametrize("name", ["blender1_6dof0", *full("blender0_6dof0")])
def test_the_published_network_is_reproduced(name, oracle_dir, dtype):
    spec, params, case = reference_case(oracle_dir, name, dtype)

    def one(point, time):
        at_time = mlp_motion.fold_time(params, spec, time)
        offsets = mlp_motion.offsets_at_time(at_time, spec, point[None])
        return jax.tree.map(lambda leaf: leaf[0], offsets)

    point, time = (case[key].astype(dtype) for key in ("x", "t"))

    def loss(point, time):  # the one whose gradients are stored
        mean, quaternion, scale = offsets = one(point, time)
        return jnp.sum(mean**2) + jnp.sum(quaternion) * scale[0], offsets

    run = jitted(jax.vmap(jax.grad(loss, argnums=(0, 1), has_aux=True)))
    grads, offsets = run(point, time[:, 0])
    # The reference ran in float32, with sines of arguments up to 2000.
    for ours, key in zip(offsets, ("d_xyz", "d_rotation", "d_scaling"), strict=True):
        np.testing.assert_allclose(ours, case[key], atol=2e-5 * np.abs(case[key]).max())
        assert ours.dtype.name == dtype
    for ours, key in zip(grads, ("g_x", "g_t"), strict=True):
        theirs = case[key].reshape(ours.shape)
        # Measured 4e-7 in float64; float32 rounds sines of 512 x and their factors 512.
        tolerance = {"float32": 2e-4, "float64": 2e-6}[dtype]
        np.testing.assert_allclose(ours, theirs, atol=tolerance * np.abs(theirs).max())


def test_the_time_part_may_be_summed_once(float64):
    """Against the network fed with [position, time] for every Gaussian."""
    spec = dataclasses.replace(SMALL, time_code=5)
    params = jax.tree.map(np.asarray, strong("mlp", spec))
    mean, time = some_gaussians(6).mean, 0.7
    code = networks.heads(params.time, networks.waves(spec.time, time))["code"]
    offsets = deformed["mlp"](params, spec, mean, time)
    for row, point in enumerate(mean):
        inputs = np.concatenate([networks.waves(spec.position, point), code])
        for name, exact in networks.heads(params.trunk, inputs, spec.skips).items():
            offset = getattr(offsets, name)[row]
            np.testing.assert_allclose(offset, exact, atol=1e-13)


@pytest.mark.parametrize("rule", ["log", *full("linear")])
def test_moving_gaussians(rule, float64):
    gaussians = some_gaussians(6)
    rng = np.random.default_rng(1)
    by = Offsets(*(rng.normal(size=(6, n)) for n in (3, 4, 3)))
    offsets = put(by)
    moved = jitted(mlp_motion.apply, static_argnums=2)(gaussians, offsets, rule)
    mean, q, scale, _ = map(np.asarray, gaussians)
    np.testing.assert_allclose(moved.mean, mean + by.mean)
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    np.testing.assert_allclose(moved.quaternion, q + by.quaternion)
    expected = scale + by.scale if rule == "linear" else scale * np.exp(by.scale)
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
    quaternion = np.full((2, 4), length, dtype)
    wild = np.asarray([[100.0] * 3, [-100.0] * 3], dtype)
    grads, moved = slopes_by_turn_and_scale(quaternion, wild, gaussians)
    assert finite((grads, moved))
    np.testing.assert_allclose(
        np.linalg.norm(np.asarray(moved.quaternion, np.float64), axis=1), 1, rtol=1e-5
    )


def test_smoothing_fades_linearly_and_then_leaves_the_time_alone(dtype):
    spec = SmoothingSpec(first=0.1, steps=1000)

    @jitted
    def smoothed(step):
        keys = jax.random.split(jax.random.key(0), 4000)
        time = jnp.asarray(0.5, dtype)
        return jax.vmap(lambda key: mlp_motion.smooth_time(key, spec, time, step, 50))(
            keys
        )

    first, later, last, after = (
        smoothed(np.int32(step)).astype(float) - 0.5 for step in (0, 750, 1000, 5000)
    )
    # 4000 draws know a standard deviation to 1.1 %.
    np.testing.assert_allclose(first.std(), 0.1 / 50, rtol=0.05)
    np.testing.assert_allclose(later.std(), 0.1 / 50 / 4, rtol=0.05)
    assert not last.any()
    assert not after.any()
