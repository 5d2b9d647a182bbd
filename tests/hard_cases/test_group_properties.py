"""Rotations, quaternions and screws are the groups they claim to be.

Bounds are counts of roundings. A component of a product of quaternions is a sum of four
products, of size at most |a| |b| (Cauchy and Schwarz): off by 2 eps |a| |b|, the whole
product by 4. A rotation made from w is off by the rounding of its angle, 2π eps, and as
much again from its entries: 16 eps in all (`TURN`; 8 was the most in 1000 draws of each
property). What a screw moves is that times lengths.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given

from nerfies_jax.geometry import lie, matrix3, quaternion
from tests.hard_cases import properties
from tests.hard_cases.properties import cast, close, compiled, eps, norm, same

pytestmark = pytest.mark.hard_cases
TURN = 16
Q, UNIT = properties.quaternions(), properties.unit_quaternions()
TURNS, SCREWS, POINT = (
    properties.rotation_vectors(),
    properties.screws(),
    properties.vectors(),
)
SHORT = properties.rotation_vectors(math.pi * (1 - 1e-3))  # one logarithm only


def length(*vectors):
    """1 and the lengths of what a bound grows with."""
    return 1 + sum(norm(v) for v in vectors)


@compiled
def products(a, b, c):
    ab, bc = quaternion.multiply(a, b), quaternion.multiply(b, c)
    return ab, quaternion.multiply(ab, c), quaternion.multiply(a, bc)


@given(a=Q, b=Q, c=Q)
def test_the_quaternion_product_is_associative_and_keeps_norms(a, b, c, dtype):
    a, b, c = cast(dtype, a, b, c)
    sizes = [norm(q) for q in (a, b, c)]
    ab, left, right = products(a, b, c)
    # 4 eps from the inner product, 2 from the outer, on both sides
    close(left, right, 12 * eps(dtype) * np.prod(sizes))
    product = norm(ab)
    close(product, sizes[0] * sizes[1], 4 * eps(dtype) * sizes[0] * sizes[1])


@compiled
def with_identity(q):
    one = quaternion.identity(q.dtype)
    unit = quaternion.normalise(q)
    return (
        quaternion.multiply(one, q),
        quaternion.multiply(q, one),
        quaternion.multiply(unit, quaternion.conjugate(unit)),
    )


@given(q=Q)
def test_quaternions_have_an_identity_and_inverses(q, dtype):
    q = cast(dtype, q)
    left, right, nothing = with_identity(q)
    same(left, q)
    same(right, q)
    # 2 eps of the product, and twice the 2 eps that a unit may be short
    close(nothing, [1, 0, 0, 0], 6 * eps(dtype))


@compiled
def turned(a, b, x):
    ab = quaternion.multiply(a, b)
    return (
        quaternion.rotate(ab, x),
        quaternion.rotate(a, quaternion.rotate(b, x)),
        quaternion.to_matrix(ab),
        quaternion.to_matrix(a),
        quaternion.to_matrix(b),
    )


@given(a=Q, b=Q, x=POINT)
def test_a_product_of_quaternions_acts_like_its_factors(a, b, x, dtype):
    a, b, x = cast(dtype, a, b, x)
    at_once, in_turn, whole, first, second = turned(a, b, x)
    size = norm(x)
    close(at_once, in_turn, TURN * eps(dtype) * size)
    close(norm(at_once), size, TURN * eps(dtype) * size)
    first, second = (np.asarray(m, np.float64) for m in (first, second))
    close(whole, first @ second, TURN * eps(dtype))


def images(q, x):
    """The matrix of q, and x turned by q and then by nothing."""
    one = np.array([1, 0, 0, 0], q.dtype)
    _, point, _, _, whole = turned(one, q, x)
    return whole, point


@given(q=Q, x=POINT, power=properties.numbers(-5, 5))
def test_a_quaternion_its_negative_and_its_multiples_turn_alike(q, x, power, dtype):
    q, negative, multiple, x = cast(dtype, q, -q, q * 10**power, x)
    here = images(q, x)
    same(here, images(negative, x))
    size = norm(x)
    there = images(multiple, x)
    close(here[0], there[0], TURN * eps(dtype))
    close(here[1], there[1], TURN * eps(dtype) * size)


@compiled
def there_and_back(q):
    vector = quaternion.log(q)
    return (
        vector,
        quaternion.log(-q),
        quaternion.exp(vector),
        quaternion.from_matrix(quaternion.to_matrix(q)),
    )


@given(q=UNIT)
def test_quaternions_survive_logarithm_and_matrix_up_to_sign(q, dtype):
    q = cast(dtype, q)
    vector, opposite, back, through_matrix = there_and_back(q)
    assert norm(vector) <= math.pi * (1 + 4 * eps(dtype))
    # Of a half turn, w = 0, both directions are as short.
    same(vector, opposite if q[0] != 0 else -opposite)
    for found in (back, through_matrix):
        sign = np.sign(np.dot(found, q))
        close(sign * found, q, TURN * eps(dtype))
        assert found[0] >= -4 * eps(dtype)  # cos of an angle rounded up to π / 2


@compiled
def logarithms(w):
    rotation = lie.exp_so3(w)
    return (
        quaternion.log(quaternion.exp(w)),
        lie.log_so3(rotation),
        rotation,
        quaternion.to_matrix(quaternion.exp(w)),
    )


@given(w=TURNS)
def test_logarithms_invert_exponentials_the_short_way_round(w, dtype):
    w = cast(dtype, w)
    through_quaternion, through_matrix, rotation, other = logarithms(w)
    exact = np.asarray(w, np.float64)
    angle = norm(exact)
    if angle > math.pi:
        exact = exact * (1 - 2 * math.pi / angle)
    near_pi = abs(angle - math.pi) < 1e-3  # rounding may choose the other direction
    for found in (through_quaternion, through_matrix):
        sign = np.sign(np.dot(found, exact)) if near_pi else 1
        away = 2 * abs(angle - math.pi) if near_pi and sign < 0 else 0
        close(sign * found, exact, TURN * eps(dtype) + away)
    close(rotation, other, TURN * eps(dtype))


@compiled
def rotations(w, x):
    rotation = lie.exp_so3(w)
    return rotation, lie.exp_so3(-w), rotation @ x, lie.rotate_point(w, x)


@given(w=TURNS, x=POINT)
def test_rotations_are_orthogonal_and_invert_by_sign(w, x, dtype):
    w, x = cast(dtype, w, x)
    rotation, inverse, product, point = rotations(w, x)
    close(inverse, rotation.T, 4 * eps(dtype))
    exact = np.asarray(rotation, np.float64)
    close(exact @ exact.T, np.eye(3), TURN * eps(dtype))
    close(np.linalg.det(exact), 1, TURN * eps(dtype))
    close(product, point, TURN * eps(dtype) * norm(x))


@compiled
def twice(w, first, second, x):
    return (
        lie.rotate_point(second * w, lie.rotate_point(first * w, x)),
        lie.rotate_point((first + second) * w, x),
    )


@given(
    w=TURNS, x=POINT, first=properties.numbers(-2, 2), second=properties.numbers(-2, 2)
)
def test_turns_about_one_axis_add(w, x, first, second, dtype):
    in_turn, at_once = twice(*cast(dtype, w, first, second, x))
    # the sum of angles up to 4 * 2π is rounded to 4π eps
    close(in_turn, at_once, 3 * TURN * eps(dtype) * norm(x))


@compiled
def there_again(screw, x):
    moved = lie.transform_point(*screw, x)
    rotation, translation = lie.exp_se3(*screw)
    return (
        moved,
        lie.transform_point(-screw.angular, -screw.linear, moved),
        rotation @ x + translation,
        x + lie.displacement(*screw, x),
    )


@given(screw=SCREWS, x=POINT)
def test_screws_act_as_their_matrices_and_invert_by_sign(screw, x, dtype):
    screw, x = cast(dtype, screw, x)
    moved, back, by_matrix, displaced = there_again(screw, x)
    bound = TURN * eps(dtype) * length(x, screw.linear)
    close(moved, by_matrix, bound)
    same(moved, displaced)
    close(back, x, 2 * bound)


@given(
    w=TURNS, along=properties.numbers(-3, 3), x=POINT, share=properties.numbers(-1, 1)
)
def test_commuting_screws_add(w, along, x, share, dtype):
    """Multiples of one screw, and a turn with a shift along its own axis."""
    w, along, x, share = cast(dtype, w, along, x, share)
    linear = along * w
    both = there_again(properties.Screw(w, linear), x)[0]
    nothing = np.zeros_like(w)
    turn = there_again(properties.Screw(w, nothing), x)[0]
    close(turn + linear, both, TURN * eps(dtype) * length(x, linear))
    part = properties.Screw(share * w, share * linear)
    rest = properties.Screw((1 - share) * w, (1 - share) * linear)
    in_turn = there_again(part, there_again(rest, x)[0])[0]
    close(in_turn, both, 3 * TURN * eps(dtype) * length(x, linear))


@compiled
def composed(first, second, x):
    (a, s), (b, t) = lie.exp_se3(*first), lie.exp_se3(*second)
    joint = lie.log_se3(b @ a, b @ s + t)
    in_turn = lie.transform_point(*second, lie.transform_point(*first, x))
    return joint, lie.transform_point(*joint, x), in_turn


@given(first=SCREWS, second=SCREWS, x=POINT)
def test_the_logarithm_of_a_composition_acts_like_its_parts(first, second, x, dtype):
    first, second, x = cast(dtype, first, second, x)
    (angular, _), at_once, in_turn = composed(first, second, x)
    assert norm(angular) <= math.pi * (1 + 4 * eps(dtype))
    # log amplifies by |J⁻¹| <= π / 2, and the product of matrices doubles the error
    bound = 4 * TURN * eps(dtype) * length(x, first.linear, second.linear)
    close(at_once, in_turn, bound)


@given(w=SHORT, v=POINT)
def test_screw_logarithm_inverts_the_exponential_below_pi(w, v, dtype):
    screw = cast(dtype, properties.Screw(w, v))
    # To do nothing before it rounds nothing.
    still = properties.Screw(0 * screw.angular, 0 * screw.linear)
    (angular, linear), _, _ = composed(still, screw, screw.linear)
    close(angular, screw.angular, TURN * eps(dtype))
    close(linear, screw.linear, 2 * TURN * eps(dtype) * length(v))


@compiled
def conjugated(rotation, translation, screw, x):
    """M exp(ξ) M⁻¹ x and exp(Ad_M ξ) x, Ad_M (w, v) = (R w, R v + t × R w)."""
    inside = lie.transform_point(*screw, rotation.T @ (x - translation))
    angular = rotation @ screw.angular
    linear = rotation @ screw.linear + jnp.cross(translation, angular)
    return rotation @ inside + translation, lie.transform_point(angular, linear, x)


@given(motion=properties.motions(), screw=SCREWS, x=POINT)
def test_conjugating_a_screw_is_its_adjoint(motion, screw, x, dtype):
    _, rotation, translation = cast(dtype, motion)
    outside, inside = conjugated(rotation, translation, *cast(dtype, screw, x))
    # t × R w is at most 2π |t|
    bound = 2 * TURN * eps(dtype) * length(x, screw.linear, 2 * math.pi * translation)
    close(outside, inside, bound)


@compiled
def jacobians(screw):
    rotation, translation = lie.exp_se3(*screw)
    nothing = jnp.zeros_like(rotation)
    adjoint = jnp.block(
        [[rotation, nothing], [lie.hat(translation) @ rotation, rotation]]
    )
    return (
        lie.left_jacobian_se3(*screw),
        adjoint @ lie.left_jacobian_se3(-screw.angular, -screw.linear),
        lie.inverse_left_jacobian(screw.angular),
        lie.left_jacobian_se3(*screw) @ jnp.concatenate(screw),
    )


@given(screw=SCREWS)
def test_jacobians_of_the_two_sides_differ_by_the_adjoint(screw, dtype):
    """J(ξ) = Ad(exp ξ) J(-ξ), J(ξ) ξ = ξ; that of a turn has an inverse below 2π."""
    angle = norm(screw.angular)
    screw = cast(dtype, screw)
    left, right, inverse, itself = jacobians(screw)
    size = length(screw.linear)
    # the coupling grows with θ |v|, the adjoint with |t| again
    bound = 4 * TURN * eps(dtype) * size
    close(left, right, 2 * bound)
    close(itself, np.concatenate(screw), 8 * bound)
    # |J⁻¹| is (θ/2) / sin(θ/2)
    if angle < 2 * math.pi - 0.1:
        worse = max(1, angle / 2 / math.sin(angle / 2)) if angle else 1
        close(inverse @ left[:3, :3], np.eye(3), worse * bound)


@compiled
def between(a, turn, share, g):
    """Pairs of quaternions that should be the same rotation."""
    multiply = quaternion.multiply
    b = multiply(quaternion.exp(turn), a)
    starts = jnp.stack([a, b, multiply(g, a), a, a, a])
    ends = jnp.stack([b, a, multiply(g, b), -b, b, b])
    shares = jnp.stack([share, 1 - share, share, share, 0 * share, 0 * share + 1])
    forward, backward, moved, other, first, last = jax.vmap(quaternion.slerp)(
        starts, ends, shares
    )
    return (
        (backward, forward),
        (moved, multiply(g, forward)),
        (other, forward),
        (first, a),
        (last, b),
    )


@given(a=UNIT, turn=SHORT, share=properties.numbers(0, 1), g=UNIT)
def test_interpolation_is_the_same_from_both_ends_and_in_any_frame(
    a, turn, share, g, dtype
):
    for found, expected in between(*cast(dtype, a, turn, share, g)):
        sign = np.sign(np.dot(found, expected))
        close(sign * found, expected, 4 * TURN * eps(dtype))


@compiled
def strains(matrix, one, other):
    """Energies and stretches of J and of R J S."""
    rotated = quaternion.to_matrix(one) @ matrix @ quaternion.to_matrix(other)
    functions = (
        matrix3.log_energy,
        matrix3.signed_log_energy,
        matrix3.singular_values,
    )
    return [jax.vmap(f)(jnp.stack([matrix, rotated])) for f in functions]


@given(strain=properties.many((3, 3), -2, 2), one=UNIT, other=UNIT)
def test_elastic_energies_do_not_see_rotations(strain, one, other, dtype):
    stretches = np.linalg.svd(strain, compute_uv=False)
    # Below COLLAPSED the energy's slope is 2 log(σ) / σ of that stretch, about 920.
    assume(stretches[0] > 0)
    energies = strains(*cast(dtype, strain, one, other))
    bound = TURN * eps(dtype) * stretches[0]
    steepest = 2 * abs(math.log(matrix3.COLLAPSED)) / matrix3.COLLAPSED
    for (here, there), slope in zip(energies, (steepest, steepest, 1), strict=True):
        close(there, here, 3 * slope * bound + TURN * eps(dtype) * np.abs(here))
