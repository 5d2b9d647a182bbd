"""so3 and se3 against SciPy, and every function of one point against a loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.spatial.transform

from nerfies_jax.geometry import camera, lie, matrix3, quaternion, se3, so3
from nerfies_jax.geometry.stumpff import SERIES_BELOW
from tests import gradients

pytestmark = pytest.mark.slow

SWITCH = SERIES_BELOW**0.5
ANGLES = np.array([0, 1e-8, 1e-3, SWITCH * (1 - 1e-6), SWITCH, np.pi - 1e-3, np.pi])
AXIS = np.array([2.0, -1.0, 2.0]) / 3
LINEAR = np.array([0.4, -0.2, 0.3])
TWISTS = np.stack([np.r_[angle * AXIS, LINEAR] for angle in ANGLES])
POINTS = np.random.default_rng(0).normal(size=(2, 1, 3))


def matrix_of(twist):
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = np.cross(np.eye(3), twist[:3])
    matrix[:3, 3] = twist[3:]
    return matrix


EXACT = np.stack([scipy.linalg.expm(matrix_of(twist)) for twist in TWISTS])


@jax.jit
def everything(twists, points):
    transforms = se3.exp(twists)
    rotations = so3.exp(twists[..., :3])
    return {
        "transforms": transforms,
        "rotations": rotations,
        "moved": se3.apply(transforms, points),
        "moved by twist": se3.apply_twist(twists, points),
        "displacement": se3.displacement(twists, points),
        "turned": so3.apply(rotations, points),
        "twists": se3.log(transforms),
        "vectors": so3.log(rotations),
        "identity": se3.multiply(se3.inverse(transforms), transforms),
        "twice": se3.multiply(transforms, transforms),
        "turned twice": so3.multiply(rotations, rotations),
        "unit": so3.multiply(so3.inverse(rotations), rotations),
    }


def test_exponentials_logarithms_and_products_are_those_of_scipy(dtype):
    actual = everything(jnp.asarray(TWISTS, dtype), jnp.asarray(POINTS, dtype))
    rotation = EXACT[:, :3, :3]
    moved = np.einsum("tij,pnj->pti", EXACT[:, :3, :3], POINTS) + EXACT[:, :3, 3]
    scipys = {
        "transforms": EXACT,
        "rotations": rotation,
        "moved": moved,
        "moved by twist": moved,
        "displacement": moved - POINTS,
        "turned": moved - EXACT[:, :3, 3],
        "identity": np.broadcast_to(np.eye(4), EXACT.shape),
        "twice": EXACT @ EXACT,
        "turned twice": rotation @ rotation,
        "unit": np.broadcast_to(np.eye(3), rotation.shape),
    }
    # A few ulps of entries up to 2; the angle itself is rounded, to 2e-7 at pi.
    bound = {"float32": 2e-6, "float64": 4e-15}[dtype]
    for name, value in scipys.items():
        assert actual[name].dtype == dtype
        assert np.max(np.abs(actual[name] - value)) < bound, name
    # Below a half turn the logarithm inverts; at it the axis may have either sign.
    below = TWISTS[:, 0] < 2
    assert np.max(np.abs(actual["twists"] - TWISTS)[below]) < 4 * bound
    again = scipy.spatial.transform.Rotation.from_rotvec(
        np.array(actual["vectors"], np.float64)
    ).as_matrix()
    bound = {"float32": 2e-6, "float64": 1e-14}[dtype]
    assert np.max(np.abs(again - rotation)) < bound


def test_left_jacobians_carry_small_changes_to_the_left(float64, rng):
    step = 1e-6 * rng.normal(size=6)
    twist = np.r_[0.7 * AXIS, LINEAR]
    whole, jacobian, inverse, crossing = (
        np.asarray(x)
        for x in jax.jit(
            lambda s: (
                se3.left_jacobian(s),
                so3.left_jacobian(s[:3]),
                so3.inverse_left_jacobian(s[:3]),
                so3.hat(s[3:]),
            )
        )(twist)
    )
    product = scipy.linalg.expm(matrix_of(whole @ step))
    changed = scipy.linalg.expm(matrix_of(twist + step))
    np.testing.assert_allclose(
        product @ scipy.linalg.expm(matrix_of(twist)), changed, atol=1e-11
    )
    np.testing.assert_allclose(whole[:3, :3], jacobian, atol=1e-15)
    np.testing.assert_allclose(inverse @ jacobian, np.eye(3), atol=1e-14)
    crossed = np.cross(twist[3:], twist[:3])
    np.testing.assert_allclose(crossing @ twist[:3], crossed, atol=1e-16)


def test_gradients_are_those_of_central_differences(float64, rng):
    def total(twists, points):
        moved = se3.apply(se3.exp(twists), points)
        again = se3.log(se3.multiply(se3.exp(twists), se3.exp(0.3 * twists)))
        return jnp.sum(jnp.sin(moved)) + jnp.sum(jnp.cos(again))

    twists = TWISTS[[0, 1, 2]]
    assert gradients.directional_error(total, twists, POINTS) < 1e-8


# Arguments of functions that are written for one item, by the axes of that item: one or
# two of each signature, since all take batches by one decorator.
SHAPES = {
    lie.transform_point: ((3,), (3,), (3,)),
    lie.rotate_point: ((3,), (3,)),
    lie.exp_so3: ((3,),),
    lie.log_so3: ((3, 3),),
    lie.exp_se3: ((3,), (3,)),
    lie.hat: ((3,),),
    so3.hat: ((3,),),
    se3.from_rotation_translation: ((3, 3), (3,)),
    quaternion.multiply: ((4,), (4,)),
    quaternion.conjugate: ((4,),),
    quaternion.rotate: ((4,), (3,)),
    quaternion.from_matrix: ((3, 3),),
    quaternion.slerp: ((4,), (4,), ()),
    matrix3.singular_values: ((3, 3),),
}


@jax.jit
def together(every):
    """One program for all functions."""
    return [f(*a) for f, a in zip(SHAPES, every, strict=True)]


def test_leading_axes_give_what_a_loop_over_them_gives(float64, rng):
    """Of three items: a batch as long as a point was once taken for one."""
    batch = (3,)
    cases = {
        function: tuple(rng.normal(size=batch + shape) for shape in shapes)
        for function, shapes in SHAPES.items()
    }
    many = together(list(cases.values()))
    for place in np.ndindex(*batch):
        single = together([tuple(x[place] for x in a) for a in cases.values()])
        for function, one, all_ in zip(SHAPES, single, many, strict=True):
            for a, b in zip(*map(jax.tree.leaves, (one, all_)), strict=True):
                np.testing.assert_allclose(
                    b[place],
                    a,
                    rtol=0,
                    atol=1e-12 * (1 + np.abs(a).max()),
                    err_msg=str(function),
                )


def test_a_camera_projects_a_cloud_and_cameras_project_a_point(rng):
    one = camera.look_at((0, 0, -4), (0, 0, 0), (0, 1, 0), 50.0, (40, 30))
    other = camera.look_at((3, 1, -2), (0, 0, 0), (0, 1, 0), 40.0, (40, 30))
    points = rng.normal(size=(2, 5, 3)).astype(np.float32)
    pixels, depth = camera.project(one, points)
    both, _ = camera.project(camera.stack([one, other]), points[0, 0])
    assert pixels.shape == (2, 5, 2)
    assert depth.shape == (2, 5)
    pixel, z = camera.project(one, points[1, 3])
    np.testing.assert_allclose(pixels[1, 3], pixel, rtol=1e-6)
    np.testing.assert_allclose(depth[1, 3], z, rtol=1e-6)
    np.testing.assert_allclose(both[0], pixels[0, 0], rtol=1e-6)
    np.testing.assert_allclose(
        both[1], camera.project(other, points[0, 0])[0], rtol=1e-6
    )
