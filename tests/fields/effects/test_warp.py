"""Warps against matrix exponentials, loops over layers and central differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from nerfies_jax.fields.effects import warp
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training.effects import TIMESTAMP, FrameCondition, Table
from tests import gradients, random_params
from tests.oracles import networks

SMALL = WarpSpec(
    position=EncodingSpec(3),
    time=EncodingSpec(2),
    code_width=4,
    depth=4,
    width=16,
    skips=(2,),
)


def frame(dtype, time=0.4, width=4, step=0, seed=3):
    code = np.random.default_rng(seed).normal(size=width)
    return FrameCondition(
        jnp.asarray(time, dtype), {"motion": jnp.asarray(code, dtype)}, jnp.int32(step)
    )


def bent(spec, dtype):
    """A warp that is far from the identity."""
    return random_params.like(lambda key: warp.init(spec, key), dtype, 0.3)


started = jax.jit(warp.init, static_argnums=(0, 2))
FLOAT32 = jnp.dtype("float32")
PAIRS = [
    ("se3", "code"),
    ("translation", "time"),
    pytest.param("se3", "time", marks=pytest.mark.full),
    pytest.param("translation", "code", marks=pytest.mark.full),
]


def by_hand(spec, params, point, when):
    """The warped point, layer by layer in float64, through a 4x4 matrix exponential."""
    bands, opened = spec.position.bands, None
    if spec.anneal_steps is not None:
        share = min(int(when.step) / spec.anneal_steps, 1)
        opened = networks.window(bands, bands * share)
    read = networks.waves(spec.time, when.time)
    if spec.condition == "code":
        read = networks.exact(when.codes[spec.table])
    point = networks.exact(point)
    inputs = np.concatenate([networks.waves(spec.position, point, opened), read])
    out = networks.heads(params, inputs, spec.skips)
    if spec.kind == "translation":
        return point + out["linear"]
    x, y, z = out["angular"]
    twist = np.zeros((4, 4))
    twist[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    twist[:3, 3] = out["linear"]
    return (scipy.linalg.expm(twist) @ [*point, 1])[:3]


@functools.cache
def compiled(spec):
    return jax.jit(jax.vmap(functools.partial(warp.displace, spec), (None, 0, None)))


@pytest.mark.parametrize(("kind", "condition"), PAIRS)
@pytest.mark.parametrize("step", [0, 7, 100])
def test_points_move_as_the_matrix_exponential_says(kind, condition, step, dtype, rng):
    spec = dataclasses.replace(SMALL, kind=kind, condition=condition, anneal_steps=20)
    tables = (Table("motion", TIMESTAMP, 4),) if condition == "code" else ()
    assert spec.tables == tables
    params, when = bent(spec, dtype), frame(dtype, step=step)
    points = rng.uniform(-1, 1, (4, 3)).astype(dtype)
    warped = compiled(spec)(params, points, when)
    assert warped.dtype == dtype
    for point, moved in zip(points, np.asarray(warped), strict=True):
        truth = by_hand(spec, params, point, when) - np.asarray(point, np.float64)
        scale = max(np.abs(truth).max(), 1)
        assert scale < 100
        # 20 layers' worth of roundings; float32's are those of sums of 16 products
        bound = {"float32": 2e-5, "float64": 1e-13}[dtype] * scale
        np.testing.assert_allclose(moved, truth, rtol=0, atol=bound)


@pytest.mark.parametrize("condition", ["code", "time"])
def test_a_warp_without_hidden_layers_reads_point_and_condition(condition, dtype, rng):
    spec = dataclasses.replace(SMALL, condition=condition, depth=0, skips=())
    params, when = bent(spec, dtype), frame(dtype)
    (point,) = rng.uniform(-1, 1, (1, 3)).astype(dtype)
    (moved,) = compiled(spec)(params, point[None], when)
    truth = by_hand(spec, params, point, when) - np.asarray(point, np.float64)
    # of sums of 25 to 26 products, and the sine and cosine of a screw
    bound = {"float32": 2e-5, "float64": 1e-13}[dtype] * max(np.abs(truth).max(), 1)
    np.testing.assert_allclose(moved, truth, rtol=0, atol=bound)


@pytest.mark.parametrize(
    ("kind", "anneal_steps"),
    [
        ("se3", 100),
        pytest.param("se3", None, marks=pytest.mark.full),
        pytest.param("translation", None, marks=pytest.mark.full),
    ],
)
def test_every_warp_starts_as_the_identity(kind, anneal_steps, rng):
    spec = WarpSpec(kind=kind, anneal_steps=anneal_steps)
    points = jnp.asarray(rng.uniform(-1, 1, (300, 3)).astype(np.float32))
    when = frame("float32", width=8)
    code = jnp.asarray(np.float32(0.05) * when.codes["motion"])
    displaced = jax.vmap(functools.partial(warp.displace, spec), (None, 0, None))

    @jax.jit
    def run(params):
        def total(params, step):
            moved = displaced(
                params, points, FrameCondition(when.time, {"motion": code}, step)
            )
            squared = jnp.sum(moved**2, axis=-1)
            return jnp.sum(squared), jnp.max(squared)

        over_steps = jax.vmap(jax.grad(total, has_aux=True), (None, 0))
        grads, longest = over_steps(params, jnp.asarray([0, 1000]))
        return grads.hidden[-1], jnp.sqrt(longest)

    for seed in range(5):
        grads, longest = run(started(spec, jax.random.key(seed), FLOAT32))
        assert np.min(longest) > 0
        assert np.max(longest) < 1.2e-4
        # and it is not stuck there
        assert all(np.any(np.asarray(leaf)[1] != 0) for leaf in jax.tree.leaves(grads))


@pytest.mark.hard_cases
def test_weights_of_bands_that_open_late_start_at_zero():
    plain, annealed = (
        jax.tree.map(np.asarray, started(spec, jax.random.key(0), FLOAT32))
        for spec in (WarpSpec(), WarpSpec(anneal_steps=100))
    )
    features = EncodingSpec(8).width(3)
    for index, above in ((0, 0), (4, 128)):
        weight = annealed.hidden[index].weight
        waves = slice(above + 3, above + features)
        assert np.all(weight[waves] == 0)
        rows = np.r_[0 : above + 3, above + features : weight.shape[0]]
        np.testing.assert_array_equal(weight[rows], plain.hidden[index].weight[rows])
    np.testing.assert_array_equal(annealed.hidden[1].weight, plain.hidden[1].weight)
    # Without hidden layers it is the heads that read them.
    bare = WarpSpec(anneal_steps=100, depth=0, skips=())
    for head in started(bare, jax.random.key(0), FLOAT32).heads.values():
        assert np.all(np.asarray(head.weight)[3:features] == 0)
        assert np.all(np.asarray(head.weight)[:3] != 0)


@pytest.mark.parametrize(
    "kind", ["se3", pytest.param("translation", marks=pytest.mark.full)]
)
def test_time_zero_is_the_template(kind, dtype, rng):
    """D-NeRF's canonical frame; a hair later the field is as it is."""
    spec = dataclasses.replace(SMALL, kind=kind, condition="time", depth=2, skips=())
    params = bent(spec, dtype)
    point = rng.uniform(-1, 1, 3).astype(dtype)

    def moved(params, point, time):
        return warp.displace(
            spec, params, point, FrameCondition(time, {}, jnp.int32(0))
        )

    @jax.jit
    def every(*args):
        pair = jax.value_and_grad(lambda *args: jnp.sum(moved(*args) ** 2), (0, 1, 2))
        return pair(*args), jax.jacfwd(moved, 1)(*args)

    arguments = (params, point, np.asarray(0, dtype))
    (value, grads), jacobian = jax.tree.map(np.asarray, every(*arguments))
    assert value == 0
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(grads))
    np.testing.assert_array_equal(jacobian, 0)
    (after, _), _ = every(params, point, np.asarray(1e-30, dtype))
    assert after > 1e-3


@pytest.mark.parametrize(("kind", "condition"), PAIRS)
def test_gradients(kind, condition, float64, rng):
    spec = dataclasses.replace(SMALL, kind=kind, condition=condition, anneal_steps=20)
    params, point = bent(spec, "float64"), rng.uniform(-1, 1, 3)
    target = rng.normal(size=3)

    def total(params, point, code, time):
        when = FrameCondition(time, {"motion": code}, jnp.int32(11))
        return jnp.sum((warp.displace(spec, params, point, when) - target) ** 2)

    code = rng.normal(size=4)
    error = gradients.directional_error(total, params, point, code, np.float64(0.3))
    assert error < 1e-6
