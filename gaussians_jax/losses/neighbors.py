"""Neighboring Gaussians keep similar embeddings, and therefore move alike.

"Sonata", equation 18, after Luiten et al. 2024, "Dynamic 3D Gaussians",
arXiv:2308.09713. Neighbors are searched on the host after each change of the set of
Gaussians, and are fixed in between.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial
from jaxtyping import Array, Bool, Float, Int

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import Number
from gaussians_jax.core.splats import Params
from nerfies_jax.training.effects import PenaltyContext, Term
from nerfies_jax.training.step_counts import steps

NAME = "neighbors"
SCALES = ("spacing", "extent", "units")
# The unit of length of `scale="spacing"` is this multiple of the median distance to the
# farthest of the 20 neighbors. That distance is 0.020, 0.030 and 0.034 scene units in
# three reconstructions of real rooms and gardens (4k, 139k and 3k points).
SPACING = 0.03
# The equation's epsilon under the square root. It bounds the gradient at zero. Pairs
# closer than 1e-10 count as equal.
FLOOR = 1e-20
LINKED = 1e-3  # pairs with a larger weight are logged as linked


@dataclasses.dataclass(frozen=True)
class NeighborSpec:
    """Number of neighbors, and decay of their weight with distance.

    The weight is exp(-gamma d^2). The equation has the distance unsquared, but the code
    it is based on squares it, and unsquared it would be 0 in float32 beyond d = 0.044.
    `scale` is the unit of d. "units" are scene units, as in that code. "extent" is the
    spread of the cameras, which is unrelated to the spacing of the Gaussians: if the
    cameras hardly move, as in a small preset of a real capture, 43 % of the Gaussians
    have no neighbor with a weight above 1e-3. With "spacing" it is 3 % or less in every
    capture measured, for any unit and density.
    """

    count: int = 20
    gamma: float = 2000.0
    weight: float = 1.0
    scale: str = "spacing"
    start: int = steps(0)  # first step with this loss

    def __post_init__(self):
        if self.count < 1 or self.start < 0:
            raise ValueError(
                "count must be at least 1 and start at least 0, got "
                f"count={self.count} and start={self.start}"
            )
        if not (0 <= self.gamma < math.inf and 0 <= self.weight < math.inf):
            raise ValueError(
                "gamma and weight must be finite and not negative, got "
                f"gamma={self.gamma} and weight={self.weight}"
            )
        if self.scale not in SCALES:
            raise ValueError(f"unknown scale {self.scale!r}; choose from {SCALES}")


class Neighbors(NamedTuple):
    """Graph of neighbors, nearest first, fixed between two changes of the Gaussians.

    Inactive Gaussians, and active ones with fewer neighbors, are their own neighbors
    with weight zero.
    """

    neighbor: Int[Array, "gaussians neighbors"]
    weight: Float[Array, "gaussians neighbors"]  # in [0, 1]


def find(spec: NeighborSpec, params: Params, extent: Number) -> Neighbors:
    """Find the nearest active neighbors of every active Gaussian, on the host.

    On one core it takes 31 ms for 10k Gaussians and 450 ms for 100k.

    Args:
      spec: Settings.
      params: Trained parameters, of which the canonical means are used.
      extent: Scene extent in scene units.

    Returns:
      Neighbors and weights.
    """
    rows = params.rows["splats"]
    means = np.asarray(rows.mean)
    active = np.flatnonzero(np.asarray(splats.active_mask(rows)))
    index = np.repeat(np.arange(len(means))[:, None], spec.count, axis=1)
    weight = np.zeros(index.shape)
    count = min(spec.count, len(active) - 1)
    if count >= 1:
        near, distance = _nearest(means[active].astype(np.float64), count)
        unit = _unit(spec, distance, extent)
        index[active, :count] = active[near]
        weight[active, :count] = np.exp(-spec.gamma * (distance / unit) ** 2)
    return Neighbors(
        jnp.asarray(index, jnp.int32), jnp.asarray(weight, means.dtype.name)
    )


def _nearest(points, count):
    """Return indices and distances [n, count] of the nearest other points."""
    distance, index = scipy.spatial.cKDTree(points).query(points, k=count + 1)
    itself = index == np.arange(len(points))[:, None]
    # If points coincide, the tree may return others first and omit the point itself.
    itself[~itself.any(axis=1), -1] = True
    others = np.argsort(itself, axis=1, kind="stable")[:, :count]
    return (np.take_along_axis(x, others, axis=1) for x in (index, distance))


def _unit(spec, distance, extent):
    if spec.scale == "units":
        return 1.0
    if spec.scale == "extent":
        return extent
    # Clones lie on their parents, so the nearest distance may be zero for most.
    farthest = float(np.median(distance[:, -1]))
    if farthest == 0:
        positive = distance[distance > 0]
        farthest = float(np.median(positive)) if positive.size else SPACING
    return farthest / SPACING


def inconsistency(
    embedding: Float[Array, "gaussians width"],
    neighbors: Neighbors,
    active: Bool[Array, " gaussians"],
) -> Float[Array, ""]:
    """Compute the mean weighted difference of embeddings of neighbors.

    Equation 18 of "Sonata": 1 / (N K) sum sqrt(w |x_i - x_k|^2 + 1e-20) over active i
    and their neighbors k. Its gradient with respect to an embedding has a norm of at
    most a few sqrt(w) / (N K), and is zero where two embeddings are equal.

    Args:
      embedding: Embeddings.
      neighbors: Graph with K neighbors per Gaussian. K counts existing ones only.
      active: True for active Gaussians.

    Returns:
      The mean.
    """
    # float16 rounds 1e-20 to zero, and the gradient at equality would be NaN.
    floor = max(FLOOR, float(jnp.finfo(embedding.dtype).tiny))

    # A scan over the neighbors of all Gaussians. With width 32, 20 neighbors and 10k
    # Gaussians, forward and backward take 11.6 ms and 2.6 MB on one core, compared with
    # 61 ms and 77 MB for one gather of all pairs, whose gradients exceed the cache.
    @functools.partial(jax.remat, prevent_cse=False)
    def one_neighbor(total, pair):
        index, weight = pair
        distance_sq = jnp.sum(jnp.square(embedding - embedding[index]), axis=-1)
        length = jnp.sqrt(weight * distance_sq + floor)
        return total + jnp.sum(jnp.where(active, length, 0)), None

    pairs = neighbors.neighbor.T, neighbors.weight.T.astype(embedding.dtype)
    total, _ = jax.lax.scan(one_neighbor, jnp.zeros((), embedding.dtype), pairs)
    active_count = jnp.sum(active)
    each = jnp.minimum(neighbors.neighbor.shape[1], active_count - 1)
    return total / jnp.maximum(active_count * each, 1).astype(embedding.dtype)


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Regularizer` of a `NeighborSpec` on `params.rows[of]`."""

    spec: NeighborSpec
    extent: Number  # of the scene, in scene units
    of: str

    name = NAME

    def state(self, params: Params) -> Neighbors:
        """Find the neighbors, on the host."""
        if self.of not in params.rows:
            raise ValueError(
                f"the scene has no per-Gaussian parameters {self.of!r} for the "
                f"neighbors loss, only {sorted(params.rows)}; leave the loss out"
            )
        return find(self.spec, params, self.extent)

    def loss(self, params: Params, context: PenaltyContext) -> dict[str, Term]:
        """Compute the difference between the embeddings of neighbors."""
        active = splats.active_mask(params.rows["splats"])
        graph, spec = context.state, self.spec

        def evaluate(embedding):
            return inconsistency(embedding, graph, active)

        value = _from_step(spec.start, context.step, evaluate, params.rows[self.of])
        linked_share = jnp.mean((graph.weight > LINKED).astype(value.dtype), axis=1)
        active_count = jnp.maximum(jnp.sum(active), 1).astype(value.dtype)
        # Inactive Gaussians have no weight and are not counted.
        return {
            "inconsistency": Term(value, spec.weight),
            "linked": Term(jnp.sum(linked_share) / active_count, None),
        }


def _from_step(start, step, evaluate, embedding):
    """Return `evaluate(embedding)`, or zero before step `start`."""
    if start == 0:
        return evaluate(embedding)

    def nothing(embedding):
        return jnp.zeros((), embedding.dtype)

    return jax.lax.cond(step < start, nothing, evaluate, embedding)
