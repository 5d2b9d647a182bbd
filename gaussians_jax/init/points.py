"""Initialization of Gaussians from the points of the capture and random points."""

import dataclasses
import math

import jax
import numpy as np
import scipy.spatial

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Splats
from gaussians_jax.init import visual_hull
from nerfies_jax.capture.capture import Capture, point_depths
from nerfies_jax.training.track_start import TrackStartSpec

SOURCES = ("auto", "points", "random")


@dataclasses.dataclass(frozen=True)
class InitSpec:
    """Settings of the initial Gaussians.

    `source="auto"` uses the capture's points if there are at least `min_points`, and
    random ones otherwise, in the visual hull if there is one. "points" and "random"
    require the capture's points, and random ones in all views. MoBa-GS, which claims to
    need no points from structure from motion, supports both.

    `extra_random` points are sampled in the views in addition to the capture's points.
    None means half as many as `points`, or none if tracks initialize the motion
    (`of_start`).
    """

    points: int = 100_000  # largest number of the capture's own points
    random: int = 10_000  # number of random points, without the capture's own
    min_points: int = 100
    extra_random: int | None = 0
    opacity: float = 0.1
    scale: float = 1.0  # initial scale relative to the distance of nearest neighbors
    max_scale: float = 0.03  # relative to the distance of the nearest camera
    source: str = "auto"

    def __post_init__(self):
        if self.source not in SOURCES:
            raise ValueError(f"unknown source {self.source!r}; choose from {SOURCES}")
        if self.points < 1 or self.random < 1 or (self.extra_random or 0) < 0:
            raise ValueError(
                "a scene needs at least one initial Gaussian, got points="
                f"{self.points}, random={self.random} and "
                f"extra_random={self.extra_random}"
            )
        if not 0 < self.opacity < 1:
            raise ValueError(f"opacity={self.opacity} must be between 0 and 1")
        for name in ("scale", "max_scale"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}={getattr(self, name)} must be positive")


@dataclasses.dataclass(frozen=True)
class StartSpec(TrackStartSpec):
    """Settings of the initial motion."""

    fit_steps: int = 3000
    fit_rate: float = 5e-3
    moving_points: int = 3000  # Gaussians lifted from moving pixels
    # Their thickness relative to their other scales, 1 for spheres. No second view of a
    # moving surface at one time corrects its depth, and the Gaussians that are in front
    # of it, to which thick ones are split, hide the others: the cube of the built-in
    # scene is nearer by 0.1 % of its distance with spheres.
    thickness: float = 0.15
    # Guess the background that a moving object hides in every frame.
    fill_hidden: bool = True

    def __post_init__(self):
        super().__post_init__()
        if self.moving_points < 1:
            raise ValueError(
                "an initialization from tracks needs at least one moving point, got "
                f"moving_points={self.moving_points}"
            )
        if not 0 < self.thickness <= 1:
            raise ValueError(f"thickness={self.thickness} must lie in (0, 1]")


def point_count(capture: Capture) -> int:
    """Count the points of a capture.

    Args:
      capture: The capture.

    Returns:
      Number of points.
    """
    return 0 if capture.points is None else len(capture.points.position)


def uses_capture_points(spec: InitSpec, capture: Capture) -> bool:
    """Test if the initial Gaussians are the capture's points, on the host.

    Args:
      spec: Settings.
      capture: The capture.

    Returns:
      True if they are, False if they are random.

    Raises:
      ValueError: If the settings require points and the capture has none.
    """
    points = point_count(capture)
    if spec.source == "points" and not points:
        raise ValueError(
            f'{capture.path or capture.name}: source="points" needs a capture with '
            'points, but it has none; choose source="random", or "auto" for random '
            "points only if there are no others"
        )
    enough = 1 if spec.source == "points" else max(spec.min_points, 1)
    return spec.source != "random" and points >= enough


def of_start(spec: InitSpec, tracked: bool, most: int | None = None) -> InitSpec:
    """Resolve the number of extra random points.

    Structure from motion finds static surfaces only. Moving objects are initialized by
    tracks, or grow from random points in the volume.

    Args:
      spec: Settings.
      tracked: Whether tracks initialize the motion.
      most: Largest number of Gaussians.

    Returns:
      Settings with a number for `extra_random`.
    """
    if spec.extra_random is not None:
        return spec
    extra = 0 if tracked else spec.points // 2
    if most is not None:
        extra = max(min(extra, most - spec.points), 0)
    return dataclasses.replace(spec, extra_random=extra)


def initial_count(spec: InitSpec, capture: Capture) -> int:
    """Compute the number of initial Gaussians, on the host.

    Args:
      spec: Settings.
      capture: The capture.

    Returns:
      Number of Gaussians.
    """
    if not uses_capture_points(spec, capture):
        return spec.random
    extra = of_start(spec, False).extra_random
    assert capture.points is not None
    assert extra is not None
    return min(len(capture.points.position), spec.points) + extra


def initial_points(spec: InitSpec, capture: Capture, seed: int):
    """Sample positions and colors of the initial Gaussians, on the host.

    Random points lie between the near and far planes of the capture, and inside the
    silhouettes of a static object in front of a known background
    (`visual_hull.hull_points`).

    Args:
      spec: Settings.
      capture: The capture.
      seed: Seed of the random points.

    Returns:
      Positions [n, 3] in scene units, and colors [n, 3] in [0, 1].
    """
    spec = of_start(spec, False)
    rng = np.random.default_rng(seed)
    if not uses_capture_points(spec, capture):
        span = capture.near, capture.far
        if spec.source != "random":
            inside = visual_hull.hull_points(rng, capture, spec.random, span)
            if inside is not None:
                return inside
        return _random_points(rng, capture, spec.random, span)
    cloud = capture.points
    assert cloud is not None
    position, color = cloud.position, cloud.color / 255
    if len(position) > spec.points:
        indices = np.sort(rng.choice(len(position), spec.points, replace=False))
        position, color = position[indices], color[indices]
    span = observed_depths(capture)
    extra, extra_color = _random_points(rng, capture, spec.extra_random, span)
    return np.concatenate([position, extra]), np.concatenate([color, extra_color])


def observed_box(
    capture: Capture, span: tuple[float, float] | None = None
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Compute the bounding box of the observed volume, on the host.

    The box is the central 98 % along each axis of points sampled in the views, between
    the depths of the capture's points.

    Args:
      capture: The capture.
      span: Smallest and largest depth, if known.

    Returns:
      Minimum and maximum corner in scene units.
    """
    rng = np.random.default_rng(0)
    point, _ = _random_points(rng, capture, 4000, span or observed_depths(capture))
    low, high = np.quantile(point, (0.01, 0.99), axis=0)
    return tuple(low.tolist()), tuple(high.tolist())


def _random_points(rng, capture, count, span):
    cameras = jax.tree.map(lambda leaf: leaf[capture.train], capture.cameras)
    position = splats.random_in_views(rng, cameras, capture.size, *span, count)
    return position, rng.uniform(size=position.shape)


def clamp_scales(rows: Splats, capture: Capture, max_scale: float) -> Splats:
    """Limit the scale of Gaussians to a share of the distance to the nearest camera.

    An isolated point gets the distance to its neighbors as its scale. Near a camera it
    would cover the image: the first steps on a capture with such points took 2 s each.

    Args:
      rows: Raw parameters.
      capture: The capture.
      max_scale: Largest scale as a share of the distance.

    Returns:
      Raw parameters with clamped scales.
    """
    cameras = scipy.spatial.cKDTree(capture.cameras.position[capture.train])
    distance, _ = cameras.query(np.asarray(rows.mean))
    bound = np.log(np.maximum(max_scale * distance, 1e-8)).astype(np.float32)
    return rows._replace(log_scale=np.minimum(rows.log_scale, bound[:, None]))


def observed_depths(capture):
    """Compute the range of z-depths of the capture's points, slightly widened.

    The near plane is often much nearer than any surface (0.05 with the first point at
    0.4). A Gaussian there would cover the whole image, and steps would take 20 times
    longer.

    Args:
      capture: The capture.

    Returns:
      Smallest and largest z-depth in scene units.
    """
    depth = point_depths(capture)
    # Points beyond the far plane are rendered, but surfaces are in front of it.
    depth = depth[depth < capture.far]
    if not depth.size:
        return capture.near, capture.far
    low, high = np.quantile(depth, (0.02, 0.98))
    return max(capture.near, 0.7 * float(low)), min(capture.far, 1.1 * float(high))
