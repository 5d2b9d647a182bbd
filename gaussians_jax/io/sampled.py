"""A trained scene at a few times, for players that do not evaluate the model."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.io.instants import At
from gaussians_jax.splatting import harmonics, rendering
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.runtime import data_parallel, events

LEAST_INSTANTS, MOST_INSTANTS = 24, 48
MOST_VIEWS = 48  # training views that say what was seen, and in which color
MOST_SIDE_PX = 320  # of their images: larger ones take longer with the same result
# Pixels' worth of picture, in the view that shows most of it: what shows less is left
# out. Built-in scene, `splats-tracked-small`, 300 steps: this
# leaves out 436 of 10,000, and held-out frames are 56.6 dB from the model's own; 0.3
# leaves out 1,426 (53.4 dB), 1 3,359 (42.5 dB), nothing none (56.8 dB).
LEAST_SEEN_PX = 0.1
# What stands hidden is looked at without what moves: farther than this share of its
# distance, at so many times.
MOVES, TIMES = 0.01, 8


class Instants(NamedTuple):
    """Gaussians at evenly spread times from 0 to 1, without what no camera saw."""

    mean: np.ndarray  # [instants, gaussians, 3], scene units
    quaternion: np.ndarray  # [instants, gaussians, 4] wxyz, unit length, sign steady
    log_scale: np.ndarray  # [instants, gaussians, 3]
    opacity: np.ndarray  # [instants, gaussians]
    color: np.ndarray  # [gaussians, 3] from 0, the same from everywhere
    left_out: int  # Gaussians that no camera saw


class Seen(NamedTuple):
    """Contribution of each Gaussian to the training views."""

    most: np.ndarray  # [gaussians] pixels, in the view that shows most of it
    color: np.ndarray  # [gaussians, 3], mean over the views by how much they show


def gathered(at: At, rows: Splats, seen: Seen, count: int) -> Instants:
    """Evaluate a scene at evenly spaced times, on the host.

    Args:
      at: Function from time to Gaussians.
      rows: Raw parameters, which tell the active Gaussians.
      seen: Contribution of each Gaussian to the training views.
      count: Number of times.

    Returns:
      The Gaussians at these times.
    """
    # NaN compares false: it is left out.
    (kept,) = np.nonzero(seen.most >= LEAST_SEEN_PX)
    if not kept.size:
        raise ValueError(
            f"none of the {len(seen.most)} Gaussians is to be seen from a training "
            "camera; train for more steps"
        )
    poses = [jax.device_get(at(float(time))) for time in np.linspace(0, 1, count)]
    mean, quaternion, scale, opacity = (
        np.stack([leaf[kept] for leaf in each]) for each in zip(*poses, strict=True)
    )
    return Instants(
        mean=mean,
        quaternion=steady(quaternion),
        log_scale=np.clip(
            np.log(np.maximum(np.abs(scale), np.finfo(np.float32).tiny)),
            *splats.LOG_SCALE_RANGE,
        ),
        opacity=opacity,
        color=seen.color[kept],
        left_out=int(splats.active_mask(rows).sum()) - kept.size,
    )


def count_for(capture: Capture) -> int:
    """Choose the number of times to store.

    Args:
      capture: The capture.

    Returns:
      Number of distinct timestamps, from 24 to 48.
    """
    moments = len(np.unique(capture.times[capture.train]))
    return int(np.clip(moments, LEAST_INSTANTS, MOST_INSTANTS))


@events.stage("finding the Gaussians that are seen")
def seen_in_training(
    at: At,
    rows: Splats,
    raster: RasterSpec,
    degree: Int[Array, ""],
    capture: Capture,
) -> Seen:
    """Measure the contribution and the mean color of each Gaussian in the training
    views.

    Every view is evaluated twice, with and without moving Gaussians, to include what
    these occlude. If this process has two devices, each evaluates one of them.

    Args:
      at: Function from time to Gaussians.
      rows: Raw parameters.
      raster: Settings of the rasterizer.
      degree: Degree of the spherical harmonics in use.
      capture: The capture.

    Returns:
      The contributions.
    """
    factor = math.ceil(max(capture.size) / MOST_SIDE_PX)
    size = (max(1, capture.size[0] // factor), max(1, capture.size[1] // factor))
    coefficients = splats.active_harmonics(rows, degree)
    toward = jax.jit(harmonics.color_toward)
    moves = _moves(at, capture)
    most: np.ndarray | float = 0.0
    total, color = 0.0, 0.0
    for row in evaluation.spread(capture.train, MOST_VIEWS):
        view = evaluation.resized(evaluation.view_of(capture, row), capture.size, size)
        deformed = at(float(view.time))
        looks = [(deformed, view.camera)]
        if moves.any():
            opacity = jnp.where(moves, 0, deformed.opacity)
            looks.append((deformed._replace(opacity=opacity), view.camera))
        both = jax.tree.map(lambda *leaves: np.stack(leaves), *looks)
        weights = list(data_parallel.rows_on_devices(_shown, (size, raster), both))
        most = np.maximum(most, np.max(weights, axis=0) * factor**2)
        weight = np.sum(weights, axis=0)
        colors = toward(coefficients, deformed.mean, view.camera.position)
        total = total + weight
        color = color + weight[:, None] * jax.device_get(colors)
    seen = np.maximum(total, np.finfo(np.float32).tiny)
    return Seen(np.asarray(most), color / seen[:, None])


def _shown(how, gaussians: Gaussians, camera: Camera):
    """Sum the compositing weights of each Gaussian over the pixels.

    An image is a weighted sum of colors, so the summed weights of a Gaussian are the
    gradient of the sum of the image with respect to the Gaussian's color.
    """
    size, raster = how

    def total(colors: Float[Array, "gaussians 3"]):
        frame = rendering.render(gaussians, colors, camera, size, raster, depth=False)
        return jnp.sum(frame.rendering.color)

    return jax.grad(total)(jnp.zeros_like(gaussians.mean))[:, 0]


def _moves(at, capture):
    """[gaussians] bool: which are elsewhere at some time."""
    means = np.stack([np.asarray(at(float(t)).mean) for t in np.linspace(0, 1, TIMES)])
    filmed_from = capture.cameras.position[capture.train].mean(axis=0)
    distance = np.linalg.norm(means[0] - filmed_from, axis=-1)
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
    agree = np.einsum("tnk,tnk->tn", unit[1:], unit[:-1])
    sign = np.cumprod(np.where(agree < 0, -1, 1), axis=0)
    return np.concatenate([unit[:1], unit[1:] * sign[..., None]])
