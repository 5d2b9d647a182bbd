"""Camera refinement for held-out frames, with the scene frozen.

An inaccurate camera reduces the PSNR of a good model by several dB. The camera is
fitted to the colors of the frame by the gradient of the squared error with respect to a
twist in the camera frame.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from nerfies_jax.capture.capture import Capture, blocks, shrink
from nerfies_jax.evaluation.frames import resized, view_of
from nerfies_jax.evaluation.scores import Draw, Scored, score
from nerfies_jax.geometry.camera import Camera, move
from nerfies_jax.training import fit, losses
from nerfies_jax.training.model import Model, TrainState, View, in_default_precision

LEVELS = 255.0  # of an 8-bit image, the unit of the error


@dataclasses.dataclass(frozen=True)
class CameraFitSpec:
    """Settings of the camera refinement, and its convergence criterion.

    The unknowns are a rotation and a translation in pixels by which they move an image
    at `depth`, so that one step size suits all. A fit has converged if the gradient of
    the mean squared error, in gray levels of 255, is at most `tolerance` per pixel. For
    images with gradients of two levels per pixel, this is 0.001 pixel from the minimum.
    """

    max_steps: int = 100  # of L-BFGS
    tolerance: float = 0.01  # squared gray levels per pixel
    # Larger images are downsampled by a whole factor. A radiance field would take
    # minutes for each of them.
    most_pixels: int = 5000

    def __post_init__(self):
        fit.check_positive(
            max_steps=self.max_steps,
            tolerance=self.tolerance,
            most_pixels=self.most_pixels,
        )


class FittedCameras(NamedTuple):
    """Fitted cameras, and the metrics of the frames with these cameras."""

    cameras: Camera  # NumPy leaves, leading axis frames
    converged: np.ndarray  # [frames] bool
    scored: Scored  # with these cameras


def photometric_loss(
    model: Model,
    state: TrainState,
    view: View,
    image: UInt8[Array, "height width 3"],
    valid: Bool[Array, "height width"] | None,
    depth: Float[Array, ""],
) -> Callable[[Float[Array, "6"]], Float[Array, ""]]:
    """Return the loss of a camera: the mean squared error of a frame in gray levels.

    Args:
      model: The model.
      state: Trained state.
      view: View of the frame with its initial camera.
      image: The frame, [height, width, 3].
      valid: True for observed pixels, [height, width], or None for all.
      depth: z-depth in scene units at which twists are measured in pixels.

    Returns:
      A function from a twist (rotation, translation) in pixels, [6], to the loss.
    """
    size = image.shape[1], image.shape[0]
    truth = image.astype(view.camera.position.dtype) / LEVELS
    render = _camera_renderer(model, state, view, size)

    def loss(twist_px):
        color = render(_move_camera(view.camera, twist_px, depth))
        return LEVELS**2 * losses.mse(color, truth, valid)

    return loss


def fit_cameras(
    model: Model,
    draw: Draw,
    state: TrainState,
    capture: Capture,
    rows: np.ndarray,
    spec: CameraFitSpec = CameraFitSpec(),
    observed: Capture | None = None,
) -> FittedCameras:
    """Refine the cameras of some frames, and evaluate these frames with them.

    Args:
      model: The model.
      draw: Renderer of `observed`.
      state: Trained state.
      capture: The capture, undistorted if the model renders pinhole cameras.
      rows: Indices of the frames.
      spec: Settings.
      observed: The original, distorted capture, which metrics are computed on. None for
        `capture` itself.

    Returns:
      The cameras, convergence flags and metrics.
    """
    factor = 1
    while capture.images[0, ::factor, ::factor].size > 3 * spec.most_pixels:
        factor += 1
    width, height = capture.size
    size = width // factor, height // factor
    # The smaller image does not contain the remaining pixels at the right and bottom.
    crop_size = size[0] * factor, size[1] * factor

    @jax.jit
    def fit_camera(params, step, view, image, valid, depth):
        at_step = state._replace(params=params, step=step)
        loss = photometric_loss(model, at_step, view, image, valid, depth)
        start = jnp.zeros(6, view.camera.position.dtype)
        solution = fit.fit_code(
            loss, start, max_steps=spec.max_steps, tolerance=spec.tolerance
        )
        camera = _move_camera(view.camera, solution.value, depth)
        # Rounding errors keep the gradient of a real image from being exactly zero, so
        # an image that does not depend on the camera never converges.
        return camera, solution.converged & (solution.residual > 0)

    depth = in_default_precision(np.float32(2 / (1 / capture.near + 1 / capture.far)))
    cameras, convergence = [], []
    for row in rows:
        view = view_of(capture, int(row))
        valid = None
        if capture.valid is not None:
            valid = jnp.asarray(blocks(capture.valid[row], factor).all((-3, -1)))
        camera, converged = fit_camera(
            state.params,
            state.step,
            resized(view, crop_size, size),
            jnp.asarray(shrink(capture.images[row], factor)),
            valid,
            depth,
        )
        cameras.append(
            view.camera._replace(
                camera_from_world=camera.camera_from_world, position=camera.position
            )
        )
        convergence.append(bool(converged))
    batch = jax.tree.map(
        lambda *leaves: np.stack([np.asarray(x, np.float32) for x in leaves]), *cameras
    )
    scores = score(draw, state, _with_poses(observed or capture, rows, batch), rows)
    return FittedCameras(batch, np.asarray(convergence), scores)


def _camera_renderer(model, state, view, size):
    """Return a function from a camera to colors. The deformation is computed once."""
    if model.stages is None:
        return lambda camera: (
            model.render(
                state.params, view._replace(camera=camera), size, state.step
            ).color
        )
    stages, params = model.stages, state.params
    deformation = stages.deform(params, stages.prepare(params), view.time)
    return lambda camera: (
        stages.draw(
            params, deformation, view._replace(camera=camera), size, state.step
        ).color
    )


def _move_camera(camera, twist_px, depth):
    angle = twist_px / camera.focal_px
    return move(camera, angle[:3], depth * angle[3:])


def _with_poses(capture, rows, cameras):
    poses = {}
    for name in ("camera_from_world", "position"):
        poses[name] = np.array(getattr(capture.cameras, name))
        poses[name][rows] = getattr(cameras, name)
    return dataclasses.replace(capture, cameras=capture.cameras._replace(**poses))
