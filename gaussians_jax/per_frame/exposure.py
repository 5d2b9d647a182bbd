"""Exposure model: an affine color transform for each exposure of the capture.

The image of a frame is `(1 + linear) color + offset` of the rendered color, as in the
exposure compensation of 3D Gaussian splatting (Kerbl et al. 2023, in its code since
2024). The mean over all exposures is subtracted, because the colors of the Gaussians
would be ambiguous otherwise.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.per_frame import id_tables
from gaussians_jax.per_frame.id_tables import Places
from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.training import schedules

NAME = "exposure"
HELD = 1e-6  # ridge per pixel in a fit, in squared color


@dataclasses.dataclass(frozen=True)
class ExposureSpec:
    """Learning rate of the exposure model.

    Each exposure is updated by its own frames only, once in as many steps as there are
    frames, and then by about eight steps of Adam.
    """

    learning_rate: float = 1e-2
    learning_rate_end: float = 1e-3

    def __post_init__(self):
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the appearance model for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.exposures)


def init(key: Key[Array, ""], exposures: int) -> Float[Array, "exposures 3 4"]:
    """Initialize transforms that change nothing, with zero linear part and offset.

    Args:
      key: PRNG key, which is not used.
      exposures: Number of trained appearance ids.

    Returns:
      One transform for each id.
    """
    del key
    return jnp.zeros((exposures, 3, 4), jnp.float32)


def of_id(
    table: Float[Array, "exposures 3 4"], places: Places, appearance: Int[Array, ""]
) -> Float[Array, "3 4"]:
    """Look up the exposure of an appearance id, relative to the mean exposure.

    Args:
      table: Affine color transforms.
      places: Interpolation of untrained exposures.
      appearance: Appearance id.

    Returns:
      The transform.
    """
    flat = table.reshape(len(table), 12)
    return id_tables.deviation(flat, places, appearance).reshape(3, 4)


def apply_exposure(
    image: Float[Array, "*pixels 3"], change: Float[Array, "3 4"]
) -> Float[Array, "*pixels 3"]:
    """Apply an exposure to colors, without clipping.

    Args:
      image: sRGB colors.
      change: Affine transform.

    Returns:
      sRGB colors.
    """
    product = exact_product(image, change[:, :3].T)
    return image + product + change[:, 3]


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
        """Initialize exposures that do not change colors."""
        return init(key, id_tables.rows_of(self.places))

    def apply(
        self,
        params: Float[Array, "exposures 3 4"],
        image: Float[Array, "*pixels 3"],
        appearance: Int[Array, ""],
    ) -> Float[Array, "*pixels 3"]:
        """Return the image as observed under an appearance id."""
        return apply_exposure(image, of_id(params, self.places, appearance))


def fit(
    image: np.ndarray, observed: np.ndarray, valid: np.ndarray | None
) -> np.ndarray:
    """Fit an exposure to an observed image by least squares.

    Args:
      image: Rendered image [height, width, 3], sRGB.
      observed: Observed image of the same shape.
      valid: True for the pixels to fit, [height, width]. None: all.

    Returns:
      The affine transform [3, 4].
    """
    is_valid = np.ones(image.shape[:2], bool) if valid is None else valid
    colors, truth = (
        image[is_valid].astype(np.float64),
        observed[is_valid].astype(np.float64),
    )
    inputs = np.concatenate([colors, np.ones((len(colors), 1))], axis=1)
    # The ridge leaves undetermined directions unchanged, as in an image of one color.
    ridge = HELD * max(len(colors), 1) * np.eye(4)
    squares = inputs.T @ inputs + ridge
    return np.linalg.solve(squares, inputs.T @ (truth - colors)).T
