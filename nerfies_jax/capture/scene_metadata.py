"""Scene metadata of a radiance field, computed from a capture before compilation."""

import dataclasses
import itertools
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from nerfies_jax.capture.capture import Capture, point_depths
from nerfies_jax.geometry import camera as cameras

# A number of a capture, traced in a program that takes it as an argument.
Number = float | Float[Array, ""]

MIN_POINTS = 100  # fewer points do not determine the bounds of the scene
# Share of points at either end taken for outliers of structure from motion.
OUTLIERS = 0.02
SHOWN_BY = 0.7  # share of the images that show the most visible points
SUBJECT_MARGIN = 1.2


@dataclasses.dataclass(frozen=True)
class SceneMetadata:
    """Bounds, scale, times and exposures of a scene. Static and hashable."""

    near: Number  # z-depth, scene units
    far: Number
    center: tuple[Number, Number, Number]  # of the captured volume, scene units
    scale: Number  # field = (scene - center) * scale
    background: tuple[Number, Number, Number] | None  # sRGB in [0, 1], if known
    # Distinct times of the training frames, ascending.
    times: tuple[float, ...] | Float[Array, " times"]
    # For each appearance id, two rows of the table of codes and the weight between them
    # (left, right, weight). The code of an appearance that no training frame has is
    # interpolated between those before and after it in time.
    exposures: tuple[tuple[int, int, float], ...] | Float[Array, "appearances 3"]
    available_data: frozenset[str] = frozenset()  # of "depths", "points", "flow"

    @property
    def numbers(self) -> dict[str, Any]:
        """Fields that programs take as arguments (`training.programs`).

        The lengths of the arrays still determine shapes.
        """
        return {
            "near": self.near,
            "far": self.far,
            "center": self.center,
            "scale": self.scale,
            "background": self.background,
            "times": np.asarray(self.times, float),
            "exposures": np.asarray(self.exposures, float),
        }

    @property
    def concrete(self) -> "SceneMetadata":
        """The metadata of the capture, which decide which operations there are."""
        return self

    def with_numbers(self, numbers: dict[str, Any]) -> "SceneMetadata":
        """Replace the numbers, by those of a program that is being traced.

        Args:
          numbers: Values of all fields of `numbers`.

        Returns:
          The metadata, whose `concrete` is that of this object.
        """
        return _Traced(**vars(self) | numbers, untraced=self.concrete)


@dataclasses.dataclass(frozen=True)
class _Traced(SceneMetadata):
    """Metadata with traced numbers."""

    untraced: SceneMetadata | None = None

    @property
    def concrete(self) -> SceneMetadata:
        assert self.untraced is not None
        return self.untraced

    def with_numbers(self, numbers):
        return self.concrete.with_numbers(numbers)


def metadata_of(
    capture: Capture, extent: float | None, volume: str = "frustums"
) -> SceneMetadata:
    """Compute the scene metadata of a capture, on the host.

    Args:
      capture: The capture.
      extent: Longest half side of the captured volume in units of the field. None keeps
        the capture's own coordinates.
      volume: "frustums" for all that the cameras may see, or "subject" for what most
        of them look at.

    Returns:
      The metadata.
    """
    near, far = _span(capture)
    center, half_side = _box(capture, near, far)
    if volume == "subject":
        center, half_side = _subject(capture) or (center, half_side)
    if extent is None:
        center, scale = (0.0, 0.0, 0.0), 1.0
    else:
        scale = extent / half_side
    times = np.unique(capture.times[capture.train])
    available_data = set()
    if capture.points is not None and len(capture.points.position):
        available_data.add("points")
    if capture.depths is not None:
        available_data.add("depths")
    if capture.flow is not None:
        available_data.add("flow")
    return SceneMetadata(
        near=near,
        far=far,
        center=(float(center[0]), float(center[1]), float(center[2])),
        scale=float(scale),
        background=capture.background,
        times=tuple(float(time) for time in times),
        exposures=exposures(capture),
        available_data=frozenset(available_data),
    )


def _span(capture):
    """Near and far planes of the capture, tightened to the depths of its points.

    The near plane of a Nerfies capture is often much nearer than the scene (0.05 where
    the first point is at 0.4), and samples in the empty space between are wasted.
    """
    depth = point_depths(capture)
    # Points beyond the far plane are ignored, or near could exceed far.
    depth = depth[depth < capture.far]
    if depth.size < MIN_POINTS:
        return float(capture.near), float(capture.far)
    low, high = np.quantile(depth, (OUTLIERS, 1 - OUTLIERS))
    # Moving objects have few points and stand in front of the static background.
    near = max(capture.near, 0.6 * float(low))
    return float(near), float(min(capture.far, 1.2 * float(high)))


def _box(capture, near, far):
    """Center and longest half side of the bounding box of the captured volume."""
    if capture.points is not None and len(capture.points.position) >= MIN_POINTS:
        positions = capture.points.position
        low, high = np.quantile(positions, (OUTLIERS, 1 - OUTLIERS), axis=0)
        # Moving objects stand in front of the points of structure from motion.
        near_points = _frustum_points(capture, near, near)
        low = np.minimum(low, np.quantile(near_points, 0.1, axis=0))
        high = np.maximum(high, np.quantile(near_points, 0.9, axis=0))
    else:
        points = _frustum_points(capture, near, far)
        low, high = np.quantile(points, (0.1, 0.9), axis=0)
    half_side = float(np.max(high - low)) / 2
    return (low + high) / 2, half_side


def _subject(capture):
    """Center and longest half side of the points that most images show.

    The cameras of a photo collection stand at several times the size of what they look
    at, and a box around them all leaves it few cells of a grid.
    """
    if capture.points is None or len(capture.points.position) < MIN_POINTS:
        return None
    position = capture.points.position
    width, height = capture.size
    views = np.zeros(len(position), int)
    for row in capture.train:
        camera = cameras.take(capture.cameras, row)
        x, y, z = camera.camera_from_world @ (position - camera.position).T
        focal = camera.focal_px * np.array([1, camera.pixel_aspect])
        with np.errstate(divide="ignore", invalid="ignore"):
            u = focal[0] * x / z + camera.principal_point_px[0]
            v = focal[1] * y / z + camera.principal_point_px[1]
        views += (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    often = views >= SHOWN_BY * np.quantile(views, 1 - OUTLIERS)
    low, high = np.quantile(position[often], (OUTLIERS, 1 - OUTLIERS), axis=0)
    half_side = SUBJECT_MARGIN * float(np.max(high - low)) / 2
    return ((low + high) / 2, half_side) if half_side > 0 else None


def _frustum_points(capture, near, far):
    """Corners, edge midpoints and centers of the images at some depths, in scene units.

    Skew and distortion are ignored, since the bounds are approximate.
    """
    views = cameras.take(capture.cameras, capture.train)
    width, height = capture.size
    rotation, focal = views.camera_from_world, views.focal_px
    focal = np.stack([focal, focal * views.pixel_aspect], axis=1)
    middle = views.principal_point_px
    points = []
    for x, y in itertools.product((0.0, width / 2, width), (0.0, height / 2, height)):
        offset = (np.array([x, y]) - middle) / focal
        ray = np.concatenate([offset, np.ones((len(capture.train), 1))], axis=1)
        world = np.einsum("fki,fk->fi", rotation, ray)
        for depth in np.linspace(near, far, 8):
            points.append(views.position + depth * world)
    return np.concatenate(points)


def exposures(capture: Capture) -> tuple[tuple[int, int, float], ...]:
    """Compute `SceneMetadata.exposures`, which interpolates untrained appearances.

    Args:
      capture: The capture.

    Returns:
      For each appearance id, two rows of the table of trained ids and the weight of the
      second.
    """
    ids = np.asarray(capture.appearance_ids)
    trained_ids = np.unique(ids[capture.train])
    row_of = {int(trained_id): row for row, trained_id in enumerate(trained_ids)}
    time_of = {
        int(frame_id): float(np.mean(capture.times[ids == frame_id]))
        for frame_id in np.unique(ids)
    }
    by_time = sorted(row_of, key=lambda trained_id: time_of[trained_id])
    trained_times = [time_of[trained_id] for trained_id in by_time]
    exposures = []
    for frame_id in range(int(ids.max()) + 1):
        if frame_id in row_of:
            exposures.append((row_of[frame_id], row_of[frame_id], 0.0))
        elif frame_id in time_of:
            left, right, weight = _interpolate(time_of[frame_id], trained_times)
            exposures.append((row_of[by_time[left]], row_of[by_time[right]], weight))
        else:
            exposures.append((0, 0, 0.0))  # no frame has this id
    return tuple(exposures)


def _interpolate(time, times):
    """Indices of the sorted times around a time, and the weight of the second."""
    right = int(np.searchsorted(times, time))
    left = max(right - 1, 0)
    right = min(right, len(times) - 1)
    gap = times[right] - times[left]
    weight = (time - times[left]) / gap if gap > 0 else 0.0
    return left, right, float(weight)
