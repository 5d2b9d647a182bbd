"""Scale of a rigid object from the smoothness of its motion."""

import numpy as np
import pytest
import scipy.optimize

from nerfies_jax.preprocessing import body_scale

FRAMES = 24


def rig():
    """Cameras on an arc in two rows that take turns."""
    angle = 0.15 * (np.arange(FRAMES) - 11.5)
    height = np.where(np.arange(FRAMES) % 2, 0.05, 0.0)
    return 0.66 * np.stack([np.sin(angle), height / 0.66, np.cos(angle)], -1)


def swing(phase=0.0):
    """A body that swings twice as far as the cameras differ in height."""
    turn = 4 * np.pi * np.linspace(0, 1, FRAMES) + phase
    return 0.1 * np.stack([np.sin(turn), np.cos(1.5 * turn), np.sin(turn + 1)], -1)


def seen_at(factor, camera, center):
    """Return the path whose directions are the same, but not the distances."""
    return camera + (center - camera) / factor


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("factor", [0.4, 1.0, 3.0])
def test_the_closed_form_has_the_least_relative_acceleration(factor, dtype):
    camera, time = rig(), np.linspace(0, 1, FRAMES)
    center = seen_at(factor, camera, swing())

    def relative_acceleration(log):
        path = camera + np.exp(log) * (center - camera)
        return (np.diff(path, 2, axis=0) ** 2).sum() / np.exp(2 * log)

    best = scipy.optimize.minimize_scalar(
        relative_acceleration, (-0.1, 0.1), tol=1e-12, method="brent"
    )
    scale = body_scale.from_smoothness(time, dtype(camera), dtype(center))
    rtol = 1e-4 if dtype is np.float32 else 1e-6
    assert scale.factor == pytest.approx(np.exp(best.x), rel=rtol)
    assert scale.factor == pytest.approx(factor, rel=0.1)
    assert scale.deviation < 0.1


def test_a_static_body_has_the_exact_scale_at_uneven_times():
    time = np.sort(np.random.default_rng(0).uniform(size=FRAMES))
    center = seen_at(1.7, rig(), np.tile([0.1, 0.0, -0.2], (FRAMES, 1)))
    scale = body_scale.from_smoothness(time, rig(), center)
    assert scale.factor == pytest.approx(1.7, rel=1e-9)
    assert scale.deviation < 1e-6


def test_the_deviation_is_that_of_the_errors_in_noise():
    rng, camera, errors = np.random.default_rng(0), rig(), []
    for _ in range(200):
        center = swing(rng.uniform(0, 2 * np.pi))
        away = center - camera
        noisy = camera + away * rng.normal(1, 0.02, (FRAMES, 1))
        scale = body_scale.from_smoothness(np.arange(FRAMES), camera, noisy)
        errors.append((scale.factor - 1) / scale.deviation)
    assert 0.85 < np.mean(np.abs(errors) < 2) <= 1
    assert abs(np.mean(errors)) < 0.5


def line(frames=FRAMES):
    return np.linspace(0, 1, frames)[:, None] * [1.0, 0, 0]


def arc():
    turn = np.linspace(0, 2, FRAMES)
    return 0.3 * np.stack([np.sin(turn), 0 * turn, np.cos(turn)], -1)


@pytest.mark.parametrize(
    ("camera", "center"),
    [
        (line(), 1 + swing()),  # uniform motion has no acceleration
        (0 * line(), 1 + swing()),  # a camera in place
        (rig()[:2], swing()[:2] + 1),  # too few frames
        (arc(), arc() @ np.diag([1, 1, 0.5]) + [0, 0.1, 0]),  # like the camera
        (arc(), 2 * arc() + [0, 0, 1]),  # contradicts every factor
    ],
)
def test_what_smoothness_cannot_tell_is_said(camera, center):
    time = np.arange(len(camera))
    assert body_scale.from_smoothness(time, camera, center).deviation > 0.2


def sweep(frames=60):
    """A camera that sweeps on an arc while it moves closer."""
    time = np.linspace(0, 1, frames)
    angle = 0.38 * np.sin(5 * np.pi * time)
    distance = 0.66 - 0.05 * np.sin(2.5 * np.pi * time) ** 2
    position = np.stack([np.sin(angle), 0.1 + 0 * time, np.cos(angle)], -1)
    return time, distance[:, None] * position


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("factor", [0.96, 1.04])
def test_a_door_that_slides_in_step_with_the_camera_has_its_scale(factor, dtype):
    time, camera = sweep()
    slide = 0.02 * np.cos(4 * np.pi * time)[:, None] * [1.0, 0, 0]
    center = slide + np.array([0.1, 0.03, -0.07])
    rng = np.random.default_rng(0)
    noisy = camera + (center - camera) * rng.normal(1, 5e-4, (len(time), 1))
    path = seen_at(factor, camera, noisy)
    closed = body_scale.from_smoothness(time, camera, path).factor
    assert abs(closed / factor - 1) > 0.02
    likely = body_scale.most_likely(time, dtype(camera), dtype(path), 0.03)
    # A factor of the grid is within 0.08 % of any other.
    assert likely == pytest.approx(factor, rel=0.005)


def test_a_scale_that_the_likelihood_cannot_tell_is_that_of_the_paths():
    time, camera = sweep()
    center = np.stack([0.1 * np.sin(9 * time), 0.1 * time**2, 0 * time], -1)
    assert body_scale.most_likely(time[:20], camera[:20], center[:20], 0.1) == 1
    uniform = time[:, None] * [0.3, 0, 0]
    assert body_scale.most_likely(time, uniform, center, 0.1) == pytest.approx(1)
    assert body_scale.most_likely(time, camera, center, 0.0) == 1
    # It accelerates more than the camera, along all axes: 1 % makes no difference.
    swift = 0.05 * np.stack(
        [np.sin(31 * time), np.cos(37 * time), np.sin(43 * time)], -1
    )
    path = seen_at(1.01, camera, swift)
    assert body_scale.most_likely(time, camera, path, 0.07, 0.5) == 1
