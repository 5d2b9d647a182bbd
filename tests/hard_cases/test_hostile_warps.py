"""The elastic penalty's slopes, from warps whose Jacobian is known.

A step differentiates the Jacobian of the warp once more. Whole steps of this kind are
in test_hostile_fields.py, beside the field that they share.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.effects import elastic, warp
from nerfies_jax.training.effects import FrameCondition
from tests.hard_cases import hostile, linear_warps, tiny_fields
from tests.hard_cases.linear_warps import CORNERS, DISPLACEMENTS

# The derivatives of the Jacobian take ten seconds to compile.
pytestmark = pytest.mark.slow


def all_warps(dtype):
    """The parameters of all warps, and what each costs at one point with its slopes."""
    spec = tiny_fields.tiny("nerfies")
    start = jax.eval_shape(
        lambda: warp.init(spec.warp, jax.random.key(0), jnp.dtype(dtype))
    )
    many = [linear_warps.linear_warp(start, one) for one in DISPLACEMENTS.values()]
    many = jax.tree.map(lambda *leaves: np.stack(leaves), *many)
    condition = FrameCondition(
        jnp.asarray(0.5, dtype),
        {spec.warp.table: jnp.zeros(spec.warp.code_width, dtype)},
        jnp.int32(0),
    )
    point = jnp.asarray([0.25, -0.5, 0.125], dtype)

    def total(params):
        jacobian = jax.jacfwd(lambda x: warp.displace(spec.warp, params, x, condition))
        return elastic.cost(spec.elastic, jacobian(point))

    return many, jax.jit(jax.vmap(jax.value_and_grad(total)))


def test_slopes_through_the_jacobian_are_finite(dtype):
    many, program = all_warps(dtype)
    values, slopes = jax.tree.map(np.asarray, program(many))
    tolerance = {"float32": 2e-6, "float64": 1e-12}[dtype]
    for row, (name, displacement) in enumerate(DISPLACEMENTS.items()):
        exact = linear_warps.cost(tiny_fields.tiny("nerfies").elastic, displacement)
        np.testing.assert_allclose(values[row], exact, rtol=tolerance, atol=1e-18)
        own = jax.tree.map(lambda leaf, row=row: leaf[row], slopes)
        assert not hostile.not_finite(own), name
        steep = max(float(np.max(np.abs(leaf))) for leaf in jax.tree.leaves(own))
        rigid = name in ("nothing", "a half turn")
        assert (steep == 0) if rigid else (steep > 0), name
    if dtype == "float64":
        slopes_are_those_of_differences(many, program, slopes)


def slopes_are_those_of_differences(many, program, slopes):
    """Along a random way, where the cost has no corner."""
    rng = np.random.default_rng(0)
    way = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), many)
    step = 1e-6
    # With their slopes, which nobody reads: it is the program that is there.
    ahead, _ = program(jax.tree.map(lambda x, w: x + step * w, many, way))
    behind, _ = program(jax.tree.map(lambda x, w: x - step * w, many, way))
    products = jax.tree.map(
        lambda slope, w: np.sum(slope * w, axis=tuple(range(1, w.ndim))), slopes, way
    )
    difference = (np.asarray(ahead) - np.asarray(behind)) / (2 * step)
    smooth = [name not in CORNERS for name in DISPLACEMENTS]
    # Where it is zero the two ends differ by 1e-13, rounding of a Jacobian of minus one
    np.testing.assert_allclose(
        difference[smooth],
        sum(jax.tree.leaves(products))[smooth],
        rtol=1e-4,
        atol=1e-7,
    )
