"""Adam and RAdam per row, and rows gathered together with their moments."""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import optax
import pytest

from gaussians_jax.core.splats import INACTIVE_LOGIT, Params, Splats
from gaussians_jax.optim import optimizer
from tests.gaussians.shared import full, jitted, put, rows_and_nets, same_bits

COUNT = 6
# optax 0.2.8 raises a float to an integer power, which strict promotion refuses.
lenient = jax.numpy_dtype_promotion


def zeros(rule, params):
    """Its first state, which is zeros, without compiling them one by one."""
    shapes = jax.eval_shape(rule.init, params)
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)


def partitioned(scale_by_rows=optimizer.scale_by_row_adam):
    def label(params):
        del params
        kinds = Splats("mean", *["rest"] * 5)
        return Params({"splats": kinds, "code": "rest"}, {"w": "nets"})

    def rows(rate):
        return optax.chain(scale_by_rows(), optax.scale(-rate))

    each = {"mean": rows(1e-2), "rest": rows(1e-3), "nets": optax.adam(1e-3)}
    return optax.chain(optax.clip_by_global_norm(10.0), optax.partition(each, label))


def first_moments(tx, grads, params):
    def one_step(grads, params):
        return tx.update(grads, tx.init(params), params)[1]

    with lenient("standard"):
        return jitted(one_step)(grads, params)


gather = jitted(optimizer.gather_rows, static_argnums=0)


PAIRS = {
    "adam": (optimizer.scale_by_row_adam, optax.scale_by_adam(eps=1e-15)),
    "radam": (optimizer.scale_by_row_radam, optax.scale_by_radam(eps=1e-15)),
}


@pytest.mark.parametrize("name", PAIRS)
def test_it_is_optax_s_while_all_rows_are_as_old(name, dtype):
    params = rows_and_nets(COUNT, dtype).rows
    ours, theirs = PAIRS[name][0](), PAIRS[name][1]
    state, reference = zeros(ours, params), zeros(theirs, params)
    step_ours, step_theirs = jitted(ours.update), jitted(theirs.update)
    for seed in range(8):  # RAdam's length passes the threshold at the sixth
        noise = np.random.default_rng(seed)
        grads = jax.tree.map(
            lambda p, n=noise: n.normal(size=p.shape).astype(p.dtype), params
        )
        step, state = step_ours(grads, state)
        with lenient("standard"):
            expected, reference = step_theirs(grads, reference)
        # optax forms 1 - 0.999^n in float32, which is good to 3e-5 at n = 1, and the
        # length of RAdam to 0.03, so that its first rectified step is 1 % off.
        far = {"adam": 1e-4, "radam": 2e-2}[name]
        tolerance = {"float32": far, "float64": 1e-11}[dtype]
        for ours_leaf, leaf in zip(
            *map(jax.tree.leaves, (step, expected)), strict=True
        ):
            np.testing.assert_allclose(ours_leaf, leaf, rtol=tolerance)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(step)} == {dtype}


def exact_length(updates, b2):
    with mpmath.workdps(60):
        b2 = mpmath.mpf(b2)
        seen = b2**updates
        return 2 / (1 - b2) - 1 - 2 * updates * seen / (1 - seen)


def exact_factor(length, b2):
    with mpmath.workdps(60):
        longest = 2 / (1 - mpmath.mpf(b2)) - 1
        top = (length - 4) * (length - 2) * longest
        return mpmath.sqrt(top / ((longest - 4) * (longest - 2) * length))


AGES = [*range(1, 12), 100, 690, 999, 1000, 1001, 1002, 5000, 10**4, 10**5, 10**6]


@functools.partial(jax.jit, static_argnums=1)
def lengths_and_factors(ages, b2):
    length = optimizer.moment_length(ages, b2)
    return length, optimizer.rectification(length, b2)


@pytest.mark.hard_cases
@pytest.mark.parametrize("b2", [0.7, 0.999, *full(0.9, 0.99, 0.9999)])
def test_the_moments_length_is_right_from_the_first_update_on(b2, dtype):
    """The printed form is 0.03 off in float32 where RAdam takes its decision."""
    length, factor = lengths_and_factors(np.asarray(AGES, dtype), b2)
    exact = [exact_length(age, b2) for age in AGES]
    # Measured 1.4e-7 and 4.4e-16, beside the switch from the series at t = -1 / log b2.
    tolerance = {"float32": 4e-7, "float64": 2e-15}[dtype]
    np.testing.assert_allclose(length, np.array(exact, float), rtol=tolerance)
    expected = [float(exact_factor(x, b2)) if x > 4 else 0.0 for x in exact]
    # One ulp of a length of 4.07 is 3e-6 of what it exceeds 4 by.
    np.testing.assert_allclose(factor, expected, atol=4 * tolerance)
    assert (np.diff(np.asarray(length, np.float64)[:-1]) > -1e-4).all()
    assert np.asarray(factor).max() <= 1


@pytest.mark.hard_cases
@pytest.mark.parametrize("shift", [-1e-3, 1e-3])
def test_radam_switches_exactly_where_its_length_passes_the_threshold(shift, dtype):
    """Just above the length of the seventh update, the eighth is the first adapted."""
    length = float(exact_length(7, 0.999))
    ours = optimizer.scale_by_row_radam(threshold=length + shift)
    grads = np.full((1, 2), 1e-3, dtype)
    state, update, steps = zeros(ours, grads), jax.jit(ours.update), []
    for _ in range(9):
        step, state = update(grads, state)
        steps.append(float(np.asarray(step)[0, 0]))
    first = 7 if shift > 0 else 6
    np.testing.assert_allclose(steps[:first], 1e-3, rtol=2e-5)
    factors = [exact_factor(exact_length(age, 0.999), 0.999) for age in range(1, 10)]
    np.testing.assert_allclose(
        steps[first:], np.array(factors[first:], float), rtol=2e-5
    )


def radam_alone(grads, b1=0.9, b2=0.999, eps=1e-15):
    """RAdam of one number, algorithm 2 of the paper with the threshold of its code."""
    first = second = 0.0
    steps = []
    for age, grad in enumerate(grads, start=1):
        first = b1 * first + (1 - b1) * grad
        second = b2 * second + (1 - b2) * grad**2
        mean, square = first / (1 - b1**age), second / (1 - b2**age)
        length = exact_length(age, b2)
        if length < 5:
            steps.append(mean)
        else:
            factor = float(exact_factor(length, b2))
            steps.append(factor * mean / (np.sqrt(square) + eps))
    return np.array(steps)


def test_rows_that_start_late_follow_radam_from_their_own_first_step(dtype):
    starts, total = [0, 3, 12], 24
    grads = np.random.default_rng(3).normal(size=(total, len(starts)))
    for row, start in enumerate(starts):
        grads[:start, row] = 0
    ours = optimizer.scale_by_row_radam()
    state = zeros(ours, grads[0].astype(dtype))
    steps, update = [], jitted(ours.update)
    for grad in grads.astype(dtype):
        step, state = update(grad, state)
        steps.append(step)
    for row, start in enumerate(starts):
        mine = np.array(steps)[:, row]
        assert not mine[:start].any()
        expected = radam_alone(grads[start:, row])
        # A mean of slopes of both signs may cancel to a tenth of them.
        tolerance = {"float32": 2e-6, "float64": 1e-12}[dtype]
        np.testing.assert_allclose(mine[start:], expected, rtol=1e-4, atol=tolerance)
    assert state.count.tolist() == [total - start for start in starts]


@pytest.mark.hard_cases
def test_a_late_row_steps_as_if_it_were_alone(dtype):
    """The reference implementations start it 2.5 to 4.6 times too fast."""
    ours = optimizer.scale_by_row_adam()
    old = np.ones((2, 3), dtype)
    state = zeros(ours, old)

    def train(state):
        return jax.lax.fori_loop(
            0, 1000, lambda _, s: ours.update(jnp.asarray(old), s)[1], state
        )

    state = jax.tree.map(np.array, jax.jit(train)(state))
    for leaf in state:
        leaf[1] = 0
    shared = optax.scale_by_adam(eps=1e-15)
    trap = optax.ScaleByAdamState(np.int32(1000), state.first, state.second)
    too_large = []
    update, trapped = jax.jit(ours.update), jax.jit(shared.update)
    for _ in range(5):
        step, state = update(old, state)
        np.testing.assert_allclose(step, 1.0, rtol=2e-5)
        with lenient("standard"):
            step, trap = trapped(old, trap)
        too_large.append(float(np.asarray(step)[1, 0]))
    np.testing.assert_allclose(too_large, [2.52, 3.38, 3.94, 4.33, 4.61], rtol=0.01)


UPDATES = {name: jitted(ours().update) for name, (ours, _) in PAIRS.items()}


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("grad", [1e19, 1e21, np.nan, *full(1e30, np.inf)])
def test_a_slope_too_large_to_square_shows_and_spares_the_others(name, grad, dtype):
    """Divided by an infinite square, its row stands still; the loop looks for it."""
    ours = PAIRS[name][0]()
    grads = np.ones((3, 2), dtype)
    state, update = zeros(ours, grads), UPDATES[name]
    for _ in range(7):  # past RAdam's threshold
        _, state = update(grads, state)
    wild = grads.copy()
    wild[1, 0] = grad
    after = state
    for hit in (wild, grads, grads):
        usual, state = update(grads, state)
        step, after = update(hit, after)
        others = np.ones((3, 2), bool)
        others[1, 0] = False
        np.testing.assert_array_equal(step[others], usual[others])
        square = after.second[1, 0]
        assert np.isfinite(step[1, 0]) or not np.isfinite(square)
    huge = {"float32": 5e20, "float64": 1e150}[dtype]
    assert np.isfinite(square) == (grad < huge)


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", PAIRS)
def test_float32_stays_float32_where_x64_is_on(name):
    """NumPy's float64 among the coefficients would make the updates float64."""
    rule, grads = PAIRS[name][0](), {"w": np.ones((3, 2), np.float32)}
    with jax.enable_x64(True):
        shapes = jax.eval_shape(rule.update, grads, jax.eval_shape(rule.init, grads))
    kinds = {leaf.dtype.name for leaf in jax.tree.leaves(shapes)}
    assert kinds == {"float32", "int32"}


@pytest.mark.parametrize("name", ["adam", *full("radam")])
@pytest.mark.parametrize("narrow", [jnp.bfloat16, *full(jnp.float16)])
def test_parameters_that_small_steps_would_not_move_are_refused(name, narrow):
    """In bfloat16, 200 steps of 1e-3 leave a parameter of one where it was."""
    one, step = np.asarray([1, 1e-3], jnp.bfloat16)
    assert one - step == one
    params = rows_and_nets(COUNT)
    params.nets["w"] = put(params.nets["w"], narrow)
    message = f"nets.w is {jnp.dtype(narrow)}, .* train in float32"
    with pytest.raises(ValueError, match=message):
        PAIRS[name][0]().init(params)


@pytest.mark.parametrize("name", ["adam", *full("radam")])
def test_a_gather_moves_rows_with_their_moments_and_leaves_nets_alone(name):
    params, tx = rows_and_nets(COUNT), partitioned(PAIRS[name][0])
    moments = first_moments(tx, params, params)
    rows = np.asarray([5, 0, 0, 2, 1, 0, 0, 0])
    fresh, inactive = np.arange(8) == 2, np.arange(8) >= 5
    gathered, moved = gather(tx, params, moments, rows, fresh, inactive)
    expected = np.asarray(params.rows["code"])[rows]
    np.testing.assert_array_equal(gathered.rows["code"], expected)
    assert (gathered.rows["splats"].opacity_logit[5:] == INACTIVE_LOGIT).all()
    np.testing.assert_array_equal(gathered.nets["w"], params.nets["w"])

    by_kind = moved[1].inner_states
    before = moments[1].inner_states["mean"].inner_state[0]
    after = by_kind["mean"].inner_state[0]
    was, now = (x.first.rows["splats"].mean for x in (before, after))
    np.testing.assert_array_equal(now[[0, 1, 3, 4]], was[rows[[0, 1, 3, 4]]])
    assert not now[[2, 5, 6, 7]].any()
    assert list(after.count.rows["splats"].mean) == [1, 1, 0, 1, 1, 0, 0, 0]
    rest = by_kind["rest"].inner_state[0].second.rows
    assert rest["code"].shape == (8, 2)
    assert rest["splats"].sh_rest.shape == (8, 3, 3)
    same_bits(by_kind["nets"], moments[1].inner_states["nets"])
    with lenient("standard"):  # the state still fits the parameters
        jax.eval_shape(tx.update, gathered, moved, gathered)
