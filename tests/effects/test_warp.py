"""Warps against matrix exponentials, loops over layers and central differences."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from nerfies_jax.effects import warp
from nerfies_jax.effects.effect import MOMENT, Moment, Table
from nerfies_jax.effects.warp import WarpSpec
from nerfies_jax.nets.encoding import EncodingSpec
from tests import gradients

SMALL = WarpSpec(
    position=EncodingSpec(3),
    time=EncodingSpec(2),
    code_width=4,
    depth=4,
    width=16,
    skips=(2,),
)


def moment(dtype, time=0.4, width=4, step=0, seed=3):
    code = np.random.default_rng(seed).normal(size=width)
    return Moment(
        jnp.asarray(time, dtype), {"motion": jnp.asarray(code, dtype)}, jnp.int32(step)
    )


def bent(spec, dtype, size=0.3, seed=0):
    """A warp that is far from the identity."""
    params = warp.init(spec, jax.random.key(seed), jnp.dtype(dtype))
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda x: x + jnp.asarray(size * rng.normal(size=x.shape), dtype), params
    )


def by_hand(spec, params, point, when):
    """The warped point, layer by layer in float64, through a 4x4 matrix exponential."""

    def waves(encoding, x, opened):
        features = [x] if encoding.identity else []
        for band in range(encoding.bands):
            features += [opened[band] * f(2.0**band * x) for f in (np.sin, np.cos)]
        return np.concatenate(features)

    bands = spec.position.bands
    opened = np.ones(bands)
    if spec.anneal_steps is not None:
        alpha = bands * min(int(when.step) / spec.anneal_steps, 1)
        opened = [
            (1 - math.cos(math.pi * min(max(alpha - k, 0), 1))) / 2
            for k in range(bands)
        ]
    point = np.asarray(point, np.float64)
    inputs = waves(spec.position, point, opened)
    if spec.condition == "code":
        read = np.asarray(when.codes[spec.table], np.float64)
    else:
        read = waves(
            spec.time, np.asarray(when.time, np.float64)[None], np.ones(spec.time.bands)
        )
    inputs = np.concatenate([inputs, read])
    hidden = inputs
    for index, layer in enumerate(params.hidden):
        if index in spec.skips:
            hidden = np.concatenate([hidden, inputs])
        weight, bias = (np.asarray(leaf, np.float64) for leaf in layer)
        hidden = np.maximum(hidden @ weight + bias, 0)
    out = {
        name: hidden @ np.asarray(head.weight, np.float64) + np.asarray(head.bias)
        for name, head in params.heads.items()
    }
    if spec.kind == "translation":
        return point + out["linear"]
    x, y, z = out["angular"]
    twist = np.zeros((4, 4))
    twist[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    twist[:3, 3] = out["linear"]
    return (scipy.linalg.expm(twist) @ [*point, 1])[:3]


@functools.cache
def compiled(spec):
    return jax.jit(lambda params, x, when: warp.displace(spec, params, x, when))


@pytest.mark.parametrize("kind", warp.KINDS)
@pytest.mark.parametrize("condition", warp.CONDITIONS)
@pytest.mark.parametrize("step", [0, 7, 100])
def test_points_move_as_the_matrix_exponential_says(kind, condition, step, dtype, rng):
    spec = dataclasses.replace(SMALL, kind=kind, condition=condition, anneal_steps=20)
    params, when = bent(spec, dtype), moment(dtype, step=step)
    for point in jnp.asarray(rng.uniform(-1, 1, (4, 3)), dtype):
        moved = compiled(spec)(params, point, when)
        assert moved.dtype == dtype
        truth = by_hand(spec, params, point, when) - np.asarray(point, np.float64)
        scale = max(np.abs(truth).max(), 1)
        assert scale < 100
        # 20 layers' worth of roundings; float32's are those of sums of 16 products
        bound = {"float32": 2e-5, "float64": 1e-13}[dtype] * scale
        np.testing.assert_allclose(moved, truth, rtol=0, atol=bound)


def test_samples_of_a_ray_share_the_product_of_their_code(float64, rng):
    spec = SMALL
    params, when = bent(spec, "float64"), moment("float64")
    points = jnp.asarray(rng.uniform(-1, 1, (7, 3)))
    along = jax.vmap(functools.partial(warp.displace, spec, params), in_axes=(0, None))
    truth = np.stack([by_hand(spec, params, x, when) for x in points])
    np.testing.assert_allclose(points + along(points, when), truth, atol=1e-12)
    text = str(jax.make_jaxpr(along)(points, when))
    # a product of one code, not of seven copies of it
    assert text.count("f64[4,16]") >= 2
    assert "f64[7,4]" not in text


@pytest.mark.hard_cases
@pytest.mark.parametrize("kind", warp.KINDS)
@pytest.mark.parametrize("anneal_steps", [None, 100])
def test_every_warp_starts_as_the_identity(kind, anneal_steps, rng):
    spec = WarpSpec(kind=kind, anneal_steps=anneal_steps)
    points = jnp.asarray(rng.uniform(-1, 1, (300, 3)), jnp.float32)
    moved = jax.jit(
        jax.vmap(functools.partial(warp.displace, spec), in_axes=(None, 0, None))
    )
    slopes = jax.jit(jax.grad(lambda *args: jnp.sum(moved(*args) ** 2)))
    for seed in range(5):
        params = warp.effect(spec).init(jax.random.key(seed))
        for step in (0, 1000):
            when = moment("float32", width=8, step=step)
            when.codes["motion"] = 0.05 * when.codes["motion"]
            lengths = np.linalg.norm(moved(params, points, when), axis=-1)
            assert 0 < lengths.max() < 1.2e-4
        # and it is not stuck there
        slope = slopes(params, points, when)
        assert all(np.any(leaf != 0) for leaf in jax.tree.leaves(slope.hidden[-1]))


@pytest.mark.hard_cases
def test_weights_of_bands_that_open_late_start_at_zero():
    plain = warp.init(WarpSpec(), jax.random.key(0))
    annealed = warp.init(WarpSpec(anneal_steps=10), jax.random.key(0))
    features = EncodingSpec(8).width(3)
    for index, above in ((0, 0), (4, 128)):
        weight = annealed.hidden[index].weight
        waves = slice(above + 3, above + features)
        assert np.all(weight[waves] == 0)
        kept = np.r_[0 : above + 3, above + features : weight.shape[0]]
        np.testing.assert_array_equal(weight[kept], plain.hidden[index].weight[kept])
    np.testing.assert_array_equal(annealed.hidden[1].weight, plain.hidden[1].weight)


def test_a_shut_window_leaves_the_point_alone_to_be_read(float64, rng):
    """At step 0 bands pass nothing; each opens in turn; at the end all are open."""
    spec = dataclasses.replace(SMALL, anneal_steps=30)
    like = jnp.zeros(3)
    shares = [
        np.asarray(warp.window(spec, jnp.int32(k), like)) for k in range(0, 41, 5)
    ]
    np.testing.assert_array_equal(shares[0], 0)
    np.testing.assert_allclose(shares[1], [0.5, 0, 0], atol=1e-15)
    np.testing.assert_allclose(shares[2], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(shares[5], [1, 1, 0.5], atol=1e-15)
    np.testing.assert_array_equal(shares[6], 1)
    np.testing.assert_array_equal(shares[8], 1)
    assert warp.window(SMALL, jnp.int32(0), like) is None
    params = bent(spec, "float64")
    point = jnp.asarray(rng.uniform(-1, 1, 3))
    when = moment("float64", step=0)
    flat = dataclasses.replace(SMALL, position=EncodingSpec(0), anneal_steps=None)
    rows = [0, 1, 2, -4, -3, -2, -1]  # the point's and the code's

    def read(index, layer):
        if index == 0:
            return layer._replace(weight=layer.weight[jnp.array(rows)])
        if index == 2:
            kept = jnp.concatenate(
                [layer.weight[:16], layer.weight[16:][jnp.array(rows)]]
            )
            return layer._replace(weight=kept)
        return layer

    fewer = params._replace(
        hidden=tuple(read(i, layer) for i, layer in enumerate(params.hidden))
    )
    np.testing.assert_allclose(
        warp.displace(spec, params, point, when),
        warp.displace(flat, fewer, point, when),
        atol=1e-13,
    )


@pytest.mark.hard_cases
@pytest.mark.parametrize("kind", warp.KINDS)
def test_time_zero_is_the_template(kind, dtype, rng):
    """D-NeRF's canonical frame; a hair later the field is as it is."""
    spec = dataclasses.replace(SMALL, kind=kind, condition="time")
    params = bent(spec, dtype)
    point = jnp.asarray(rng.uniform(-1, 1, 3), dtype)

    def total(params, point, time):
        when = Moment(time, {}, jnp.int32(0))
        return jnp.sum(warp.displace(spec, params, point, when) ** 2)

    start, after = jnp.asarray(0, dtype), jnp.asarray(1e-30, dtype)
    value, slopes = jax.jit(jax.value_and_grad(total, (0, 1, 2)))(params, point, start)
    assert value == 0
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(slopes))
    assert total(params, point, after) > 1e-3
    still = Moment(start, {}, jnp.int32(0))
    jacobian = jax.jit(jax.jacfwd(lambda x: warp.displace(spec, params, x, still)))(
        point
    )
    np.testing.assert_array_equal(jacobian, 0)


@pytest.mark.parametrize("kind", warp.KINDS)
@pytest.mark.parametrize("condition", warp.CONDITIONS)
def test_gradients(kind, condition, float64, rng):
    spec = dataclasses.replace(SMALL, kind=kind, condition=condition, anneal_steps=20)
    params, point = bent(spec, "float64"), jnp.asarray(rng.uniform(-1, 1, 3))
    target = jnp.asarray(rng.normal(size=3))

    def total(params, point, code, time):
        when = Moment(time, {"motion": code}, jnp.int32(11))
        return jnp.sum((warp.displace(spec, params, point, when) - target) ** 2)

    code = jnp.asarray(rng.normal(size=4))
    error = gradients.directional_error(total, params, point, code, jnp.asarray(0.3))
    assert error < 1e-6


@pytest.mark.hard_cases
@pytest.mark.parametrize("angular", [0.0, 1e-20, 1e-8, 1e-3])
@pytest.mark.parametrize("linear", [0.0, 1.0])
def test_tiny_turns_keep_their_slopes(angular, linear, dtype):
    """Zero screws and pure translations: Jacobian and gradient as to first order."""
    spec = dataclasses.replace(SMALL, depth=2, skips=())
    params = warp.init(spec, jax.random.key(0), jnp.dtype(dtype))
    # heads that answer their bias
    params = params._replace(
        heads={
            name: head._replace(weight=jnp.zeros_like(head.weight))
            for name, head in params.heads.items()
        }
    )
    w = angular * np.array([2.0, -1.0, 2.0]) / 3
    v = linear * np.array([1.0, 2.0, -2.0]) / 3
    point = np.array([0.3, -0.5, 0.7])

    def moved(w, v, x):
        heads = {
            "angular": params.heads["angular"]._replace(bias=w),
            "linear": params.heads["linear"]._replace(bias=v),
        }
        return warp.displace(spec, params._replace(heads=heads), x, moment(dtype))

    args = [jnp.asarray(a, dtype) for a in (w, v, point)]
    value = moved(*args)
    by_w, by_v, by_x = jax.jit(jax.jacfwd(moved, (0, 1, 2)))(*args)

    def hat(a):
        return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])

    # to second order in w; what is left is |w|³/6 = 2e-10 at most
    turn, once = hat(w), np.eye(3)
    bound = {"float32": 4e-7, "float64": 1e-9}[dtype]
    first = turn + turn @ turn / 2
    along = once + turn / 2 + turn @ turn / 6
    np.testing.assert_allclose(value, first @ point + along @ v, atol=bound)
    np.testing.assert_allclose(by_v, along, atol=bound)
    # relative: the elastic energy reads this, and it is as small as w
    relative = {"float32": 4e-7, "float64": 1e-14}[dtype] * angular
    np.testing.assert_allclose(by_x, first, atol=relative + angular**3 / 5 + 1e-30)
    lever = -hat(point) - hat(v) / 2 - (hat(turn @ point) + turn @ hat(point)) / 2
    lever -= (hat(turn @ v) + turn @ hat(v)) / 6
    np.testing.assert_allclose(by_w, lever, atol=max(4 * angular**2, bound))


def test_seams_of_the_effect():
    code, time = warp.effect(WarpSpec()), warp.effect(WarpSpec(condition="time"))
    assert code.tables == (Table("motion", MOMENT, 8),)
    assert time.tables == ()
    assert code.name == time.name == "warp"
    spec = WarpSpec(table="pose", code_width=2)
    assert warp.effect(spec).tables == (Table("pose", MOMENT, 2),)
    for seam in ("condition", "lift", "medium", "penalty"):
        assert getattr(code, seam) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "affine"}, "'affine'.*se3"),
        ({"condition": "frame"}, "'frame'.*code"),
        ({"code_width": 0}, "code_width=0"),
        ({"anneal_steps": 0}, "anneal_steps=0.*None"),
        ({"skips": (6,)}, "layer 6 is not in"),
        ({"width": 0}, "width=0"),
    ],
)
def test_wrong_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        WarpSpec(**change)


@pytest.mark.hard_cases
@pytest.mark.parametrize("place", [0.3, 100.0])
@pytest.mark.parametrize("times_pi", [False, True])
def test_strain_keeps_its_slopes_through_the_encoding(times_pi, place):
    """Second derivatives of the features: what an elastic penalty trains on.

    Far from the origin too, where π rounded in before the sine reduces leaves float32
    slopes of the strain 1e-2 off.
    """
    spec = dataclasses.replace(SMALL, position=EncodingSpec(8, times_pi=times_pi))
    params = bent(spec, "float32")
    point = np.float32(place) * np.array([1.0, -0.7, 0.4], np.float32)

    def strain(params, point):
        jacobian = jax.jacfwd(
            lambda x: warp.displace(spec, params, x, moment(point.dtype))
        )(point)
        return jnp.sum(jacobian**2)

    slopes = {}
    for kind in ("float32", "float64"):
        with jax.enable_x64(kind == "float64"):
            args = jax.tree.map(lambda x, k=kind: jnp.asarray(x, k), (params, point))
            found = jax.jit(jax.grad(strain, argnums=(0, 1)))(*args)
            slopes[kind] = [np.asarray(x, np.float64) for x in jax.tree.leaves(found)]
    for narrow, wide in zip(*slopes.values(), strict=True):
        assert np.abs(narrow - wide).max() <= 2e-5 * np.abs(wide).max()
