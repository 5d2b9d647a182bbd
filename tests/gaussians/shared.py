"""Gaussians, tables and checks that the tests of share."""

import jax
import numpy as np
import pytest
import scipy.spatial.transform

from gaussians_jax.core.splats import Gaussians, Params, Splats


def full(*rows):
    """Further rows of a table of parameters, for the full tier alone."""
    rows = (row if type(row) is tuple else (row,) for row in rows)
    return [pytest.param(*row, marks=pytest.mark.full) for row in rows]


def put(tree, dtype=None):
    """Numbers on the device, for which `jnp.asarray` would compile a program each."""
    tree = jax.tree.map(
        lambda leaf: np.asarray(leaf, dtype),
        tree,
        is_leaf=lambda x: isinstance(x, list),
    )
    return jax.device_put(tree)


def jitted(function, **options):
    """Compiled whole; gives NumPy arrays, whose arithmetic compiles nothing."""
    compiled = jax.jit(function, **options)
    return lambda *args: jax.tree.map(np.asarray, compiled(*args))


def some_gaussians(count, dtype="float64", seed=0):
    rng = np.random.default_rng(seed)
    fields = (
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.1, 1, (count, 3)),
        rng.uniform(0.1, 1, count),
    )
    return put(Gaussians(*fields), dtype)


def rows_of(gaussians, opacity_logit=0.0, rest=0):
    """Gray rows of these Gaussians, all of one opacity."""
    mean, quaternion, scale = (np.asarray(x) for x in gaussians[:3])
    count = len(mean)
    leaves = (
        mean,
        np.log(scale),
        quaternion,
        np.full(count, opacity_logit),
        np.zeros((count, 1, 3)),
        np.zeros((count, rest, 3)),
    )
    return put(Splats(*leaves), mean.dtype)


def rows_and_nets(count, dtype="float32"):
    """Parameters of each kind, and a weight matrix with as many rows as Gaussians."""
    rng = np.random.default_rng(0)
    shapes = (count, 3), (count, 3), (count, 4), (count,), (count, 1, 3), (count, 3, 3)
    rows = Splats(*(rng.normal(size=shape) for shape in shapes))
    code, weight = (rng.normal(size=(count, n)) for n in (2, 5))
    return put(Params({"splats": rows, "code": code}, {"w": weight}), dtype)


def with_rows(params, **leaves):
    """The same parameters with leaves of their splats replaced."""
    splats = params.rows["splats"]._replace(**leaves)
    return Params(params.rows | {"splats": splats}, params.nets)


def rotations(quaternion):
    """SciPy's, of quaternions [n, 4] with the real part in front."""
    wxyz = np.asarray(quaternion, np.float64)
    return scipy.spatial.transform.Rotation.from_quat(np.roll(wxyz, -1, axis=-1))


def finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def any_nonzero(tree):
    return any(np.asarray(leaf).any() for leaf in jax.tree.leaves(tree))


def close(result, expected, tolerance, least=1.0):
    """Leaf by leaf, to a share of the largest number of the leaf, or of `least`."""
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
        scale = np.abs(b).max(initial=least)
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * scale)


def same_bits(result, expected):
    jax.tree.map(np.testing.assert_array_equal, result, expected)
