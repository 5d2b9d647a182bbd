"""Anchors, and the features all is made of: against loops in NumPy, SciPy's law."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation

from gaussians_jax import representation
from gaussians_jax.core import splats
from gaussians_jax.core.splats import Gaussians, Params
from gaussians_jax.init.points import InitSpec
from gaussians_jax.motion import anchor_motion, anchors
from gaussians_jax.motion.anchors import AnchorMotionSpec, RateSpec
from gaussians_jax.scene import scene, variants
from nerfies_jax import evaluation
from nerfies_jax.nn import entropy
from nerfies_jax.training import loop
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from tests import scenes
from tests.gaussians import bound
from tests.gaussians.shared import jitted, put, rotations, rows_of, some_gaussians
from tests.gradients import directional_error

ROWS, EACH, FRAMES, NAME = 4, 3, 6, anchor_motion.NAME
SPEC = AnchorMotionSpec(
    count=EACH,
    reference=3,
    residual=4,
    time_code=2,
    width=5,
    make_width=5,
    rate=RateSpec(start=10, width=4),
    warm_up=0,
)
EXACT = {"float32": 1e-5, "float64": 1e-12}


@functools.cache
def effect():
    return bound.record(SPEC, frames=FRAMES)


def params_of(dtype, size=0.5):
    rows = rows_of(some_gaussians(ROWS, dtype), opacity_logit=0.3)
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(
        lambda key: tuple(effect().init(key, rows)), jax.random.key(0)
    )
    own, net = put(
        jax.tree.map(lambda leaf: size * rng.normal(size=leaf.shape), shapes), dtype
    )
    return Params({"splats": rows, NAME: own}, {NAME: net})


def host(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf).astype(float), tree)


def network(net, reads):
    """A network of ReLU layers by hand, each head by its name."""
    for layer in net.hidden:
        reads = np.maximum(reads @ layer.weight + layer.bias, 0)
    return {name: reads @ one.weight + one.bias for name, one in net.heads.items()}


def rounded(value, mean, step):
    return mean + step * np.round((value - mean) / step)


def kept_by_hand(own, law):
    """Features as whole steps from their means, and the bits of all of them."""
    step, residual_step = np.exp(law.log_step), np.exp(law.residual_log_step)
    reference, residual, bits = [], [], np.zeros(ROWS)
    for n in range(ROWS):
        one = rounded(own.reference[n], law.mean, step)
        made = network(law.context, one)
        mean, wide = (made[x].reshape(EACH, 4) for x in ("mean", "log_scale"))
        others = rounded(own.residual[n], mean, residual_step)
        for value, middle, log_scale, width in (
            (one, law.mean, law.log_scale, step),
            (others, mean, wide, residual_step),
        ):
            normal = scipy.stats.norm(middle, np.exp(log_scale))
            share = normal.cdf(value + width / 2) - normal.cdf(value - width / 2)
            bits[n] -= np.log2(share).sum()
        reference.append(one)
        residual.append(others)
    return np.array(reference), np.array(residual), bits


def code_at(times, time):
    return [np.interp(time, np.linspace(0, 1, len(times)), one) for one in times.T]


def turn_of(wxyz):
    return Rotation.from_quat(np.roll(wxyz, -1))


def drawn_by_hand(params, time):
    """Mean, rotation, scale, opacity and color of each, in float64."""
    rows, net = params.rows["splats"], params.nets[NAME]
    reference, residual, _ = kept_by_hand(params.rows[NAME], net.law)
    code, children = code_at(net.times, time), []
    for n in range(ROWS):
        moved = network(net.coarse, np.concatenate([reference[n], code]))
        core = Rotation.from_rotvec(moved["turn"]) * turn_of(rows.quaternion[n])
        mean = rows.mean[n] + moved["position"]
        scale = np.exp(rows.log_scale[n] + moved["log_scale"])
        for k in range(EACH):
            first, second = residual[n, k, :2], residual[n, k, 2:]
            made = network(net.make, np.concatenate([reference[n], first]))
            fine = network(net.fine, np.concatenate([second, code]))
            turns = (Rotation.from_rotvec(x["turn"]) for x in (fine, made))
            away = scale * (made["offset"] + fine["position"])
            logit = rows.opacity_logit[n] + made["opacity_logit"][0]
            grown = made["log_scale"] + fine["log_scale"] + np.log(SPEC.first_scale)
            children.append(
                (
                    mean + core.apply(away),
                    functools.reduce(Rotation.__mul__, turns, core),
                    scale * np.exp(grown),
                    1 / (1 + np.exp(-logit)),
                    rows.sh_dc[n, 0] + made["sh_dc"],
                )
            )
    return [*zip(*children, strict=True)]


@pytest.mark.parametrize("time", [0.0, 0.7])
def test_all_is_made_of_features_as_they_are_kept(time, dtype):
    params = params_of(dtype)

    def run(params, time):
        derived = effect().derive_rows(params, None)
        condition = FrameCondition(time)
        still = splats.activate(params.rows["splats"])
        rows = effect().deform(params, still, condition, None)
        return derived[0].sh_dc[:, 0], effect().derive(params, derived, rows, condition)

    color, actual = jitted(run)(params, put(time, dtype))
    *expected, colors = drawn_by_hand(host(params), time)
    for leaf, by_hand in zip(
        (actual.mean, actual.scale, actual.opacity, color),
        (expected[0], *expected[2:], colors),
        strict=True,
    ):
        np.testing.assert_allclose(leaf, by_hand, rtol=EXACT[dtype], atol=EXACT[dtype])
    apart = rotations(actual.quaternion) * Rotation.concatenate(expected[1]).inv()
    np.testing.assert_allclose(apart.magnitude(), 0, atol=10 * EXACT[dtype])
    assert {leaf.dtype for leaf in actual} == {np.dtype(dtype)}


@pytest.mark.full
def test_bits_are_those_of_the_law_and_the_file_says_bytes(float64):
    params = params_of("float64")
    off = params.rows["splats"]
    off = splats.deactivate(off, jnp.arange(ROWS) == 2)
    params = Params(params.rows | {"splats": off}, params.nets)
    *_, bits = kept_by_hand(host(params.rows[NAME]), host(params.nets[NAME].law))
    features, others = anchor_motion.coded_bytes(params, SPEC)
    np.testing.assert_allclose(features, bits[[0, 1, 3]].sum() / 8, rtol=1e-9)
    nets = sum(leaf.size for leaf in jax.tree.leaves(params.nets))
    assert others == 4 * (3 * (3 + 3 + 4 + 1 + 3) + nets)
    plain = dataclasses.replace(SPEC, rate=None)
    bare = Params(params.rows, {NAME: params.nets[NAME]._replace(law=None)})
    assert anchor_motion.coded_bytes(bare, plain)[0] == 4 * 3 * (3 + EACH * 4)


@pytest.mark.full
def test_slopes_are_those_of_differences(float64):
    """With the noise of training: rounding has slopes of its own making."""
    params = params_of("float64")
    weights = np.random.default_rng(1).normal(size=(ROWS * EACH, 14))
    condition = FrameCondition(
        put(0.4, "float64"), step=jnp.int32(20), key=jax.random.key(3)
    )

    def value(params, time):
        now = condition._replace(time=time)
        derived = effect().derive_rows(params, now)
        still = splats.activate(params.rows["splats"])
        rows = effect().deform(params, still, now, None)
        child_gaussians = effect().derive(params, derived, rows, now)
        leaves = [
            *child_gaussians[:3],
            child_gaussians.opacity[:, None],
            derived[0].sh_dc[:, 0],
        ]
        context = PenaltyContext(now, now.step, jax.random.key(4), params)
        (term,) = effect().penalty(params.nets[NAME], context).values()
        return jnp.sum(weights * jnp.concatenate(leaves, axis=1)) + term.value

    assert directional_error(value, params, put(0.47), step=1e-6) < 1e-6


def test_noise_and_cost_begin_together():
    params = params_of("float32")

    def seen(step):
        condition = FrameCondition(jnp.float32(0.4), step=step, key=jax.random.key(3))
        context = PenaltyContext(condition, step, jax.random.key(4), params)
        (term,) = effect().penalty(params.nets[NAME], context).values()
        return term.value, effect().derive_rows(params, condition)[1][1].reference

    run = jitted(seen)
    own = params.rows[NAME].reference
    free, before = run(jnp.int32(9))
    cost, after = run(jnp.int32(10))
    assert free == 0 < cost
    np.testing.assert_array_equal(before, own)
    far = np.abs(after - own) / np.exp(params.nets[NAME].law.log_step)
    assert 0.2 < far.max() <= 0.5 + 1e-5


@pytest.mark.hard_cases
def test_a_law_without_a_width_is_held(dtype):
    run = jitted(jax.value_and_grad(entropy.bits, argnums=(0, 1, 2, 3)))
    value, slopes = run(*put((0.3, 0.0, -1e4, 0.1), dtype))
    assert np.isfinite(value)
    assert all(np.isfinite(slope) for slope in slopes)
    assert slopes[0] > 0 == slopes[2]


def test_what_is_hardly_to_be_seen_counts_less(dtype):
    rng = np.random.default_rng(0)
    scale, opacity = rng.uniform(0.1, 1, (20, 3)), rng.uniform(size=20)
    volume = scale.prod(axis=1)
    share = np.clip(volume / np.quantile(volume, 0.8), 0, 1) ** 0.01
    gaussians = put(
        Gaussians(np.zeros((20, 3)), np.ones((20, 4)), scale, opacity), dtype
    )
    actual = jitted(anchor_motion.significance)(gaussians)
    np.testing.assert_allclose(actual, opacity * share, rtol=1e-5)
    nothing = gaussians._replace(scale=0 * gaussians.scale)
    assert np.isfinite(jitted(anchor_motion.significance)(nothing)).all()


TINY = dataclasses.replace(
    scenes.TINY_SPLATS,
    init=InitSpec(random=60, min_points=1000),
    motion=dataclasses.replace(SPEC, warm_up=4),
)


@pytest.mark.slow
def test_a_scene_of_anchors_grows_trains_and_stands_still_without_its_motion(tmp_path):
    capture = scenes.tiny_capture()
    metadata = scene.metadata_of(capture)
    model = scene.build(TINY, metadata)
    start = model.init(capture, jax.random.key(0))
    frames = evaluation.frames_of(capture, model.required_data)
    state = loop.fit(model, start, frames, steps=30).state
    counts = model.counts(state)
    assert counts["rows"] > 60
    assert counts["gaussians"] == EACH * counts["rows"]
    for leaf, first in zip(
        jax.tree.leaves(state.params.nets),
        jax.tree.leaves(start.params.nets),
        strict=True,
    ):
        assert np.isfinite(leaf).all()
        assert np.any(np.asarray(leaf) != first)
    saved = representation.save(tmp_path, TINY, metadata, state)
    assert saved.coded_bytes == sum(
        anchor_motion.coded_bytes(state.params, TINY.motion)
    )
    assert saved.coded_bytes < saved.model_bytes
    still = variants.without_effects(TINY, metadata, ("motion",), False)
    deform = jax.jit(still.stages.deform)
    where = [
        np.asarray(deform(state.params, {}, np.float32(time)).mean)
        for time in (0.0, 1.0)
    ]
    np.testing.assert_array_equal(*where)
    rest = jax.jit(still.stages.rows)(state.params).mean
    np.testing.assert_allclose(where[0], rest, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "changes", "words"),
    [
        (AnchorMotionSpec, dict(residual=3), "residual=3 must be even"),
        (AnchorMotionSpec, dict(count=0), "count=0 must be at least 1"),
        (AnchorMotionSpec, dict(spread=0.0), "positive and finite"),
        (RateSpec, dict(weight=-1.0), "weight=-1.0"),
        (RateSpec, dict(step=0.0), "step=0.0"),
    ],
)
def test_settings_of_anchors_that_cannot_work_are_refused(kind, changes, words):
    with pytest.raises(ValueError, match=words):
        kind(**changes)


def test_the_law_starts_as_wide_as_the_features(float64):
    @jitted
    def first_bits():
        net = anchors.init(jax.random.key(0), SPEC, FRAMES)
        features = anchors.init_features(jax.random.key(1), SPEC, 500)
        return anchors.bits(features, net.law, SPEC)

    first, others = first_bits()
    # Of a normal law of deviation 0.5 in steps of 0.1: log2(5 sqrt(2 pi e)).
    entropy_bits = np.log2(5 * np.sqrt(2 * np.pi * np.e))
    np.testing.assert_allclose(first.mean(), entropy_bits, atol=0.1)
    np.testing.assert_allclose(others.mean(), entropy_bits, atol=0.1)
