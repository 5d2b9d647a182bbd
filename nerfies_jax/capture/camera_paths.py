"""Camera paths for videos: where the camera goes, and at which time of the scene."""

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.rays import across_ray

KINDS = ("sway", "orbit", "captured")


def path(kind: str, capture: Capture, count: int, turns: float = 1.0) -> Camera:
    """`count` cameras moving around what the capture looks at.

    `sway` keeps to the span of the filmed positions, where a monocular reconstruction
    can be trusted; `orbit` circles the focus point in full; `captured` repeats the
    training cameras in the order of their times.
    """
    if kind == "captured":
        rows = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
        picked = np.linspace(0, len(rows) - 1, count).round().astype(int)
        return cameras.take(capture.cameras, rows[picked])
    phase = np.linspace(0, 2 * np.pi * turns, count, endpoint=False)
    train_cameras = cameras.take(capture.cameras, capture.train)
    up = mean_up(train_cameras) if capture.up is None else np.asarray(capture.up)
    target = focus_point(train_cameras, capture.near, capture.far)
    positions = (_sway if kind == "sway" else _orbit)(train_cameras, target, up, phase)
    middle = cameras.take(train_cameras, len(train_cameras.focal_px) // 2)
    size = capture.size
    looking = cameras.stack(
        [
            cameras.look_at(position, target, up, float(middle.focal_px), size)
            for position in positions
        ]
    )
    return looking._replace(
        pixel_aspect=np.broadcast_to(middle.pixel_aspect, (count,)).copy()
    )


def times(count: int, loops: float = 1.0) -> np.ndarray:
    """Instants in [0, 1] that play the scene forwards and back, `loops` times."""
    phase = np.linspace(0, loops, count, endpoint=False) % 1
    return (1 - np.abs(1 - 2 * phase)).astype(np.float32)


def mean_up(train_cameras: Camera) -> np.ndarray:
    """The mean of the pictures' upward directions, unit length."""
    up = -train_cameras.camera_from_world[:, 1, :].astype(np.float64).mean(axis=0)
    return up / np.linalg.norm(up)


def focus_point(train_cameras: Camera, near: float, far: float) -> np.ndarray:
    """The point closest to all viewing axes, kept between the near and far planes.

    Parallel axes have no closest point; the least-squares system then is singular, and
    the point lies halfway (in inverse depth) along the mean axis instead.
    """
    axes = train_cameras.camera_from_world[:, 2, :].astype(np.float64)
    centres = train_cameras.position.astype(np.float64)
    across = across_ray(axes)
    system = across.sum(axis=0)
    mean_axis = axes.mean(axis=0) / np.linalg.norm(axes.mean(axis=0))
    mean_centre = centres.mean(axis=0)
    halfway = 2 / (1 / near + 1 / far)
    # Smallest eigenvalue per camera = mean squared sine to the common direction.
    if np.linalg.eigvalsh(system)[0] < 1e-3 * len(axes):
        return mean_centre + halfway * mean_axis
    point = np.linalg.solve(system, np.einsum("nij,nj->i", across, centres))
    depth = float((point - mean_centre) @ mean_axis)
    if near < depth < far:
        return point
    return mean_centre + halfway * mean_axis


def _sway(train_cameras, target, up, phase):
    """An ellipse through the 70 % span of the filmed positions, facing the target."""
    centres = train_cameras.position.astype(np.float64)
    middle = np.median(centres, axis=0)
    forward = target - middle
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    upward = np.cross(right, forward)
    offset = centres - middle
    wide = np.quantile(np.abs(offset @ right), 0.7)
    high = np.quantile(np.abs(offset @ upward), 0.7)
    # A camera that hardly moved still sways a little, to show depth.
    least = 0.03 * np.linalg.norm(target - middle)
    wide, high = max(wide, least), max(high, least / 2)
    return (
        middle
        + np.sin(phase)[:, None] * wide * right
        + np.cos(phase)[:, None] * high * upward
    )


def _orbit(train_cameras, target, up, phase):
    """A full circle about the up axis, at the filmed distance and height."""
    offset = np.median(train_cameras.position.astype(np.float64), axis=0) - target
    height = (offset @ up) * up
    flat = offset - height
    side = np.cross(up, flat)
    return (
        target + height + np.cos(phase)[:, None] * flat + np.sin(phase)[:, None] * side
    )
