"""The elastic penalty against NumPy's singular values, loops and exact expectations."""

import functools
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.spatial.transform

from nerfies_jax.effects import elastic, warp
from nerfies_jax.effects.effect import RayOutput
from nerfies_jax.effects.elastic import ElasticSpec
from nerfies_jax.effects.warp import WarpSpec
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from tests import gradients

TURN = scipy.spatial.transform.Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()
OTHER = scipy.spatial.transform.Rotation.from_rotvec([-1.1, 0.2, 0.4]).as_matrix()
cost = jax.jit(elastic.cost, static_argnums=0)
cost_and_slope = jax.jit(jax.value_and_grad(elastic.cost, 1), static_argnums=0)
OFFICIAL = ElasticSpec(points=None, scaling="official", fold_cost=0.0)
SPECS = {
    "default": ElasticSpec(),
    "official": OFFICIAL,
    "squared": ElasticSpec(robust_width=None),
}

# Jacobians of warps: (matrix, is it in the range of NumPy's plain formula)
MATRICES = {
    "identity": np.eye(3),
    "rotation": TURN,
    "strain of 1e-3": np.eye(3) + 1e-3 * OTHER,
    "twice everything": 2 * np.eye(3),
    "repeated": TURN @ np.diag([2, 2, 0.5]) @ OTHER,
    "strong": TURN @ np.diag([3, 1.1, 0.05]) @ OTHER,
    "random": TURN @ np.diag([1.3, 1.1, 0.8]) @ OTHER,
}
FOLDS = {
    "mirror": np.diag([1.0, 1.0, -1.0]),
    "turned mirror": TURN @ np.diag([1.2, 1.0, -0.7]) @ OTHER,
    "inside out": -1.5 * np.eye(3),
    "just folded": TURN @ np.diag([1.2, 0.9, -0.03]) @ OTHER,
}
SINGULAR = {
    "rank two": np.diag([1.0, 2.0, 0.0]),
    "rank one": np.diag([1.0, 0.0, 0.0]),
    "zero": np.zeros((3, 3)),
    "nearly zero": 1e-20 * np.eye(3),
    "huge": 1e6 * TURN,
}
HARD = MATRICES | FOLDS | SINGULAR
STRETCHES = np.linspace(-1.3, 0.98, 115)  # of one direction, through the fold


@functools.cache
def hard_costs(dtype):
    """By spec cost and slope: of `HARD`, and along diag(1, 1, s) of `STRETCHES`."""
    through = [np.diag([1, 1, s]) for s in STRETCHES]
    displacement = np.asarray([*HARD.values(), *through]) - np.eye(3)

    @jax.jit
    @jax.vmap
    def every(displacement):
        return {
            name: jax.value_and_grad(elastic.cost, 1)(spec, displacement)
            for name, spec in SPECS.items()
        }

    return jax.tree.map(np.asarray, every(displacement.astype(dtype)))


def of_hard(spec_name, name, dtype):
    row = list(HARD).index(name)
    return [leaf[row] for leaf in hard_costs(dtype)[spec_name]]


def plain(spec, matrix):
    """ρ(Σ log²σ) by mpmath; with `fold_cost`, σ3 has the sign of det.

    NumPy's float64 is itself 2e-13 off at a strain of 1e-3.
    """
    with mpmath.workdps(30):
        given = mpmath.matrix(np.asarray(matrix, np.float64).tolist())
        stretch = list(mpmath.svd_r(given, compute_uv=False))
        if spec.fold_cost and np.linalg.det(matrix) < 0:
            stretch[2] *= -1
        logs = [
            mpmath.log(s) if s > 0.01 else math.log(0.01) + 100 * s - 1 for s in stretch
        ]
        value = float(sum(log**2 for log in logs))
    if spec.robust_width is None:
        return value
    ratio = value / spec.robust_width**2
    scale = {"paper": 1.0, "official": spec.robust_width}[spec.scaling]
    return scale * 2 * ratio / (ratio + 4)


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("spec_name", SPECS)
def test_cost_is_that_of_the_singular_values(name, spec_name, dtype):
    displacement = (MATRICES[name] - np.eye(3)).astype(dtype)
    stretched = np.asarray(displacement, np.float64) + np.eye(3)
    truth = plain(SPECS[spec_name], stretched)
    # A strain of 1e-7 from rounding the rotation costs 1e-7² / 1e-3 under ρ; σ = 0.05
    # of 3 is known to 60 ulps.
    bound = {"float32": 2e-5, "float64": 1e-13}[dtype]
    floor = {"float32": 1e-10, "float64": 1e-18}[dtype]
    value, _ = of_hard(spec_name, name, dtype)
    assert value.dtype == dtype
    np.testing.assert_allclose(value, truth, rtol=bound, atol=floor)


@pytest.mark.full
@pytest.mark.hard_cases
@pytest.mark.parametrize("name", FOLDS)
def test_folds_cost_more_than_any_stretch_and_by_their_volume(name, dtype):
    volume = abs(np.linalg.det(FOLDS[name]))
    value, _ = of_hard("default", name, dtype)
    # ρ is within 0.2 % of its saturation at two
    assert 1.996 + volume < value < 2.0001 + volume * 1.0001
    free, _ = of_hard("official", name, dtype)
    np.testing.assert_allclose(free, plain(OFFICIAL, FOLDS[name]), rtol=1e-5, atol=1e-9)


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", HARD)
@pytest.mark.parametrize("spec_name", ["default", "squared"])
def test_every_jacobian_has_a_finite_cost_and_slope(name, spec_name, dtype):
    value, grad = of_hard(spec_name, name, dtype)
    assert np.isfinite(value)
    assert np.all(np.isfinite(grad))
    if name in ("rank two", "mirror", "turned mirror", "inside out", "just folded"):
        assert np.linalg.norm(grad) > 1e-3


@pytest.mark.parametrize("name", ["random", "strong", *FOLDS])
@pytest.mark.parametrize("robust_width", [0.03, None])
def test_slopes_of_the_cost(name, robust_width, float64):
    matrix = (MATRICES | FOLDS)[name]
    if name in ("mirror", "inside out"):
        matrix = matrix + 0.05 * OTHER  # off the corner that equal σ make of σ3
    spec, at = ElasticSpec(robust_width=robust_width), jnp.asarray(matrix - np.eye(3))
    _, grad = cost_and_slope(spec, at)
    for seed in range(4):
        along = np.random.default_rng(seed).normal(size=(3, 3))
        step = 1e-6 * along / np.linalg.norm(along)
        difference = float(cost(spec, at + step) - cost(spec, at - step)) / 2
        error = abs(difference - np.sum(grad * step))
        assert error < 1e-6 * 1e-6 * np.linalg.norm(grad)


@pytest.mark.hard_cases
def test_a_fold_is_pulled_open_all_the_way(dtype):
    """Along diag(1, 1, s) the cost falls from any fold to the identity.

    Without `fold_cost` a mirror image is at rest and a half-folded one slides there.
    """
    grad, free = (
        hard_costs(dtype)[name][1][len(HARD) :, 2, 2]
        for name in ("default", "official")
    )
    assert np.all(grad < 0)
    assert np.all(grad[STRETCHES < -1e-6] < -0.9)
    assert np.all(free[(STRETCHES > -0.99) & (STRETCHES < -0.05)] > 0)


# -- draws ---------------------------------------------------------------------------

RAYS = {
    "surface": [0.0, 0.01, 0.02, 0.7, 0.2, 0.01, 0.0, 0.0],
    "two surfaces": [0.3, 0.0, 0.0, 0.1, 0.0, 0.0, 0.4, 0.05],
    "fog": [0.03] * 8,
    "one sample": [0, 0, 0, 0, 0, 0, 1, 0],
    "empty": [0] * 8,
}


systematic = jax.jit(elastic.systematic, static_argnums=2)


@pytest.mark.parametrize("ray", RAYS)
@pytest.mark.parametrize(
    "draws", [3, *(pytest.param(n, marks=pytest.mark.full) for n in (1, 4))]
)
def test_draws_are_unbiased(ray, draws, dtype):
    """Over all places of the first mark, each sample stands for its own weight."""
    weight = jnp.asarray(RAYS[ray], dtype)
    cells = 4000
    starts = (jnp.arange(cells, dtype=dtype) + 0.5) / cells
    chosen, share = jax.vmap(elastic.systematic, (None, 0, None))(weight, starts, draws)
    expected = np.zeros(8)
    np.add.at(expected, np.asarray(chosen), np.asarray(share, np.float64) / cells)
    # a step of the draw falls inside one cell
    np.testing.assert_allclose(expected, RAYS[ray], atol=1.5 / cells)
    assert np.all(np.asarray(RAYS[ray])[chosen] > 0) or ray == "empty"


@pytest.mark.hard_cases
@pytest.mark.parametrize("start", [0.0, 1 - 2.0**-24])
def test_the_ends_of_the_marks_fall_on_samples_of_weight(start, dtype):
    weight, start = np.asarray(RAYS["surface"], dtype), np.asarray(start, dtype)
    chosen, _ = systematic(weight, start, 4)
    assert np.all((chosen >= 1) & (chosen <= 5))


def level(point, weight):
    fields = dict.fromkeys(RayOutput._fields)
    return RayOutput(
        **fields | {"point": point, "static_weight": weight, "media_weight": {}}
    )


def context(displace, point, weight, conditions, key=0, step=0):
    fields = dict.fromkeys(PenaltyContext._fields)
    return PenaltyContext(
        **fields
        | {
            "displace": displace,
            "condition": conditions,
            "levels": (level(point, weight), None),
            "step": jnp.int32(step),
            "key": jax.random.key(key),
        }
    )


SMALL = WarpSpec(position=EncodingSpec(2), code_width=2, depth=2, width=8, skips=())


@pytest.fixture
def setting(float64, rng):
    """Three rays of eight samples, one of them empty, under a strong warp."""
    params = warp.init(SMALL, jax.random.key(0), jnp.float64)
    params = jax.tree.map(lambda x: x + 0.2 * rng.normal(size=x.shape), params)
    point = jnp.asarray(rng.uniform(-1, 1, (3, 8, 3)))
    weight = jnp.asarray([RAYS["surface"], RAYS["empty"], RAYS["two surfaces"]])
    codes = {"motion": jnp.asarray(rng.normal(size=(3, 2)))}
    conditions = FrameCondition(jnp.zeros(3), codes, jnp.zeros(3, jnp.int32))
    return SimpleNamespace(
        params=params, point=point, weight=weight, conditions=conditions
    )


def field(params):
    return lambda x, condition: warp.displace(SMALL, params, x, condition)


def slow(spec, setting):
    """Every sample in a loop, Jacobians by central differences."""
    total, folded, moved = 0.0, 0.0, jax.jit(field(setting.params))
    for ray in range(3):
        condition = jax.tree.map(lambda x: x[ray], setting.conditions)  # noqa: B023
        for sample in range(8):
            x, step = setting.point[ray, sample], 1e-6 * np.eye(3)
            jacobian = np.stack(
                [
                    (moved(x + e, condition) - moved(x - e, condition)) / 2e-6
                    for e in step
                ],
                axis=1,
            ) + np.eye(3)
            weight = float(setting.weight[ray, sample])
            volume = np.linalg.det(jacobian)
            total += weight * plain(spec, jacobian) / 3
            total += weight * spec.fold_cost * max(0, -volume) / 3
            folded += weight * (volume < 0)
    return total, folded / float(setting.weight.sum())


def test_energy_of_all_samples_in_a_loop(setting):
    spec = ElasticSpec(points=None, robust_width=0.5)
    here = context(
        field(setting.params), setting.point, setting.weight, setting.conditions
    )
    value, folded = jax.jit(lambda: elastic.energy(spec, here))()
    truth, share = slow(spec, setting)
    assert 0 < share < 1  # both kinds are among the samples
    np.testing.assert_allclose(value, truth, rtol=1e-7)
    np.testing.assert_allclose(folded, share, atol=1e-12)
    unfolded = ElasticSpec(points=None, robust_width=0.5, fold_cost=0.0)
    value, _ = jax.jit(lambda: elastic.energy(unfolded, here))()
    np.testing.assert_allclose(value, slow(unfolded, setting)[0], rtol=1e-7)


@pytest.mark.full
@pytest.mark.parametrize("points", [1, 4])
def test_the_penalty_of_drawn_samples_has_the_mean_of_all(points, setting):
    """By many keys; its deviation is what the table of the experiment says."""

    def value(spec, key):
        here = context(
            field(setting.params), setting.point, setting.weight, setting.conditions
        )._replace(key=key)
        return elastic.energy(spec, here)[0]

    every = jax.jit(lambda: value(ElasticSpec(points=None), jax.random.key(0)))()
    keys = jax.random.split(jax.random.key(1), 2000)
    drawn = jax.jit(jax.vmap(lambda key: value(ElasticSpec(points=points), key)))(keys)
    error = np.std(drawn) / math.sqrt(2000)
    assert error > 0
    assert abs(np.mean(drawn) - every) < 4 * error


def test_as_many_points_as_samples_take_each_once(setting):
    eight, weight = elastic.draw(
        8, level(setting.point, setting.weight), jax.random.key(0)
    )
    np.testing.assert_array_equal(eight, setting.point)
    np.testing.assert_array_equal(weight, setting.weight)


@pytest.mark.parametrize("points", [2, pytest.param(None, marks=pytest.mark.full)])
def test_gradients_reach_the_warp_and_not_the_weights(points, setting):
    spec = ElasticSpec(points=points)

    def total(params, codes, weight):
        here = context(
            field(params),
            setting.point,
            weight,
            setting.conditions._replace(codes={"motion": codes}),
        )
        return elastic.energy(spec, here)[0]

    codes = setting.conditions.codes["motion"]
    error = gradients.directional_error(
        lambda params, codes: total(params, codes, setting.weight),
        setting.params,
        codes,
        step=1e-6,
    )
    assert error < 1e-5
    grad = jax.jit(jax.grad(total, 2))(setting.params, codes, setting.weight)
    np.testing.assert_array_equal(grad, 0)


@pytest.mark.hard_cases
def test_a_batch_of_empty_rays_costs_nothing(dtype):
    """Whatever the warp, here one that bends and strains."""

    def total(matrix):
        points, weight = jnp.ones((2, 5, 3), dtype), jnp.zeros((2, 5), dtype)
        conditions = FrameCondition(jnp.zeros(2, dtype), {}, jnp.zeros(2, jnp.int32))

        def displace(point, _):
            return jnp.sin(jnp.sum(matrix * point, axis=-1))

        return elastic.energy(
            ElasticSpec(), context(displace, points, weight, conditions)
        )

    matrix = np.asarray(TURN + 0.1, dtype)
    (value, folded), grad = jax.jit(jax.value_and_grad(total, has_aux=True))(matrix)
    assert value == 0
    assert folded == 0
    assert np.all(grad == 0)


def test_terms_and_schedule(setting):
    spec = ElasticSpec(weight=1e-2, hold_steps=50, decay_steps=100, last_weight=1e-8)
    here = context(
        field(setting.params), setting.point, setting.weight, setting.conditions
    )
    seams = elastic.effect(spec)
    assert seams.name == "elastic"
    assert seams.init is None
    assert seams.tables == ()
    at_step = jax.jit(lambda step: seams.penalty(None, here._replace(step=step)))
    for step, weight in ((0, 1e-2), (50, 1e-2), (100, 5.000005e-3), (999, 1e-8)):
        terms = at_step(jnp.int32(step))
        assert set(terms) == {"elastic", "folded"}
        np.testing.assert_allclose(terms["elastic"].weight, weight, rtol=1e-6)
        assert terms["folded"].weight is None
    assert elastic.schedule(ElasticSpec()) == 1e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": 0}, "points=0.*None"),
        ({"weight": -1.0}, "weight=-1"),
        ({"fold_cost": math.nan}, "fold_cost=nan"),
        ({"robust_width": 0.0}, "width > 0"),
        ({"scaling": "twice"}, "'twice'"),
        ({"decay_steps": 0}, "steps=0"),
    ],
)
def test_wrong_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        ElasticSpec(**change)
