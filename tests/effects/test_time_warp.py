"""TiNeuVox's motion and its smooth grid against loops in NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.effects import smoothness, time_warp
from nerfies_jax.effects.smoothness import SmoothnessSpec
from nerfies_jax.effects.time_warp import TimeWarpSpec
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.nets.grids import HashGridSpec
from nerfies_jax.nets.voxels import VoxelGridSpec
from nerfies_jax.radiance.template import Template, TemplateSpec
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from tests import drawn, gradients
from tests.oracles import networks

SPEC = TimeWarpSpec(EncodingSpec(3), EncodingSpec(2), embedding=4, depth=3, width=7)


def at(time, dtype):
    return FrameCondition(jnp.asarray(time, dtype), {}, jnp.int32(0))


def by_hand(params, point, time):
    """(shift, what the radiance network reads), layer by layer in float64."""
    waves = networks.waves(SPEC.time, time)
    embedding = networks.heads(params.time, waves)["embedding"]
    read = np.concatenate([networks.waves(SPEC.position, point), embedding])
    return networks.heads(params.shift, read)["linear"], read


@pytest.mark.parametrize("time", [0.0, 0.37, 1.0])
def test_shift_and_features_are_those_of_the_layers(time, dtype, rng):
    params = drawn.params(lambda key: time_warp.init(SPEC, key), dtype, 0.3)
    effect = time_warp.effect(SPEC)
    points = rng.uniform(-1, 1, (4, 3)).astype(dtype)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def both(params, point):
        when = at(time, dtype)
        return effect.displace(params, point, when), effect.lift(params, point, when)

    shifts, lifted = both(params, points)
    assert shifts.dtype == lifted.dtype == dtype
    assert lifted.shape == (4, effect.lift_width)
    bound = {"float32": 2e-5, "float64": 1e-13}[dtype]
    for point, shift, features in zip(points, shifts, lifted, strict=True):
        expected = by_hand(params, np.asarray(point, np.float64), time)
        np.testing.assert_allclose(shift, expected[0], rtol=bound, atol=bound)
        np.testing.assert_allclose(features, expected[1], rtol=bound, atol=bound)


@pytest.mark.hard_cases
def test_it_starts_as_the_identity_and_does_not_stay_there(rng):
    spec = TimeWarpSpec()
    points = rng.uniform(-1, 1, (300, 3)).astype(np.float32)
    moved = jax.vmap(functools.partial(time_warp.displace, spec), (None, 0, None))

    def total(params):
        shift = moved(params, points, at(0.4, "float32"))
        return jnp.sum(shift**2), jnp.max(jnp.abs(shift))

    start = jax.jit(time_warp.init, static_argnums=0)(spec, jax.random.key(0))
    slopes, longest = jax.jit(jax.grad(total, has_aux=True))(start)
    assert 0 < longest < 1e-4
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves(slopes.shift.heads))


def test_gradients(float64, rng):
    params = drawn.params(lambda key: time_warp.init(SPEC, key), "float64", 0.3)
    pull = rng.normal(size=SPEC.position.width(3) + SPEC.embedding)

    def total(params, point, time):
        when = FrameCondition(time, {}, jnp.int32(0))
        read = time_warp.features(SPEC, params, point, when)
        shift = time_warp.displace(SPEC, params, point, when)
        return pull @ read + jnp.sum(jnp.sin(shift))

    point = rng.uniform(-1, 1, 3)
    assert gradients.directional_error(total, params, point, np.float64(0.3)) < 1e-6


TEMPLATES = {
    "coarse": TemplateSpec(HashGridSpec(levels=3, coarsest=2, finest=8, rows=130)),
    "fine": TemplateSpec(VoxelGridSpec(cells=4, features=3)),
}


def tables(dtype, rng):
    shapes = {"coarse": [(27, 2), (125, 2), (130, 2)], "fine": [(125, 3)]}
    return {
        name: tuple(jnp.asarray(rng.normal(size=one), dtype) for one in shape)
        for name, shape in shapes.items()
    }


def roughness(effect, found, step):
    nets = {name: Template(None, None, one) for name, one in found.items()}
    context = PenaltyContext(None, jnp.int32(step), None, {"template": nets})
    return effect.penalty(None, context)["variation"]


def test_smoothness_is_the_mean_square_between_neighbours(dtype, rng):
    effect = smoothness.effect(SmoothnessSpec(2.0, until=5), TEMPLATES)
    found = tables(dtype, rng)
    term = roughness(effect, found, 4)
    assert term.value.dtype == dtype

    def of(table, vertices):
        grid = np.asarray(table, np.float64).reshape(*[vertices] * 3, -1)
        return np.mean([np.mean(np.diff(grid, axis=a) ** 2) for a in range(3)])

    coarse = [of(found["coarse"][0], 3), of(found["coarse"][1], 5)]  # 8 cells hashed
    expected = np.mean(coarse) + of(found["fine"][0], 5)
    np.testing.assert_allclose(term.value, expected, rtol=3e-6)
    assert term.weight == 2
    assert roughness(effect, found, 5).weight == 0


@pytest.mark.hard_cases
def test_a_level_grid_has_neither_roughness_nor_slope(dtype, rng):
    effect = smoothness.effect(SmoothnessSpec(), TEMPLATES)
    level = jax.tree.map(lambda x: 0 * x + 7, tables(dtype, rng))
    value, slopes = jax.value_and_grad(lambda t: roughness(effect, t, 0).value)(level)
    assert value == 0
    assert not any(leaf.any() for leaf in jax.tree.leaves(slopes))


def test_smoothness_needs_a_grid():
    with pytest.raises(ValueError, match="no template has one; set smoothness=none"):
        smoothness.effect(SmoothnessSpec(), {"fine": TemplateSpec()})
