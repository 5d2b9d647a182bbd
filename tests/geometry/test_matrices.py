"""Cameras from matrices, against OpenCV's projection and what they refuse."""

import cv2
import numpy as np
import pytest
import scipy.spatial.transform

from nerfies_jax.geometry import camera
from nerfies_jax.geometry.camera import Camera

K = np.array([[50.0, 0, 21], [0, 48, 14], [0, 0, 1]])
ROTATION = scipy.spatial.transform.Rotation.from_rotvec([0.2, -0.4, 0.1]).as_matrix()
TRANSLATION = np.array([0.3, -0.1, 4.0])
POSE = np.eye(4)
POSE[:3, :3], POSE[:3, 3] = ROTATION, TRANSLATION
LENS = np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01])


@pytest.mark.parametrize("count", [0, 4, 5])
def test_it_projects_as_opencv_does(count, dtype, rng):
    points = rng.uniform(-1, 1, (6, 3))
    lens = LENS[:count] if count else None
    made = Camera.from_K(K, POSE, 40, 30, lens, dtype)
    expected, _ = cv2.projectPoints(points, ROTATION, TRANSLATION, K, lens)
    pixels, depth = camera.project(made, points.astype(dtype))
    assert pixels.dtype == dtype
    bound = {"float32": 2e-5, "float64": 1e-12}[dtype]
    assert np.max(np.abs(pixels - expected[:, 0])) < bound
    in_camera = points @ ROTATION.T + TRANSLATION
    np.testing.assert_allclose(depth, in_camera[:, 2], rtol=bound)


def test_it_keeps_skew_and_gives_back_its_matrices():
    skewed = K + np.array([[0, 0.5, 0], [0, 0, 0], [0, 0, 0]])
    made = Camera.from_K(skewed, POSE[:3], 40, 30, dtype=np.float64)
    np.testing.assert_allclose(camera.camera_matrix(made), skewed, rtol=1e-6)
    pose = np.linalg.inv(np.asarray(camera.world_from_camera(made), np.float64))
    np.testing.assert_allclose(pose, POSE, atol=1e-6)


def test_leading_axes_make_a_batch_of_cameras():
    poses = np.stack([POSE, np.eye(4)])
    made = Camera.from_K(K, poses, 40, 30)
    assert made.position.shape == (2, 3)
    assert made.focal_px.shape == (2,)
    np.testing.assert_allclose(made.position[1], 0)


def scaled(matrix, factor):
    changed = matrix.copy()
    changed[:3, :3] *= factor
    return changed


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"camera_from_world": scaled(POSE, 1.01)}, "not rigid"),
        ({"camera_from_world": scaled(POSE, -1)}, "reflection"),
        ({"camera_from_world": POSE.T}, r"last row .*transpose it"),
        ({"camera_from_world": ROTATION}, r"camera_from_world has shape \[3, 3\]"),
        ({"camera_from_world": POSE * np.nan}, "camera_from_world is not finite"),
        ({"K": K.T}, "upper triangular"),
        ({"K": 2 * K}, "divide it by its last entry"),
        ({"K": -K + 2 * np.diag([0, 0, 1])}, "must be positive"),
        ({"K": K[:2]}, r"K has shape \[2, 3\], expected \[\.\.\., 3, 3\]"),
        ({"K": K.astype(complex)}, "K must be real numbers"),
        ({"K": np.stack([K] * 3), "camera_from_world": [POSE] * 2}, "do not broadcast"),
        ({"distortion": np.zeros(3)}, r"distortion has shape \[3\]"),
        ({"K": K + 1000 * np.eye(3, k=2)}, "principal point"),
        ({"width": 0}, "must be at least 1x1"),
    ],
)
def test_what_is_no_camera_is_refused(changes, words):
    inputs = dict(K=K, camera_from_world=POSE, width=40, height=30) | changes
    with pytest.raises(ValueError, match=words):
        Camera.from_K(**inputs)
