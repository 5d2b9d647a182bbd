"""The lens model's inverse, against a dense search in NumPy float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.geometry import distortion

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

slope = jax.jit(jax.jacrev(lambda *lens: distortion.undistort(*lens)[0], argnums=2))


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
    bent = jnp.asarray(targets[:, None] * [0.6, -0.8], dtype)
    slopes, converged = undistort(
        jnp.asarray(radial, dtype), jnp.zeros(2, dtype), jnp.asarray(bent)
    )
    assert slopes.dtype == dtype
    assert np.all(np.isfinite(slopes))
    radii, edge = first_branch(radial, targets)
    clear = abs(targets - edge) > 1e-3  # at the fold itself either answer is right
    assert np.array_equal(converged[clear], (targets < edge)[clear])
    error = np.linalg.norm(slopes, axis=-1) - radii
    # the search interpolates in a grid 2e-5 fine
    assert np.max(abs(error[clear & np.asarray(converged)])) < 1e-5


@pytest.mark.hard_cases
def test_plain_newton_would_land_on_another_branch():
    """The failure that the flag is for: a residual of zero on no ray of light."""
    k1, target = -0.5, 0.6
    radius = target
    for _ in range(100):
        excess = radius * (1 + k1 * radius**2) - target
        radius -= excess / (1 + 3 * k1 * radius**2)
    assert abs(radius * (1 + k1 * radius**2) - target) < 1e-9
    _, converged = distortion.undistort(
        jnp.asarray([k1, 0, 0], jnp.float32), jnp.zeros(2), jnp.asarray([target, 0])
    )
    assert not converged


@pytest.mark.hard_cases
@pytest.mark.parametrize("tangential", [(1e-3, -2e-3), (0.02, 0.03)])
@pytest.mark.parametrize("name", ["none", "phone", "pincushion"])
def test_round_trip_with_tangential_terms(name, tangential, dtype, rng):
    radial = jnp.asarray(LENSES[name], dtype)
    tangential = jnp.asarray(tangential, dtype)
    slopes = jnp.asarray(rng.uniform(-0.6, 0.6, (200, 2)), dtype)
    slopes = slopes.at[0].set(0)
    bent = distort(radial, tangential, slopes)
    found, converged = undistort(radial, tangential, bent)
    allowed = one_to_one(radial, tangential, slopes)
    assert np.array_equal(converged, allowed)
    assert np.mean(converged) > 0.7
    error = np.abs(np.asarray(found - slopes))[np.asarray(converged)]
    # near the fold an ulp of the distorted point is several of the slope
    assert error.max() < {"float32": 2e-4, "float64": 1e-12}[dtype]
    assert np.median(error) < {"float32": 2e-7, "float64": 1e-15}[dtype]


@pytest.mark.hard_cases
@pytest.mark.parametrize("target", [0.0, 0.544, 0.5443310, 0.6, 1e4, 1e15])
def test_derivatives_stay_finite_past_the_fold(target, dtype):
    radial = jnp.asarray([-0.5, 0, 0], dtype)  # folds at 0.5443311

    gradient = slope(radial, jnp.zeros(2, dtype), jnp.asarray([target, 0], dtype))
    assert np.all(np.isfinite(gradient))
    if target > 0.55:
        assert np.all(gradient == 0)


@pytest.mark.hard_cases
def test_nan_pixels_are_flagged(dtype):
    lens = jnp.asarray([0.1, 0, 0], dtype), jnp.zeros(2, dtype)
    _, converged = distortion.undistort(*lens, jnp.asarray([jnp.nan, 0], dtype))
    assert not converged
