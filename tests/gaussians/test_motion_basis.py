"""The motion basis: its equations, what is prepared, its size, its hard cases."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.motion import basis as motion_basis
from gaussians_jax.motion.basis import BasisMotionSpec, Offsets
from tests.gaussians.motions import BASIS as SMALL
from tests.gaussians.motions import deformed, strong
from tests.gaussians.shared import finite, full, jitted, some_gaussians
from tests.oracles import networks

RESIDUAL = dataclasses.replace(SMALL, count=None)


uncached = deformed["basis"]


# Equations 3 to 6 in NumPy, one Gaussian at a time.


def silu(x):
    return x / (1 + np.exp(-x))


def by_the_book(params, spec, point, time):
    placed = networks.waves(spec.position, point)
    base = np.concatenate([placed, networks.waves(spec.base_time, time)])
    slow = networks.heads(params.base, base, activation=silu)["mean"]
    inputs = [networks.waves(spec.position, point + slow)]
    inputs.append(networks.waves(spec.time, time))
    heads = networks.heads(
        params.weights, np.concatenate(inputs), spec.skips, activation=silu
    )
    if spec.count is None:
        return slow + heads["weights"], heads["turn"], heads["log_scale"]
    raw = networks.heads(params.basis, placed, activation=silu)["directions"]
    residual = np.zeros(3)
    for k, direction in enumerate(raw.reshape(3, spec.count).T):
        if spec.basis_form == "bounded":
            direction = direction / max(np.linalg.norm(direction), 1)
        residual += heads["weights"][k] * direction
    return slow + residual, heads["turn"], heads["log_scale"]


@pytest.mark.parametrize(
    "spec", [SMALL, RESIDUAL, *full(dataclasses.replace(SMALL, basis_form="free"))]
)
def test_offsets_are_those_of_the_equations(spec, dtype):
    params = strong("basis", spec, dtype)
    mean = some_gaussians(17, dtype).mean
    offsets = uncached(params, spec, mean, np.asarray(0.7, dtype))
    exact = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)
    time = float(np.asarray(0.7, dtype))
    for row, point in enumerate(np.asarray(mean, np.float64)):
        expected = by_the_book(exact, spec, point, time)
        for ours, theirs in zip(offsets, expected, strict=True):
            tolerance = {"float32": 2e-5, "float64": 1e-13}[dtype]
            np.testing.assert_allclose(ours[row], theirs, atol=tolerance)
    assert {leaf.dtype.name for leaf in offsets} == {dtype}


def test_weights_and_basis_make_the_residual(dtype):
    """V w is the displacement without the slow one of the base network."""
    params = strong("basis", SMALL, dtype)
    mean, time = some_gaussians(17, dtype).mean, np.asarray(0.7, dtype)

    @jax.jit
    def parts(params, mean, time):
        prepared = motion_basis.prepare(params, SMALL, mean)
        arguments = params, SMALL, mean, time, prepared
        return motion_basis.blending_weights(*arguments), prepared.basis

    weights, basis = map(np.asarray, parts(params, mean, time))
    offsets = np.asarray(uncached(params, SMALL, mean, time).mean)
    exact = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)
    tolerance = {"float32": 2e-5, "float64": 1e-13}[dtype]
    for row, point in enumerate(np.asarray(mean, np.float64)):
        placed = networks.waves(SMALL.position, point)
        inputs = np.concatenate([placed, networks.waves(SMALL.base_time, float(time))])
        slow = networks.heads(exact.base, inputs, activation=silu)["mean"]
        made = slow + basis[row] @ weights[row]
        np.testing.assert_allclose(offsets[row], made, atol=tolerance)


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

    @jitted
    def first(mean, time):
        params = motion_basis.init(jax.random.key(0), spec, jnp.dtype(dtype))
        ready = motion_basis.prepare(params, spec, mean)

        def total(params):
            moved = motion_basis.deform(params, spec, mean, time, ready)
            return jnp.sum(moved.mean), moved

        grads, offsets = jax.grad(total, has_aux=True)(params)
        return offsets, ready, grads.weights.heads["weights"].weight

    mean = some_gaussians(50, dtype).mean
    offsets, ready, grad = first(mean, np.asarray(0.5, dtype))
    assert 0 < max(np.abs(leaf).max() for leaf in offsets) < 5e-3
    length = np.linalg.norm(ready.basis, axis=1)
    assert 0.5 < np.median(length) <= length.max() < 1 + 1e-6
    assert np.abs(grad).max() > 1


@pytest.mark.hard_cases
@pytest.mark.parametrize("length", [0.0, 1e-30, 1e25, *full(1.0)])
@pytest.mark.parametrize("angle", [0.0, 1e-20, np.pi, 1e3, *full(1e-4, 2 * np.pi)])
def test_turns_of_every_size_are_rotations_with_finite_slopes(length, angle, dtype):
    """Also where q + dq would vanish: half a turn, and q of no length."""
    gaussians = some_gaussians(2, dtype)._replace(
        quaternion=np.full((2, 4), length, dtype)
    )
    turn = np.asarray([[angle, 0, 0], [0, -0.6 * angle, 0.8 * angle]], dtype)
    wild = np.asarray([[100.0] * 3, [-100.0] * 3], dtype)
    grads, moved = slopes_by_turn_and_scale(turn, wild, gaussians)
    assert finite((grads, moved))
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


def test_the_networks_are_as_large_as_the_papers_storage_says():
    """11.3 MB less its Gaussians leave 2.11 to 2.26 MiB, 570k to 590k numbers."""
    shapes = jax.eval_shape(
        lambda key: motion_basis.init(key, BasisMotionSpec()), jax.random.key(0)
    )
    numbers = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    assert numbers == 589_225
    assert 2.11 < 4 * numbers / 2**20 < 2.26
