"""Relocation: the closed form, who moves where, the noise and the penalties."""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import rich.console
import scipy.special

from gaussians_jax.core import splats as rows
from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.optim import densification, mcmc, optimizer
from gaussians_jax.optim.mcmc import MCMCStrategySpec
from gaussians_jax.optim.phases import AlternationSpec
from gaussians_jax.scene import scene
from nerfies_jax import evaluation
from nerfies_jax.training import checkpoint, loop
from tests import gradients, scenes
from tests.gaussians.shared import (
    any_nonzero,
    jitted,
    put,
    rotations,
    same_bits,
    with_rows,
)

TX = optax.chain(optimizer.scale_by_row_adam(), optax.scale(-1e-2))
KEY = jax.random.key(3)
SPEC = MCMCStrategySpec()
QUIET = rich.console.Console(quiet=True)
# 200 points, and five events of 5 % up to the cap.
SCENE = dataclasses.replace(
    scenes.TINY_DEFORMABLE,
    strategy=MCMCStrategySpec(refine_every=4, refine_start_iter=4, cap_max=230),
)


@jax.jit
def first_moments(params):
    return TX.update(jax.tree.map(jnp.ones_like, params), TX.init(params))[1]


def make(opacity, dtype="float32"):
    rng, opacity = np.random.default_rng(0), np.asarray(opacity, float)
    count = len(opacity)
    splats = Splats(
        mean=rng.normal(size=(count, 3)),
        log_scale=rng.normal(size=(count, 3)) - 2,
        quaternion=rng.normal(size=(count, 4)),
        opacity_logit=np.log(opacity) - np.log1p(-opacity),
        sh_dc=rng.normal(size=(count, 1, 3)),
        sh_rest=np.zeros((count, 0, 3)),
    )
    params = put(Params({"splats": splats}, {}), dtype)
    return params, first_moments(params)


def opacity_of(splats):
    return scipy.special.expit(np.asarray(splats.opacity_logit, np.float64))


compute_relocation = jitted(mcmc.compute_relocation, static_argnums=3)


def spread(opacity, copies, dtype, least=1e-12):
    """Of each opacity over each number of copies: [opacities, copies] twice."""
    opacity, copies = (x.ravel() for x in np.meshgrid(opacity, copies, indexing="ij"))
    ones = np.ones((len(opacity), 3), dtype)
    each, scale = compute_relocation(
        opacity.astype(dtype), ones, np.int32(copies), least
    )
    return each.astype(float), scale[:, 0].astype(float)


def test_spreading_equals_the_reference_kernel(oracle_dir, dtype):
    with np.load(oracle_dir / "splatting" / "mcmc_relocation.npz") as oracle:
        names = {"opacities": dtype, "scales": dtype, "ratios": "int32"}
        inputs = (oracle[name].astype(kind) for name, kind in names.items())
        each, scale = compute_relocation(*inputs, 0.005)
        tolerance = {"float32": 3e-6, "float64": 2e-13}[dtype]
        np.testing.assert_allclose(each, oracle["new_opacities"], rtol=tolerance)
        np.testing.assert_allclose(scale, oracle["new_scales"], rtol=tolerance)
    assert each.dtype.name == scale.dtype.name == dtype


@pytest.mark.hard_cases
def test_spreading_equals_the_alternating_sum_in_high_precision(dtype):
    mpmath = pytest.importorskip("mpmath")
    opacities = np.asarray([1e-6, 0.006, 0.5, 0.999, 1 - 1e-6], dtype)
    copies, exact = [1, 2, 7, 51, 1000], []
    for opacity, count in itertools.product(opacities.tolist(), copies):
        with mpmath.workdps(400):
            share = 1 - mpmath.power(1 - mpmath.mpf(opacity), mpmath.mpf(1) / count)
            # The double sum of the paper, its inner index summed by the hockey-stick
            # rule.
            total = mpmath.fsum(
                mpmath.binomial(count, j) * (-1) ** (j - 1) * share**j / mpmath.sqrt(j)
                for j in range(1, count + 1)
            )
            exact.append((float(share), float(mpmath.mpf(opacity) / total)))
    each, scale = spread(opacities, copies, dtype)
    # float32: 1 - o of 1e-6 is itself known to 6e-2 only once o is rounded, which the
    # oracle shares; log1p and expm1 keep the rest.
    tolerance = {"float32": 2e-6, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(np.stack([each, scale], 1), exact, rtol=tolerance)


@pytest.mark.hard_cases
def test_spreading_the_invisible_and_the_opaque_is_finite(dtype):
    each, scale = spread([0.0, 1.0], [3], dtype, least=0.005)
    assert (each * 1.000001 >= 0.005).all()
    assert (each < 1).all()
    assert np.isfinite(scale).all()
    assert np.isfinite(np.log(each) - np.log1p(-each)).all()


def test_spreading_gradient(float64):
    def total(opacity, scale):
        each, spread_scale = mcmc.compute_relocation(
            jax.nn.sigmoid(opacity), scale, put([2, 5, 9], "int32"), 1e-9
        )
        return jnp.sum(each**2) + jnp.sum(spread_scale**2)

    rng = np.random.default_rng(0)
    opacity, scale = put(rng.normal(size=3)), put(rng.uniform(0.1, 1, (3, 3)))
    assert gradients.directional_error(total, opacity, scale) < 1e-8


def test_a_copy_and_its_source_composite_to_the_opacity_there_was(dtype):
    params, moments = make([0.9, 0.001, 0.002, 0.003], dtype)
    moved, after, report = mcmc.relocate(TX, params, moments, KEY, SPEC)
    assert report == densification.Report(relocated=3, active=4, capacity=4)
    splats = moved.rows["splats"]
    np.testing.assert_array_equal(
        splats.mean, np.tile(np.asarray(params.rows["splats"].mean)[0], (4, 1))
    )
    np.testing.assert_allclose(1 - np.prod(1 - opacity_of(splats)), 0.9, rtol=2e-6)
    before = np.asarray(params.rows["splats"].log_scale[:1])
    scale = np.exp(np.asarray(splats.log_scale) - before)
    np.testing.assert_allclose(scale, spread([0.9], [4], "float32")[1][0], rtol=1e-5)
    assert not np.asarray(after[0].count.rows["splats"].mean).any()


def test_sources_are_drawn_in_proportion_to_their_opacity():
    params, moments = make([0.8, 0.4, 0.2] + [0.001] * 4000)
    moved, _, report = mcmc.relocate(TX, params, moments, KEY, SPEC)
    assert report.relocated == 4000
    mean = np.asarray(moved.rows["splats"].mean)
    share = [(mean[3:] == mean[i]).all(axis=1).mean() for i in range(3)]
    np.testing.assert_allclose(share, [4 / 7, 2 / 7, 1 / 7], atol=0.03)


def test_untouched_rows_keep_their_bits_and_moments():
    params, moments = make([0.9, 0.8, 0.7, 0.001])
    moved, after, _ = mcmc.relocate(TX, params, moments, KEY, SPEC)
    untouched = np.asarray(after[0].count.rows["splats"].mean) == 1
    assert untouched.sum() == 2
    for now, before in zip(moved.rows["splats"], params.rows["splats"], strict=True):
        np.testing.assert_array_equal(
            np.asarray(now)[untouched], np.asarray(before)[untouched]
        )


@pytest.mark.hard_cases
def test_nothing_faint_and_nothing_visible():
    params, moments = make([0.5, 0.6])
    same, _, report = mcmc.relocate(TX, params, moments, KEY, SPEC)
    assert report.relocated == 0
    assert same is params
    params, moments = make([0.001, 0.002])
    same, _, report = mcmc.relocate(TX, params, moments, KEY, SPEC)
    assert report.refused == 2
    assert same is params


@pytest.mark.hard_cases
@pytest.mark.parametrize("leaf", ["mean", "opacity_logit"])
def test_a_row_that_is_not_finite_becomes_a_copy_and_is_counted(leaf):
    params, moments = make(np.full(20, 0.3))
    rows = params.rows["splats"]
    broken = rows._replace(**{leaf: getattr(rows, leaf).at[3].set(np.nan)})
    params = params._replace(rows={"splats": broken})
    params, moments, report = mcmc.refine(TX, params, moments, KEY, SPEC)
    assert (report.broken, report.relocated, report.cloned) == (1, 1, 1)
    assert report.active == 21
    for part in jax.tree.leaves(params):
        assert np.isfinite(part).all()


def test_adding_grows_by_a_twentieth_into_the_inactive_rows_and_stops_at_the_cap():
    params, moments = make(np.full(100, 0.3))
    params, moments, report = mcmc.add(TX, params, moments, KEY, SPEC)
    assert report == densification.Report(cloned=5, active=105, capacity=256)
    splats = params.rows["splats"]
    assert np.asarray(rows.active_mask(splats)).sum() == 105
    opacity = opacity_of(splats)
    # However they were shared out, all of them together hide what 100 of 0.3 did.
    np.testing.assert_allclose(np.log1p(-opacity).sum(), 100 * np.log(0.7), rtol=1e-5)
    capped = MCMCStrategySpec(cap_max=107)
    params, moments, report = mcmc.add(TX, params, moments, KEY, capped)
    assert report == densification.Report(cloned=2, refused=3, active=107, capacity=256)
    _, _, report = mcmc.add(TX, params, moments, KEY, capped)
    assert report == densification.Report(refused=5, active=107, capacity=256)


def test_noise_has_the_covariance_squared_and_spares_the_opaque(dtype):
    params = make([0.001], dtype)[0]
    splats = jax.tree.map(lambda x: np.repeat(x, 800, axis=0), params.rows["splats"])
    shake = jitted(mcmc.position_noise, static_argnums=3)
    noise = shake(KEY, splats, 1e-6, SPEC)
    assert noise.dtype.name == dtype
    turn = rotations(splats.quaternion[0]).as_matrix()
    variance = np.exp(2 * splats.log_scale[0].astype(float))
    strength = 0.5 / (1 + math.exp(100 * (0.001 - 0.005)))
    # R S² Rᵀ of a standard normal draw: through R for Rᵀ it would be distributed alike.
    covariance = turn * variance @ turn.T
    normal = np.asarray(jax.random.normal(KEY, noise.shape, dtype), np.float64)
    np.testing.assert_allclose(noise, strength * normal @ covariance, atol=1e-6)

    logit = np.repeat([0.0, -6.0, rows.INACTIVE_LOGIT], [400, 200, 200]).astype(dtype)
    noise = np.abs(shake(KEY, splats._replace(opacity_logit=logit), 1e-6, SPEC))
    assert noise[:400].max() < 1e-18
    assert noise[400:600].max() > 1e-5
    assert not noise[600:].any()


def test_penalty_counts_active_rows_only(dtype):
    params, _ = make([0.5, 0.25, 0.9], dtype)
    penalty = jitted(jax.value_and_grad(mcmc.penalty), static_argnums=1)
    logit = np.array(params.rows["splats"].opacity_logit)
    logit[2] = rows.INACTIVE_LOGIT
    splats = params.rows["splats"]._replace(opacity_logit=logit)
    expected = 0.01 * 0.375 + 0.01 * np.exp(np.asarray(splats.log_scale)[:2]).mean()
    value, grads = penalty(splats, SPEC)
    np.testing.assert_allclose(value, expected, rtol=1e-6)
    assert not any(leaf[2].any() for leaf in grads)
    none = splats._replace(opacity_logit=np.full_like(logit, rows.INACTIVE_LOGIT))
    assert not any_nonzero(penalty(none, SPEC))


def test_penalty_gradient(float64):
    splats = make([0.5, 0.25, 0.9], "float64")[0].rows["splats"]
    error = gradients.directional_error(lambda s: mcmc.penalty(s, SPEC), splats)
    assert error < 1e-7


@functools.cache
def built(spec):
    capture = scenes.tiny_capture()
    model = scene.build(spec, scene.metadata_of(capture))
    return model, model.init(capture, jax.random.key(3)), evaluation.frames_of(capture)


def train(state, steps, **settings):
    model, _, frames = built(SCENE)
    return loop.fit(model, state, frames, steps=steps, console=QUIET, **settings).state


def test_the_event_of_a_scene_adds_rows_and_makes_effects_look_again():
    model, state, frames = built(SCENE)
    (event,) = model.events
    assert event.steps[0] == 4
    after = event.apply(state, frames)
    assert model.counts(after)["gaussians"] == 210
    assert jax.tree.structure(after) == jax.tree.structure(state)


@pytest.mark.full
def test_a_moving_scene_grows_to_the_cap_and_resumes_bit_for_bit(tmp_path):
    model, first, _ = built(SCENE)
    straight = train(first, 22)
    splats = straight.params.rows["splats"]
    assert model.counts(first)["gaussians"] == 200
    assert model.counts(straight)["gaussians"] == len(splats.mean) == 230
    for leaf in jax.tree.leaves(straight.params):
        assert np.isfinite(leaf).all()
    # Stopped between two events, of which the later one draws anew where rows go.
    with checkpoint.Checkpoints(tmp_path, model.spec) as checkpoints:
        train(first, 14, checkpoints=checkpoints)
    restored = checkpoint.restore(tmp_path, first, model.spec)
    again = train(restored.state, 22)
    same_bits(again._replace(key=0), straight._replace(key=0))


@pytest.mark.full
def test_a_step_shakes_the_means_and_nothing_else():
    spec = dataclasses.replace(SCENE, alternation=AlternationSpec(1, 3, nets=1))

    def stepped(spec, **changed):
        plan = dataclasses.replace(SCENE.strategy, **changed)
        model, state, frames = built(dataclasses.replace(spec, strategy=plan))
        # Opacities of 0.0067, near the threshold: at 0.1 there is next to no noise.
        splats = state.params.rows["splats"]
        logit = np.where(rows.active_mask(splats), -5.0, splats.opacity_logit)
        logit = put(logit, "float32")
        state = state._replace(params=with_rows(state.params, opacity_logit=logit))
        step = jax.jit(model.step)
        once, metrics = step(state, frames)
        return once, step(once, frames)[0], metrics

    noisy, held, metrics = stepped(spec)
    still, _, unpaid = stepped(spec, noise_lr=0.0)
    shift = np.abs(noisy.params.rows["splats"].mean - still.params.rows["splats"].mean)
    active = np.asarray(rows.active_mask(still.params.rows["splats"]))
    assert (shift[active] > 0).any(axis=1).all()
    assert not shift[~active].any()
    quiet = noisy.params.rows["splats"]._replace(mean=still.params.rows["splats"].mean)
    same_bits(quiet, still.params.rows["splats"])
    same_bits(noisy.optimizer, still.optimizer)
    assert metrics["mcmc/penalty"] == unpaid["mcmc/penalty"] > 0
    # The second step is the networks' turn: the rows stay where they are.
    same_bits(held.params.rows, noisy.params.rows)
