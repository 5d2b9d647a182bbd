"""Refinement of the training cameras during training.

One screw per frame, in the camera's frame, is optimized with the Gaussians. This is the
pose refinement of BARF (Lin et al. 2021, arXiv:2104.06405) for splats, which MotionGS
uses with its flow (Zhu et al. 2024, arXiv:2410.07707, section 4.3, there alternating
with the Gaussians) and gsplat as an option. The mean of all screws is subtracted, or
cameras and scene could drift together. No gradient passes through that mean: each
frame's would reach all others, and Adam normalizes even the smallest gradients, so that
cameras would drift before their frame is first used.

The gain for cameras that are wrong by a pixel, and for cameras from structure from
motion with masked objects, is in `docs/results/ablate_poses.md` and
`ablate_poses_bookshelf.md`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core.metadata import SceneMetadata
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry.camera import Camera, move
from nerfies_jax.training import schedules
from nerfies_jax.training.model import in_default_precision

NAME = "poses"

Screws = Float[Array, "frames 6"]  # turn, and shift over the depth of the scene; rad


@dataclasses.dataclass(frozen=True)
class PoseRefinementSpec:
    """Learning rate of the cameras, in rad of a rotation and of a translation at mid
    depth.

    A frame's screw is updated once in as many steps as there are frames, and then by
    about eight of Adam's steps. With a flow loss (`motion_flow`) it is also updated in
    the steps of the previous frame.
    """

    learning_rate: float = 1e-4
    learning_rate_end: float = 1e-5

    def __post_init__(self):
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the camera optimizer for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.frames, metadata.depth)


def refined(screws: Screws, cameras: Camera, depth: float) -> Camera:
    """Cameras, one for each screw, moved by what it differs from the mean of all.

    `depth`, in scene units, is where a shift of one radian moves the picture as far as
    such a turn. Equal screws leave every camera as it is. The mean counts as constant:
    a camera's slope reaches its own screw alone.
    """
    own = screws - jax.lax.stop_gradient(jnp.mean(screws, axis=0))
    return _moved(own, cameras, depth)


def _moved(screws, cameras, depth):
    return jax.vmap(lambda camera, screw: move(camera, screw[:3], depth * screw[3:]))(
        cameras, screws
    )


def found(screws: Screws, capture: Capture, depth: float) -> Capture:
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
    own = np.asarray(screws)
    own = own - own.mean(axis=0)
    moves = np.zeros((len(capture.times), 6), own.dtype)
    cameras_of, times = capture.camera_ids[capture.train], capture.times[capture.train]
    for one in np.unique(cameras_of):
        learned = np.flatnonzero(cameras_of == one)
        learned = learned[np.argsort(times[learned], kind="stable")]
        rows = np.flatnonzero(capture.camera_ids == one)
        for axis in range(6):
            moves[rows, axis] = np.interp(
                capture.times[rows], times[learned], own[learned, axis]
            )
    moves[capture.train] = own
    given = in_default_precision((moves, capture.cameras))
    moved = jax.jit(_moved, static_argnums=2)(*given, depth)
    cameras = jax.tree.map(lambda new: np.asarray(new, np.float32), moved)
    return dataclasses.replace(capture, cameras=cameras)


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `CameraOptimizer` of a `PoseRefinementSpec` in a run of `steps`."""

    spec: PoseRefinementSpec
    steps: int
    frames: int  # that the scene is trained on
    depth: float  # z-depth halfway into the scene, scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> Float[Array, ""]:
        """Evaluate the learning rate of the screws."""
        first, last = self.spec.learning_rate, self.spec.learning_rate_end
        return schedules.log_linear(first, last, self.steps)(step)

    def init(self, key: Key[Array, ""]) -> Screws:
        """Initialize screws that leave every camera as it is."""
        return jnp.zeros((self.frames, 6), jnp.float32)

    def apply(self, params: Screws, cameras: Camera) -> Camera:
        """Return the refined cameras of the training frames."""
        return refined(params, cameras, self.depth)

    def apply_to_capture(self, params: Screws, capture: Capture) -> Capture:
        """Return the capture with the refined cameras of all frames, on the host."""
        return found(params, capture, self.depth)
