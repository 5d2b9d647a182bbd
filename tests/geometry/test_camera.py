"""Projection and its inverse, against float64 NumPy and the Nerfies code."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from tests import gradients

SIZE = (640, 480)

project = jax.jit(jax.vmap(cameras.project, (None, 0)))
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
    """World points that fall well inside the picture."""
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
    points = jnp.asarray(seen_points(rng, camera), dtype)
    pixels, _ = project(camera, points)
    directions, converged = unproject(camera, pixels)
    offsets = np.asarray(points) - np.asarray(camera.position)
    offsets = offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
    assert np.all(converged)
    np.testing.assert_allclose(
        directions, offsets, atol={"float32": 2e-6, "float64": 1e-14}[dtype]
    )


@pytest.mark.full
def test_camera_matrix_and_pose_agree_with_projection(float64, rng):
    camera = make_camera("float64", radial=(0, 0, 0), tangential=(0, 0))
    point = seen_points(rng, camera, 1)[0]
    pose = np.linalg.inv(cameras.world_from_camera(camera))
    homogeneous = np.asarray(cameras.camera_matrix(camera)) @ (pose @ [*point, 1])[:3]
    pixel, depth = cameras.project(camera, jnp.asarray(point))
    np.testing.assert_allclose(pixel, homogeneous[:2] / homogeneous[2], rtol=1e-12)
    np.testing.assert_allclose(depth, homogeneous[2], rtol=1e-12)


def test_gradients_of_both_directions(float64, rng):
    camera = make_camera("float64")
    point = jnp.asarray(seen_points(rng, camera, 1)[0])
    pixel, _ = cameras.project(camera, point)
    weight = jnp.asarray(rng.normal(size=3))

    def seen(camera, point):
        pixel, depth = cameras.project(camera, point)
        return pixel @ weight[:2] * 1e-2 + depth

    def looked(camera, pixel):
        return cameras.unproject(camera, pixel)[0] @ weight

    assert gradients.directional_error(seen, camera, point) < 1e-6
    # a central difference over pixels of 300 keeps some six digits
    assert gradients.directional_error(looked, camera, pixel, step=1e-4) < 1e-5


@pytest.mark.full
def test_unprojection_has_the_implicit_second_derivative(float64):
    camera = make_camera("float64")
    pixel = jnp.asarray([400.0, 120.0])
    grad = jax.jit(jax.grad(lambda p: cameras.unproject(camera, p)[0][0]))
    hessian = jax.jit(jax.jacfwd(grad))(pixel)
    step = 1e-2
    for axis in range(2):
        along = jnp.zeros(2).at[axis].set(step)
        difference = (grad(pixel + along) - grad(pixel - along)) / (2 * step)
        np.testing.assert_allclose(hessian[axis], difference, atol=1e-6 * 1e-3)


@pytest.mark.hard_cases
@pytest.mark.parametrize("depth", [0.0, 1e-30, -1e-30, 1e-20, 1e-6, -1.0, -1e20])
@pytest.mark.parametrize("lateral", [0.0, 1e-20, 1.0, 1e20])
def test_points_at_and_behind_the_camera_stay_finite(depth, lateral, dtype):
    camera = make_camera(dtype)._replace(
        camera_from_world=np.eye(3, dtype=dtype), position=np.zeros(3, dtype)
    )
    point = np.asarray([lateral, -lateral / 2, depth], dtype)
    pixel, z_depth, gradient, projectable = seen(camera, point)
    assert np.all(np.isfinite(pixel))
    assert np.all(np.isfinite(gradient))
    assert z_depth == point[2] or abs(depth) < 1e-29  # XLA flushes denormals
    assert not projectable or depth >= 1e-6 > lateral
    if lateral >= 1 and depth < 1e-6:  # off the picture, not somewhere inside it
        assert np.max(np.abs(pixel)) > 1e4


@pytest.mark.hard_cases
def test_depth_in_front_is_kept_far_from_the_origin(float64):
    """R(x - c) keeps the pixel where R x + t would lose 0.16 px in float32."""
    far = np.array([1e4, -1e4, 1e4])
    camera = cameras.look_at(far, far + np.array([0, 0, 4]), [0, -1, 0], 500.0, SIZE)
    point = np.float32(far + np.array([0.5, 0.25, 4]))
    pixel = seen(camera, point)[0]
    truth, _ = oracle_pixel(camera, np.asarray(point, np.float64))
    assert pixel.dtype == jnp.float32
    np.testing.assert_allclose(pixel, truth, atol=1e-3)


def test_resizing_scales_every_parameter(dtype, rng):
    """The resized camera's pixels are the camera's own, scaled: skew and aspect too."""
    camera = make_camera(dtype)
    points = jnp.asarray(seen_points(rng, camera), dtype)
    small = cameras.resize(camera, SIZE, (160, 240))
    pixels, _ = project(camera, points)
    resized, _ = project(small, points)
    scaled = np.asarray(pixels) * np.array([160 / 640, 240 / 480], dtype)
    np.testing.assert_allclose(
        resized, scaled, atol={"float32": 2e-4, "float64": 1e-11}[dtype]
    )
    assert small.skew_px == camera.skew_px * 0.25


def test_cropping_shifts_pixels(rng):
    camera = make_camera("float32")
    point = jnp.asarray(seen_points(rng, camera, 1)[0], jnp.float32)
    pixel, _ = cameras.project(camera, point)
    cut, _ = cameras.project(cameras.crop(camera, 30, 12.5), point)
    np.testing.assert_allclose(cut, pixel - np.array([30, 12.5], np.float32), atol=1e-4)


def test_look_at_puts_target_in_the_middle_and_up_upwards(dtype):
    camera = cameras.look_at([1, 2, -3], [0.5, 0, 1], [0, 1, 0.2], 300.0, SIZE, dtype)
    camera = jax.tree.map(jnp.asarray, camera)
    target = jnp.asarray([0.5, 0, 1], dtype)
    pixel, depth = cameras.project(camera, target)
    np.testing.assert_allclose(pixel, [320, 240], atol=1e-3)
    np.testing.assert_allclose(depth, np.linalg.norm([0.5, 2, -4]), rtol=1e-6)
    above, _ = cameras.project(camera, target + jnp.asarray([0, 0.1, 0.02], dtype))
    np.testing.assert_allclose(above[0], 320, atol=1e-3)
    assert above[1] < 239  # rows count downwards
    assert abs(np.linalg.det(camera.camera_from_world) - 1) < 1e-6


@pytest.mark.full
def test_nerfies_projection_and_rays(oracle_dir, float64):
    """google/nerfies on its own distorted camera; its resize leaves the skew behind."""
    values = np.load(oracle_dir / "nerfies.npz")
    raw = json.loads((oracle_dir / "nerfies_camera.json").read_text())
    camera = Camera(
        *(
            jnp.asarray(raw[key], jnp.float64)
            for key in (
                "orientation",
                "position",
                "focal_length",
                "principal_point",
                "skew",
                "pixel_aspect_ratio",
                "radial_distortion",
                "tangential_distortion",
            )
        )
    )
    points = jnp.asarray(values["unit/camera/points"], jnp.float64)
    pixels, _ = project(camera, points)
    # reference values are float32: 1.2e-4 px is an ulp at 2000 px
    np.testing.assert_allclose(pixels, values["unit/camera/project"], atol=2e-3)
    pixels = jnp.asarray(values["unit/camera/pixels"], jnp.float64)
    directions, converged = unproject(camera, pixels)
    assert np.all(converged)
    np.testing.assert_allclose(directions, values["unit/camera/rays"], atol=1e-6)
    quarter = cameras.resize(camera, (2448, 3264), (612, 816))
    unscaled_skew = quarter._replace(skew_px=camera.skew_px)
    pixels, _ = project(unscaled_skew, points)
    np.testing.assert_allclose(
        pixels, values["unit/camera/scaled_quarter_project"], atol=1e-3
    )


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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"position": np.nan}, r"left.png: position is not finite \(row 1\)"),
        ({"camera_from_world": np.eye(3) * 2}, r"not orthonormal \(row 1\)"),
        ({"camera_from_world": np.diag([1, 1, -1])}, r"reflection \(row 1\)"),
        ({"focal_px": 0}, r"focal_px must be positive, got 0 \(row 1\)"),
        ({"pixel_aspect": -1}, r"pixel_aspect must be positive, got -1"),
        ({"principal_point_px": 5000}, r"outside 640x480 \(row 1\)"),
    ],
)
def test_unusable_cameras_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        cameras.validate(broken(**changes), SIZE, "left.png")


@pytest.mark.full
def test_usable_cameras_pass_validation():
    cameras.validate(broken(), SIZE)
    cameras.validate(make_camera("float32"), SIZE)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: cameras.look_at([0] * 3, [0] * 3, [0, 1, 0], 1, SIZE), "itself"),
        (lambda: cameras.look_at([0] * 3, [0, 2, 0], [0, 1, 0], 1, SIZE), "parallel"),
        (lambda: cameras.look_at([0] * 3, [0, 2, 0], [0, 0, 0], 1, SIZE), "parallel"),
        (lambda: cameras.resize(make_camera("float32"), SIZE, (0, 3)), "new_size"),
        (
            lambda: cameras.validate(
                make_camera("float32")._replace(radial=np.zeros(2)), SIZE
            ),
            r"radial has shape \(2,\)",
        ),
    ],
)
def test_impossible_requests_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
