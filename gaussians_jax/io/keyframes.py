"""A trained scene sampled at a few times, for players without the model."""

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Int

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.io.single_time import At
from gaussians_jax.splatting import harmonics, projection, raster
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.runtime import data_parallel, events

LEAST_KEYFRAMES, MOST_KEYFRAMES = 24, 48
MOST_VIEWS = 48  # training views that determine visibility and color
MOST_SIDE_PX = 320  # of their images, because larger ones give the same result
# Gaussians are left out if they contribute less to every view, in pixels. Built-in
# scene, `splats-tracked-small`, 300 steps: this leaves out 436 of 10,000, and held-out
# renders have 56.6 dB with respect to the model's own. 0.3 leaves out 1,426 (53.4 dB),
# 1 leaves out 3,359 (42.5 dB), and 0 none (56.8 dB).
LEAST_SEEN_PX = 0.1
# Gaussians count as moving if they move by more than this share of their distance to
# the cameras, at this number of times. Hidden ones are evaluated without them.
MOVES, TIMES = 0.01, 8


class Keyframes(NamedTuple):
    """Gaussians at evenly spaced times from 0 to 1, without invisible ones."""

    mean: np.ndarray  # [keyframes, gaussians, 3], scene units
    quaternion: np.ndarray  # [keyframes, gaussians, 4] wxyz, unit, with steady signs
    log_scale: np.ndarray  # [keyframes, gaussians, 3]
    opacity: np.ndarray  # [keyframes, gaussians]
    color: np.ndarray  # [gaussians, 3], not negative, independent of the direction
    left_out: int  # Gaussians that no camera saw


class Contributions(NamedTuple):
    """Contribution of each Gaussian to the training views."""

    most: np.ndarray  # [gaussians] pixels, in the view with the largest contribution
    color: np.ndarray  # [gaussians, 3], mean over the views weighted by contribution


def sample(at: At, rows: Splats, contributions: Contributions, count: int) -> Keyframes:
    """Evaluate a scene at evenly spaced times, on the host.

    Args:
      at: Function from time to Gaussians.
      rows: Raw parameters, for the number of active Gaussians.
      contributions: Contribution of each Gaussian to the training views.
      count: Number of times.

    Returns:
      The Gaussians at these times.

    Raises:
      ValueError: If no Gaussian is visible from a training camera.
    """
    is_visible = visible(contributions)
    poses = [jax.device_get(at(float(time))) for time in np.linspace(0, 1, count)]
    mean, quaternion, scale, opacity = (
        np.stack([leaf[is_visible] for leaf in leaves])
        for leaves in zip(*poses, strict=True)
    )
    return Keyframes(
        mean=mean,
        quaternion=steady(quaternion),
        log_scale=np.clip(
            np.log(np.maximum(np.abs(scale), np.finfo(np.float32).tiny)),
            *splats.LOG_SCALE_RANGE,
        ),
        opacity=opacity,
        color=contributions.color[is_visible],
        left_out=splats.active_count(rows) - int(is_visible.sum()),
    )


def visible(contributions: Contributions) -> np.ndarray:
    """Select the Gaussians that a training camera saw.

    Args:
      contributions: Contribution of each Gaussian to the training views.

    Returns:
      [gaussians] bool.

    Raises:
      ValueError: If no Gaussian is visible from a training camera.
    """
    # NaN compares false and is left out.
    is_visible = contributions.most >= LEAST_SEEN_PX
    if not is_visible.any():
        raise ValueError(
            f"none of the {len(contributions.most)} Gaussians is visible from a "
            "training camera; train for more steps"
        )
    return is_visible


def count_for(capture: Capture) -> int:
    """Choose the number of times to store.

    Args:
      capture: The capture.

    Returns:
      Number of distinct timestamps, from 24 to 48.
    """
    times = len(np.unique(capture.times[capture.train]))
    return int(np.clip(times, LEAST_KEYFRAMES, MOST_KEYFRAMES))


@events.stage("finding visible Gaussians")
def measure_contributions(
    at: At,
    rows: Splats,
    raster_spec: RasterSpec,
    degree: Int[Array, ""],
    capture: Capture,
) -> Contributions:
    """Measure the contribution and mean color of each Gaussian in the training views.

    Every view is evaluated twice, with and without moving Gaussians, to include
    Gaussians that they occlude. With two devices, each evaluates one of the two.

    Args:
      at: Function from time to Gaussians.
      rows: Raw parameters.
      raster_spec: Settings of the rasterizer.
      degree: Degree of the spherical harmonics in use.
      capture: The capture.

    Returns:
      The contributions.
    """
    factor = math.ceil(max(capture.size) / MOST_SIDE_PX)
    size = (max(1, capture.size[0] // factor), max(1, capture.size[1] // factor))
    coefficients = jax.jit(splats.active_harmonics)(rows, degree)
    color_toward = jax.jit(harmonics.color_toward)
    moves = _moves(at, capture)
    most: np.ndarray | float = 0.0
    total, color = 0.0, 0.0
    for row in evaluation.spread(capture.train, MOST_VIEWS):
        view = evaluation.resized(evaluation.view_of(capture, row), capture.size, size)
        gaussians = at(float(view.time))
        variants = [(gaussians, view.camera)]
        if moves.any():
            opacity = np.array(gaussians.opacity)
            opacity[moves] = 0
            static = gaussians._replace(opacity=jax.device_put(opacity))
            variants.append((static, view.camera))
        batch = jax.tree.map(lambda *leaves: np.stack(leaves), *variants)
        weights = list(
            data_parallel.rows_on_devices(_weights, (size, raster_spec), batch)
        )
        most = np.maximum(most, np.max(weights, axis=0) * factor**2)
        weight = np.sum(weights, axis=0)
        colors = color_toward(coefficients, gaussians.mean, view.camera.position)
        total = total + weight
        color = color + weight[:, None] * jax.device_get(colors)
    total_weight = np.maximum(total, np.finfo(np.float32).tiny)
    return Contributions(np.asarray(most), color / total_weight[:, None])


def _weights(how, gaussians: Gaussians, camera: Camera):
    """Sum the compositing weights of each Gaussian over the pixels."""
    size, spec = how
    footprints = projection.project(gaussians, camera, size, spec)
    return raster.summed_weights(footprints, size, spec)


def _moves(at, capture):
    """Return the Gaussians that move, [gaussians] bool."""
    means = np.stack([np.asarray(at(float(t)).mean) for t in np.linspace(0, 1, TIMES)])
    center = capture.cameras.position[capture.train].mean(axis=0)
    distance = np.linalg.norm(means[0] - center, axis=-1)
    return np.linalg.norm(np.ptp(means, axis=0), axis=-1) > MOVES * distance


def steady(quaternion: np.ndarray) -> np.ndarray:
    """Choose signs of quaternions so that consecutive ones are on the same hemisphere.

    q and -q are the same rotation, and a player interpolates linearly between times.

    Args:
      quaternion: Unit quaternions [times, gaussians, 4].

    Returns:
      The same rotations.
    """
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    unit = quaternion / np.maximum(length, np.finfo(np.float32).tiny)
    cosine = np.einsum("tnk,tnk->tn", unit[1:], unit[:-1])
    sign = np.cumprod(np.where(cosine < 0, -1, 1), axis=0)
    return np.concatenate([unit[:1], unit[1:] * sign[..., None]])
