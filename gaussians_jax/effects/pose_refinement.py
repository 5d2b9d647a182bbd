"""Cameras of the frames that are learned from, refined while the scene is.

A screw for each frame, in the camera's own frame, descends with the Gaussians: the pose
refinement of BARF (Lin et al. 2021, arXiv:2104.06405) for splats, as MotionGS has it
beside its flow (Zhu et al. 2024, arXiv:2410.07707, section 4.3; there by turns with the
Gaussians, here together) and gsplat as an option. The mean of all screws is taken off,
or cameras and scene could drift away together. No slope goes through that mean: each
frame's would reach all others, and Adam makes whole steps of the smallest slopes, so
that cameras walk off until they are seen themselves.

What it is worth where cameras are off by a pixel, and where they come from a structure
from motion that left out what moves: `docs/results/ablate_poses.md` and
`ablate_poses_bookshelf.md`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.metadata import SceneMetadata
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry.camera import Camera, move
from nerfies_jax.training import schedules
from nerfies_jax.training.model import in_default_precision

NAME = "poses"

Screws = Float[Array, "frames 6"]  # turn, and shift over the depth of the scene; rad


@dataclasses.dataclass(frozen=True)
class PoseRefinementSpec:
    """How fast the cameras learn, in rad of a turn and of a shift seen at mid depth.

    A frame's own screw learns once in so many steps as there are frames, and Adam's
    step then counts some eight times. Beside a flow (`motion_flow`) it learns in the
    steps of the frame before, too.
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
    """A capture with its cameras as training found them; host side.

    A frame that was not learned from lies between the corrections of those before and
    after it of the same physical camera; what no such camera filmed stays as it is.
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
        """Return the capture with the refined cameras of all frames; host side."""
        return found(params, capture, self.depth)
