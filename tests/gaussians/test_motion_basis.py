"""The motion basis: its equations, what is prepared, its size, its hard cases."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform

from gaussians_jax import splats as rows
from gaussians_jax.effects import deformation, mlp_motion, motion_basis
from gaussians_jax.effects.mlp_motion import SmoothingSpec
from gaussians_jax.effects.motion_basis import BasisMotionSpec, Offsets
from gaussians_jax.splats import Gaussians, Params, Splats
from nerfies_jax.measure import clock
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.training.effects import FrameCondition
from tests import gradients

SMALL = BasisMotionSpec(
    position=EncodingSpec(3),
    base_time=EncodingSpec(1),
    time=EncodingSpec(2),
    base_depth=2,
    base_width=8,
    count=4,
    basis_width=8,
    depth=3,
    width=16,
    skips=(2,),
    block=8,
)
RESIDUAL = dataclasses.replace(SMALL, count=None)


@functools.partial(jax.jit, static_argnums=(0, 1))
def strong(spec, dtype="float64", seed=0):
    """A field that moves things by about their own size; every bias is drawn too."""
    params = motion_basis.init(jax.random.key(seed), spec, jnp.dtype(dtype))
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(seed + 1), len(leaves))
    drawn = [
        leaf + 0.2 * jax.random.normal(key, leaf.shape, dtype)
        for key, leaf in zip(keys, leaves, strict=True)
    ]
    return jax.tree.unflatten(tree, drawn)


@functools.partial(jax.jit, static_argnums=1)
def uncached(params, spec, mean, time, active=None):
    """As in a training step: prepared and used in one program."""
    prepared = motion_basis.prepare(params, spec, mean, active)
    return motion_basis.deform(params, spec, mean, time, prepared, active)


prepare = jax.jit(motion_basis.prepare, static_argnums=1)
deform = jax.jit(motion_basis.deform, static_argnums=1)


def some_gaussians(count, dtype="float64", seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians(
        mean=jnp.asarray(rng.normal(size=(count, 3)), dtype),
        quaternion=jnp.asarray(rng.normal(size=(count, 4)), dtype),
        scale=jnp.asarray(rng.uniform(0.1, 1, (count, 3)), dtype),
        opacity=jnp.asarray(rng.uniform(size=count), dtype),
    )


def scene_of(spec, dtype="float32", count=9):
    gaussians = some_gaussians(count, dtype)
    splats = Splats(
        gaussians.mean,
        jnp.log(gaussians.scale),
        gaussians.quaternion,
        jnp.zeros(count, dtype),
        jnp.zeros((count, 1, 3), dtype),
        jnp.zeros((count, 0, 3), dtype),
    )
    return Params({"splats": splats}, {motion_basis.NAME: strong(spec, dtype)})


# Equations 3 to 6 in NumPy, one Gaussian at a time.


def features(values, bands):
    waves = [f(2**k * values) for k in range(bands) for f in (np.sin, np.cos)]
    return np.concatenate([values, *waves])


def network(params, inputs, skips=()):
    hidden = inputs
    for index, layer in enumerate(params.hidden):
        if index in skips:
            hidden = np.concatenate([hidden, inputs])
        hidden = hidden @ np.asarray(layer.weight) + np.asarray(layer.bias)
        hidden = hidden / (1 + np.exp(-hidden))
    return {
        name: hidden @ np.asarray(head.weight) + np.asarray(head.bias)
        for name, head in params.heads.items()
    }


def by_the_book(params, spec, point, time):
    p, t = np.asarray(point), np.asarray([time])
    slow = network(
        params.base,
        np.concatenate([features(p, spec.position.bands), features(t, 1)]),
    )["mean"]
    inputs = [features(p + slow, spec.position.bands), features(t, spec.time.bands)]
    found = network(params.weights, np.concatenate(inputs), spec.skips)
    if spec.count is None:
        return slow + found["weights"], found["turn"], found["log_scale"]
    raw = network(params.basis, features(p, spec.position.bands))["directions"]
    residual = np.zeros(3)
    for k, direction in enumerate(raw.reshape(3, spec.count).T):
        if spec.basis_form == "bounded":
            direction = direction / max(np.linalg.norm(direction), 1)
        residual += found["weights"][k] * direction
    return slow + residual, found["turn"], found["log_scale"]


@pytest.mark.parametrize(
    "spec", [SMALL, RESIDUAL, dataclasses.replace(SMALL, basis_form="free")]
)
def test_offsets_are_those_of_the_equations(spec, dtype):
    params = strong(spec, dtype)
    mean = some_gaussians(17, dtype).mean
    offsets = uncached(params, spec, mean, jnp.asarray(0.7, dtype))
    exact = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)
    time = float(jnp.asarray(0.7, dtype))
    for row, point in enumerate(np.asarray(mean, np.float64)):
        expected = by_the_book(exact, spec, point, time)
        for ours, theirs in zip(offsets, expected, strict=True):
            tolerance = {"float32": 2e-5, "float64": 1e-13}[dtype]
            np.testing.assert_allclose(ours[row], theirs, atol=tolerance)
    assert {leaf.dtype.name for leaf in offsets} == {dtype}


@pytest.mark.full
@pytest.mark.parametrize("spec", [SMALL, RESIDUAL])
def test_prepared_ahead_or_in_the_step_is_the_same(spec, dtype):
    params = strong(spec, dtype)
    mean = some_gaussians(17, dtype).mean
    ahead = prepare(params, spec, mean)
    for instant in (0.0, 0.4, 1.0):
        time = jnp.asarray(instant, dtype)
        for ours, theirs in zip(
            deform(params, spec, mean, time, ahead),
            uncached(params, spec, mean, time),
            strict=True,
        ):
            # Rounding only: the two programs may fuse sums differently.
            tolerance = {"float32": 1e-6, "float64": 1e-15}[dtype]
            np.testing.assert_allclose(ours, theirs, atol=tolerance, rtol=tolerance)


def test_what_is_prepared_follows_means_and_parameters(float64):
    """It is a pure function of the parameters: the scene keys it by the arrays."""
    field = motion_basis.effect(SMALL, steps=100, frames=20)
    params = scene_of(SMALL, "float64")
    ready = jax.jit(field.prepare)
    first = ready(params)
    same = ready(jax.tree.map(jnp.copy, params))
    jax.tree.map(np.testing.assert_array_equal, first, same)

    moved = params.rows["splats"]._replace(mean=params.rows["splats"].mean + 0.01)
    other_means = ready(params._replace(rows={"splats": moved}))
    motion = params.nets[motion_basis.NAME]
    for part in ("base", "basis"):
        network = jax.tree.map(lambda leaf: 1.01 * leaf, getattr(motion, part))
        nets = {motion_basis.NAME: motion._replace(**{part: network})}
        other = ready(params._replace(nets=nets))
        for name in ("base", "basis"):
            changed = np.abs(getattr(other, name) - getattr(first, name)).max() > 1e-4
            assert changed == (name == part)
            assert np.abs(getattr(other_means, name) - getattr(first, name)).max() > 0
    # Nor does it read what the time decides.
    weights = jax.tree.map(lambda leaf: 2 * leaf, motion.weights)
    nets = {motion_basis.NAME: motion._replace(weights=weights)}
    jax.tree.map(
        np.testing.assert_array_equal, first, ready(params._replace(nets=nets))
    )


@pytest.mark.full
def test_stale_directions_are_wrong(float64):
    """So reusing what was prepared of other means would show."""
    params, gaussians = strong(SMALL), some_gaussians(9)
    time = jnp.asarray(0.4)
    stale = prepare(params, SMALL, gaussians.mean + 0.1)
    ours = deform(params, SMALL, gaussians.mean, time, stale)
    assert (
        np.abs(ours.mean - uncached(params, SMALL, gaussians.mean, time).mean).max()
        > 1e-3
    )


@pytest.mark.parametrize("detach", [True, False])
def test_gradients_of_the_field(detach, float64):
    """Through what is prepared as well; of the means where they are not detached."""
    spec = dataclasses.replace(SMALL, detach=detach)
    mean = some_gaussians(5).mean

    def total(params, time, mean):
        offsets = uncached(params, spec, mean, time)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in offsets)

    params, time = strong(spec), jnp.asarray(0.4)
    grad = jax.jit(jax.grad(total, argnums=2))(params, time, mean)
    if detach:
        assert not np.asarray(grad).any()
        error = gradients.directional_error(
            lambda params, time: total(params, time, mean), params, time, step=1e-6
        )
    else:
        error = gradients.directional_error(total, params, time, mean, step=1e-6)
    assert error < 1e-6


@jax.jit
def directions_and_slopes(params):
    """The directions of one point, and their slopes in the bias of the head."""

    def vectors(bias):
        head = params.heads["directions"]._replace(bias=bias)
        encoded = jnp.ones(SMALL.position.width(3), bias.dtype)
        return motion_basis.basis_vectors(
            params._replace(heads={"directions": head}), SMALL, encoded
        )

    bias = params.heads["directions"].bias
    return vectors(bias), jax.jacfwd(vectors)(bias)


@pytest.mark.hard_cases
@pytest.mark.parametrize("length", [0.0, 1e-30, 0.999, 1.0, 1.001, 1e12])
def test_bounded_directions_are_at_most_one_long_with_finite_slopes(length, dtype):
    shapes = jax.eval_shape(
        lambda: motion_basis.init(jax.random.key(0), SMALL, jnp.dtype(dtype)).basis
    )
    # No weights: every direction along x, of the given length, whatever is encoded.
    params = jax.tree.map(lambda leaf: np.zeros(leaf.shape, dtype), shapes)
    params.heads["directions"].bias[:4] = length
    vectors, grads = map(np.asarray, directions_and_slopes(params))

    expected = np.zeros((3, 4))
    expected[0] = min(length, 1.0)
    tolerance = {"float32": 3e-7, "float64": 1e-15}[dtype]
    np.testing.assert_allclose(vectors, expected, rtol=tolerance)
    grads = grads[0, 0]
    # Along itself a short direction grows; a long one does not.
    along = {1.0: (0.0, 1.0)}.get(length, (float(length < 1),) * 2)
    assert along[0] - 1e-6 <= grads[0] <= along[1] + 1e-6
    assert np.isfinite(grads).all()


@pytest.mark.full
def test_the_start_is_still_and_yet_learns(dtype):
    """Weights near zero, directions about one: dp_res = 0 with a slope in w."""
    spec = BasisMotionSpec()

    @jax.jit
    def first(mean, time):
        params = motion_basis.init(jax.random.key(0), spec, jnp.dtype(dtype))
        ready = motion_basis.prepare(params, spec, mean)

        def total(params):
            moved = motion_basis.deform(params, spec, mean, time, ready)
            return jnp.sum(moved.mean), moved

        grads, offsets = jax.grad(total, has_aux=True)(params)
        return offsets, ready, grads.weights.heads["weights"].weight

    mean = some_gaussians(50, dtype).mean
    offsets, ready, grad = first(mean, jnp.asarray(0.5, dtype))
    assert 0 < max(float(jnp.abs(leaf).max()) for leaf in offsets) < 5e-3
    length = np.linalg.norm(ready.basis, axis=1)
    assert 0.5 < np.median(length) <= length.max() < 1 + 1e-6
    assert np.abs(grad).max() > 1


@pytest.mark.full
def test_motion_is_smooth_in_time(float64):
    """C1, as the paper claims and ReLU networks are not: no jump of the velocity."""
    params, mean = strong(SMALL), some_gaussians(3).mean
    times = jnp.linspace(0.0, 1.0, 4001)
    path = jax.jit(jax.vmap(lambda time: uncached(params, SMALL, mean, time).mean))(
        times
    )
    jump = np.abs(np.diff(path, n=2, axis=0)).max(axis=(1, 2)) / (times[1]) ** 2
    assert jump.max() < 20 * np.median(jump)


@pytest.mark.full
@pytest.mark.parametrize("count", [0, 1, 17])
def test_blocks_change_nothing_but_memory(count, dtype):
    params = strong(SMALL, dtype)
    mean = some_gaussians(count, dtype).mean
    time = jnp.asarray(0.3, dtype)
    whole = dataclasses.replace(SMALL, block=1000)

    def total(params, spec):
        offsets = uncached(params, spec, mean, time)
        return sum(jnp.sum(leaf**2) for leaf in offsets), offsets

    run = jax.jit(jax.value_and_grad(total, has_aux=True), static_argnums=1)
    (_, blocked), grads = run(params, SMALL)
    (_, at_once), expected = run(params, whole)
    tolerance = {"float32": 2e-5, "float64": 1e-13}[dtype]
    for ours, theirs in zip(
        jax.tree.leaves((blocked, grads)),
        jax.tree.leaves((at_once, expected)),
        strict=True,
    ):
        scale = np.abs(theirs).max(initial=1e-30)
        np.testing.assert_allclose(ours / scale, theirs / scale, atol=tolerance)
    assert blocked.mean.shape == blocked.turn.shape == (count, 3)


def test_rows_beyond_the_active_blocks_are_still(float64):
    params = strong(SMALL)
    mean = some_gaussians(24).mean
    time = jnp.asarray(0.5)
    active = jnp.arange(24) < 9  # the last of three blocks of 8 is idle
    offsets = uncached(params, SMALL, mean, time, active)
    full = uncached(params, SMALL, mean, time)
    for ours, theirs in zip(offsets, full, strict=True):
        np.testing.assert_array_equal(ours[:16], theirs[:16])
        assert not np.asarray(ours[16:]).any()
    assert not np.asarray(prepare(params, SMALL, mean, active).basis[16:]).any()

    def total(params):
        nobody = jnp.zeros(24, bool)
        return sum(
            jnp.sum(leaf) for leaf in uncached(params, SMALL, mean, time, nobody)
        )

    grads = jax.jit(jax.grad(total))(params)
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(grads))


def test_moving_gaussians(float64):
    """Against SciPy's rotations."""
    gaussians = some_gaussians(6)
    rng = np.random.default_rng(1)
    offsets = Offsets(*(jnp.asarray(rng.normal(size=(6, 3))) for _ in range(3)))
    moved = motion_basis.apply(gaussians, offsets)
    rotation = scipy.spatial.transform.Rotation
    expected = rotation.from_rotvec(np.array(offsets.turn)) * rotation.from_quat(
        np.array(gaussians.quaternion)[:, [1, 2, 3, 0]]
    )
    ours = rotation.from_quat(np.array(moved.quaternion)[:, [1, 2, 3, 0]])
    np.testing.assert_allclose(ours.as_matrix(), expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(moved.mean, gaussians.mean + offsets.mean)
    np.testing.assert_allclose(moved.scale, gaussians.scale * np.exp(offsets.log_scale))

    def total(gaussians, offsets):
        return sum(jnp.sum(jnp.sin(x)) for x in motion_basis.apply(gaussians, offsets))

    assert gradients.directional_error(total, gaussians, offsets) < 1e-7


@pytest.mark.hard_cases
@pytest.mark.parametrize("length", [0.0, 1e-30, 1.0, 1e25])
@pytest.mark.parametrize("angle", [0.0, 1e-20, 1e-4, np.pi, 2 * np.pi, 1e3])
def test_turns_of_every_size_are_rotations_with_finite_slopes(length, angle, dtype):
    """Also where q + dq would vanish: half a turn, and q of no length."""
    gaussians = some_gaussians(2, dtype)._replace(
        quaternion=np.full((2, 4), length, dtype)
    )
    turn = np.asarray([[angle, 0, 0], [0, -0.6 * angle, 0.8 * angle]], dtype)
    wild = np.asarray([[100.0] * 3, [-100.0] * 3], dtype)
    grads, moved = slopes_by_turn_and_scale(turn, wild, gaussians)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((grads, moved)))
    tolerance = {"float32": 1e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(
        np.linalg.norm(np.asarray(moved.quaternion, np.float64), axis=1),
        1,
        rtol=tolerance,
    )
    # The first turns about x: its half angle, from identity or from (1, 1, 1, 1) / 2.
    half = float(turn[0, 0]) / 2
    w, x = np.cos(half), np.sin(half)
    expected = [w, x, 0, 0]
    if length > 0:
        expected = np.array([w - x, w + x, w - x, w + x]) / 2
    np.testing.assert_allclose(
        moved.quaternion[0], expected, atol=tolerance * max(1, angle)
    )


@jax.jit
@functools.partial(jax.grad, argnums=(0, 1), has_aux=True)
def slopes_by_turn_and_scale(turn, scale, gaussians):
    offsets = Offsets(jnp.zeros_like(turn), turn, scale)
    moved = motion_basis.apply(gaussians, offsets)
    return jnp.sum(moved.quaternion) + jnp.sum(moved.scale**2), moved


def test_warm_up_and_noise_are_of_training_alone():
    spec = dataclasses.replace(SMALL, warm_up=10, smoothing=SmoothingSpec(0.5, 50))
    field = motion_basis.effect(spec, steps=100, frames=2)
    params = scene_of(spec)
    gaussians = rows.activate(params.rows["splats"])
    time = jnp.asarray(0.5)

    @jax.jit
    def moved(params, step):
        condition = FrameCondition(time, step=step, key=jax.random.key(0))
        return deformation.deform_in_training((field,), params, gaussians, condition)

    np.testing.assert_array_equal(moved(params, jnp.asarray(9)).mean, gaussians.mean)
    ready = jax.jit(field.prepare)(params)
    trained = jax.jit(field.deform)(params, gaussians, FrameCondition(time), ready)
    motion = params.nets[motion_basis.NAME]
    at_rest = motion_basis.apply(
        gaussians, uncached(motion, spec, gaussians.mean, time)
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6),
        trained,
        at_rest,
    )
    noisy, late = moved(params, jnp.asarray(10)), moved(params, jnp.asarray(50))
    assert np.abs(noisy.mean - trained.mean).max() > 1e-3
    np.testing.assert_allclose(late.mean, trained.mean, atol=1e-6)

    def total(params, step):
        return jnp.sum(moved(params, step).mean)

    grad = jax.jit(jax.grad(total))
    for step, learns in ((9, False), (10, True)):
        nets = grad(params, jnp.asarray(step)).nets[motion_basis.NAME]
        for part in nets:  # base, basis and weights
            assert any(np.asarray(x).any() for x in jax.tree.leaves(part)) == learns


@pytest.mark.full
def test_a_scene_poses_alike_from_what_it_prepared(dtype):
    field = motion_basis.effect(SMALL, steps=100, frames=20)
    params = scene_of(SMALL, dtype)
    time = jnp.asarray(0.25, dtype)
    ready = jax.jit(lambda p: deformation.prepare((field,), p))(params)

    @jax.jit
    def whole(params):
        ready = deformation.prepare((field,), params)
        return deformation.deform((field,), params, ready, time)

    ours = jax.jit(lambda p, r: deformation.deform((field,), p, r, time))(params, ready)
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=tolerance),
        ours,
        whole(params),
    )


def test_the_networks_are_as_large_as_the_papers_storage_says():
    """11.3 MB less its Gaussians leave 2.11 to 2.26 MiB, 570k to 590k numbers."""
    shapes = jax.eval_shape(
        lambda key: motion_basis.init(key, BasisMotionSpec()), jax.random.key(0)
    )
    numbers = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    assert numbers == 589_225
    assert 2.11 < 4 * numbers / 2**20 < 2.26


@pytest.mark.full
@pytest.mark.parametrize(
    ("spec", "share"),
    [
        (BasisMotionSpec(), 0.053),
        (BasisMotionSpec(count=None), 0.014),
        (motion_basis.SMALL_BASIS_MOTION, 0.24),
    ],
)
def test_what_is_prepared_spares_a_small_share_of_the_arithmetic(spec, share):
    """The paper's "dot product" leaves base and weight networks to run every frame."""
    counts = motion_basis.multiply_adds(spec)
    assert abs(counts["prepared"] / counts["all"] - share) < 0.01
    count = spec.block  # one round of the loop, which the compiler counts once
    params = jax.eval_shape(lambda key: motion_basis.init(key, spec), jax.random.key(0))
    mean = jax.ShapeDtypeStruct((count, 3), jnp.float32)
    time = jax.ShapeDtypeStruct((), jnp.float32)
    ready = jax.eval_shape(lambda p, m: motion_basis.prepare(p, spec, m), params, mean)
    ahead = clock.cost(lambda p, m: motion_basis.prepare(p, spec, m), params, mean)
    each = clock.cost(
        lambda p, m, t, r: motion_basis.deform(p, spec, m, t, r),
        *(params, mean, time, ready),
    )
    compiled = ahead.flops / (ahead.flops + each.flops)
    assert abs(compiled - share) < 0.03
    products = 2 * count * counts["all"]
    assert products < ahead.flops + each.flops < 1.6 * products


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"count": 0}, "at least one direction"),
        ({"basis_form": "square"}, "unknown basis_form 'square'"),
        ({"base_depth": 0}, "hidden layer each"),
        ({"depth": 0, "skips": ()}, "hidden layer each"),
        ({"block": 0}, "block >= 1"),
        ({"warm_up": -1}, "warm_up >= 0"),
        ({"learning_rate": 1e-8}, "both are positive"),
        ({"activation": "cubic"}, "unknown activation 'cubic'"),
        ({"skips": (9,)}, "layer 9 is not in"),
    ],
)
def test_settings_that_cannot_work_are_refused(setting, message):
    with pytest.raises(ValueError, match=message):
        BasisMotionSpec(**setting)


def test_the_rate_falls_in_equal_ratios():
    field = motion_basis.effect(BasisMotionSpec(), steps=1000, frames=20)
    rates = [float(field.learning_rate(jnp.asarray(s))) for s in (0, 500, 1000, 4000)]
    middle = (8e-4 * 1.6e-6) ** 0.5
    np.testing.assert_allclose(rates, [8e-4, middle, 1.6e-6, 1.6e-6], rtol=1e-5)
    assert field.name != mlp_motion.NAME
