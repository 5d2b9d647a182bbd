"""The lens model's inverse, against a dense search in NumPy float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.geometry import distortion
from tests import gradients

LENSES = {
    "none": (0, 0, 0),
    "phone": (0.1, -0.209, 0.0),
    "barrel": (-0.1, 0, 0),
    "strong barrel": (-0.5, 0, 0),
    "pincushion": (0.5, 0.3, 0.1),
    "moustache": (0.4, -0.6, 0.2),
    "fold and return": (-1.2, 0.5, 0),  # a second branch with larger radii
    "grazing": (-1 / 3, 0.052, 0.0),  # slope down to 0.04, then steep again
}

distort = jax.jit(jax.vmap(distortion.distort, (None, None, 0)))
undistort = jax.jit(jax.vmap(distortion.undistort, (None, None, 0)))
one_to_one = jax.jit(jax.vmap(distortion.one_to_one, (None, None, 0)))

grad = jax.jit(jax.jacrev(lambda *lens: distortion.undistort(*lens)[0], argnums=2))


ROWS = 200  # that every test has, so that programs are shared


def undistorted(radial, tangential, bent):
    """NumPy arrays, `bent` of at most that many rows."""
    padded = np.resize(bent, (ROWS, 2)).astype(radial.dtype)
    grads, converged = undistort(radial, tangential, padded)
    assert grads.dtype == radial.dtype
    return np.asarray(grads)[: len(bent)], np.asarray(converged)[: len(bent)]


def first_branch(radial, targets):
    """Roots of r·stretch(r²) = target before the first fold, by dense search.

    Also the largest distorted radius of that branch; roots beyond it mean nothing.
    """
    radii = np.linspace(0, 12, 600_001)
    bent = radii * (
        1 + radial[0] * radii**2 + radial[1] * radii**4 + radial[2] * radii**6
    )
    falls = np.flatnonzero(np.diff(bent) <= 0)
    end = falls[0] if len(falls) else len(radii) - 1
    return np.interp(targets, bent[: end + 1], radii[: end + 1]), bent[end]


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", LENSES)
def test_the_root_is_on_the_axis_branch_or_flagged(name, dtype):
    radial = np.asarray(LENSES[name], np.float64)
    targets = np.linspace(0, 1.5, 61)
    bent = targets[:, None] * [0.6, -0.8]
    grads, converged = undistorted(radial.astype(dtype), np.zeros(2, dtype), bent)
    assert np.all(np.isfinite(grads))
    radii, edge = first_branch(radial, targets)
    clear = abs(targets - edge) > 1e-3  # at the fold itself either answer is right
    assert np.array_equal(converged[clear], (targets < edge)[clear])
    error = np.linalg.norm(grads, axis=-1) - radii
    # the search interpolates in a grid 2e-5 fine
    assert np.max(abs(error[clear & converged])) < 1e-5


@pytest.mark.hard_cases
@pytest.mark.parametrize("tangential", [(1e-3, -2e-3), (0.02, 0.03)])
@pytest.mark.parametrize("name", ["none", "phone", "pincushion"])
def test_round_trip_with_tangential_terms(name, tangential, dtype, rng):
    radial = np.asarray(LENSES[name], dtype)
    tangential = np.asarray(tangential, dtype)
    grads = rng.uniform(-0.6, 0.6, (ROWS, 2)).astype(dtype)
    grads[0] = 0
    bent = np.asarray(distort(radial, tangential, grads))
    undone, converged = undistorted(radial, tangential, bent)
    allowed = one_to_one(radial, tangential, grads)
    assert np.array_equal(converged, allowed)
    assert np.mean(converged) > 0.7
    error = np.abs(undone - grads)[converged]
    # near the fold an ulp of the distorted point is several of the slope
    assert error.max() < {"float32": 2e-4, "float64": 1e-12}[dtype]
    assert np.median(error) < {"float32": 2e-7, "float64": 1e-15}[dtype]


@pytest.mark.hard_cases
@pytest.mark.parametrize("target", [0.0, 0.544, 0.5443310, 0.6, 1e4, 1e15])
def test_derivatives_stay_finite_past_the_fold(target, dtype):
    radial = np.asarray([-0.5, 0, 0], dtype)  # folds at 0.5443311
    bent = np.asarray([target, 0], dtype)
    gradient = np.asarray(grad(radial, np.zeros(2, dtype), bent))
    assert np.all(np.isfinite(gradient))
    if target > 0.55:
        assert np.all(gradient == 0)


def test_derivatives_in_the_point_and_the_lens_match_differences(float64):
    """The sign of the lens's term is not seen by derivatives in the point alone."""
    lens = np.asarray(LENSES["phone"]), np.asarray([1e-3, -2e-3])

    def along(radial, tangential, bent):
        return distortion.undistort(radial, tangential, bent)[0] @ jnp.asarray([1, 2.0])

    assert gradients.directional_error(along, *lens, np.array([0.3, -0.4])) < 1e-8


@pytest.mark.hard_cases
def test_nan_pixels_are_flagged(dtype):
    lens = np.asarray([0.1, 0, 0], dtype), np.zeros(2, dtype)
    assert not undistorted(*lens, np.array([[np.nan, 0]]))[1]


def test_no_fold_on_the_way_is_missed_where_the_lens_is_decentered(float64, rng):
    """Of 3000 lenses, against the determinant at 400 places of the way each."""
    count = 3000
    radial = rng.uniform(-1, 1, (count, 3)) * (0.4, 0.2, 0.1)
    tangential = rng.uniform(-0.06, 0.06, (count, 2))
    slopes = rng.uniform(-1.5, 1.5, (count, 2))
    (k1, k2, k3), (p1, p2) = radial.T, tangential.T
    least = np.full(count, np.inf)
    for share in np.linspace(0, 1, 400):
        x, y = share * slopes.T
        r = x * x + y * y
        stretch = 1 + r * (k1 + r * (k2 + r * k3))
        bend = 2 * (k1 + r * (2 * k2 + r * 3 * k3))
        xx = stretch + x * x * bend + 2 * p1 * y + 6 * p2 * x
        yy = stretch + y * y * bend + 2 * p2 * x + 6 * p1 * y
        xy = x * y * bend + 2 * p1 * x + 2 * p2 * y
        least = np.minimum(least, xx * yy - xy * xy)
    accepted = jax.jit(jax.vmap(distortion.one_to_one))(radial, tangential, slopes)
    assert not np.any(accepted & (least <= 0))  # some were, by the end of the way alone
    assert np.mean(accepted[least > distortion.MIN_DETERMINANT]) > 0.98
