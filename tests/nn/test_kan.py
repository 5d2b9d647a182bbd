"""RBF-KANs against loops and closed forms: values, derivatives, spectrum."""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate

from nerfies_jax.nn import bsplines, kan
from nerfies_jax.nn.kan import KANSpec, Kernels
from nerfies_jax.nn.mlp import HeadSpec
from tests import gradients
from tests.oracles import networks

SPEC = KANSpec(
    in_features=5,
    hidden=(7, 6),
    heads=(("shift", HeadSpec(3)), ("turn", HeadSpec(2))),
    kernels=5,
    width_ratio=0.6,
)
VARIANTS = {
    "full": SPEC,
    "no base": dataclasses.replace(SPEC, base=False),
    "no norm": dataclasses.replace(SPEC, norm=False),
    "trained kernels": dataclasses.replace(SPEC, trainable_kernels=True),
    "unequal widths": dataclasses.replace(SPEC, width_jitter=0.4),
    "no hidden": dataclasses.replace(SPEC, hidden=()),
    "B-splines": dataclasses.replace(SPEC, basis="bspline", kernels=6),
}
SOME = [
    name
    if name in ("full", "trained kernels", "B-splines")
    else pytest.param(name, marks=pytest.mark.full)
    for name in VARIANTS
]

apply = jax.jit(kan.apply_heads, static_argnums=0)


def centers(spec, layer):
    return np.linspace(*spec.grid_of(layer), spec.kernels)[:, None]


def filled(spec, dtype):
    """A network all of whose parameters matter: kernels moved, biases not zero."""
    shapes = jax.eval_shape(lambda key: kan.init(key, spec), jax.random.key(0))
    rng = np.random.default_rng(1)

    def draw(leaf):
        return (0.4 * rng.normal(size=leaf.shape)).astype(jnp.dtype(dtype))

    params = jax.tree.map(draw, shapes)
    if not spec.trainable_kernels:
        return params
    kernels = tuple(
        Kernels(
            (0.3 * layer.center + centers(spec, index)).astype(layer.center.dtype),
            (0.3 * layer.log_width + math.log(kan.width(spec, index))).astype(
                layer.log_width.dtype
            ),
        )
        for index, layer in enumerate(params.kernels)
    )
    return params._replace(kernels=kernels)


def held(x, grid, margin):
    low, high = grid
    if low <= x <= high:
        return x
    excess = (x - high if x > high else low - x) / margin
    risen = margin * (1 - (1 + 2 * excess + 3 * excess**2) ** -0.5)
    return high + risen if x > high else low - risen


def splines(features, grid, count):
    """SciPy's B-splines, whose inputs are held within an interval of the grid."""
    step = (grid[1] - grid[0]) / (count - 3)
    knots = grid[0] + step * np.arange(-3, count + 1)
    clamped = np.array([held(v, grid, step) for v in features])
    rows = (
        scipy.interpolate.BSpline.basis_element(knots[k : k + 5], False)(clamped)
        for k in range(count)
    )
    return np.nan_to_num(np.stack(list(rows)))  # outside its own knots it says NaN


def by_hand(spec, params, x):
    """Kernel by kernel in NumPy float64, each input of each layer by itself."""
    params = networks.exact(params)
    layers = [[layer] for layer in params.hidden] + [list(params.heads.values())]
    features = networks.exact(x)
    for index, side_by_side in enumerate(layers):
        grid = spec.hidden_grid if index else spec.grid
        sigma = spec.width_ratio * (grid[1] - grid[0]) / (spec.kernels - 1)
        if index and spec.norm:
            features = features - np.mean(features)
            features = features / np.sqrt(np.mean(features**2) + 1e-6)
        center = np.linspace(*grid, spec.kernels)[:, None]
        scale = math.sqrt(2) * sigma
        if spec.width_jitter is not None:
            noise = np.random.default_rng(index).normal(size=spec.kernels)
            scale = scale * np.exp(spec.width_jitter * noise)[:, None]
        if spec.trainable_kernels:
            center = params.kernels[index].center
            scale = np.exp(params.kernels[index].log_width)
        if spec.basis == "bspline":
            psi = splines(features, grid, spec.kernels)
        else:
            clamped = np.array([held(v, grid, sigma) for v in features])
            psi = np.exp(-(((clamped - center) / scale) ** 2))
        outputs = [
            layer.bias + np.einsum("gi,gio->o", psi, layer.kernel)
            for layer in side_by_side
        ]
        if spec.base:
            silu = features / (1 + np.exp(-features))
            pairs = zip(outputs, side_by_side, strict=True)
            outputs = [sums + silu @ layer.base for sums, layer in pairs]
        features = np.concatenate(outputs)
    return dict(zip(params.heads, outputs, strict=True))


@pytest.mark.parametrize("variant", SOME)
def test_outputs_edge_by_edge(variant, dtype, rng):
    spec = VARIANTS[variant]
    params = filled(spec, dtype)
    inputs = rng.normal(size=(4, 5)).astype(dtype)  # a third outside the grid
    batch = jax.tree.map(np.asarray, apply(spec, params, inputs))
    bound = {"float32": 2e-5, "float64": 1e-13}[dtype]
    for row in range(4):
        for name, value in by_hand(spec, params, inputs[row]).items():
            assert batch[name].dtype == dtype
            np.testing.assert_allclose(batch[name][row], value, rtol=bound, atol=bound)


def test_one_output_of_any_leading_axes_edge_by_edge(dtype, rng):
    spec = KANSpec(in_features=5, hidden=(7, 6), out_features=3, kernels=5)
    params = filled(spec, dtype)
    inputs = rng.normal(size=(2, 2, 5)).astype(dtype)
    outputs = jax.jit(kan.apply, static_argnums=0)(spec, params, inputs)
    assert outputs.shape == (2, 2, 3)
    bound = {"float32": 2e-5, "float64": 1e-13}[dtype]
    for place in np.ndindex(2, 2):
        value = by_hand(spec, params, inputs[place])[kan.OUTPUT]
        np.testing.assert_allclose(outputs[place], value, rtol=bound, atol=bound)
    with pytest.raises(ValueError, match=r"expected \[\.\.\., 5\] for in_features=5"):
        kan.apply(spec, params, inputs[..., :4])
    with pytest.raises(ValueError, match=r"use kan\.apply_heads"):
        kan.apply(SPEC, params, inputs)
    with pytest.raises(ValueError, match="`x` is bfloat16 but the parameters are"):
        kan.apply(spec, params, jnp.asarray(inputs, jnp.bfloat16))


@pytest.mark.parametrize("variant", SOME)
def test_gradients(variant, float64, rng):
    spec = VARIANTS[variant]

    def total(params, inputs):
        return sum(
            jnp.sum(jnp.sin(head))
            for head in kan.apply_heads(spec, params, inputs).values()
        )

    inputs = rng.normal(size=(3, 5))
    error = gradients.directional_error(total, filled(spec, "float64"), inputs)
    assert error < 1e-6


@jax.jit
def holding(x):
    """Value, slope and curvature of `hold` at each input."""

    def hold(x):
        return kan.hold(x[None], (-1.0, 2.0), 0.3)[0]

    orders = hold, jax.grad(hold), jax.grad(jax.grad(hold))
    return [jax.vmap(order)(x) for order in orders]


@pytest.mark.hard_cases
def test_holding_is_twice_differentiable_at_the_ends(float64):
    ends = np.array([-1.0, 2.0])
    places = (ends + np.array([[-1e-9], [0.0], [1e-9]])).reshape(-1)
    for leaf, expected in zip(holding(places), (ends, [1, 1], [0, 0]), strict=True):
        leaf = np.asarray(leaf).reshape(3, 2)
        np.testing.assert_array_equal(leaf[1], expected)
        np.testing.assert_allclose(leaf, np.tile(expected, (3, 1)), atol=1e-6)


@pytest.mark.hard_cases
def test_holding_keeps_its_slope_however_far_out(dtype):
    """The square of the distance overflows float32 from 1e19 on: 0, and NaN at 3e38."""
    x = np.array([-1e10, 1e10, 1e15, 1e18, 3e38], dtype)
    exact = (0.3 / x.astype(np.float64)) ** 2 / np.sqrt(3)  # to 1 / x of itself
    value, grad, curvature = holding(x)
    np.testing.assert_allclose(value, [-1.3, *[2.3] * 4], rtol=1e-6)
    np.testing.assert_allclose(grad, exact, rtol=1e-6, atol=np.finfo(dtype).tiny)
    assert np.isfinite(curvature).all()


@jax.jit
def standardized(features):
    """And its slopes."""
    return kan.standardize(features), jax.jacrev(kan.standardize)(features)


@pytest.mark.hard_cases
@pytest.mark.parametrize("size", [1.0, 1e20, 3e38])
def test_features_of_any_size_are_standardized(size, dtype):
    """In float32 the variance of 1e20 overflows, and every feature would become 0."""
    samples = np.array([0.9, -0.3, 0.5, -1.0])
    exact = (samples - samples.mean()) / np.sqrt(samples.var() + 1e-6 / size**2)
    standard, grads = standardized((size * samples).astype(dtype))
    np.testing.assert_allclose(standard, exact, rtol=1e-6)
    # d z = (1 - 1/n - z zᵀ/n) dx / deviation
    change = (np.eye(4) - 0.25 - np.outer(exact, exact) / 4) / samples.std() / size
    np.testing.assert_allclose(grads, change, rtol=2e-6, atol=2e-6 / size + 1e-38)


# Small: what is hard about an input or a width is so in any network.
HARD = dataclasses.replace(
    SPEC, hidden=(4,), heads=(("y", HeadSpec(3)),), kernels=4, base=False
)
HARD_VARIANTS = {
    "full": HARD,
    "no norm": dataclasses.replace(HARD, norm=False),
    "trained kernels": dataclasses.replace(HARD, trainable_kernels=True),
}


@functools.partial(jax.jit, static_argnums=0)
def sum_and_slopes(spec, params, inputs):
    """The sum of the heads, the heads, and the slopes of the sum."""

    def total(params, inputs):
        heads = kan.apply_heads(spec, params, inputs)
        return sum(jnp.sum(head) for head in heads.values()), heads

    return jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(params, inputs)


@pytest.mark.hard_cases
@pytest.mark.parametrize("variant", HARD_VARIANTS)
def test_any_input_has_finite_slopes(variant, dtype):
    """Without SiLU, which hands on what it reads; all alike, so nothing spreads."""
    spec = HARD_VARIANTS[variant]
    params = filled(spec, dtype)
    still = jax.tree.map(np.zeros_like, params)  # hidden features without spread
    for values, x in itertools.product((params, still), (0.0, -1e20, 1e30)):
        leaves = sum_and_slopes(spec, values, np.full(5, x, dtype))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(leaves))


@pytest.mark.full
@pytest.mark.hard_cases
def test_bfloat16_is_finite_and_near(rng):
    """With the norm, SiLU and trained kernels all in."""
    spec = dataclasses.replace(HARD_VARIANTS["trained kernels"], base=True)
    params = filled(spec, "bfloat16")
    inputs = rng.normal(size=(16, 5)).astype(jnp.bfloat16)
    (_, heads), grads = sum_and_slopes(spec, params, inputs)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))
    exact = np.array([by_hand(spec, params, x)["y"] for x in inputs])
    assert heads["y"].dtype == jnp.bfloat16
    # Layers with eight bits; standardized features lose the most.
    error = np.abs(np.asarray(heads["y"], np.float64) - exact)
    assert np.median(error) < 0.01 * np.abs(exact).max()  # measured 2e-3


def test_initial_outputs_have_variance_one(dtype, rng):
    """Over inputs spread over the grid, whatever their number and the kernels'."""
    init = jax.jit(kan.init, static_argnums=(1, 2))
    cases = ((2, 8, 0.7, "rbf"), (48, 5, 0.5, "rbf"), (200, 16, 1.0, "rbf"))
    for inputs, kernels, ratio, basis in (*cases, (48, 9, 0.7, "bspline")):
        spec = KANSpec(
            inputs,
            heads=(("y", HeadSpec(256)),),
            kernels=kernels,
            width_ratio=ratio,
            base=False,
            basis=basis,
        )
        params = init(jax.random.key(0), spec, jnp.dtype(dtype))
        assert not np.asarray(params.heads["y"].bias).any()
        x = rng.uniform(-0.8, 0.8, (256, inputs)).astype(dtype)
        outputs = np.asarray(apply(spec, params, x)["y"], np.float64)
        # A mean of squares: a constant f(x) counts, as it does for the next layer.
        assert abs(np.mean(outputs**2) - 1) < 0.25


def test_networks_start_as_they_are_told(rng):
    heads = (("still", HeadSpec(3, "zero")), ("hardly", HeadSpec(3, "small")))
    spec = dataclasses.replace(SPEC, hidden=(5, 5), heads=(*heads, ("b", HeadSpec(5))))

    @jax.jit
    def start(key, inputs):
        params = kan.init(key, spec)
        return params, kan.apply_heads(spec, params, inputs)

    samples = jax.random.key(4), rng.normal(size=(9, 5)).astype(np.float32)
    params, answers = jax.tree.map(np.asarray, start(*samples))
    assert not answers["still"].any()
    assert 0 < np.abs(answers["hardly"]).max() < 1e-4 * 6 * 6
    one, two, three = (
        layer.kernel for layer in (*params.hidden, params.heads["b"])
    )  # drawn independently
    assert not any(np.any(a == b) for a, b in ((one, two), (one, three), (two, three)))


@pytest.mark.hard_cases
def test_a_b_spline_is_scipy_s_at_its_knots_between_and_beyond(dtype):
    """Value, slope and curvature; nothing beyond, where SciPy has no answer."""
    knots = np.arange(-2.0, 3.0)
    near = [np.nextafter(knots, -9), knots, np.nextafter(knots, 9)]
    x = np.concatenate([*near, np.linspace(-2, 2, 41)]).astype(dtype)
    exact = scipy.interpolate.BSpline.basis_element(knots, False)
    orders = [bsplines.cubic]
    for _ in range(2):
        orders.append(jax.grad(orders[-1]))
    beyond = np.array([-np.inf, -3e38, 2, 3, np.inf], dtype)
    every = jax.jit(lambda x: [jax.vmap(order)(x) for order in orders])
    bound = {"float32": 4e-7, "float64": 1e-15}[dtype]
    for number, answers in enumerate(every(np.concatenate([x, beyond]))):
        answers = np.asarray(answers)
        expected = np.nan_to_num(exact(x.astype(float), number))
        expected = np.where(np.abs(x) < 2, expected, 0)
        np.testing.assert_allclose(answers[: len(x)], expected, atol=bound)
        assert not answers[len(x) :].any()


def test_b_splines_sum_to_one_on_their_grid(float64):
    spec = dataclasses.replace(VARIANTS["B-splines"], grid=(-1.0, 2.0))
    x = np.linspace(-1, 2, 31)[:, None]
    apart = (x - np.asarray(kan.centers(spec, 0, float))) / kan.spacing(spec, 0)
    values = jax.jit(bsplines.cubic)(apart)
    np.testing.assert_allclose(np.asarray(values).sum(1), 1, rtol=1e-14)


def test_what_is_off_has_no_parameters():
    bare, trained = (
        jax.eval_shape(
            lambda key, name=name: kan.init(key, VARIANTS[name]), jax.random.key(0)
        )
        for name in ("no base", "trained kernels")
    )
    assert len(jax.tree.leaves(bare)) == 2 * 4  # kernel weights and biases
    assert [layer.center.shape for layer in trained.kernels] == [(5, 5), (5, 7), (5, 6)]
