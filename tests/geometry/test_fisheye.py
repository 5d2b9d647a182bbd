"""The fisheye model against OpenCV, and its inverse against its definition."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.geometry import fisheye
from nerfies_jax.geometry.camera import Camera, project, projectable, unproject
from tests import gradients

LENSES = {
    "equidistant": (0, 0, 0, 0),
    "action camera": (-0.02, 0.01, -0.003, 0.0005),
    "spreading": (0.1, 0.05, 0, 0),
    "folding": (-0.1, -0.05, 0, 0),  # at 76 degrees
}
ROWS = 200  # that every test has, so that programs are shared

distort = jax.jit(jax.vmap(fisheye.distort, (None, 0)))
undistort = jax.jit(jax.vmap(fisheye.undistort, (None, 0)))
one_to_one = jax.jit(jax.vmap(fisheye.one_to_one, (None, 0)))


def slopes_at(degrees):
    """Image-plane positions at angles from the axis, in all directions."""
    angle = np.radians(np.resize(degrees, ROWS))
    turn = np.linspace(0, 12, ROWS)
    return np.tan(angle)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def opencv(coefficients, slopes):
    points = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    none = np.zeros(3)
    k = np.asarray(coefficients, float)
    return cv2.fisheye.projectPoints(points[None], none, none, np.eye(3), k)[0][0]


@pytest.mark.parametrize("name", LENSES)
def test_distortion_is_opencv_s_and_its_inverse_leads_back(name, dtype):
    k = np.asarray(LENSES[name], dtype)
    degrees = np.linspace(0.01, 89, ROWS)
    slopes = slopes_at(degrees)
    bent = np.asarray(distort(k, slopes.astype(dtype)))
    bound = {"float32": 2e-6, "float64": 1e-13}[dtype]
    np.testing.assert_allclose(bent, opencv(LENSES[name], slopes), atol=bound)
    back, converged = map(np.asarray, undistort(k, bent))
    single = np.asarray(one_to_one(k, slopes.astype(dtype)))
    assert single.sum() > (150 if name == "folding" else 199)
    # What has folded lands where another ray does, which is then found.
    assert converged[single].all()
    # Compared as angles; the angle is worth less and less of a pixel near the fold.
    angle = np.degrees(np.arctan(np.linalg.norm(back, axis=1)))[single]
    bound = {"float32": 2e-2, "float64": 1e-5}[dtype]
    np.testing.assert_allclose(angle, degrees[single], atol=bound)
    if name == "folding":
        # d/dθ (θ - 0.1 θ³ - 0.05 θ⁵) = 0 at 69.9 degrees.
        assert degrees[single].max() == pytest.approx(69.9, abs=0.5)


@pytest.mark.hard_cases
def test_what_no_ray_reaches_is_flagged_with_zero_gradient(dtype):
    k = jnp.asarray(LENSES["folding"], dtype)
    bent = np.resize(np.asarray([[1.0, 0.5], [3.0, 0.0], [1e9, 0.0]], dtype), (ROWS, 2))
    slopes, converged = undistort(k, bent)
    assert not np.any(converged)
    assert np.isfinite(slopes).all()
    jacobian = jax.vmap(jax.jacfwd(lambda bent: fisheye.undistort(k, bent)[0]))
    assert not np.any(jax.jit(jacobian)(bent[:3]))


@jax.jit
def jacobians(k, slopes):
    """Of the distortion and of its inverse there, and the stretch in closed form."""
    forward, bent = jax.jacfwd(lambda x: (fisheye.distort(k, x),) * 2, has_aux=True)(
        slopes
    )
    inverse = jax.jacrev(lambda bent: fisheye.undistort(k, bent)[0])(bent)
    return forward, inverse, fisheye.stretch(k, jnp.sum(slopes**2))


@pytest.mark.hard_cases
@pytest.mark.parametrize("degrees", [0, 1e-6, 1e-3, 26.56, 26.57, 60, 88])
def test_derivatives_hold_at_the_center_the_switch_and_the_rim(degrees, float64):
    k = jnp.asarray(LENSES["action camera"])
    slopes = np.tan(np.radians(degrees)) * np.asarray([0.6, -0.8])
    forward, inverse, stretch = jax.tree.map(np.asarray, jacobians(k, slopes))
    np.testing.assert_allclose(forward @ inverse, np.eye(2), atol=1e-9)
    closed = stretch.ratio * np.eye(2)
    closed += 2 * stretch.change * np.outer(slopes, slopes)
    np.testing.assert_allclose(closed, forward, atol=1e-13)
    radial = stretch.along * slopes
    np.testing.assert_allclose(forward @ slopes, radial, atol=1e-13)


def test_inverse_gradient_equals_central_differences(float64, rng):
    bent = rng.uniform(-0.8, 0.8, (6, 2))

    def loss(k, bent):
        slopes, _ = jax.vmap(fisheye.undistort, (None, 0))(k, bent)
        return jnp.sum(jnp.sin(slopes))

    k = np.asarray(LENSES["action camera"])
    assert gradients.directional_error(loss, k, bent) < 1e-7


def test_a_fisheye_camera_projects_as_opencv_and_casts_rays_back(dtype, rng):
    k = (0.03, -0.01, 0.004, -0.001)
    K = np.array([[40.0, 0, 33.0], [0, 44.0, 23.0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, 3] = [0.2, -0.1, 1.0]
    camera = Camera.from_K(K, pose, 64, 48, k, dtype, camera_model="fisheye")
    points = rng.normal(size=(50, 3)) * [3, 3, 0.5]
    points[:, 2] = np.abs(points[:, 2]) - 0.9
    pixel, _ = jax.jit(project)(camera, points.astype(dtype))
    inner = points + pose[:3, 3]
    slopes = inner[:, :2] / inner[:, 2:]
    expected = opencv(k, slopes) @ K[:2, :2].T + K[:2, 2]
    bound = {"float32": 2e-4, "float64": 1e-11}[dtype]
    np.testing.assert_allclose(pixel, expected, atol=bound)
    in_view = jax.jit(projectable)
    assert np.all(in_view(camera, points.astype(dtype)))
    direction, converged = jax.jit(unproject)(camera, pixel)
    assert np.all(converged)
    unit = inner / np.linalg.norm(inner, axis=1, keepdims=True)
    bound = {"float32": 2e-5, "float64": 1e-10}[dtype]
    np.testing.assert_allclose(direction, unit, atol=bound)
    behind = np.tile(np.asarray([0, 0, -2.0], dtype), (50, 1))
    assert not np.any(in_view(camera, behind))


def test_a_camera_of_both_models_is_refused():
    with pytest.raises(ValueError, match="camera_model must be one of"):
        Camera.from_K(np.eye(3), np.eye(4), 8, 6, camera_model="ortho")
    with pytest.raises(ValueError, match="expected"):
        Camera.from_K(np.eye(3), np.eye(4), 8, 6, np.zeros(5), camera_model="fisheye")
