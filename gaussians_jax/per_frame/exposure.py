"""An affine change of color for each exposure: what light and camera did to a frame.

The picture of a frame is `(1 + linear) color + offset` of what the Gaussians show, as
in the exposure compensation of 3D Gaussian splatting (Kerbl et al. 2023, in its code
since 2024). What counts is by how much an exposure differs from the mean of all, or
Gaussians could be of any color.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core.metadata import SceneMetadata
from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.nn import codes
from nerfies_jax.training import schedules

NAME = "exposure"
# For each appearance id the rows it lies between, and where, as in
# `nerfies_jax.capture.scene_metadata.exposures`.
Places = tuple[tuple[int, int, float], ...]
HELD = 1e-6  # squared error a pixel that a change of one in one number counts for


@dataclasses.dataclass(frozen=True)
class ExposureSpec:
    """Learning rate of the exposure model.

    Each exposure is updated by its own frames only, once in as many steps as there are
    frames, and then by about eight of Adam's steps.
    """

    learning_rate: float = 1e-2
    learning_rate_end: float = 1e-3

    def __post_init__(self):
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the appearance model for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.exposures)


def init(key: Key[Array, ""], exposures: int) -> Float[Array, "exposures 3 4"]:
    """No change: zero linear part and offset."""
    del key
    return jnp.zeros((exposures, 3, 4), jnp.float32)


def of_id(
    table: Float[Array, "exposures 3 4"], places: Places, appearance: Int[Array, ""]
) -> Float[Array, "3 4"]:
    """Look up the exposure of an appearance id; untrained ones are interpolated in
    time.

    The mean of all exposures is the identity, and is treated as constant: a gradient
    through it would reach all other frames, and Adam normalizes even the smallest
    gradients. An unknown id uses the nearest one.

    Args:
      table: Affine color transforms.
      places: Interpolation of untrained exposures.
      appearance: Appearance id.

    Returns:
      The transform.
    """
    left, right, progress = (np.asarray(column) for column in zip(*places, strict=True))
    one = jnp.clip(appearance, 0, len(places) - 1)
    share = jnp.asarray(progress, table.dtype)[one]
    own = table - jax.lax.stop_gradient(jnp.mean(table, axis=0))
    flat = own.reshape(len(table), 12)
    before, after = (jnp.asarray(side, jnp.int32)[one] for side in (left, right))
    return codes.blend(flat, before, after, share).reshape(3, 4)


def changed(
    picture: Float[Array, "*pixels 3"], change: Float[Array, "3 4"]
) -> Float[Array, "*pixels 3"]:
    """Apply an exposure to colors, without clipping.

    Args:
      picture: sRGB colors.
      change: Affine transform.

    Returns:
      sRGB colors.
    """
    mixed = exact_product(picture, change[:, :3].T)
    return picture + mixed + change[:, 3]


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Appearance` of an `ExposureSpec` in a run of `steps`."""

    spec: ExposureSpec
    steps: int
    places: Places

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> Float[Array, ""]:
        """Evaluate the learning rate of the table."""
        first, last = self.spec.learning_rate, self.spec.learning_rate_end
        return schedules.log_linear(first, last, self.steps)(step)

    def init(self, key: Key[Array, ""]) -> Float[Array, "exposures 3 4"]:
        """Initialize exposures that change nothing."""
        count = 1 + max(max(left, right) for left, right, _ in self.places)
        return init(key, count)

    def apply(
        self,
        params: Float[Array, "exposures 3 4"],
        image: Float[Array, "*pixels 3"],
        appearance: Int[Array, ""],
    ) -> Float[Array, "*pixels 3"]:
        """Return the image as observed under an appearance id."""
        return changed(image, of_id(params, self.places, appearance))


def fitted(
    picture: np.ndarray, filmed: np.ndarray, valid: np.ndarray | None
) -> np.ndarray:
    """The change [3, 4] that brings a picture nearest to what was filmed.

    Floats [height, width, 3] in sRGB, least squares over the pixels that are `valid`.
    """
    keep = np.ones(picture.shape[:2], bool) if valid is None else valid
    seen, truth = picture[keep].astype(np.float64), filmed[keep].astype(np.float64)
    inputs = np.concatenate([seen, np.ones((len(seen), 1))], axis=1)
    # Where a picture has one color only, what cannot be told stays as it is.
    held = HELD * max(len(seen), 1) * np.eye(4)
    squares = inputs.T @ inputs + held
    return np.linalg.solve(squares, inputs.T @ (truth - seen)).T
