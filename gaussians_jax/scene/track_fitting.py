"""Fit a motion model to given 3D tracks, without images."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from gaussians_jax.core import components
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import Motion
from gaussians_jax.core.splats import Params
from gaussians_jax.init import motion_fit
from gaussians_jax.init.motion_fit import Paths, Points
from nerfies_jax.training import programs
from nerfies_jax.training.extensions import check


@dataclasses.dataclass(frozen=True)
class TrackFit:
    """A motion fitted to tracks by `fit_tracks`.

    Attributes:
      params: Parameters of a scene whose Gaussians are the tracked points at their
        canonical positions (`params.rows["splats"].mean`), together with the motion's
        per-Gaussian and shared parameters.
      error_before: Mean distance from the tracks before optimization, in scene units.
      error_after: Mean distance from the tracks after optimization, in scene units.
    """

    params: Params
    error_before: float
    error_after: float
    _positions: programs.Program
    _points: Points
    _span: tuple[float, float]

    def positions(self, times: ArrayLike) -> Float[Array, "points times 3"]:
        """Evaluate the fitted motion.

        Args:
          times: Times [times] in the unit of the `times` of the fit.

        Returns:
          Positions of the tracked points at these times, in scene units.

        Raises:
          ValueError: If `times` is not one-dimensional.
        """
        first, last = self._span
        fraction = (np.asarray(times, np.float64) - first) / (last - first)
        if fraction.ndim != 1:
            raise ValueError(f"times must have shape [times], got {fraction.shape}")
        dtype = self._points.canonical.dtype
        return self._positions(self._points, jnp.asarray(fraction, dtype))


def _positions(effect, points, times):
    position_at = functools.partial(motion_fit.positions_at, effect, points)
    return jnp.swapaxes(jax.vmap(position_at)(times), 0, 1)


def fit_tracks(
    motion: Any,
    tracks: ArrayLike,
    visible: ArrayLike | None = None,
    times: ArrayLike | None = None,
    *,
    key: Array | None = None,
    steps: int = 1000,
    learning_rate: float = 5e-3,
) -> TrackFit:
    """Fit a motion model to 3D point tracks.

    Adam minimizes the mean distance between the moved points and the tracks where they
    are visible. The distance is smooth near zero, so that single wrong tracks have
    little influence. Motions made of rigid bodies (`SE3BasesSpec`) start from a
    closed-form fit of groups of points. The fit runs on the host, compiles one program
    and computes in float32.

    Args:
      motion: Settings of the motion, such as `SE3BasesSpec(bases=8)`: any value of
        `SplatScene.motion`.
      tracks: Positions of the points over time, [points, times, 3], in scene units.
      visible: True where a position is known, [points, times] bool. None: everywhere.
        Positions that are not finite count as unknown.
      times: Increasing times of the columns, [times], in any unit. None: evenly spaced
        from 0 to 1.
      key: PRNG key of the initialization and of the sampled times. None: key 0.
      steps: Number of Adam steps.
      learning_rate: Learning rate. The motion's own rates determine only its ratios
        between parameters.

    Returns:
      The fitted motion.

    Raises:
      ValueError: If a shape or setting is invalid, or a track is never visible.

    References:
      Wang et al. 2024 (Shape of Motion, arXiv:2407.13764), Section 3.3, for the
      initialization of SE(3) bases from tracks.
    """
    check("motion", motion, Motion)
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    if not 0 < learning_rate < np.inf:
        raise ValueError(f"learning_rate must be positive, got {learning_rate}")
    position = np.asarray(tracks, np.float64)
    if position.ndim != 3 or position.shape[2] != 3 or position.shape[1] < 2:
        raise ValueError(
            "tracks must have shape [points, times, 3] with at least two times, got "
            f"{position.shape}"
        )
    valid = np.all(np.isfinite(position), axis=-1)
    if visible is not None:
        visible = np.asarray(visible)
        if visible.shape != valid.shape or visible.dtype != bool:
            raise ValueError(
                f"visible must be bool of shape {valid.shape}, got {visible.dtype} of "
                f"shape {visible.shape}"
            )
        valid &= visible
    invisible = np.flatnonzero(~valid.any(axis=1))
    if len(invisible) or not len(valid):
        raise ValueError(
            f"every track must be visible at some time, but {len(invisible)} of "
            f"{len(valid)} never are (rows {invisible[:5].tolist()}); remove them"
        )
    count = position.shape[1]
    times = np.linspace(0, 1, count) if times is None else np.asarray(times, np.float64)
    if times.shape != (count,) or not (np.diff(times) > 0).all():
        raise ValueError(
            f"times must be {count} increasing numbers, one for each column of tracks, "
            f"got {times}"
        )
    points = position[valid]
    unit = float(np.sqrt(np.mean(np.sum((points - points.mean(0)) ** 2, axis=-1))))
    unit = max(unit, float(np.finfo(np.float32).tiny) ** 0.5)
    box = tuple(points.min(0) - unit), tuple(points.max(0) + unit)
    metadata = SceneMetadata(unit, (0.0, 0.0, 0.0), count, box=box)
    motion = components.moving_at_once(motion)
    effect = components.motion_of_capture(motion, steps, metadata)
    fraction = (times - times[0]) / (times[-1] - times[0])
    solution = motion_fit.fit(
        effect,
        Paths(
            fraction.astype(np.float32),
            np.where(valid[..., None], position, np.nan).astype(np.float32),
            valid,
            unit,
        ),
        jax.random.key(0) if key is None else key,
        rate=learning_rate,
        steps=steps,
    )
    return TrackFit(
        motion_fit.scene_of(effect, solution.points),
        solution.first,
        solution.last,
        programs.Program(_positions, effect),
        solution.points,
        (float(times[0]), float(times[-1])),
    )
