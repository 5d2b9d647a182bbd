"""Camera paths for rendering videos: cameras and scene times."""

from typing import Any, NamedTuple

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.capture.world_points import mean_up
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.rays import across_ray

KINDS = ("sway", "orbit", "lemniscate", "stabilized", "captured")
# Standard deviation of the Gaussian smoothing of a stabilized path, as a share of the
# duration: 0.5 s of 10 s, which removes hand shake and preserves the walk.
SMOOTHED_OVER = 0.05
SECONDS = 4.0  # duration of a video if the frame rate of the capture is unknown
SHORTEST, LONGEST = 1.0, 60.0  # seconds
# Smallest sine of the angle between the viewing direction and the up axis. A sway
# rotates the view by about 20 degrees, and images would flip where it crosses the axis.
# On an orbit all views have the same angle to the axis.
LEAST_TILT, LEAST_ORBIT = 0.35, 0.01


class CameraPath(NamedTuple):
    """Cameras of a video and their times, in NumPy."""

    cameras: Camera  # [frames], scene units
    size: tuple[int, int]  # width and height of the images, in pixels
    # [frames] in [0, 1]. None if the path does not determine them.
    times: np.ndarray | None = None


def planned(kind: str, capture: Capture, count: int) -> CameraPath:
    """Make a path of one of the `KINDS`, with the times of its cameras.

    Args:
      kind: One of `KINDS`.
      capture: The capture to look at.
      count: Number of cameras.

    Returns:
      The path. Its times are None unless the kind determines them.

    Raises:
      ValueError: If the kind is unknown.
    """
    times = None
    if kind == "captured":
        times = capture.times[_rows_in_time(capture, count)]
    elif kind == "stabilized":
        times = _even_times(capture, count)
    return CameraPath(path(kind, capture, count), capture.size, times)


def path(kind: str, capture: Capture, count: int) -> Camera:
    """Make cameras that move around the scene.

    "sway" stays within the range of the captured positions, where a monocular
    reconstruction is reliable, and so does "lemniscate", a horizontal figure of eight.
    "orbit" is a full circle around the focus point. "captured" repeats the training
    cameras in the order of their times, and "stabilized" does the same without camera
    shake. If the cameras look along the up axis, as an overhead camera does, the
    vertical of the middle image replaces it.

    Args:
      kind: One of `KINDS`.
      capture: The capture to look at.
      count: Number of cameras.

    Returns:
      Cameras in scene units, [count].

    Raises:
      ValueError: If the kind is unknown.
    """
    if kind not in KINDS:
        raise ValueError(f"no camera path {kind!r}; {known_names(kind, KINDS)}")
    if kind == "captured":
        return cameras.take(capture.cameras, _rows_in_time(capture, count))
    train_cameras = cameras.take(capture.cameras, capture.train)
    if kind == "stabilized":
        train_times = capture.times[capture.train].astype(np.float64)
        return smoothed(train_cameras, train_times, _even_times(capture, count))
    phase = np.linspace(0, 2 * np.pi, count, endpoint=False)
    target = focus_point(train_cameras, capture.near, capture.far)
    min_sine = LEAST_ORBIT if kind == "orbit" else LEAST_TILT
    up = _usable_up(up_axis(capture), train_cameras, target, min_sine)
    shapes = {"sway": _sway, "orbit": _orbit, "lemniscate": _lemniscate}
    positions = shapes[kind](train_cameras, target, up, phase)
    middle = cameras.take(train_cameras, len(train_cameras.focal_px) // 2)
    size = capture.size
    path_cameras = cameras.stack(
        [
            cameras.look_at(position, target, up, float(middle.focal_px), size)
            for position in positions
        ]
    )
    aspect: Any = np.broadcast_to(middle.pixel_aspect, (count,)).copy()
    return path_cameras._replace(pixel_aspect=aspect)


def _usable_up(up, train_cameras, target, min_sine):
    """Return `up`, or that of the middle image if the view is nearly parallel to it."""
    forward = target - np.median(train_cameras.position.astype(np.float64), axis=0)
    if np.linalg.norm(np.cross(forward, up)) >= min_sine * np.linalg.norm(forward):
        return up
    middle = len(train_cameras.focal_px) // 2
    return -train_cameras.camera_from_world[middle, 1].astype(np.float64)


def _rows_in_time(capture, count):
    """Indices of evenly spaced training frames in the order of their times."""
    rows = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    return rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]


def _even_times(capture, count):
    """Evenly spaced times from the first to the last training frame."""
    times = capture.times[capture.train]
    return np.linspace(times.min(), times.max(), count, dtype=np.float32)


def smoothed(captured: Camera, captured_times: np.ndarray, times: np.ndarray) -> Camera:
    """Remove camera shake and resample a camera in time.

    Positions and rotation matrices are local linear regressions over time, weighted by
    a Gaussian with a standard deviation of `SMOOTHED_OVER`, or 1.5 times the largest
    gap between frames. A fitted matrix is projected to the nearest rotation. A local
    mean would shrink the path at the first and last frame.

    Args:
      captured: Captured cameras, [frames].
      captured_times: Their times, [frames].
      times: Times of the result, [count].

    Returns:
      Cameras [count], with the intrinsics of the middle one, without skew and
      distortion.
    """
    gaps = np.diff(np.unique(captured_times))
    width = max(SMOOTHED_OVER, 1.5 * gaps.max(initial=0))
    count = len(captured.focal_px)
    poses = np.concatenate(
        [captured.position, captured.camera_from_world.reshape(count, 9)], axis=1
    ).astype(np.float64)
    solution = np.empty((len(times), 12))
    for row, time in enumerate(np.asarray(times, np.float64)):
        offset = captured_times - time
        # The square root of the Gaussian, since least squares squares the weights.
        weight = np.exp(-((offset / (2 * width)) ** 2))
        line = np.stack([np.ones(count), offset], axis=1) * weight[:, None]
        solution[row] = np.linalg.lstsq(line, poses * weight[:, None], rcond=1e-9)[0][0]
    left, _, right = np.linalg.svd(solution[:, 3:].reshape(-1, 3, 3))
    flip = np.ones((len(times), 3))
    flip[:, 2] = np.linalg.det(left @ right)  # excludes reflections
    lens = cameras.take(captured, np.full(len(times), count // 2))
    leaves: dict[str, Any] = dict(
        camera_from_world=((left * flip[:, None]) @ right).astype(np.float32),
        position=solution[:, :3].astype(np.float32),
        skew_px=np.zeros_like(lens.skew_px),
        radial=np.zeros_like(lens.radial),
        tangential=np.zeros_like(lens.tangential),
        fisheye=None,
    )
    return lens._replace(**leaves)


def times(count: int, loops: float = 1.0) -> np.ndarray:
    """Return times that play the scene forward and backward.

    Args:
      count: Number of times.
      loops: Number of repetitions.

    Returns:
      Times in [0, 1], [count], float32.
    """
    phase = np.linspace(0, loops, count, endpoint=False) % 1
    return (1 - np.abs(1 - 2 * phase)).astype(np.float32)


def playing_seconds(capture: Capture) -> float:
    """Return the duration of the scene.

    Args:
      capture: The capture.

    Returns:
      Seconds, clamped to `SHORTEST` and `LONGEST`, or `SECONDS` if the frame rate is
      unknown.
    """
    if capture.frames_per_second is None:
        return SECONDS
    count = len(np.unique(capture.times))
    return float(np.clip(count / capture.frames_per_second, SHORTEST, LONGEST))


def up_axis(capture: Capture) -> np.ndarray:
    """Return the up direction of a capture, by default the mean of its images.

    Args:
      capture: The capture.

    Returns:
      A direction in scene axes, [3].
    """
    if capture.up is not None:
        return np.asarray(capture.up, np.float64)
    up = mean_up(cameras.take(capture.cameras, capture.train))
    return up / np.linalg.norm(up)


def focus_point(train_cameras: Camera, near: float, far: float) -> np.ndarray:
    """Find the point closest to all viewing axes, between the near and far planes.

    Parallel axes have no closest point, and the least-squares system is singular. The
    point then lies halfway (in inverse depth) along the mean axis instead.

    Args:
      train_cameras: Cameras, [frames].
      near: Depth of the near plane in scene units.
      far: Depth of the far plane in scene units.

    Returns:
      The point in scene units, [3].
    """
    axes = np.asarray(train_cameras.camera_from_world, np.float64)[:, 2, :]
    centers = np.asarray(train_cameras.position, np.float64)
    across = across_ray(axes)
    system = across.sum(axis=0)
    mean_axis = axes.mean(axis=0) / np.linalg.norm(axes.mean(axis=0))
    mean_center = centers.mean(axis=0)
    halfway = 2 / (1 / near + 1 / far)
    # The smallest eigenvalue per camera is the mean squared sine of the angles to the
    # common direction.
    if np.linalg.eigvalsh(system)[0] < 1e-3 * len(axes):
        return mean_center + halfway * mean_axis
    point = np.linalg.solve(system, np.einsum("nij,nj->i", across, centers))
    depth = float((point - mean_center) @ mean_axis)
    if near < depth < far:
        return point
    return mean_center + halfway * mean_axis


class _Window(NamedTuple):
    """Median of the captured positions, and their extent across the view."""

    middle: np.ndarray  # [3]
    right: np.ndarray  # [3], half of the range of 70 % of the positions
    upward: np.ndarray  # [3], likewise


def _window(train_cameras, target, up):
    centers = train_cameras.position.astype(np.float64)
    middle = np.median(centers, axis=0)
    forward = target - middle
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    upward = np.cross(right, forward)
    offset = centers - middle
    wide = np.quantile(np.abs(offset @ right), 0.7)
    high = np.quantile(np.abs(offset @ upward), 0.7)
    # The path of a nearly static camera gets some parallax to show depth.
    minimum = 0.03 * np.linalg.norm(target - middle)
    return _Window(middle, max(wide, minimum) * right, max(high, minimum / 2) * upward)


def _sway(train_cameras, target, up, phase):
    """Ellipse within the range of 70 % of the captured positions."""
    middle, right, upward = _window(train_cameras, target, up)
    return middle + np.sin(phase)[:, None] * right + np.cos(phase)[:, None] * upward


def _lemniscate(train_cameras, target, up, phase):
    """Lemniscate of Gerono within the same range as the sway."""
    middle, right, upward = _window(train_cameras, target, up)
    return middle + np.sin(phase)[:, None] * right + np.sin(2 * phase)[:, None] * upward


def _orbit(train_cameras, target, up, phase):
    """Full circle about the up axis, at the captured distance and height."""
    offset = np.median(train_cameras.position.astype(np.float64), axis=0) - target
    height = (offset @ up) * up
    flat = offset - height
    side = np.cross(up, flat)
    return (
        target + height + np.cos(phase)[:, None] * flat + np.sin(phase)[:, None] * side
    )
