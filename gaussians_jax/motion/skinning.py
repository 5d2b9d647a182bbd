"""Linear blend skinning of many Gaussians by few nodes: neighbors, weights, motion.

SC-GS (Huang et al. 2024, arXiv:2312.14937): a Gaussian follows its nearest nodes by
linear blend skinning, with weights that decay with the distance in units of each node's
radius. A loss asks neighboring nodes to move rigidly (ARAP, Sorkine and Alexa 2007).
The paper's equations were not available, so its code (yihua7/SC-GS, `ControlNodeWarp`)
is followed. `motion.nodes` lists the differences.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Gaussians
from nerfies_jax.geometry import matrix3
from nerfies_jax.geometry import quaternion as quaternions
from nerfies_jax.geometry.precision import exact_einsum

# Gaussians whose distances to all nodes are in memory at once: 4 MB with 512 nodes.
SEARCHED_AT_ONCE = 2048


class Moves(NamedTuple):
    """Rigid motions of nodes at one time: x maps to p + R(turn) (x - p) + shift."""

    turn: Float[Array, "nodes 4"]  # unit quaternions, world axes
    shift: Float[Array, "nodes 3"]  # scene units


class Displacement(NamedTuple):
    """Displacement and rotation of Gaussians by their nodes."""

    offset: Float[Array, "gaussians 3"]  # scene units
    turn: Float[Array, "gaussians 4"]  # quaternion minus the identity


class Links(NamedTuple):
    """Pairs of nodes that should move rigidly, and their weights."""

    neighbor: Int[Array, "nodes links"]
    weight: Float[Array, "nodes links"]  # sums to one over the links of a node


def nearest(
    points: Float[Array, "points coordinates"],
    nodes: Float[Array, "nodes coordinates"],
    count: int,
) -> Int[Array, "points near"]:
    """Find the nodes nearest to each point, nearest first.

    On one core, 10,000 points and three of 64, 128 and 512 nodes take 7, 13 and 44 ms,
    so this runs when the set of Gaussians changes and not in every step.

    Args:
      points: The points.
      nodes: The nodes.
      count: Number of nodes per point, or all if there are fewer.

    Returns:
      Indices of the nodes.
    """
    count = min(count, len(nodes))

    def nearest_nodes(point):
        return jax.lax.top_k(-jnp.sum(jnp.square(nodes - point), axis=1), count)[1]

    return jax.lax.map(nearest_nodes, points, batch_size=SEARCHED_AT_ONCE)


def weights(
    distance_sq: Float[Array, "*points near"], log_radius: Float[Array, "*points near"]
) -> Float[Array, "*points near"]:
    """Compute normalized weights exp(-d² / 2r²) of the nearest nodes.

    SC-GS's code multiplies them by a learned factor of each node and adds 1e-7. The
    plain quotient is 0/0 in float32 beyond 13 radii. This one depends on differences
    only and converges to the node that is nearest in units of its radius. At about 1e6
    times the spacing of the nodes, they are equally far in float32. Radii are clamped
    to `splats.LOG_SCALE_RANGE` (as logarithms).

    Args:
      distance_sq: Squared distances.
      log_radius: Logarithms of the radii.

    Returns:
      Weights that sum to one.
    """
    clamped_log_radius = jnp.clip(log_radius, *splats.LOG_SCALE_RANGE)
    return jax.nn.softmax(-distance_sq * jnp.exp(-2 * clamped_log_radius) / 2, axis=-1)


def displace(
    position: Float[Array, "nodes 3"],
    log_radius: Float[Array, " nodes"],
    moves: Moves,
    near: Int[Array, "gaussians near"],
    mean: Float[Array, "gaussians 3"],
) -> Displacement:
    """Displace and rotate Gaussians by their nearest nodes.

    Means move to the weighted mean of their positions under each node's motion. The
    rotation is the weighted mean of the nodes' quaternions, each with the sign nearer
    to the one with the largest weight, because opposite quaternions are the same
    rotation. A Gaussian without moving nodes stays exactly in place. Rotations of a
    node also move distant Gaussians, as in SC-GS's code with `local_frame`. Otherwise
    nodes only translate.

    Args:
      position: Positions of the nodes.
      log_radius: Logarithms of their radii.
      moves: Motion of the nodes.
      near: Nearest nodes of each Gaussian.
      mean: Canonical means.

    Returns:
      Displacements and rotations.
    """
    # One gather of all values of a node takes 1.4 ms for 10,000 Gaussians with three
    # nodes each, forward and backward. Products with one-hot matrices, which need no
    # scatter, take 6 ms with 64 nodes and 78 ms with 512.
    table = jnp.concatenate([position, log_radius[:, None], *moves], axis=1)
    rows = [table[near[:, k]] for k in range(near.shape[1])]
    from_node = [mean - row[:, :3] for row in rows]
    distance_sq = jnp.stack([jnp.sum(d * d, axis=1) for d in from_node], axis=1)
    radius = jnp.stack([row[:, 3] for row in rows], axis=1)
    weight = weights(distance_sq, radius)
    offset = sum(
        weight[:, k : k + 1]
        * (_rotation_offset(row[:, 4:8], from_node[k]) + row[:, 8:])
        for k, row in enumerate(rows)
    )
    turn = blend([row[:, 4:8] for row in rows], weight)
    return Displacement(offset, turn - quaternions.identity(turn.dtype))


def apply(gaussians: Gaussians, by: Displacement) -> Gaussians:
    """Apply displacements and rotations to Gaussians.

    Args:
      gaussians: Canonical Gaussians.
      by: Displacements and rotations.

    Returns:
      Gaussians with normalized rotations.
    """

    def rotate(extra, orientation):
        return quaternions.normalize(
            orientation + quaternions.multiply(extra, orientation)
        )

    return gaussians._replace(
        mean=gaussians.mean + by.offset,
        quaternion=jax.vmap(rotate)(by.turn, gaussians.quaternion),
    )


def blend(
    turns: list[Float[Array, "gaussians 4"]], weight: Float[Array, "gaussians near"]
) -> Float[Array, "gaussians 4"]:
    """Average unit quaternions, with signs nearer to the one with the largest weight.

    Args:
      turns: Quaternions of each node.
      weight: Their weights, which sum to one.

    Returns:
      Quaternions whose length is at least the largest weight.
    """
    leader, largest = turns[0], weight[:, 0]
    for k, turn in enumerate(turns[1:], 1):
        exceeds = weight[:, k] > largest
        leader = jnp.where(exceeds[:, None], turn, leader)
        largest = jnp.where(exceeds, weight[:, k], largest)

    def align(turn):
        opposite = jnp.sum(leader * turn, axis=1, keepdims=True) < 0
        return jnp.where(opposite, -turn, turn)

    return sum(weight[:, k : k + 1] * align(turn) for k, turn in enumerate(turns))


def _rotation_offset(turn, vector):
    """Compute (R - 1) x for unit quaternions, accurately for small rotations."""
    scalar, axis = turn[:, :1], turn[:, 1:]
    cross = jnp.cross(axis, vector)
    return 2 * (scalar * cross + jnp.cross(axis, cross))


def links(
    paths: Float[Array, "nodes times 3"],
    log_radius: Float[Array, " nodes"],
    count: int,
) -> Links:
    """Find the nodes that stay nearest to each node over a video.

    The distance is the root mean square over time, as in SC-GS, which takes all nodes
    within a radius. Nodes that touch once and then separate are not linked.

    Args:
      paths: Positions of the nodes over time.
      log_radius: Logarithms of their radii.
      count: Number of links per node, or all other nodes if there are fewer.

    Returns:
      Links, with weights by the radius of the node.
    """
    difference = paths[:, None] - paths[None]
    distance_sq = jnp.mean(jnp.sum(difference * difference, axis=3), axis=2)
    itself = jnp.arange(len(paths))
    # By index, because a coincident node may come before the node itself.
    others = distance_sq.at[itself, itself].set(jnp.inf)
    near, index = jax.lax.top_k(-others, min(count, len(paths) - 1))
    radius = jnp.broadcast_to(log_radius[:, None], near.shape)
    return Links(index, weights(-near, radius))


def arap_error(
    before: Float[Array, "nodes 3"], after: Float[Array, "nodes 3"], linked: Links
) -> Float[Array, ""]:
    """Measure the deviation of linked nodes from rigid motion.

    It is the mean over the nodes of sum_k w_k |(p_i - p_k) - R_i (q_i - q_k)|², the
    as-rigid-as-possible loss of SC-GS (there a sum), with the rotation R_i that
    minimizes it. At a minimum the gradient is the one with constant R_i, so no gradient
    passes through the decomposition.

    Args:
      before: Positions of the nodes.
      after: Their positions at another time.
      linked: Linked pairs.

    Returns:
      The error in squared units of the positions.
    """
    edges, edges_after = (
        positions[:, None] - positions[linked.neighbor] for positions in (before, after)
    )
    spread = exact_einsum("nk,nki,nkj->nij", linked.weight, edges, edges_after)
    left, _, right = jax.vmap(matrix3.svd)(jax.lax.stop_gradient(spread))
    rotation = exact_einsum("nij,nkj->nik", left, right)
    residual = edges - exact_einsum("nij,nkj->nki", rotation, edges_after)
    total = jnp.sum(linked.weight * jnp.sum(residual * residual, axis=2))
    return total / len(before)


def farthest_points(
    points: Float[np.ndarray, "points coordinates"], count: int
) -> Int[np.ndarray, " chosen"]:
    """Sample points by farthest-point sampling, on the host.

    It starts from the point farthest from the center. 128 of 9000 points take 20 ms.

    Args:
      points: The points.
      count: Number of samples, limited to the number of distinct points.

    Returns:
      Indices of the samples.
    """
    points = np.asarray(points, np.float64)
    if not len(points) or count < 1:
        return np.zeros(0, int)
    offset = points - points.mean(axis=0)
    selection = [int(np.argmax(np.sum(offset * offset, axis=1)))]
    distance_sq = np.full(len(points), np.inf)
    while len(selection) < count:
        offset = points - points[selection[-1]]
        distance_sq = np.minimum(distance_sq, np.sum(offset * offset, axis=1))
        farthest = int(np.argmax(distance_sq))
        if distance_sq[farthest] == 0:
            break
        selection.append(farthest)
    return np.array(selection)
