"""Projection and its inverse, against float64 NumPy and the Nerfies code."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from tests import gradients

SIZE = (640, 480)

project = jax.jit(jax.vmap(cameras.project, (None, 0)))
crop, resize = (
    jax.jit(f, static_argnums=(1, 2)) for f in (cameras.crop, cameras.resize)
)
unproject = jax.jit(jax.vmap(cameras.unproject, (None, 0)))


@jax.jit
def seen(camera, point):
    """Pixel, depth, slope of the pixel, and whether there is one."""
    grad = jax.jacrev(lambda place: cameras.project(camera, place)[0])(point)
    return *cameras.project(camera, point), grad, cameras.projectable(camera, point)


def make_camera(dtype, radial=(0.1, -0.2, 0.05), tangential=(1e-3, -2e-3)):
    plain = cameras.look_at(
        [1.0, -2.0, 3.0], [0, 0.2, 0], [0, 1, 0], 500.0, SIZE, dtype
    )
    return jax.tree.map(
        jnp.asarray,
        plain._replace(
            skew_px=np.asarray(1.5, dtype),
            pixel_aspect=np.asarray(1.02, dtype),
            radial=np.asarray(radial, dtype),
            tangential=np.asarray(tangential, dtype),
        ),
    )


def oracle_pixel(camera, point):
    """OpenCV's published formula, written out with 4x4 matrices in NumPy float64."""
    c = Camera(*(np.asarray(leaf, np.float64) for leaf in camera))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = c.camera_from_world, -c.camera_from_world @ c.position
    x, y, z = (pose @ [*point, 1.0])[:3]
    x, y = x / z, y / z
    r2 = x**2 + y**2
    k = 1 + c.radial @ [r2, r2**2, r2**3]
    p1, p2 = c.tangential
    bent = [
        x * k + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * k + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        1,
    ]
    matrix = np.array(
        [
            [c.focal_px, c.skew_px, c.principal_point_px[0]],
            [0, c.focal_px * c.pixel_aspect, c.principal_point_px[1]],
        ]
    )
    return matrix @ bent, z


def seen_points(rng, camera, count=64):
    """World points that fall well inside the image."""
    depth = rng.uniform(0.5, 6, count)
    grads = rng.uniform(-0.45, 0.45, (count, 2))
    local = np.concatenate([grads * depth[:, None], depth[:, None]], axis=1)
    return local @ np.asarray(camera.camera_from_world) + np.asarray(camera.position)


def test_projection_is_the_published_formula(dtype, rng):
    camera = make_camera(dtype)
    points = seen_points(rng, camera).astype(dtype)
    pixels, depths = project(camera, jnp.asarray(points))
    truth = [oracle_pixel(camera, point) for point in points]
    assert pixels.dtype == dtype
    # float32: pixels of 600 keep 3e-5 each, over a few operations
    tolerance = {"float32": 5e-4, "float64": 1e-11}[dtype]
    np.testing.assert_allclose(pixels, [pixel for pixel, _ in truth], atol=tolerance)
    np.testing.assert_allclose(
        depths, [depth for _, depth in truth], rtol=tolerance * 1e-2
    )


def test_unprojection_inverts_projection(dtype, rng):
    camera = make_camera(dtype)
    points = seen_points(rng, camera).astype(dtype)
    directions, converged = unproject(camera, project(camera, points)[0])
    offsets = points - np.asarray(camera.position)
    offsets = offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
    assert np.all(converged)
    np.testing.assert_allclose(
        directions, offsets, atol={"float32": 2e-6, "float64": 1e-14}[dtype]
    )


def test_camera_matrix_and_pose_agree_with_projection(float64, rng):
    camera = make_camera("float64", radial=(0, 0, 0), tangential=(0, 0))
    points = seen_points(rng, camera)
    world_from_camera, matrix = map(
        np.asarray,
        jax.jit(lambda c: (cameras.world_from_camera(c), cameras.camera_matrix(c)))(
            camera
        ),
    )
    local = np.linalg.solve(world_from_camera, np.c_[points, np.ones(64)].T)[:3]
    pixels, depths = project(camera, points)
    homogeneous = matrix @ local
    np.testing.assert_allclose(pixels, (homogeneous[:2] / homogeneous[2]).T, rtol=1e-12)
    np.testing.assert_allclose(depths, homogeneous[2], rtol=1e-12)


def test_gradients_of_both_directions(float64, rng):
    camera = make_camera("float64")
    points = seen_points(rng, camera)
    pixel = np.asarray(project(camera, points)[0][0])
    weight = jnp.asarray(rng.normal(size=3))

    def seen(camera, point):
        pixel, depth = cameras.project(camera, point)
        return pixel @ weight[:2] * 1e-2 + depth

    def looked(camera, pixel):
        return cameras.unproject(camera, pixel)[0] @ weight

    assert gradients.directional_error(seen, camera, points[0]) < 1e-6
    # a central difference over pixels of 300 keeps some six digits
    assert gradients.directional_error(looked, camera, pixel, step=1e-4) < 1e-5


@pytest.mark.hard_cases
def test_points_at_and_behind_the_camera_stay_finite(dtype):
    camera = make_camera(dtype)._replace(
        camera_from_world=np.eye(3, dtype=dtype), position=np.zeros(3, dtype)
    )
    depths = [0.0, 1e-30, -1e-30, 1e-20, 1e-6, -1.0, -1e20]
    for depth, lateral in itertools.product(depths, (0.0, 1e-20, 1.0, 1e20)):
        point = np.asarray([lateral, -lateral / 2, depth], dtype)
        seen_and_slopes = (np.asarray(leaf) for leaf in seen(camera, point))
        pixel, z_depth, gradient, projectable = seen_and_slopes
        assert np.all(np.isfinite(pixel))
        assert np.all(np.isfinite(gradient))
        assert z_depth == point[2] or abs(depth) < 1e-29  # XLA flushes denormals
        assert not projectable or depth >= 1e-6 > lateral
        if lateral >= 1 and depth < 1e-6:  # off the image, not somewhere inside it
            assert np.max(np.abs(pixel)) > 1e4


def test_resizing_and_cropping_move_pixels(dtype, rng):
    """The camera's own pixels, scaled or shifted: skew and aspect too."""
    camera = make_camera(dtype)
    points = seen_points(rng, camera).astype(dtype)
    pixels, small, cut = (
        np.asarray(project(one, points)[0])
        for one in (camera, resize(camera, SIZE, (160, 240)), crop(camera, 30, 12.5))
    )
    tolerance = {"float32": 2e-4, "float64": 1e-11}[dtype]
    np.testing.assert_allclose(small, pixels * [0.25, 0.5], atol=tolerance)
    np.testing.assert_allclose(cut, pixels - [30, 12.5], atol=tolerance / 2)


def test_look_at_puts_target_in_the_middle_and_up_upwards(dtype):
    camera = cameras.look_at([1, 2, -3], [0.5, 0, 1], [0, 1, 0.2], 300.0, SIZE, dtype)
    points = np.resize([[0.5, 0, 1], [0.5, 0.1, 1.02]], (64, 3)).astype(dtype)
    (middle, above, *_), (depth, *_) = map(np.asarray, project(camera, points))
    np.testing.assert_allclose(middle, [320, 240], atol=1e-3)
    np.testing.assert_allclose(depth, np.linalg.norm([0.5, 2, -4]), rtol=1e-6)
    np.testing.assert_allclose(above[0], 320, atol=1e-3)
    assert above[1] < 239  # rows count downwards
    assert abs(np.linalg.det(camera.camera_from_world) - 1) < 1e-6


def test_a_batch_is_stacked_and_taken_apart():
    one, two = make_camera("float32"), make_camera("float32", radial=(0, 0, 0))
    both = cameras.stack([one, two])
    assert both.position.shape == (2, 3)
    again = cameras.take(both, 1)
    assert all(np.array_equal(a, b) for a, b in zip(again, two, strict=True))


def broken(**changes):
    batch = cameras.stack([make_camera("float32")] * 3)
    fields = {name: getattr(batch, name).copy() for name in changes}
    for name, value in changes.items():
        fields[name][1] = value
    return batch._replace(**fields)


def validated(**changes):
    cameras.validate(broken(**changes), SIZE, "left.png")


def one_with(**changes):
    return make_camera("float32")._replace(**changes)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: validated(position=np.nan),
            r"left.png: position is not fin.*row 1",
        ),
        (
            lambda: validated(camera_from_world=np.eye(3) * 2),
            r"orthonormal \(row 1",
        ),
        (
            lambda: validated(camera_from_world=np.diag([1, 1, -1])),
            r"reflection .row 1",
        ),
        (lambda: validated(focal_px=0), r"focal_px must be positive, got 0 \(row 1\)"),
        (lambda: validated(pixel_aspect=-1), r"pixel_aspect must be positive, got -1"),
        (lambda: validated(focal_px=1e30), r"focal_px over .* 1.5.e\+27 \(row 1\)"),
        (lambda: validated(focal_px=1e-30), r"focal_px over .*; expected 0.005"),
        (lambda: validated(pixel_aspect=1e6), r"pixel_aspect is 1e\+06 \(row 1\)"),
        (lambda: validated(skew_px=-1e9), r"skew_px\| over focal_px is"),
        (lambda: validated(position=1e30), r"position\| is 1e\+30 \(row 1\)"),
        (lambda: validated(radial=1e20), r"distortion coefficient is 1e\+20"),
        (lambda: validated(principal_point_px=50000), r"outside 640x480 \(row 1\)"),
        (
            lambda: cameras.validate(one_with(radial=np.zeros(2)), SIZE),
            r"radial has shape \(2,\)",
        ),
        (lambda: cameras.look_at([0] * 3, [0] * 3, [0, 1, 0], 1, SIZE), "itself"),
        (lambda: cameras.look_at([0] * 3, [0, 2, 0], [0, 1, 0], 1, SIZE), "parallel"),
        (lambda: cameras.look_at([0] * 3, [0, 2, 0], [0, 0, 0], 1, SIZE), "parallel"),
        (lambda: cameras.resize(one_with(), SIZE, (0, 3)), "new_size"),
    ],
)
def test_unusable_cameras_and_requests_are_refused(call, message):
    validated()
    with pytest.raises(ValueError, match=message):
        call()


def test_a_camera_moves_as_its_matrix_does(float64):
    """Against the matrix exponential, also far out, where R x + t cancels."""
    angular, linear = np.array([0.03, -0.05, 0.04]), np.array([0.1, -0.06, 0.08])
    camera = make_camera("float64")
    camera = camera._replace(position=camera.position + 1e4)
    moved = jax.jit(cameras.move)(camera, angular, linear)
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = np.cross(np.eye(3), angular), linear
    before = np.asarray(cameras.world_from_camera(camera))
    exact = before @ np.linalg.inv(scipy.linalg.expm(twist))
    # 1e-11: SciPy's side multiplies positions of 1e4
    np.testing.assert_allclose(cameras.world_from_camera(moved), exact, atol=1e-11)
