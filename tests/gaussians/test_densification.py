"""Clone, split, prune, reset: what happens to rows, moments and the count."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gaussians_jax import densification, optimiser
from gaussians_jax import splats as rows
from gaussians_jax.densification import DefaultStrategySpec
from gaussians_jax.splats import Params, Splats

EXTENT = 2.0  # so that 0.02 separates small from large
KEY = jax.random.key(0)
TX = optax.chain(optimiser.scale_by_row_adam(), optax.scale(-1e-2))


@jax.jit
def first_state(params):
    _, moments = TX.update(jax.tree.map(jnp.ones_like, params), TX.init(params))
    return params, moments, densification.empty_stats(params.rows["splats"])


def make(count, dtype="float32", scale=0.01, opacity=0.5):
    """`count` active rows, one tell-tale parameter each, with moments."""
    rng = np.random.default_rng(count)
    splats = Splats(
        mean=rng.normal(size=(count, 3)),
        log_scale=np.full((count, 3), math.log(scale)),
        quaternion=rng.normal(size=(count, 4)),
        opacity_logit=np.full(count, math.log(opacity / (1 - opacity))),
        sh_dc=np.zeros((count, 1, 3)),
        sh_rest=np.zeros((count, 3, 3)),
    )
    label = np.arange(count)[:, None]
    params = Params({"splats": splats, "label": label}, {"w": np.ones((4, 4))})
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), params)
    return first_state(params)


def hot(stats, which, gradient=1.0):
    grads, views = np.array(stats.grad2d), np.array(stats.views)
    grads[which], views[which] = gradient, 1
    return stats._replace(grad2d=jnp.asarray(grads), views=jnp.asarray(views))


def run(params, moments, stats, spec=None, step=600):
    spec = spec or DefaultStrategySpec()
    return densification.densify(
        TX, params, moments, stats, KEY, spec, step=step, extent=EXTENT
    )


observe = jax.jit(densification.observe, static_argnums=4)


def labels(changed):
    active = np.asarray(changed.stats.active)
    return np.asarray(changed.params.rows["label"])[active, 0].astype(int).tolist()


def counts(changed):
    return np.asarray(changed.moments[0].count.rows["label"])[: changed.report.active]


def test_observe_counts_visible_views_in_ndc_units(dtype):
    _, _, stats = make(3, dtype)
    gradient = jnp.asarray([[3e-4, 0], [0, 4e-4], [5.0, 5.0]], dtype)
    visible = jnp.asarray([True, True, False])
    radius = jnp.asarray([2, 9, 90], dtype)
    for _ in range(2):
        stats = densification.observe(stats, gradient, visible, radius, (64, 48))
    np.testing.assert_allclose(stats.grad2d, [6e-4 * 32, 8e-4 * 24, 0], rtol=1e-6)
    assert list(stats.views) == [2, 2, 0]
    assert list(stats.radius_px) == [2, 9, 0]
    assert stats.grad2d.dtype.name == dtype


@pytest.mark.hard_cases
def test_tiny_slopes_are_not_lost_to_their_squares(dtype):
    _, _, stats = make(1, dtype)
    gradient = np.full((1, 2), 1e-25, dtype)
    stats = observe(stats, gradient, np.ones(1, bool), np.ones(1, dtype), (2, 2))
    np.testing.assert_allclose(stats.grad2d, math.sqrt(2) * 1e-25, rtol=1e-6)


@pytest.mark.full
@pytest.mark.hard_cases
def test_invisible_rows_may_have_slopes_that_are_not_finite():
    _, _, stats = make(2)
    gradient = np.float32([[1, 0], [np.nan, 0]])
    visible = np.array([True, False])
    stats = observe(stats, gradient, visible, np.ones(2, np.float32), (2, 2))
    assert stats.grad2d.tolist() == [1, 0]


def test_a_small_row_is_cloned_and_its_clone_starts_without_moments(dtype):
    params, moments, stats = make(5, dtype)
    changed = run(params, moments, hot(stats, [2]))
    report = changed.report
    assert report == densification.Report(cloned=1, active=6, capacity=256)
    assert labels(changed) == [0, 1, 2, 3, 4, 2]
    np.testing.assert_array_equal(
        changed.params.rows["splats"].mean[5], params.rows["splats"].mean[2]
    )
    assert list(counts(changed)) == [1, 1, 1, 1, 1, 0]
    first = changed.moments[0].first.rows["splats"].mean
    assert np.asarray(first[:5]).all()
    assert not np.asarray(first[5:]).any()
    np.testing.assert_allclose(changed.moments[0].first.nets["w"], 0.1, rtol=1e-6)
    assert all(leaf.shape[0] == 256 for leaf in jax.tree.leaves(changed.params.rows))


def test_a_large_row_becomes_two_that_are_drawn_from_it():
    params, moments, stats = make(3, scale=0.1)
    params = rows.take_rows(params, jnp.ones(4000, int))
    moments = TX.init(params)
    stats = densification.empty_stats(params.rows["splats"])
    stretched = params.rows["splats"]._replace(
        log_scale=jnp.tile(jnp.log(jnp.asarray([0.3, 0.1, 0.05])), (4000, 1))
    )
    params = params._replace(rows=params.rows | {"splats": stretched})
    changed = run(params, moments, hot(stats, np.arange(4000)))
    assert changed.report.split == 4000
    assert changed.report.active == 8000
    child = changed.params.rows["splats"]
    np.testing.assert_allclose(
        np.exp(child.log_scale[:8000]),
        [[0.3 / 1.6, 0.1 / 1.6, 0.05 / 1.6]] * 8000,
        1e-5,
    )
    offset = np.asarray(child.mean[:8000] - stretched.mean[0], np.float64)
    w, x, y, z = np.asarray(stretched.quaternion[0], np.float64) / np.linalg.norm(
        stretched.quaternion[0]
    )
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    # Standard error of a variance over 8000 draws: 1.6 %.
    spread = np.cov(offset @ turn, rowvar=False)
    np.testing.assert_allclose(np.diag(spread), [0.09, 0.01, 0.0025], rtol=0.07)
    np.testing.assert_allclose(spread - np.diag(np.diag(spread)), 0, atol=1.5e-3)
    assert not counts(changed).any()


def test_faint_rows_go_and_the_rest_close_up():
    params, moments, stats = make(5)
    logit = params.rows["splats"].opacity_logit.at[jnp.asarray([0, 3])].set(-6.0)
    splats = params.rows["splats"]._replace(opacity_logit=logit)
    params = params._replace(rows=params.rows | {"splats": splats})
    changed = run(params, moments, hot(stats, [3]))
    assert labels(changed) == [1, 2, 4]
    assert changed.report.pruned == 2
    assert changed.report.cloned == 0


def test_large_rows_go_only_after_the_first_reset():
    params, moments, stats = make(4, scale=0.25)
    small = params.rows["splats"].log_scale.at[1].set(math.log(0.01))
    splats = params.rows["splats"]._replace(log_scale=small)
    params = params._replace(rows=params.rows | {"splats": splats})
    assert labels(run(params, moments, stats, step=3000)) == [0, 1, 2, 3]
    late = run(params, moments, hot(stats, [2]), step=3100)
    # Row 2 splits: its children have 0.25 / 1.6 = 0.156 of an allowed 0.2.
    assert labels(late) == [1, 2, 2]
    assert late.report.pruned == 2


def test_rows_wide_on_the_screen_go_where_asked():
    params, moments, stats = make(3)
    stats = stats._replace(radius_px=jnp.asarray([1.0, 30.0, 5.0]))
    assert run(params, moments, stats, step=5000).report.pruned == 0
    spec = DefaultStrategySpec(prune_radius_px=20.0)
    assert labels(run(params, moments, stats, spec, step=5000)) == [0, 2]


@pytest.mark.hard_cases
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_rows_that_are_not_finite_are_pruned_and_counted(value):
    params, moments, stats = make(4)
    splats = params.rows["splats"]
    mean = np.array(splats.mean)
    mean[2, 0] = value
    splats = splats._replace(mean=jnp.asarray(mean))
    params = params._replace(rows=params.rows | {"splats": splats})
    stats = hot(hot(stats, [1]), [2], value)
    changed = run(params, moments, stats)
    assert labels(changed) == [0, 1, 3, 1]
    assert changed.report.broken == 1
    assert changed.report.pruned == 0
    assert np.isfinite(changed.params.rows["splats"].mean).all()


def test_the_cap_takes_the_largest_gradients_and_says_who_was_refused():
    params, moments, stats = make(6)
    stats = stats._replace(
        grad2d=jnp.asarray([1.0, 5, 2, 4, 3, 0]), views=jnp.full(6, 2)
    )
    changed = run(params, moments, stats, DefaultStrategySpec(cap_max=8))
    assert labels(changed) == [0, 1, 2, 3, 4, 5, 1, 3]
    assert changed.report == densification.Report(
        cloned=2, refused=3, active=8, capacity=8
    )
    again = run(*changed[:2], hot(changed.stats, [0]), DefaultStrategySpec(cap_max=8))
    assert again.report == densification.Report(refused=1, active=8, capacity=8)


@pytest.mark.full
def test_capacity_grows_in_buckets_and_does_not_waver():
    params, moments, stats = make(200)
    changed = run(params, moments, hot(stats, np.arange(100)))
    assert changed.report.capacity == 512
    stats = changed.stats._replace(
        active=changed.stats.active & (jnp.arange(512) < 240)
    )
    changed = run(*changed[:2], stats)
    assert changed.report.capacity == 512  # 256 would do
    stats = changed.stats._replace(
        active=changed.stats.active & (jnp.arange(512) < 200)
    )
    assert run(*changed[:2], stats).report.capacity == 256


@pytest.mark.full
@pytest.mark.hard_cases
def test_one_gaussian_and_none():
    params, moments, stats = make(1)
    changed = run(params, moments, hot(stats, [0]))
    assert labels(changed) == [0, 0]
    gone = changed.stats._replace(active=jnp.zeros(256, bool))
    changed = run(*changed[:2], gone)
    assert changed.report.active == 0
    assert not np.asarray(rows.active_mask(changed.params.rows["splats"])).any()
    assert run(*changed[:3]).report.active == 0


@pytest.mark.full
def test_the_same_key_gives_the_same_rows():
    params, moments, stats = make(3, scale=0.1)
    first, second = (run(params, moments, hot(stats, [0, 1])) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_a_revised_clone_and_its_source_hide_what_one_did(dtype):
    params, moments, stats = make(3, dtype, opacity=0.8)
    changed = run(
        params, moments, hot(stats, [1]), DefaultStrategySpec(revised_opacity=True)
    )
    opacity = np.asarray(rows.activate(changed.params.rows["splats"]).opacity)[:4]
    half = 1 - math.sqrt(0.2)
    np.testing.assert_allclose(opacity, [0.8, half, 0.8, half], rtol=1e-6)


halve_opacity = jax.jit(lambda logit: densification.halve_opacity(logit[None])[0])


@pytest.mark.hard_cases
@pytest.mark.parametrize("logit", [-30.0, -1.0, 0.0, 8.0, 17.0, 40.0, 100.0])
def test_halved_opacity_is_right_where_the_opacity_saturates(logit, dtype):
    mpmath = pytest.importorskip("mpmath")
    with mpmath.workdps(120):
        clear = 1 / (1 + mpmath.exp(mpmath.mpf(logit)))
        exact = mpmath.log((1 - mpmath.sqrt(clear)) / mpmath.sqrt(clear))
    result = halve_opacity(np.asarray(logit, dtype))
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    assert abs(float(result) - float(exact)) < tolerance * max(1, abs(float(exact)))


def test_a_reset_lowers_opacities_and_forgets_their_moments_only(dtype):
    params, moments, _ = make(4, dtype)
    logit = jnp.asarray([3.0, -6.0, rows.INACTIVE_LOGIT, 0.1], dtype)
    splats = params.rows["splats"]._replace(opacity_logit=logit)
    params = params._replace(rows=params.rows | {"splats": splats})
    lowered, after = densification.reset_opacity(
        TX, params, moments, DefaultStrategySpec()
    )
    opacity = np.asarray(rows.activate(lowered.rows["splats"]).opacity)
    np.testing.assert_allclose(opacity, [0.01, 1 / (1 + math.exp(6)), 0, 0.01], 1e-6)
    assert list(rows.active_mask(lowered.rows["splats"])) == [True, True, False, True]
    assert not np.asarray(after[0].first.rows["splats"].opacity_logit).any()
    assert not np.asarray(after[0].count.rows["splats"].opacity_logit).any()
    kept = after[0].first.rows["splats"]._replace(opacity_logit=None)
    was = moments[0].first.rows["splats"]._replace(opacity_logit=None)
    jax.tree.map(np.testing.assert_array_equal, kept, was)
