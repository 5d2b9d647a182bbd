"""Gaussians through a lens: against quadrature with OpenCV, gradients, hard cases."""

import dataclasses

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform

import gaussians_jax as gj
from gaussians_jax.core.splats import Gaussians
from gaussians_jax.splatting import projection, rendering
from gaussians_jax.splatting.raster_spec import GSPLAT
from nerfies_jax.geometry.camera import Camera
from tests import gradients
from tests.gaussians.shared import finite, jitted, put
from tests.gaussians.test_projection import covariance_of, some_gaussians

SIZE = (64, 48)
LENS = dataclasses.replace(GSPLAT, distorted=True)
K = np.array([[60.0, 0, 30.0], [0, 66.0, 25.0], [0, 0, 1]])
NONE = np.zeros(3)
# Coefficients in OpenCV's order.
LENSES = {
    "barrel": ("pinhole", (-0.3, 0.05, 0.0, 0.0, 0.0)),
    "tangential": ("pinhole", (0.1, -0.1, 0.02, -0.03, 0.02)),
    "fisheye": ("fisheye", (-0.02, 0.01, -0.003, 0.0005)),
}

project = jitted(projection.project, static_argnums=(2, 3))


def camera_at(model, coefficients, dtype, turn=0.3, position=(0.2, 0.1, -2.0), K=K):
    pose = np.eye(4)
    pose[:3, :3] = [
        [np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)],
    ]  # fmt: skip
    pose[:3, 3] = -pose[:3, :3] @ position
    camera = Camera.from_K(K, pose, *SIZE, coefficients, dtype, camera_model=model)
    return jax.device_put(camera)


def through_opencv(model, coefficients, points):
    """Pixels of points [n, 3] in the camera's frame."""
    k = np.asarray(coefficients, float)
    if model == "fisheye":
        return cv2.fisheye.projectPoints(points[None], NONE, NONE, K, k)[0][0]
    return cv2.projectPoints(points, NONE, NONE, K, k)[0][:, 0]


def moments(model, coefficients, camera, gaussians):
    """Means and covariances in px by Gauss-Hermite quadrature of 7³ points each."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    grid = np.stack(np.meshgrid(nodes, nodes, nodes), -1).reshape(-1, 3)
    weight = np.prod(np.stack(np.meshgrid(weights, weights, weights), -1), -1).ravel()
    weight /= weight.sum()
    rotation = np.asarray(camera.camera_from_world)
    means, covariances = [], []
    for mean, quaternion, scale, _ in zip(*map(np.asarray, gaussians), strict=True):
        wxyz = np.roll(quaternion, -1)
        turn = scipy.spatial.transform.Rotation.from_quat(wxyz).as_matrix()
        world = mean + (grid * scale) @ turn.T
        inner = (world - np.asarray(camera.position)) @ rotation.T
        pixel = through_opencv(model, coefficients, inner)
        middle = weight @ pixel
        means.append(middle)
        covariances.append((pixel - middle).T @ ((pixel - middle) * weight[:, None]))
    return np.stack(means), np.stack(covariances)


@pytest.mark.parametrize("name", LENSES)
def test_footprints_equal_the_moments_of_what_opencv_projects(name, dtype, rng):
    """Of Gaussians of 1 px; the difference shrinks with the square of their size."""
    model, coefficients = LENSES[name]
    count = 40
    gaussians = Gaussians(
        rng.uniform([-0.7, -0.5, -0.3], [1.2, 0.5, 0.5], (count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(-5, -3.5, (count, 3))),
        np.full(count, 0.5),
    )
    camera = camera_at(model, coefficients, dtype)
    footprints = project(put(gaussians, dtype), camera, SIZE, LENS)
    assert (footprints.extent_px > 0).all()
    exact = camera_at(model, coefficients, "float64")
    means, covariances = moments(model, coefficients, exact, gaussians)
    on_screen = ((means > 0) & (means < SIZE)).all(axis=1)
    assert on_screen.sum() > 20
    actual = covariance_of(footprints.whitening) - GSPLAT.eps2d * np.eye(2)
    size = np.trace(covariances, axis1=1, axis2=2)
    error = np.linalg.norm(actual - covariances, axis=(1, 2)) / (size + 0.01)
    assert error[on_screen].max() < 0.02
    shift = np.linalg.norm(footprints.mean_px - means, axis=1)
    assert (shift / np.sqrt(size))[on_screen].max() < 0.03


def test_without_coefficients_a_footprint_is_a_pinhole_s(dtype, rng):
    gaussians = some_gaussians(rng, 300, dtype)
    camera = camera_at("pinhole", np.zeros(5), dtype)
    plain = project(gaussians, camera, SIZE, GSPLAT)
    bent = project(gaussians, camera, SIZE, LENS)
    tolerance = {"float32": 2e-5, "float64": 1e-12}[dtype]
    for one, other in zip(plain, bent, strict=True):
        np.testing.assert_allclose(other, one, rtol=tolerance, atol=tolerance)


def test_a_pinhole_s_program_reads_no_lens(rng):
    gaussians = some_gaussians(rng, 8, "float32")
    camera = camera_at("pinhole", np.zeros(5), "float32")

    def used(spec):
        program = jax.jit(lambda g, c: projection.project(g, c, SIZE, spec))
        text = program.lower(gaussians, camera).as_text()
        return text.count("stablehlo."), text.count("%arg")

    plain = jax.jit(lambda g, c: projection.project(g, c, SIZE, GSPLAT))
    lowered = plain.lower(gaussians, camera)
    # Unused arguments are dropped: the last two of twelve leaves are the lens.
    assert lowered.compile().as_text().count("parameter(") >= 9
    variables = lowered._lowering.compile_args["kept_var_idx"]
    assert sorted(variables) == list(range(10))
    assert used(LENS)[0] > used(GSPLAT)[0]


@pytest.mark.parametrize(
    "name", [pytest.param("tangential", marks=pytest.mark.full), "fisheye"]
)
def test_projection_gradient_equals_central_differences(name, float64, rng):
    gaussians = some_gaussians(rng, 6, float64)
    camera = camera_at(*LENSES[name], float64, position=(0.2, 0.1, -4.0))
    weights = rng.normal(size=(6, 7))
    sharp = dataclasses.replace(LENS, antialiased=True)

    def loss(gaussians, camera):
        footprints = projection.project(gaussians, camera, SIZE, sharp)
        fields = (footprints.mean_px, footprints.whitening, footprints.opacity[:, None])
        return jnp.sum(
            jnp.concatenate([*fields, footprints.depth[:, None]], 1) * weights
        )

    assert gradients.directional_error(loss, gaussians, camera) < 1e-6


def at_degrees(degrees, z=2.0):
    return (float(np.tan(np.radians(degrees)) * z), 0.0, z)


HARD = {
    "center": (dict(), True),
    "next to the center": (dict(mean=(1e-20, 0.0, 2.0)), True),
    "corner": (dict(mean=(0.9, 0.7, 2.0)), True),
    "large, in a corner": (dict(mean=(0.9, 0.7, 2.0), scale=(1.0,) * 3), True),
    "just inside the rim": (dict(mean=at_degrees(40)), True),
    "behind": (dict(mean=(0.1, 0.1, -1.0)), False),
    "behind, mirrored into the image": (dict(mean=(-0.3, 0.2, -2.0)), False),
    "on the camera's plane": (dict(mean=(1.0, 0.0, 0.0)), False),
    "at the camera": (dict(mean=(0.0, 0.0, 0.0)), False),
    "sideways beyond any lens": (dict(mean=(1e20, 0.0, 2.0)), False),
    "huge": (dict(scale=(1e8,) * 3), True),
    "nan": (dict(mean=(float("nan"), 0.0, 2.0)), False),
}


@jitted
def footprint_and_gradient(gaussians, camera):
    def loss(gaussians):
        footprints = projection.project(gaussians, camera, SIZE, LENS)
        total = jnp.sum(footprints.mean_px) + jnp.sum(footprints.whitening)
        return total + jnp.sum(footprints.opacity + footprints.depth), footprints

    gradient, footprints = jax.grad(loss, has_aux=True)(gaussians)
    return footprints, gradient


def drawn_one(lens, dtype, mean=(0, 0, 2), scale=(0.1,) * 3):
    fields = ([mean], [(1, 0, 0, 0)], [scale], [0.5])
    gaussians = Gaussians(*(np.asarray(x, dtype) for x in fields))
    camera = camera_at(*lens, dtype, turn=0.0, position=(0, 0, 0))
    return footprint_and_gradient(gaussians, camera)


@pytest.mark.hard_cases
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("name", HARD)
def test_hard_gaussians_are_drawn_or_left_out_and_finite(name, lens, dtype):
    changes, shown = HARD[name]
    footprints, gradient = drawn_one(LENSES[lens], dtype, **changes)
    assert finite((footprints, gradient))
    assert (footprints.extent_px > 0).all() == shown
    if not shown:
        assert not any(leaf.any() for leaf in gradient)


@pytest.mark.hard_cases
def test_what_the_lens_folds_back_into_the_image_is_left_out(dtype):
    # Folds at a tangent of 1.05; a tangent of 1.7 would land in the image.
    lens = LENSES["barrel"][0], (-0.3, 0.0, 0.0, 0.0)
    inside, _ = drawn_one(lens, dtype, mean=(2 * 1.04, 0.0, 2.0))
    assert (inside.extent_px > 0).all()
    folded = (2 * 1.7, 0.0, 2.0)
    landed = through_opencv(*lens, np.asarray([folded]))[0]
    assert (landed > 0).all()
    assert (landed < SIZE).all()
    outside, gradient = drawn_one(lens, dtype, mean=folded)
    assert not outside.extent_px.any()
    assert finite((outside, gradient))


@pytest.mark.hard_cases
@pytest.mark.parametrize("degrees", [60, 80, 88, 89.9])
def test_a_strong_fisheye_draws_up_to_the_rim(degrees, dtype):
    lens = LENSES["fisheye"][0], (0.0, 0.0, 0.0, 0.0)
    footprints, gradient = drawn_one(lens, dtype, at_degrees(degrees, 0.5), (1e-3,) * 3)
    assert finite((footprints, gradient))
    expected = K[0, 2] + K[0, 0] * np.radians(degrees)
    bound = {"float32": 1e-4, "float64": 1e-9}[dtype]
    np.testing.assert_allclose(footprints.mean_px[0, 0], expected, atol=bound)


@pytest.mark.hard_cases
def test_a_large_gaussian_beside_the_image_keeps_a_bounded_footprint(dtype):
    """The Jacobian is taken inside the widened image: 12 px here, not 100."""
    lens = LENSES["tangential"][0], (0.3, 0.2, 0.0, 0.0)
    footprints, _ = drawn_one(lens, dtype, mean=(4.0, 0.0, 2.0), scale=(0.1,) * 3)
    assert 0 < footprints.extent_px[0, 0] < 60


def arguments(rng, dtype, count=60):
    gaussians = some_gaussians(rng, count, dtype)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [[0.1, 0, 3.0], [-0.2, 0.1, 3.5]]
    colors, views, intrinsics = put(
        (rng.uniform(size=(count, 3)), poses, np.tile(K, (2, 1, 1))), dtype
    )
    return (*gaussians, colors, views, intrinsics)


@pytest.mark.full
@pytest.mark.parametrize("name", ["barrel", "fisheye"])
def test_rasterization_through_a_lens_is_a_large_pinhole_image_resampled(name, rng):
    """Pixel by pixel, from a pinhole image of four times the resolution."""
    model, coefficients = LENSES[name]
    *scene, views, intrinsics = arguments(rng, "float32", count=40)
    scene[2] = scene[2] * 0.2  # small: footprints are linear within
    lenses = jnp.tile(jnp.asarray(coefficients, jnp.float32), (2, 1))
    images, _, _ = gj.rasterization(
        *scene, views, intrinsics, *SIZE, distortion=lenses, camera_model=model
    )
    large = tuple(8 * side for side in SIZE)
    wide = np.array([[240, 0, large[0] / 2], [0, 264, large[1] / 2], [0, 0, 1.0]])
    flat, _, _ = gj.rasterization(
        *scene, views, jnp.tile(jnp.float32(wide), (2, 1, 1)), *large,
        eps2d=16 * GSPLAT.eps2d,
    )  # fmt: skip
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    pixels = np.stack([x, y], -1).reshape(-1, 1, 2)
    if model == "fisheye":
        slopes = cv2.fisheye.undistortPoints(pixels, K, np.asarray(coefficients))
    else:
        stop = (cv2.TERM_CRITERIA_COUNT, 100, 0)
        slopes = cv2.undistortPoints(pixels, K, np.asarray(coefficients), criteria=stop)
    place = slopes[:, 0] @ wide[:2, :2].T + wide[:2, 2] - 0.5
    column, row = np.float32(place.reshape(*SIZE[::-1], 2)).transpose(2, 0, 1)
    for image, whole in zip(images, flat, strict=True):
        sampled = cv2.remap(np.asarray(whole), column, row, cv2.INTER_CUBIC)
        assert np.asarray(image).std() > 0.05
        error = np.abs(np.asarray(image) - sampled)
        assert np.sqrt(np.mean(error**2)) < 0.01


@pytest.mark.full
def test_rasterization_takes_a_lens_under_grad_and_vmap(float64, rng):
    *scene, views, intrinsics = arguments(rng, float64, count=8)
    lenses = jnp.tile(jnp.asarray(LENSES["tangential"][1]), (2, 1))
    toward = rng.normal(size=(2, *SIZE[::-1], 3))

    def loss(means, lenses):
        images = gj.rasterization(
            means, *scene[1:], views, intrinsics, *SIZE, distortion=lenses
        )[0]
        return jnp.sum(images * toward)

    gradient = jax.jit(jax.grad(loss, (0, 1)))(scene[0], lenses)
    assert all(np.abs(leaf).max() > 0 for leaf in gradient)
    step = 1e-6 * np.eye(5)[0]
    both = [float(loss(scene[0], lenses + sign * step)) for sign in (1, -1)]
    # The jumps at the thresholds of alpha are left out of the derivative.
    slope = (both[0] - both[1]) / 2e-6
    assert slope == pytest.approx(float(gradient[1][:, 0].sum()), rel=1e-3)


def test_arguments_of_the_lens_are_checked(rng):
    *scene, views, intrinsics = arguments(rng, "float32", count=4)
    with pytest.raises(ValueError, match=r"camera_model must be one of .*'ortho'"):
        gj.rasterization(*scene, views, intrinsics, *SIZE, camera_model="ortho")
    for model, count in (("pinhole", 3), ("pinhole", 6), ("fisheye", 5)):
        with pytest.raises(ValueError, match="distortion must have shape"):
            gj.rasterization(
                *scene, views, intrinsics, *SIZE,
                distortion=jnp.zeros((2, count)), camera_model=model,
            )  # fmt: skip


def test_distortion_that_would_be_ignored_is_refused(rng):
    gaussians = some_gaussians(rng, 4, "float32")
    camera = camera_at(*LENSES["barrel"], "float32")
    with pytest.raises(ValueError, match="RasterSpec"):
        rendering.render(gaussians, jnp.zeros((4, 3)), camera, SIZE)
