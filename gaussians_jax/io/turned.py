"""Raw parameters in turned axes."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gaussians_jax.core.splats import Splats
from gaussians_jax.splatting import harmonics

DIRECTIONS = 64  # for the 15 harmonics of degrees 1 to 3


def turned(rows: Splats, rotation: np.ndarray) -> Splats:
    """Rotate Gaussians about the origin, on the host.

    Harmonics are rotated with them, so that a camera that is rotated in the same way
    sees the same image.

    Args:
      rows: Raw parameters.
      rotation: Rotation matrix [3, 3].

    Returns:
      Raw parameters in the new axes.
    """
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    mean = np.asarray(rows.mean, np.float64) @ rotation.T
    quaternion = np.asarray(rows.quaternion, np.float64) @ left.T
    rest = rows.sh_rest
    if rest.shape[1]:
        matrix = _harmonics_matrix(rotation, harmonics.degree_of(rest.shape[1] + 1))
        rest = np.einsum("ij,njc->nic", matrix, np.asarray(rest, np.float64))
    dtype = rows.mean.dtype
    return rows._replace(
        mean=jnp.asarray(mean, dtype),
        quaternion=jnp.asarray(quaternion, dtype),
        sh_rest=jnp.asarray(rest, dtype),
    )


def _harmonics_matrix(rotation: np.ndarray, degree: int) -> np.ndarray:
    """Return the matrix that rotates the coefficients of degrees 1 and higher.

    It is fitted at more directions than there are coefficients. The harmonics of a
    degree are closed under rotation, so the fit is exact.
    """
    # A Fibonacci lattice, evenly spread over the sphere.
    z = 1 - (2 * np.arange(DIRECTIONS) + 1) / DIRECTIONS
    angle = np.arange(DIRECTIONS) * np.pi * (3 - 5**0.5)
    radius = np.sqrt(1 - z**2)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)

    def values(where):
        terms = harmonics.basis(jnp.asarray(where, jnp.float32), degree)
        return np.stack(terms, axis=-1).astype(np.float64)[:, 1:]

    # A rotated function has at v the value that it had at the inverse rotation of v.
    return np.linalg.lstsq(values(directions), values(directions @ rotation))[0]
