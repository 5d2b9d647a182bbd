"""Local isometry: neighboring Gaussians keep their distances as they move.

Luiten et al. 2024, "Dynamic 3D Gaussians", arXiv:2308.09713, the long-term local
isometry of section 3.3: distances at a time are compared with those in the canonical
state. Rigid motions are free, while stretching has a cost.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import Number, SceneMetadata
from gaussians_jax.core.splats import Params
from gaussians_jax.losses import neighbors
from gaussians_jax.losses.acceleration import draw_active
from gaussians_jax.losses.neighbors import Neighbors, NeighborSpec
from nerfies_jax.training.effects import PenaltyContext

FLOOR = 1e-12  # added to squared distances (extent²) to bound the gradient at zero


@dataclasses.dataclass(frozen=True)
class IsometrySpec:
    """Settings of the local isometry loss.

    Attributes:
      weight: Weight of the loss, which is in units of the scene's extent.
      count: Number of neighbors of each Gaussian.
      gamma: Decay of a neighbor's weight with its squared distance, as in
        `NeighborSpec`.
      samples: Number of Gaussians evaluated in each step.
    """

    weight: float = 1.0
    count: int = 8
    gamma: float = 2000.0
    samples: int = 512

    def __post_init__(self):
        if self.samples < 1:
            raise ValueError(f"samples={self.samples} must be at least 1")
        if not 0 <= self.weight < math.inf:
            raise ValueError(f"weight={self.weight} must be finite and not negative")
        self.graph()  # raises for invalid counts

    def graph(self) -> NeighborSpec:
        """Return the settings of the graph of neighbors."""
        return NeighborSpec(count=self.count, gamma=self.gamma)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the regularizer for this capture."""
        return Bound(self, metadata.extent)


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Regularizer` of an `IsometrySpec`."""

    spec: IsometrySpec
    extent: Number  # of the scene, in scene units

    name = "isometry"

    @property
    def weight(self) -> float:
        """Weight of the loss."""
        return self.spec.weight

    def state(self, params: Params) -> Neighbors:
        """Find the neighbors, on the host."""
        return neighbors.find(self.spec.graph(), params, self.extent)

    def loss(self, params: Params, context: PenaltyContext) -> Float[Array, ""]:
        """Compute the mean change of distances at the time of a frame."""
        active = splats.active_mask(params.rows["splats"])
        count = min(self.spec.samples, active.shape[0])
        rows = draw_active(context.key, active, count)
        graph = context.state
        indices = jnp.concatenate([rows[:, None], graph.neighbor[rows]], axis=1)
        sample = splats.take_rows(params, indices.ravel())
        shape = (*indices.shape, 3)
        canonical = sample.rows["splats"].mean.reshape(shape) / self.extent
        assert context.at_time is not None
        mean = context.at_time(sample, context.condition.time).mean
        return change_of_distances(
            canonical, mean.reshape(shape) / self.extent, graph.weight[rows]
        )


def change_of_distances(
    canonical: Float[Array, "samples points 3"],
    deformed: Float[Array, "samples points 3"],
    weight: Float[Array, "samples neighbors"],
) -> Float[Array, ""]:
    """Compute the weighted mean change of distances from a point to its neighbors.

    Args:
      canonical: Positions of each sample (first) and of its neighbors.
      deformed: The same points at another time.
      weight: Weights of the neighbors, in [0, 1].

    Returns:
      Mean of |d' - d| in the unit of the positions, zero if all weights are zero.
    """

    def distances(points):
        difference = points[:, 1:] - points[:, :1]
        return jnp.sqrt(jnp.sum(difference**2, axis=-1) + FLOOR)

    before = jax.lax.stop_gradient(distances(canonical))
    change = jnp.abs(distances(deformed) - before)
    total = jnp.sum(weight)
    return jnp.sum(weight * change) / jnp.where(total > 0, total, 1)
