"""Clone, split, prune, reset: what happens to rows, moments and the count."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gaussians_jax.core import splats as rows
from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.optim import densification, optimizer
from gaussians_jax.optim.densification import DefaultStrategySpec
from tests.gaussians.shared import full, put, rotations, same_bits, with_rows

EXTENT = 2.0  # so that 0.02 separates small from large
KEY = jax.random.key(0)
TX = optax.chain(optimizer.scale_by_row_adam(), optax.scale(-1e-2))


@jax.jit
def first_state(params):
    _, moments = TX.update(jax.tree.map(jnp.ones_like, params), TX.init(params))
    return params, moments, densification.empty_stats(params.rows["splats"])


def make(count=6, dtype="float32", scale=0.01, opacity=0.5, **leaves):
    """`count` active rows, one tell-tale parameter each, with moments."""
    rng = np.random.default_rng(count)
    splats = Splats(
        mean=rng.normal(size=(count, 3)),
        log_scale=np.full((count, 3), math.log(scale)),
        quaternion=rng.normal(size=(count, 4)),
        opacity_logit=np.full(count, math.log(opacity / (1 - opacity))),
        sh_dc=np.zeros((count, 1, 3)),
        sh_rest=np.zeros((count, 3, 3)),
    )._replace(**leaves)
    label = np.arange(count)[:, None]
    params = Params({"splats": splats, "label": label}, {"w": np.ones((4, 4))})
    return first_state(put(params, dtype))


def hot(stats, which, gradient=1.0):
    grads, views = np.array(stats.grad2d), np.array(stats.views)
    grads[which], views[which] = gradient, 1
    return stats._replace(grad2d=put(grads), views=put(views))


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
    """Also slopes whose squares underflow; those of the invisible may be anything."""
    stats = make(dtype=dtype)[2]
    gradient = np.full((6, 2), np.nan, dtype)
    gradient[:3] = [[3e-4, 0], [0, 4e-4], [3e-25, 3e-25]]
    visible = np.arange(6) < 3
    radius = np.asarray([2, 9, 4, 90, 90, 90], dtype)
    for _ in range(2):
        stats = observe(stats, gradient, visible, radius, (64, 48))
    tiny = 6e-25 * math.hypot(32, 24)
    expected = [6e-4 * 32, 8e-4 * 24, tiny, 0, 0, 0]
    np.testing.assert_allclose(stats.grad2d, expected, rtol=1e-6)
    assert stats.views.tolist() == [2, 2, 2, 0, 0, 0]
    assert stats.radius_px.tolist() == [2, 9, 4, 0, 0, 0]
    assert stats.grad2d.dtype.name == dtype


@pytest.mark.parametrize(("active", "capacity"), [(200, 256), (500, 1024)])
def test_buckets_shrink_once_less_than_four_ninths_are_in_use(active, capacity):
    logit = np.where(np.arange(1024) < active, 0.0, rows.INACTIVE_LOGIT)
    changed = run(*make(1024, opacity_logit=logit))
    assert changed.report == densification.Report(active=active, capacity=capacity)


def test_a_small_row_is_cloned_and_its_clone_starts_without_moments(dtype):
    params, moments, stats = make(dtype=dtype)
    changed = run(params, moments, hot(stats, [2]))
    report = changed.report
    assert report == densification.Report(cloned=1, active=7, capacity=256)
    assert labels(changed) == [0, 1, 2, 3, 4, 5, 2]
    now, before = (np.asarray(x.rows["splats"].mean) for x in (changed.params, params))
    np.testing.assert_array_equal(now[6], before[2])
    assert list(counts(changed)) == [1, 1, 1, 1, 1, 1, 0]
    first = np.asarray(changed.moments[0].first.rows["splats"].mean)
    assert first[:6].all()
    assert not first[6:].any()
    np.testing.assert_allclose(changed.moments[0].first.nets["w"], 0.1, rtol=1e-6)
    assert all(leaf.shape[0] == 256 for leaf in jax.tree.leaves(changed.params.rows))


def test_a_large_row_becomes_two_that_are_drawn_from_it(rng):
    """And the same two from the same key."""
    mean, quaternion, scale = rng.normal(size=3), rng.normal(size=4), [0.3, 0.1, 0.05]
    params, moments, stats = make(
        4000,
        mean=np.tile(mean, (4000, 1)),
        quaternion=np.tile(quaternion, (4000, 1)),
        log_scale=np.tile(np.log(scale), (4000, 1)),
    )
    stats = hot(stats, np.arange(4000))
    changed = run(params, moments, stats)
    assert changed.report.split == 4000
    assert changed.report.active == 8000
    child = jax.tree.map(lambda leaf: np.asarray(leaf)[:8000], changed.params).rows
    scales = np.exp(child["splats"].log_scale)
    np.testing.assert_allclose(scales, np.tile(scale, (8000, 1)) / 1.6, 1e-5)
    turn = rotations(quaternion).as_matrix()
    # Standard error of a variance over 8000 draws: 1.6 %.
    spread = np.cov((child["splats"].mean - mean) @ turn, rowvar=False)
    np.testing.assert_allclose(np.diag(spread), [0.09, 0.01, 0.0025], rtol=0.07)
    np.testing.assert_allclose(spread - np.diag(np.diag(spread)), 0, atol=1.5e-3)
    assert not counts(changed).any()
    same_bits(run(params, moments, stats), changed)


def test_faint_rows_go_and_the_rest_close_up():
    logit = np.asarray([-6.0, 0, 0, -6, 0, 0])
    params, moments, stats = make(opacity_logit=logit)
    changed = run(params, moments, hot(stats, [3]))
    assert labels(changed) == [1, 2, 4, 5]
    assert changed.report.pruned == 2
    assert changed.report.cloned == 0


def test_large_rows_go_only_after_the_first_reset():
    scale = np.full((6, 3), 0.25)
    scale[[1, 4, 5]] = 0.01
    params, moments, stats = make(log_scale=np.log(scale))
    assert labels(run(params, moments, stats, step=3000)) == [0, 1, 2, 3, 4, 5]
    late = run(params, moments, hot(stats, [2]), step=3100)
    # Row 2 splits: its children have 0.25 / 1.6 = 0.156 of an allowed 0.2.
    assert labels(late) == [1, 4, 5, 2, 2]
    assert late.report.pruned == 2


def test_rows_wide_on_the_screen_go_where_asked():
    params, moments, stats = make()
    stats = stats._replace(radius_px=put([1, 30, 5, 1, 1, 21], "float32"))
    assert run(params, moments, stats, step=5000).report.pruned == 0
    spec = DefaultStrategySpec(prune_radius_px=20.0)
    assert labels(run(params, moments, stats, spec, step=5000)) == [0, 2, 3, 4]


@pytest.mark.hard_cases
@pytest.mark.parametrize("value", [math.nan, *full(math.inf)])
def test_rows_that_are_not_finite_are_pruned_and_counted(value):
    mean = np.ones((6, 3))
    mean[2, 0] = value
    params, moments, stats = make(mean=mean)
    stats = hot(hot(stats, [1]), [2], value)
    changed = run(params, moments, stats)
    assert labels(changed) == [0, 1, 3, 4, 5, 1]
    assert changed.report.broken == 1
    assert changed.report.pruned == 0
    assert np.isfinite(changed.params.rows["splats"].mean).all()


def test_the_cap_takes_the_largest_gradients_and_says_who_was_refused():
    params, moments, stats = make()
    grads = put([1.0, 5, 2, 4, 3, 0], "float32")
    stats = stats._replace(grad2d=grads, views=put(np.full(6, 2), "int32"))
    changed = run(params, moments, stats, DefaultStrategySpec(cap_max=8))
    assert labels(changed) == [0, 1, 2, 3, 4, 5, 1, 3]
    assert changed.report == densification.Report(
        cloned=2, refused=3, active=8, capacity=8
    )
    again = run(*changed[:2], hot(changed.stats, [0]), DefaultStrategySpec(cap_max=8))
    assert again.report == densification.Report(refused=1, active=8, capacity=8)


def test_what_is_too_large_goes_where_the_cap_keeps_it_from_being_split():
    spec = DefaultStrategySpec(cap_max=6, prune_scale3d=0.1)
    params, moments, stats = make(scale=0.15 * EXTENT)
    stats = hot(stats, [1, 4])
    changed = run(params, moments, stats, spec, step=spec.reset_every + 1)
    assert (changed.report.split, changed.report.pruned) == (2, 4)
    full = DefaultStrategySpec(cap_max=3, prune_scale3d=0.1)
    params, moments, stats = make(count=3, scale=0.15 * EXTENT)
    changed = run(params, moments, hot(stats, [0, 1, 2]), full, full.reset_every + 1)
    assert (changed.report.refused, changed.report.pruned) == (3, 3)


def test_a_revised_clone_and_its_source_hide_what_one_did(dtype):
    params, moments, stats = make(dtype=dtype, opacity=0.8)
    changed = run(
        params, moments, hot(stats, [1]), DefaultStrategySpec(revised_opacity=True)
    )
    logit = np.asarray(changed.params.rows["splats"].opacity_logit, np.float64)[:7]
    half = 1 - math.sqrt(0.2)
    expected = [0.8, half, *[0.8] * 4, half]
    np.testing.assert_allclose(1 / (1 + np.exp(-logit)), expected, rtol=1e-6)


def test_a_reset_lowers_opacities_and_forgets_their_moments_only(dtype):
    params, moments, _ = make(dtype=dtype)
    logit = np.asarray([3.0, -6.0, rows.INACTIVE_LOGIT, 0.1, 0.1, 0.1], dtype)
    reset = jax.jit(densification.reset_opacity, static_argnums=(0, 3))
    params = with_rows(params, opacity_logit=logit)
    lowered, after = reset(TX, params, moments, DefaultStrategySpec())
    least = math.log(0.01 / 0.99)
    expected = [least, -6.0, rows.INACTIVE_LOGIT, least, least, least]
    logits = lowered.rows["splats"].opacity_logit
    np.testing.assert_allclose(logits, np.asarray(expected, dtype), 1e-6)
    assert not np.asarray(after[0].first.rows["splats"].opacity_logit).any()
    assert not np.asarray(after[0].count.rows["splats"].opacity_logit).any()
    others = after[0].first.rows["splats"]._replace(opacity_logit=None)
    was = moments[0].first.rows["splats"]._replace(opacity_logit=None)
    jax.tree.map(np.testing.assert_array_equal, others, was)
