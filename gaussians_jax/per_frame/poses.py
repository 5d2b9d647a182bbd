"""Refinement of the training cameras during training.

One screw per frame, in the camera's frame, is optimized with the Gaussians. This is the
pose refinement of BARF (Lin et al. 2021, arXiv:2104.06405) for splats, which MotionGS
uses with its flow (Zhu et al. 2024, arXiv:2410.07707, section 4.3, there alternating
with the Gaussians) and gsplat as an option. The mean of all screws is subtracted,
because cameras and scene could drift together. No gradient passes through that mean:
the gradient of one frame would reach all others, and Adam normalizes even the smallest
gradients, so cameras would drift before their frame is first used.

The gain for cameras with an error of one pixel, and for cameras from structure from
motion with masked objects, is in `docs/results/ablate_poses.md` and
`ablate_poses_bookshelf.md`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core.metadata import Number, SceneMetadata
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry.camera import Camera, move
from nerfies_jax.training import schedules
from nerfies_jax.training.model import in_default_precision

NAME = "poses"

Screws = Float[Array, "frames 6"]  # rotation (rad), translation over mid depth (rad)


@dataclasses.dataclass(frozen=True)
class PoseRefinementSpec:
    """Learning rates of the cameras, for rotations and translations at mid depth (rad).

    The screw of a frame is updated once in as many steps as there are frames, and then
    by about eight steps of Adam. With a flow loss (`losses.flow`) it is also updated in
    the steps of the previous frame.
    """

    learning_rate: float = 1e-4
    learning_rate_end: float = 1e-5

    def __post_init__(self):
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the camera optimizer for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.frames, metadata.depth)


def refine(screws: Screws, cameras: Camera, depth: Number) -> Camera:
    """Move cameras by the deviation of their screws from the mean.

    Equal screws do not change any camera. The mean is treated as constant, so the
    gradient of a camera reaches its own screw only.

    Args:
      screws: Corrections, one per camera.
      cameras: The cameras.
      depth: Mid depth in scene units, at which a translation of one radian moves the
        image as far as a rotation of one radian.

    Returns:
      The refined cameras.
    """
    deviation = screws - jax.lax.stop_gradient(jnp.mean(screws, axis=0))
    return _move(deviation, cameras, depth)


def _move(screws, cameras, depth):
    return jax.vmap(lambda camera, screw: move(camera, screw[:3], depth * screw[3:]))(
        cameras, screws
    )


def refine_capture(screws: Screws, capture: Capture, depth: float) -> Capture:
    """Return a capture with refined cameras, on the host.

    The correction of a held-out frame is interpolated between the previous and next
    training frame of the same physical camera. Frames of other cameras are unchanged.

    Args:
      screws: Corrections.
      capture: The capture.
      depth: Mid depth in scene units.

    Returns:
      The capture.
    """
    deviation = np.asarray(screws)
    deviation = deviation - deviation.mean(axis=0)
    moves = np.zeros((len(capture.times), 6), deviation.dtype)
    cameras_of, times = capture.camera_ids[capture.train], capture.times[capture.train]
    for camera_id in np.unique(cameras_of):
        train_rows = np.flatnonzero(cameras_of == camera_id)
        train_rows = train_rows[np.argsort(times[train_rows], kind="stable")]
        rows = np.flatnonzero(capture.camera_ids == camera_id)
        for axis in range(6):
            moves[rows, axis] = np.interp(
                capture.times[rows], times[train_rows], deviation[train_rows, axis]
            )
    moves[capture.train] = deviation
    inputs = in_default_precision((moves, capture.cameras))
    refined_cameras = jax.jit(_move, static_argnums=2)(*inputs, depth)
    cameras = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), refined_cameras)
    return dataclasses.replace(capture, cameras=cameras)


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `CameraOptimizer` of a `PoseRefinementSpec` in a run of `steps`."""

    spec: PoseRefinementSpec
    steps: int
    frames: int  # number of training frames
    depth: Number  # z-depth in the middle of the scene, scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> Float[Array, ""]:
        """Evaluate the learning rate of the screws."""
        first, last = self.spec.learning_rate, self.spec.learning_rate_end
        return schedules.log_linear(first, last, self.steps)(step)

    def init(self, key: Key[Array, ""]) -> Screws:
        """Initialize screws that do not change any camera."""
        return jnp.zeros((self.frames, 6), jnp.float32)

    def apply(self, params: Screws, cameras: Camera) -> Camera:
        """Return the refined cameras of the training frames."""
        return refine(params, cameras, self.depth)

    def apply_to_capture(self, params: Screws, capture: Capture) -> Capture:
        """Return the capture with the refined cameras of all frames, on the host."""
        return refine_capture(params, capture, float(self.depth))
