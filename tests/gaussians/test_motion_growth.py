"""What moves, as seen in a stream of frames, and what may grow because of it."""

import dataclasses
import itertools
import math

import jax
import numpy as np
import pytest

from gaussians_jax.core import splats
from gaussians_jax.core.protocols import Population
from gaussians_jax.core.splats import Gaussians, Params, Splats
from gaussians_jax.motion import growth as motion_growth
from gaussians_jax.motion.growth import Guided, MotionGrowthSpec, MotionGuided, Travel
from gaussians_jax.optim import densification, optimizer
from gaussians_jax.optim.densification import DefaultStrategySpec
from tests.gaussians.shared import full, jitted, put

EXTENT = 2.0
TAU = 2e-3  # of the default threshold in this extent, scene units
SOFT = MotionGrowthSpec(start=100)
HARD = dataclasses.replace(SOFT, form="hard")
STRATEGY = DefaultStrategySpec()
TX = optimizer.scale_by_row_adam()


def rows_of(count, dtype="float32"):
    rng = np.random.default_rng(count)
    rows = Splats(
        mean=rng.normal(size=(count, 3)),
        log_scale=np.full((count, 3), math.log(0.01)),
        quaternion=rng.normal(size=(count, 4)),
        opacity_logit=np.zeros(count),
        sh_dc=np.zeros((count, 1, 3)),
        sh_rest=np.zeros((count, 0, 3)),
    )
    params = Params({"splats": rows, "label": np.arange(count)[:, None]}, {})
    return put(params, dtype)


@jitted
def watch(canonical, displacements):
    """What is kept after all displacements [instants, gaussians, 3], in one scan."""

    def body(state, displacement):
        moved = canonical._replace(mean=canonical.mean + displacement)
        return motion_growth.traveled(state, canonical, moved), None

    first = motion_growth.no_travel(canonical)  # its means are all that is read
    return jax.lax.scan(body, first, displacements)[0]


def seen_motion(displacements, opacity=None):
    """The motion of rows that are all active unless told."""
    _, count, _ = displacements.shape
    opacity = np.full(count, 0.5) if opacity is None else opacity
    ones = (np.ones((count, n)) for n in (4, 3))
    rows = Gaussians(np.zeros((count, 3)), *ones, opacity)
    rows = jax.tree.map(lambda leaf: leaf.astype(displacements.dtype), rows)
    return motion_growth.motion(put(watch(rows, displacements)))


def slow_motion(displacements, active):
    """Half the diagonal of each row's box about the median row, in plain loops."""
    displacements = np.asarray(displacements, np.float64)
    places = [[] for _ in active]
    for instant in displacements:
        middle = [np.median(instant[active, axis]) for axis in range(3)]
        for row, displacement in enumerate(instant):
            places[row].append(displacement - middle)
    sides = [np.ptp(place, axis=0) for place in places]
    return np.array([math.dist(side, (0, 0, 0)) / 2 for side in sides])


@pytest.mark.parametrize("count", [1, 10, *full(2, 9)])
def test_motion_is_the_box_about_the_median_row(count, rng, dtype):
    paths = rng.normal(size=(6, count, 3)).astype(dtype)
    active = np.arange(count) % 4 != 1
    result = seen_motion(paths, opacity=np.where(active, 0.5, 0.0))
    tolerance = {"float32": 1e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(result, slow_motion(paths, active), atol=tolerance)


@pytest.mark.hard_cases
def test_one_instant_and_none_are_no_motion(dtype):
    paths = np.ones((1, 4, 3), dtype) * np.arange(4, dtype=dtype)[:, None]
    assert not seen_motion(paths).any()
    nothing = motion_growth.no_travel(rows_of(4, dtype).rows["splats"])
    assert not motion_growth.motion(nothing).any()
    assert nothing.low.dtype.name == nothing.high.dtype.name == dtype
    nobody = put(jax.tree.map(lambda x: np.asarray(x)[:0], nothing))
    assert motion_growth.motion(nobody).shape == (0,)


@pytest.mark.hard_cases
@pytest.mark.parametrize("bad", [math.nan, *full(math.inf, -math.inf)])
def test_a_displacement_that_is_not_finite_does_not_count(bad, dtype):
    paths = np.zeros((4, 5, 3), dtype)
    paths[1, 2] = 0.5
    clean = seen_motion(paths)
    paths[2, 2, 0] = paths[:, 4, 1] = bad
    result = seen_motion(paths)
    np.testing.assert_array_equal(result, clean)
    assert result[2] == pytest.approx(math.sqrt(3) / 4)
    assert result[4] == 0


@pytest.mark.hard_cases
@pytest.mark.parametrize("size", [1e-30, 1e-4, 1e30])
def test_motions_of_any_size_keep_their_digits(size, dtype):
    paths = np.zeros((2, 3, 3), dtype)
    paths[1, 0] = size
    result = seen_motion(paths)
    np.testing.assert_allclose(result, [size * math.sqrt(3) / 2, 0, 0], rtol=1e-6)


@pytest.mark.parametrize("count", [513, *full(1, 7, 511, 512, 2000)])
def test_the_common_motion_is_the_median_of_a_sample(count, rng, dtype):
    paths = rng.normal(size=(count, 3)).astype(dtype)
    counts = rng.uniform(size=count) < 0.7
    counts[0] = True
    every = math.ceil(count / 512)
    selected = paths[::every][counts[::every]]
    common_motion = jitted(motion_growth.common_motion)
    result = common_motion(paths, counts)
    np.testing.assert_allclose(result, np.median(selected, axis=0), rtol=1e-6)
    none = common_motion(paths, np.zeros(count, bool))
    np.testing.assert_array_equal(none, 0)


def factor_of(spec, motion):
    """The factor of rows that moved so far, by way of what is kept."""
    motion = np.asarray(motion, np.float32)
    high = np.zeros((len(motion), 3), np.float32)
    high[:, 1] = 2 * motion  # half the diagonal of the box
    state = put(Travel(np.zeros_like(high), high))
    return motion_growth.grow_score(spec, EXTENT, state, 500)


def test_the_soft_factor_is_its_formula():
    motions = np.array([0, 0.3, 0.999, 1, 1.001, 3, 50]) * TAU
    exact = [1 / (1 + math.exp(math.log(4) * (1 - m / TAU))) for m in motions]
    spec = dataclasses.replace(SOFT, beta=4.0)
    np.testing.assert_allclose(factor_of(spec, motions), exact, rtol=1e-5)
    # Equation 7 has > twice, where 3DGS has >= for the slope.
    edges = np.array([0.99, 1.01]) * TAU
    np.testing.assert_array_equal(factor_of(HARD, edges), [0.0, 1.0])
    at_it = motion_growth.growth_factor(HARD, np.array([TAU]), TAU)
    np.testing.assert_array_equal(at_it, [0.0])


@pytest.mark.hard_cases
@pytest.mark.parametrize("beta", [1 + 1e-9, 1e300])
def test_wild_settings_and_motions_stay_in_range(beta):
    factor = factor_of(dataclasses.replace(SOFT, beta=beta), [0, 1e-30, 1.0, 1e25])
    assert ((factor >= 0) & (factor <= 1)).all()


def test_the_soft_form_becomes_the_hard_one_as_beta_grows():
    motions = np.concatenate([np.linspace(0, 0.97, 50), np.linspace(1.03, 4, 50)]) * TAU
    hard = factor_of(HARD, motions)
    assert set(hard) == {0, 1}
    apart = []
    for beta in (4.0, 1e6, 1e100, 1e300):
        spec = dataclasses.replace(SOFT, beta=beta)
        apart.append(np.abs(factor_of(spec, motions) - hard).max())
    assert apart == sorted(apart, reverse=True)
    assert apart[0] > 0.4
    assert apart[-1] < 1e-8
    # What 1 + beta exp(-m / tau) in place of it would do: everything stops.
    plain = 1 / (1 + 1e300 * np.exp(-motions / TAU))
    assert np.abs(plain - hard).max() == pytest.approx(1)


def grown(spec, params, gradient, motion, step=600):
    """Labels of the rows that are cloned by the event of a strategy so guided."""
    rows = params.rows["splats"]
    strategy, stats = STRATEGY, densification.empty_stats(rows)
    score = np.zeros_like(stats.grad2d)
    score[: len(gradient)] = gradient
    stats = stats._replace(grad2d=put(score), views=put(np.ones_like(stats.views)))
    if spec is not None:
        strategy = MotionGuided(STRATEGY, spec, EXTENT)
        high = np.zeros_like(rows.mean)
        high[: len(motion), 0] = 2 * motion
        stats = Guided(stats, put(Travel(np.zeros_like(high), high)))
    moments, key = jax.jit(TX.init)(params), jax.random.key(0)
    grow, _ = strategy.events(steps=1000)
    population = Population(params, moments, stats, key, step, EXTENT, TX)
    changed = grow.apply(population).params.rows
    active = np.asarray(splats.active_mask(changed["splats"]))
    count = len(rows.mean)
    labels = np.asarray(changed["label"])[active, 0].astype(int)
    np.testing.assert_array_equal(labels[:count], np.arange(count))  # none is gone
    return sorted(labels[count:])


STEEP, FLAT = 1.5 * STRATEGY.grow_grad2d, 0.5 * STRATEGY.grow_grad2d
# Every combination of slope and motion, in the order of the rows.
TABLE = tuple(itertools.product((STEEP, FLAT), (2 * TAU, 0.5 * TAU, 0.0)))


@pytest.mark.parametrize(
    ("spec", "step", "cloned"),
    [
        (HARD, 600, [0]),  # steep and moving: the conjunction of equation 7
        (HARD, 99, [0, 1, 2]),  # before its start: the plain rule
        (SOFT, 600, [0]),
        *full(
            (SOFT, 99, [0, 1, 2]),
            (dataclasses.replace(SOFT, beta=100.0, start=0), 600, [0]),
            (None, 600, [0, 1, 2]),
        ),
    ],
)
def test_truth_table_of_the_conjunction(spec, step, cloned, dtype):
    gradient, motion = (np.array(column) for column in zip(*TABLE, strict=True))
    params = rows_of(len(TABLE), dtype)
    assert grown(spec, params, gradient, motion, step) == cloned
