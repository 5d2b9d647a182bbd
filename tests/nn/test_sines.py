"""Sines and cosines in vectors where they may be, and as XLA has them elsewhere."""

import jax
import mpmath
import numpy as np
import pytest

from nerfies_jax.nn import sines


@pytest.mark.hard_cases
@pytest.mark.parametrize("far", [12_801.0, 1e30, np.nan, -np.inf])
def test_one_number_out_of_reach_leaves_the_others_right(far):
    angles = np.asarray([[0.3, -12_800], [far, 7000.25]], np.float32)
    actual = jax.vmap(sines.sincos)(angles)
    for ours, exact in zip(actual, (mpmath.sin, mpmath.cos), strict=True):
        finite = np.isfinite(angles)
        truth = np.full_like(angles, np.nan)
        with mpmath.workdps(60):
            truth[finite] = [float(exact(float(x))) for x in angles[finite]]
        np.testing.assert_allclose(ours, truth, atol=2e-7)


def test_no_numbers_have_no_sines():
    assert [x.shape for x in jax.jit(sines.sincos)(np.zeros((0, 3)))] == [(0, 3)] * 2


def test_numbers_within_reach_are_computed_in_vectors(rng):
    """Of XLA:CPU: its own sine is twice as exact, which tells the two apart."""
    angles = rng.uniform(-500, 500, 10_000).astype(np.float32)
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        near = np.asarray(jax.jit(sines.sincos)(angles)[0], np.float64)
        far = jax.jit(sines.sincos)(np.append(angles, np.float32(1e5)))[0]
    truth = np.sin(angles.astype(np.float64))
    assert np.max(np.abs(np.asarray(far)[:-1] - truth)) < 4e-8
    assert 5e-8 < np.max(np.abs(near - truth)) < 1e-7
