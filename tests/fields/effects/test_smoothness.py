"""Total variation of grids and planes against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields.effects import smoothness
from nerfies_jax.fields.effects.smoothness import SmoothnessSpec
from nerfies_jax.fields.template import Template, TemplateSpec
from nerfies_jax.nn import planes
from nerfies_jax.nn.grids import HashGridSpec
from nerfies_jax.nn.planes import PlanesSpec
from nerfies_jax.nn.voxels import VoxelGridSpec
from nerfies_jax.training.effects import PenaltyContext
from tests import random_params

PLANES = PlanesSpec(vertices=3, multiples=(1, 2), features=2)
TEMPLATES = {
    "coarse": TemplateSpec(PLANES),
    "fine": TemplateSpec(VoxelGridSpec(cells=4, features=3)),
}
HASHED = {"fine": TemplateSpec(HashGridSpec(levels=2, coarsest=2, finest=4, rows=130))}


def tables(dtype, rng):
    voxels = (jnp.asarray(rng.normal(size=(125, 3)), dtype),)
    read = random_params.like(lambda key: planes.init(PLANES, key), dtype, 0.3)
    return {"coarse": read, "fine": voxels}


def roughness(effect, random_tables, step, seed=0):
    nets = {name: Template(None, None, one) for name, one in random_tables.items()}
    key, step = jax.random.key(seed), jnp.int32(step)
    context = PenaltyContext(None, step, key, {"template": nets})
    return effect.loss(context.params, context)["variation"]


def of(grid, axes):
    grid = np.asarray(grid, np.float64)
    return np.mean([np.mean(np.diff(grid, axis=axis) ** 2) for axis in range(axes)])


def test_smoothness_is_the_mean_square_between_neighbors(dtype, rng):
    effect = smoothness.Bound(SmoothnessSpec(2.0, until=5), TEMPLATES)
    random_tables = tables(dtype, rng)
    term = roughness(effect, random_tables, 4)
    assert term.value.dtype == dtype
    read = [of(plane, 2) for level in random_tables["coarse"] for plane in level.space]
    expected = np.mean(read) + of(np.reshape(random_tables["fine"][0], (5, 5, 5, 3)), 3)
    np.testing.assert_allclose(term.value, expected, rtol=3e-6)
    assert term.weight == 2
    assert roughness(effect, random_tables, 5).weight == 0


def test_of_hashed_grids_it_is_guessed(rng):
    effect = smoothness.Bound(SmoothnessSpec(), HASHED)
    rows = tuple(jnp.asarray(rng.normal(size=(n, 2)), "float32") for n in (27, 125))
    each = [of(np.reshape(rows[0], (3, 3, 3, 2)), 3)]
    each += [of(np.reshape(rows[1], (5, 5, 5, 2)), 3)]
    guessed = [roughness(effect, {"fine": rows}, 0, seed).value for seed in (0, 1)]
    assert guessed[0] != guessed[1]
    np.testing.assert_allclose(guessed, np.mean(each), rtol=0.1)  # three sigmas


@pytest.mark.hard_cases
def test_what_is_even_has_neither_roughness_nor_slope(dtype, rng):
    effect = smoothness.Bound(SmoothnessSpec(), TEMPLATES)
    level = jax.tree.map(lambda x: 0 * x + 7, tables(dtype, rng))
    value, slopes = jax.value_and_grad(lambda t: roughness(effect, t, 0).value)(level)
    assert value == 0
    assert not any(leaf.any() for leaf in jax.tree.leaves(slopes))


def test_smoothness_needs_tables():
    with pytest.raises(ValueError, match="no template has one; set smoothness=none"):
        smoothness.Bound(SmoothnessSpec(), {"fine": TemplateSpec()})
