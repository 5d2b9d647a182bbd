"""Linear blend skinning of many Gaussians by few nodes: neighbors, weights, motion.

SC-GS (Huang et al. 2024, arXiv:2312.14937): a Gaussian follows its nearest nodes under
weights that fall with the distance in each node's own radius, by linear blend skinning,
and nodes near each other are asked to move as one rigid body (ARAP, Sorkine and Alexa
2007). The paper's equations were not at hand; its code (yihua7/SC-GS,
`ControlNodeWarp`) is followed. What is not as there is said in `node_motion`.
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

# Rows whose distances to all nodes stand in memory at once: 4 MB with 512 nodes.
SEARCHED_AT_ONCE = 2048


class Moves(NamedTuple):
    """Rigid motions of nodes at one time: x goes to p + R(turn) (x - p) + shift."""

    turn: Float[Array, "nodes 4"]  # unit quaternions, world axes
    shift: Float[Array, "nodes 3"]  # scene units


class Displaced(NamedTuple):
    """Displacement and rotation of Gaussians by their nodes."""

    offset: Float[Array, "gaussians 3"]  # scene units
    turn: Float[Array, "gaussians 4"]  # quaternion, less the identity


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
    so this runs when the number of Gaussians changes and not in every step.

    Args:
      points: The points.
      nodes: The nodes.
      count: Number of nodes per point, or all if there are fewer.

    Returns:
      Indices of the nodes.
    """
    count = min(count, len(nodes))

    def one(point):
        return jax.lax.top_k(-jnp.sum(jnp.square(nodes - point), axis=1), count)[1]

    return jax.lax.map(one, points, batch_size=SEARCHED_AT_ONCE)


def weights(
    distance_sq: Float[Array, "*points near"], log_radius: Float[Array, "*points near"]
) -> Float[Array, "*points near"]:
    """Compute normalized weights exp(-d² / 2r²) of the nearest nodes.

    In SC-GS's code a learned factor of each node multiplies it, and 1e-7 is added. The
    plain quotient is 0/0 in float32 from 13 radii on. This one depends on differences
    only and converges to the node that is nearest in its own radii. About 1e6 times as
    far away as the spacing of the nodes, float32 makes them equally far. A radius
    outside `splats.LOG_SCALE_RANGE` (as a logarithm) is clamped.

    Args:
      distance_sq: Squared distances.
      log_radius: Logarithms of the radii.

    Returns:
      Weights that sum to one.
    """
    held = jnp.clip(log_radius, *splats.LOG_SCALE_RANGE)
    return jax.nn.softmax(-distance_sq * jnp.exp(-2 * held) / 2, axis=-1)


def displaced(
    position: Float[Array, "nodes 3"],
    log_radius: Float[Array, " nodes"],
    moves: Moves,
    near: Int[Array, "gaussians near"],
    mean: Float[Array, "gaussians 3"],
) -> Displaced:
    """Displace and rotate Gaussians by their nearest nodes.

    Means move to the weighted mean of where each node moves them. The rotation is the
    weighted mean of the nodes' quaternions, each with the sign nearer to the one with
    the largest weight, because opposite quaternions are the same rotation. A Gaussian
    none of whose nodes moves stays exactly in place. Rotations of a node also move
    distant Gaussians, as in SC-GS's code with `local_frame`. Otherwise nodes only
    translate.

    Args:
      position: Positions of the nodes.
      log_radius: Logarithms of their radii.
      moves: Motion of the nodes.
      near: Nearest nodes of each Gaussian.
      mean: Canonical means.

    Returns:
      Displacements and rotations.
    """
    # One gather of a node's whole row: 1.4 ms for 10,000 Gaussians with three nodes
    # each, forward and backward. As products with a matrix that is 0 or 1, which
    # scatter nothing: 6 ms with 64 nodes, 78 ms with 512.
    table = jnp.concatenate([position, log_radius[:, None], *moves], axis=1)
    rows = [table[near[:, k]] for k in range(near.shape[1])]
    from_node = [mean - row[:, :3] for row in rows]
    distance_sq = jnp.stack([jnp.sum(d * d, axis=1) for d in from_node], axis=1)
    radius = jnp.stack([row[:, 3] for row in rows], axis=1)
    share = weights(distance_sq, radius)
    offset = sum(
        share[:, k : k + 1] * (_swept(row[:, 4:8], from_node[k]) + row[:, 8:])
        for k, row in enumerate(rows)
    )
    turn = blended([row[:, 4:8] for row in rows], share)
    return Displaced(offset, turn - quaternions.identity(turn.dtype))


def apply(gaussians: Gaussians, by: Displaced) -> Gaussians:
    """Apply displacements and rotations to Gaussians.

    Args:
      gaussians: Canonical Gaussians.
      by: Displacements and rotations.

    Returns:
      Gaussians with normalized rotations.
    """

    def turned(extra, own):
        return quaternions.normalize(own + quaternions.multiply(extra, own))

    return gaussians._replace(
        mean=gaussians.mean + by.offset,
        quaternion=jax.vmap(turned)(by.turn, gaussians.quaternion),
    )


def blended(
    turns: list[Float[Array, "gaussians 4"]], share: Float[Array, "gaussians near"]
) -> Float[Array, "gaussians 4"]:
    """The weighted mean of unit quaternions, on the side of the one with most weight.

    Its length is at least the largest weight, so at least one over their number.
    """
    leader, most = turns[0], share[:, 0]
    for k, turn in enumerate(turns[1:], 1):
        leads = share[:, k] > most
        leader = jnp.where(leads[:, None], turn, leader)
        most = jnp.where(leads, share[:, k], most)

    def alike(turn):
        opposite = jnp.sum(leader * turn, axis=1, keepdims=True) < 0
        return jnp.where(opposite, -turn, turn)

    return sum(share[:, k : k + 1] * alike(turn) for k, turn in enumerate(turns))


def _swept(turn, vector):
    """(R - 1) x for rows of unit quaternions: a small turn keeps all its digits."""
    scalar, axis = turn[:, :1], turn[:, 1:]
    swept = jnp.cross(axis, vector)
    return 2 * (scalar * swept + jnp.cross(axis, swept))


def links(
    paths: Float[Array, "nodes moments 3"],
    log_radius: Float[Array, " nodes"],
    count: int,
) -> Links:
    """The nodes that stay nearest to each over a film, none where there is one node.

    Nearness is the root mean square distance over the moments, as in SC-GS, which takes
    all within a radius: what touches once and then parts is not held together. Weights
    are those of `weights`, in the radius of the node.
    """
    apart = paths[:, None] - paths[None]
    distance_sq = jnp.mean(jnp.sum(apart * apart, axis=3), axis=2)
    itself = jnp.arange(len(paths))
    # Not by the order of distances: a node that coincides with another comes first too.
    others = distance_sq.at[itself, itself].set(jnp.inf)
    near, index = jax.lax.top_k(-others, min(count, len(paths) - 1))
    radius = jnp.broadcast_to(log_radius[:, None], near.shape)
    return Links(index, weights(-near, radius))


def arap_error(
    before: Float[Array, "nodes 3"], after: Float[Array, "nodes 3"], linked: Links
) -> Float[Array, ""]:
    """Measure the deviation of linked nodes from rigid motion.

    It is the mean over the nodes of sum_k w_k |(p_i - p_k) - R_i (q_i - q_k)|², the
    as-rigid-as-possible term of SC-GS (there a sum), with the rotation R_i that
    minimizes it. At a minimum the gradient is that with constant R_i, so no gradient
    passes through the decomposition.

    Args:
      before: Positions of the nodes.
      after: Their positions at another time.
      linked: Linked pairs.

    Returns:
      The error in squared units of the positions.
    """
    edges, turned = (
        places[:, None] - places[linked.neighbor] for places in (before, after)
    )
    spread = exact_einsum("nk,nki,nkj->nij", linked.weight, edges, turned)
    left, _, right = jax.vmap(matrix3.svd)(jax.lax.stop_gradient(spread))
    rotation = exact_einsum("nij,nkj->nik", left, right)
    off = edges - exact_einsum("nij,nkj->nki", rotation, turned)
    total = jnp.sum(linked.weight * jnp.sum(off * off, axis=2))
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
    off = points - points.mean(axis=0)
    chosen = [int(np.argmax(np.sum(off * off, axis=1)))]
    distance_sq = np.full(len(points), np.inf)
    while len(chosen) < count:
        off = points - points[chosen[-1]]
        distance_sq = np.minimum(distance_sq, np.sum(off * off, axis=1))
        following = int(np.argmax(distance_sq))
        if distance_sq[following] == 0:
            break
        chosen.append(following)
    return np.array(chosen)
