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
from hypothesis import given

from nerfies_jax.geometry import lie, quaternion
from tests.hard_cases import properties
from tests.hard_cases.properties import cast, close, compiled, eps, norm, same

pytestmark = [pytest.mark.hard_cases, pytest.mark.full]
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
