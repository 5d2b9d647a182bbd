"""The elastic penalty against NumPy's singular values, loops and exact expectations."""

import dataclasses
import functools
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.spatial.transform

from nerfies_jax.fields.effects import elastic
from nerfies_jax.fields.effects.effect import RayOutput
from nerfies_jax.fields.effects.elastic import ElasticSpec
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from tests import gradients

TURN = scipy.spatial.transform.Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()
OTHER = scipy.spatial.transform.Rotation.from_rotvec([-1.1, 0.2, 0.4]).as_matrix()
cost_and_slope = jax.jit(
    jax.value_and_grad(elastic.displacement_cost, 1), static_argnums=0
)
OFFICIAL = ElasticSpec(points=None, scaling="official", fold_cost=0.0)
SPECS = {
    "default": ElasticSpec(),
    "official": OFFICIAL,
    "squared": ElasticSpec(robust_width=None),
}

# Jacobians of warps
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
            name: jax.value_and_grad(elastic.displacement_cost, 1)(spec, displacement)
            for name, spec in SPECS.items()
        }

    return jax.tree.map(np.asarray, every(displacement.astype(dtype)))


def of_hard(spec_name, name, dtype):
    row = list(HARD).index(name)
    return [leaf[row] for leaf in hard_costs(dtype)[spec_name]]


def plain(spec, matrix):
    """ρ(Σ log²σ) by mpmath, σ3 with the sign of det, and what folded volume costs.

    NumPy's float64 is itself 2e-13 off at a strain of 1e-3.
    """
    volume = np.linalg.det(matrix)
    with mpmath.workdps(30):
        inputs = mpmath.matrix(np.asarray(matrix, np.float64).tolist())
        stretch = list(mpmath.svd_r(inputs, compute_uv=False))
        if spec.fold_cost and volume < 0:
            stretch[2] *= -1
        logs = [
            mpmath.log(s) if s > 0.01 else math.log(0.01) + 100 * s - 1 for s in stretch
        ]
        value = float(sum(log**2 for log in logs))
    if spec.robust_width is not None:
        ratio = value / spec.robust_width**2
        scale = {"paper": 1.0, "official": spec.robust_width}[spec.scaling]
        value = scale * 2 * ratio / (ratio + 4)
    return value + spec.fold_cost * max(0, -volume)


@pytest.mark.parametrize("name", MATRICES | FOLDS)
@pytest.mark.parametrize("spec_name", SPECS)
def test_cost_is_that_of_the_singular_values(name, spec_name, dtype):
    displacement = (HARD[name] - np.eye(3)).astype(dtype)
    stretched = np.asarray(displacement, np.float64) + np.eye(3)
    truth = plain(SPECS[spec_name], stretched)
    # A strain of 1e-7 from rounding the rotation costs 1e-7² / 1e-3 under ρ; σ = 0.05
    # of 3 is known to 60 ulps.
    bound = {"float32": 2e-5, "float64": 1e-13}[dtype]
    floor = {"float32": 1e-10, "float64": 1e-18}[dtype]
    value, _ = of_hard(spec_name, name, dtype)
    assert value.dtype == dtype
    np.testing.assert_allclose(value, truth, rtol=bound, atol=floor)


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", HARD)
def test_every_jacobian_has_a_finite_cost_and_slope(name, dtype):
    for spec_name in ("default", "squared"):
        value, grad = of_hard(spec_name, name, dtype)
        assert np.isfinite(value)
        assert np.all(np.isfinite(grad))
        if name == "rank two" or name in FOLDS:
            assert np.linalg.norm(grad) > 1e-3


@pytest.mark.parametrize("robust_width", [0.03, None])
def test_slopes_of_the_cost(robust_width, float64):
    spec = ElasticSpec(robust_width=robust_width)
    for name in ("random", "strong", *FOLDS):
        matrix = HARD[name]
        if name in ("mirror", "inside out"):
            matrix = matrix + 0.05 * OTHER  # off the corner that equal σ make of σ3
        at = matrix - np.eye(3)
        grad = np.asarray(cost_and_slope(spec, at)[1])
        for seed in range(4):
            along = np.random.default_rng(seed).normal(size=(3, 3))
            step = 1e-6 * along / np.linalg.norm(along)
            ends = [float(cost_and_slope(spec, x)[0]) for x in (at + step, at - step)]
            error = abs((ends[0] - ends[1]) / 2 - np.sum(grad * step))
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

CELLS = 4000
RAYS = {
    "surface": [0.0, 0.01, 0.02, 0.7, 0.2, 0.01, 0.0, 0.0],
    "two surfaces": [0.3, 0.0, 0.0, 0.1, 0.0, 0.0, 0.4, 0.05],
    "fog": [0.03] * 8,
    "one sample": [0, 0, 0, 0, 0, 0, 1, 0],
    "empty": [0] * 8,
}


@functools.partial(jax.jit, static_argnums=2)
def systematic(weight, starts, draws):
    return jax.vmap(elastic.systematic, (None, 0, None))(weight, starts, draws)


@pytest.mark.parametrize("ray", RAYS)
@pytest.mark.parametrize(
    "draws", [3, *(pytest.param(n, marks=pytest.mark.full) for n in (1, 4))]
)
def test_draws_are_unbiased(ray, draws, dtype):
    """Over all places of the first mark, each sample stands for its own weight."""
    weight, starts = np.asarray(RAYS[ray], dtype), (np.arange(CELLS) + 0.5) / CELLS
    chosen, share = map(np.asarray, systematic(weight, starts.astype(dtype), draws))
    expected = np.zeros(8)
    np.add.at(expected, chosen, share.astype(np.float64) / CELLS)
    # a step of the draw falls inside one cell
    np.testing.assert_allclose(expected, RAYS[ray], atol=1.5 / CELLS)
    assert np.all(weight[chosen] > 0) or ray == "empty"


@pytest.mark.hard_cases
def test_the_ends_of_the_marks_fall_on_samples_of_weight(dtype):
    weight, starts = np.asarray(RAYS["surface"], dtype), np.zeros(CELLS, dtype)
    starts[1:] = 1 - 2.0**-24
    chosen = np.asarray(systematic(weight, starts, 3)[0])
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


@pytest.fixture
def setting(float64, rng):
    """Three rays of eight samples, one of them empty, under a motion that folds."""
    point = jnp.asarray(rng.uniform(-1, 1, (3, 8, 3)))
    weight = jnp.asarray([RAYS["surface"], RAYS["empty"], RAYS["two surfaces"]])
    codes = {"motion": jnp.asarray(rng.normal(size=(3, 3)))}
    nowhere = jnp.asarray(np.zeros(3)), jnp.asarray(np.zeros(3, np.int32))
    conditions = FrameCondition(nowhere[0], codes, nowhere[1])
    return SimpleNamespace(
        params=jnp.asarray(rng.normal(size=(3, 3))),
        point=point,
        weight=weight,
        conditions=conditions,
    )


def field(params):
    """Little to compile: the energy is costly enough."""
    return lambda x, condition: jnp.sin(params @ x + condition.codes["motion"])


def slow(spec, setting):
    """Every sample in a loop, Jacobians by central differences."""
    total, folded, along = 0.0, 0.0, jax.vmap(field(setting.params), (0, None))
    moved = jax.jit(jax.vmap(along, (0, 0)))  # of rays, and of places on each
    steps = 1e-6 * np.concatenate([np.eye(3), -np.eye(3)])
    around = np.asarray(setting.point)[:, :, None] + steps
    ends = np.asarray(moved(around.reshape(3, 48, 3), setting.conditions))
    ends = ends.reshape(3, 8, 2, 3, 3)
    jacobians = np.swapaxes(ends[:, :, 0] - ends[:, :, 1], -1, -2) / 2e-6 + np.eye(3)
    for ray in range(3):
        for sample in range(8):
            jacobian, weight = (
                jacobians[ray, sample],
                float(setting.weight[ray, sample]),
            )
            volume = np.linalg.det(jacobian)
            total += weight * plain(spec, jacobian) / 3
            folded += weight * (volume < 0)
    return total, folded / float(setting.weight.sum())


@pytest.mark.full
def test_energy_of_all_samples_in_a_loop(setting):
    spec = ElasticSpec(points=None, robust_width=0.5)
    unfolded = dataclasses.replace(spec, fold_cost=0.0)
    here = context(
        field(setting.params), setting.point, setting.weight, setting.conditions
    )
    energies = jax.jit(
        lambda: [elastic.energy(one, here) for one in (spec, unfolded)]
    )()
    truth, share = slow(spec, setting)
    assert 0 < share < 1  # both kinds are among the samples
    np.testing.assert_allclose(energies[0], (truth, share), rtol=1e-7)
    np.testing.assert_allclose(energies[1][0], slow(unfolded, setting)[0], rtol=1e-7)


def test_as_many_points_as_samples_take_each_once(setting):
    drawn_all = jax.jit(lambda *seen: elastic.draw(8, level(*seen), jax.random.key(0)))
    eight, weight = drawn_all(setting.point, setting.weight)
    np.testing.assert_array_equal(eight, setting.point)
    np.testing.assert_array_equal(weight, setting.weight)


@pytest.mark.full
@pytest.mark.parametrize("points", [2, None])
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
    assert spec.name == "elastic"
    at_step = jax.jit(lambda step: spec.loss(None, here._replace(step=step)))
    for step, weight in ((0, 1e-2), (50, 1e-2), (100, 5.000005e-3), (999, 1e-8)):
        terms = at_step(jnp.int32(step))
        assert set(terms) == {"elastic", "folded"}
        np.testing.assert_allclose(terms["elastic"].weight, weight, rtol=1e-6)
        assert terms["folded"].weight is None
    assert elastic.schedule(ElasticSpec()) == 1e-3


@pytest.mark.full
def test_a_lazy_penalty_counts_for_the_steps_that_skip_it(setting):
    """Its value, its share of folds and its slopes, through the choice of the step."""

    def total(params, every, step):
        here = context(
            field(params), setting.point, setting.weight, setting.conditions, step=step
        )
        terms = ElasticSpec(every=every).loss(None, here)
        return terms["elastic"].value, terms["folded"].value

    slopes = jax.value_and_grad(total, has_aux=True)
    each = jax.jit(lambda params: slopes(params, 1, 0))(setting.params)
    lazy = jax.jit(lambda params, step: slopes(params, 3, step))
    assert np.any(each[1] != 0)
    for step in range(5):
        times = 0 if step % 3 else 3
        actual = jax.tree.leaves(lazy(setting.params, jnp.int32(step)))
        for one, full in zip(actual, jax.tree.leaves(each), strict=True):
            np.testing.assert_allclose(one, times * full, rtol=1e-12)


def test_steps_that_skip_a_penalty_do_not_compute_it(setting, monkeypatch):
    computed = []

    def energy(_, context):
        jax.debug.callback(lambda: computed.append(True))
        return jnp.sum(context.levels[0].point), jnp.ones(())

    monkeypatch.setattr(elastic, "energy", energy)
    here = context(None, setting.point, setting.weight, setting.conditions)
    at_step = jax.jit(
        lambda step: elastic.energy_of_step(
            ElasticSpec(every=4), here._replace(step=step)
        )
    )
    for step in range(9):
        jax.block_until_ready(at_step(jnp.int32(step)))
    jax.effects_barrier()
    assert len(computed) == 3
