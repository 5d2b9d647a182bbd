"""The elastic energy at its hard points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.hard_elastic import ALONG, CASES, DIRECTIONS
from nerfies_jax.effects import elastic
from nerfies_jax.geometry import lie, matrix3
from tests.hard_cases import checks

Rotation = scipy.spatial.transform.Rotation
ENERGIES = {
    "log_energy": matrix3.log_energy,
    "signed_log_energy": matrix3.signed_log_energy,
    "displacement_log_energy": matrix3.displacement_log_energy,
}
TURN = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
BACK = Rotation.from_rotvec([-1, 0.4, 0.7]).as_matrix()


@checks.by_case(CASES, slow=("float64",))
def test_held(case, dtype):
    checks.hold(case, dtype)


@pytest.mark.hard_cases
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_textbook_form_is_caught(case):
    checks.catches_the_textbook(case)


def neighbours(edge, dtype):
    """Two adjacent numbers, the lower one below `edge`."""
    above = np.asarray(edge, dtype)
    return np.stack([np.nextafter(above, np.asarray(0, dtype)), above])


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", ["log_energy", "signed_log_energy"])
def test_value_and_slope_are_continuous_where_the_logarithm_becomes_a_tangent(
    name, dtype
):
    """Twice differentiable but for this edge, where the curvature jumps."""
    least = neighbours(matrix3.COLLAPSED, dtype)
    both = jnp.asarray([np.diag([2, 1, x]) for x in least], dtype)
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(ENERGIES[name])))(both)
    eps = np.finfo(dtype).eps
    assert abs(value[1] - value[0]) < 8 * eps * value[0]
    assert np.max(abs(slope[1] - slope[0])) < 8 * eps * np.max(abs(slope[0]))


@pytest.mark.hard_cases
def test_both_forms_of_a_displacement_meet_in_value_slope_and_curvature(dtype):
    """The smallest step across |D| = 0.1: log1p of strains before, Jacobi on J after.

    The two differ by what rounding J = 1 + D costs, an ulp of one in 0.1.
    """
    unit = np.tensordot(ALONG, DIRECTIONS, 1)
    unit = unit / np.linalg.norm(unit)
    edge = matrix3.SMALL_DISPLACEMENT
    eps = float(np.finfo(dtype).eps)
    both = jnp.asarray(
        [edge * (1 - 2 * eps) * unit, edge * (1 + 2 * eps) * unit], dtype
    )
    sizes = np.sum(np.asarray(both, np.float64) ** 2, axis=(1, 2))
    assert sizes[0] < edge**2 < sizes[1]
    along = jnp.asarray(DIRECTIONS[1], dtype)

    def all_orders(matrix):
        slope = jax.value_and_grad(matrix3.displacement_log_energy)
        (value, first), (_, second) = jax.jvp(slope, (matrix,), (along,))
        return value, first, second

    for order in jax.jit(jax.vmap(all_orders))(both):
        size = np.max(abs(order[0]))
        assert np.max(abs(order[1] - order[0])) < 100 * eps * size


@pytest.mark.hard_cases
@pytest.mark.parametrize("kind", ["bfloat16", "float16"])
@pytest.mark.parametrize("name", [*ENERGIES, "singular_values", "svd"])
def test_half_precision_is_rounded_once(name, kind):
    function = getattr(matrix3, name)
    matrix = jnp.asarray(0.1 * DIRECTIONS[0], kind)
    found = jax.tree.leaves(jax.jit(function)(matrix))
    exact = jax.tree.leaves(jax.jit(function)(matrix.astype(jnp.float32)))
    for one, other in zip(found, exact, strict=True):
        assert one.dtype == kind
        off = np.abs(one.astype(jnp.float32) - other)
        half_ulp = float(jnp.finfo(kind).eps) / 2
        assert np.all(off <= 1.001 * half_ulp * np.abs(other) + 6e-8)


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", [*ENERGIES, "singular_values"])
def test_float32_stays_float32_with_x64_on(name):
    function = getattr(matrix3, name)
    matrix = jnp.asarray(np.eye(3) + 0.2 * DIRECTIONS[2], jnp.float32)
    alone = jax.jit(function)(matrix)
    with jax.enable_x64(True):
        wide = jax.jit(function)(matrix)
        slope = jax.jit(jax.jacrev(function))(matrix)
        rows = jax.jit(jax.vmap(function))(jnp.stack([matrix, matrix]))
    assert wide.dtype == slope.dtype == rows.dtype == jnp.float32
    for other in (wide, rows[1]):
        np.testing.assert_allclose(other, alone, rtol=2e-6)


def _field(params, point):
    """A warp that mostly translates: turns of 1e-5, changing from place to place."""
    turn, shift = params
    return lie.displacement(turn @ point, shift @ point + jnp.sum(shift), point)


@pytest.mark.hard_cases
@pytest.mark.slow
@pytest.mark.parametrize("spec", [elastic.ElasticSpec(), None], ids=["robust", "plain"])
def test_the_elastic_gradient_of_a_translating_warp_survives_float32(spec):
    """Through warp, Jacobian and energy; officially 80 % wrong in the turn."""
    cost = matrix3.displacement_log_energy
    if spec is not None:

        def cost(jacobian):
            return elastic.cost(spec, jacobian)

    def mean(params, points):
        def at(point):
            return cost(jax.jacfwd(lambda x: _field(params, x))(point))

        return jnp.mean(jax.vmap(at)(points))

    rng = np.random.default_rng(0)
    turn, shift = 1e-5 * rng.normal(size=(3, 3)), 1e-3 * rng.normal(size=(3, 3))
    shift[0] += 0.4  # scene units of plain translation beside it
    points = rng.uniform(-1, 1, (16, 3))
    inputs = [jnp.asarray(x, jnp.float32) for x in (turn, shift, points)]
    found = jax.jit(jax.grad(mean))(tuple(inputs[:2]), inputs[2])
    with jax.enable_x64(True):
        wide = [jnp.asarray(np.asarray(x), jnp.float64) for x in inputs]
        exact = jax.jit(jax.grad(mean))(tuple(wide[:2]), wide[2])
    for one, other in zip(found, exact, strict=True):
        one, other = np.asarray(one, np.float64), np.asarray(other)
        assert np.max(abs(one - other)) < 1e-5 * np.max(abs(other))


numbers = st.floats(-1, 1, width=32)
triples = st.tuples(numbers, numbers, numbers)
axioms = settings(max_examples=40, deadline=None, derandomize=True, database=None)


@jax.jit
def _energies(matrix, one, other):
    turned = lie.exp_so3(one) @ matrix @ lie.exp_so3(other)
    still = lie.exp_so3(one) - jnp.eye(3, dtype=one.dtype)
    energy, signed = matrix3.log_energy, matrix3.signed_log_energy
    flat = matrix3.displacement_log_energy(matrix - jnp.eye(3, dtype=matrix.dtype))
    return {
        "turned": energy(turned) - energy(matrix),
        "turned, signed": signed(turned) - signed(matrix),
        "turned over": energy(matrix.T) - energy(matrix),
        "mirrored": energy(-matrix) - energy(matrix),
        "undone": energy(jnp.linalg.inv(matrix)) - energy(matrix),
        "displaced": flat - energy(matrix),
        "rigid": matrix3.displacement_log_energy(still),
    }


@pytest.mark.slow
@pytest.mark.hard_cases
@pytest.mark.parametrize("kind", ["float32", "float64"])
@axioms
@given(stretch=triples, one=triples, other=triples)
def test_turning_before_or_after_costs_nothing(kind, stretch, one, other):
    """Nor does undoing or transposing; stretches from 1/e to e."""
    matrix = TURN @ np.diag(np.exp(stretch)) @ BACK
    with jax.enable_x64(kind == "float64"):
        args = [jnp.asarray(x, kind) for x in (matrix, one, other)]
        for name, rest in _energies(*args).items():
            # energies to 3, by matrices of condition up to e²
            assert abs(rest) < {"float32": 2e-5, "float64": 4e-14}[kind], name


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", ["log_energy", "signed_log_energy"])
@pytest.mark.parametrize("stretch", [0, 1e-5, 1e-3, 9e-3])
def test_a_collapsed_direction_is_pulled_open(name, stretch, dtype):
    """A clamp at 1e-6 has no slope below it; the tangent keeps 2 log(0.01) / 0.01."""
    matrix = jnp.asarray(TURN @ np.diag([1.5, 1, stretch]) @ BACK, dtype)
    slope = jax.jit(jax.grad(ENERGIES[name]))(matrix)
    along = np.sum(np.asarray(slope) * np.outer(TURN[:, 2], BACK[2]))
    if name == "log_energy" and stretch == 0:
        along = -abs(along)  # at the cone either way is up
    assert along < -900
