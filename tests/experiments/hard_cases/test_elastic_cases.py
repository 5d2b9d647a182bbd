"""The elastic energy at its hard points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform

from experiments.hard_cases.elastic import CASES
from nerfies_jax.fields.effects import elastic
from nerfies_jax.geometry import lie, matrix3
from tests.experiments.hard_cases import checks

Rotation = scipy.spatial.transform.Rotation
ENERGIES = {
    "log_energy": matrix3.log_energy,
    "signed_log_energy": matrix3.signed_log_energy,
    "displacement_log_energy": matrix3.displacement_log_energy,
}
TURN = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
BACK = Rotation.from_rotvec([-1, 0.4, 0.7]).as_matrix()
ROWS = 7  # as many matrices as one test asks for at most

pytestmark = pytest.mark.hard_cases
test_held = checks.by_case(CASES, slow=("float64",))


@jax.jit
@jax.vmap
def every_way(matrix):
    """By name the value and the slope; one program for most of this file."""
    energies = {name: jax.value_and_grad(f)(matrix) for name, f in ENERGIES.items()}
    values = matrix3.singular_values
    return energies | {"singular_values": (values(matrix), jax.jacrev(values)(matrix))}


def of_all(matrices, dtype):
    """`every_way` of a few matrices; more rows than asked for share the program."""
    rows = np.resize(np.asarray(matrices, dtype), (ROWS, 3, 3))
    results = jax.tree.map(np.asarray, every_way(rows))
    return jax.tree.map(lambda leaf: leaf[: len(matrices)], results)


@pytest.mark.parametrize("name", ["log_energy", "signed_log_energy"])
def test_value_and_slope_are_continuous_where_the_logarithm_becomes_a_tangent(
    name, dtype
):
    """Twice differentiable but for this edge, where the curvature jumps."""
    edge = np.asarray(matrix3.COLLAPSED, dtype)
    least = [np.nextafter(edge, np.asarray(0, dtype)), edge]
    value, slope = of_all([np.diag([2, 1, x]) for x in least], dtype)[name]
    eps = np.finfo(dtype).eps
    assert abs(value[1] - value[0]) < 8 * eps * value[0]
    assert np.max(abs(slope[1] - slope[0])) < 8 * eps * np.max(abs(slope[0]))


def _field(params, point):
    """A warp that mostly translates: turns of 1e-5, changing from place to place."""
    turn, shift = params
    return lie.displacement(turn @ point, shift @ point + jnp.sum(shift), point)


@pytest.mark.slow
def test_the_elastic_gradient_of_a_translating_warp_survives_float32():
    """Through warp, Jacobian and energy; officially 80 % wrong in the turn."""

    @jax.grad
    def slopes(params, points):
        def at(point):
            jacobian = jax.jacfwd(lambda x: _field(params, x))(point)
            return elastic.displacement_cost(elastic.ElasticSpec(), jacobian)

        return jnp.mean(jax.vmap(at)(points))

    rng = np.random.default_rng(0)
    turn, shift = 1e-5 * rng.normal(size=(3, 3)), 1e-3 * rng.normal(size=(3, 3))
    shift[0] += 0.4  # scene units of plain translation beside it
    points = rng.uniform(-1, 1, (16, 3))
    inputs = [np.asarray(x, np.float32) for x in (turn, shift, points)]
    results = jax.jit(slopes)(tuple(inputs[:2]), inputs[2])
    with jax.enable_x64(True):
        wide = [np.asarray(x, np.float64) for x in inputs]
        roughly = dict(checks.ROUGHLY)  # how it is compiled does not matter
        exact = jax.jit(slopes, compiler_options=roughly)(tuple(wide[:2]), wide[2])
    for one, other in zip(results, exact, strict=True):
        one, other = np.asarray(one, np.float64), np.asarray(other)
        assert np.max(abs(one - other)) < 1e-5 * np.max(abs(other))


@pytest.mark.parametrize("name", ["log_energy", "signed_log_energy"])
@pytest.mark.parametrize("stretch", [0, 1e-5, 1e-3, 9e-3])
def test_a_collapsed_direction_is_pulled_open(name, stretch, dtype):
    """A clamp at 1e-6 has no slope below it; the tangent keeps 2 log(0.01) / 0.01."""
    matrix = TURN @ np.diag([1.5, 1, stretch]) @ BACK
    _, slope = of_all([matrix], dtype)[name]
    along = np.sum(slope[0] * np.outer(TURN[:, 2], BACK[2]))
    if name == "log_energy" and stretch == 0:
        along = -abs(along)  # at the cone either way is up
    assert along < -900
