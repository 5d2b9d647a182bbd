"""How the canonical positions come to rest."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.optim import learning_rates, phases
from gaussians_jax.optim.learning_rates import LearningRateSpec
from gaussians_jax.optim.phases import AnnealingSpec
from nerfies_jax.training import schedules, step_counts
from nerfies_jax.training.updates import apply_updates
from tests.gaussians.shared import jitted, put

MAIN = schedules.log_linear(1.6e-4, 1.6e-6, 1000)
ANNEALING = AnnealingSpec(after=750)
SHAPES = (3,), (3,), (4,), (), (1, 3), (3, 3)  # of a row


def exact_rate(step, spec, steps):
    """Equation 8 in Python floats."""

    def main(i):
        return 1.6e-4 * (1.6e-6 / 1.6e-4) ** (i / steps)

    if step >= steps * (1 - spec.freeze_share):
        return 0.0
    if step < spec.after:
        return main(step)
    return main(spec.after) * math.exp(
        -spec.decay * (step - spec.after) / (steps - spec.after)
    )


def test_the_annealed_rate_is_equation_8_in_one_scan(dtype):
    schedule = phases.annealed(MAIN, ANNEALING, 1000)
    traced = jitted(jax.vmap(schedule))(np.arange(1001, dtype=np.int32))
    exact = [exact_rate(step, ANNEALING, 1000) for step in range(1001)]
    np.testing.assert_allclose(
        traced, exact, rtol={"float32": 1e-6, "float64": 1e-12}[dtype]
    )
    assert traced.dtype.name == dtype


@pytest.mark.hard_cases
def test_the_annealed_rate_is_exact_at_its_ends(dtype):
    schedule = jitted(phases.annealed(MAIN, ANNEALING, 1000))
    main = jitted(MAIN)
    for step in (0, 1, 300, 749, 750):
        np.testing.assert_array_equal(schedule(step), main(step))
    # Continuous: from one step to the next it falls by its slope, 2 % at most.
    assert 0.97 < float(schedule(751)) / float(schedule(749)) < 1
    assert float(schedule(949)) > 0
    for step in (950, 951, 999, 1000, 5000):
        assert float(schedule(step)) == 0


@pytest.mark.hard_cases
def test_annealing_counts_steps_beyond_the_integers_of_float32(dtype):
    steps, after = 40_000_000, 30_000_001
    schedule = jitted(
        phases.annealed(lambda step: jnp.ones(()), AnnealingSpec(after=after), steps)
    )
    assert float(schedule(after)) == 1
    np.testing.assert_allclose(
        1 - float(schedule(after + 200_000)),
        -math.expm1(-5 * 200_000 / (steps - after)),
        rtol={"float32": 2e-6, "float64": 1e-12}[dtype],
    )


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_a_run_of_a_few_steps_may_have_no_step_to_anneal_in(steps):
    short = step_counts.scale_steps(ANNEALING, steps / 1000)
    schedule = jitted(phases.annealed(MAIN, short, steps))
    for step in range(steps):  # 5 % of these are none to freeze
        assert float(schedule(step)) == float(MAIN(step))


@pytest.mark.full
def test_an_annealing_without_freezing_trains_to_the_last_step():
    spec = AnnealingSpec(after=0, decay=2.0, freeze_share=0.0)
    schedule = jitted(phases.annealed(lambda step: jnp.ones(()), spec, 10))
    ends = [schedule(np.int32(step)) for step in (0, 9, 10)]
    np.testing.assert_allclose(ends, [1, math.exp(-1.8), 0], rtol=1e-6)


def test_only_the_means_are_annealed_and_stand_still_at_the_end():
    ones = Splats(*(np.ones((4, *shape), np.float32) for shape in SHAPES))
    params = Params({"splats": ones}, {"w": np.ones((4, 4), np.float32)})
    spec = LearningRateSpec()

    @jitted
    def both(step):
        annealed = learning_rates.at_step(spec, 2.0, 1000, step, ANNEALING)
        plain = learning_rates.at_step(spec, 2.0, 1000, step)
        after = apply_updates(params, params, Params({"splats": annealed}, {"w": 1e-3}))
        return annealed, plain, after

    for step in (10, 800, 949, 950):
        annealed, plain, after = both(np.int32(step))
        expected = 2 * exact_rate(step, ANNEALING, 1000)
        np.testing.assert_allclose(annealed.mean, expected, rtol=1e-6)
        assert annealed._replace(mean=None) == plain._replace(mean=None)
        assert (after.rows["splats"].mean != 1).any() == (step < 950)
        assert (after.nets["w"] != 1).all()
    still = LearningRateSpec(mean=0.0)
    assert learning_rates.at_step(still, 2.0, 1000, put(800), ANNEALING).mean == 0
