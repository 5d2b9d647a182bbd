"""Sparse control nodes that a network moves as rigid bodies, and that move all
Gaussians.

SC-GS (Huang et al. 2024, CVPR, arXiv:2312.14937, "Sparse-Controlled Gaussian
Splatting"): nodes with a place and a radius of influence, a network that makes a turn
and a shift of each node and the time, and linear blend skinning from the nodes near a
Gaussian (`effects.skinning`). Nodes that stay near each other are asked to move as one
rigid body. The network is asked for the nodes alone, so it costs the same however many
Gaussians there are.

With a mask (`MaskSpec`) it is the motion of EDGS (Kong et al. 2025, AAAI,
arXiv:2502.20378): sparse anchors carry Gaussians by a radial kernel, and a mask that is
learned along says which of them move. The network is asked for those alone, and
Gaussians that only resting anchors carry are passed over. Its anchors also make the
looks of their Gaussians, which here keep their own.

The texts were not at hand. SC-GS is as in its code (yihua7/SC-GS), EDGS, which has
none, as its abstract and the caption of its pipeline say.

What is not as in SC-GS: turns are rotation vectors, where it has quaternions; which
nodes are near is found when rows change and not in every step; the rigid term is a mean
and not a sum, over a fixed number of links and not those within a radius, and compares
any two moments, in the code two within a twentieth of the film; a node's kernel has no
weight of its own, as it has in the code, and starts as wide as neighbors are far, not
as a tenth of the scene; one turn of a node moves and turns what it carries, where the
code has two; and nodes start among the first Gaussians, or from tracks half on what
moves and half on what is at rest, where the paper first trains them as Gaussians of
their own. Their number stays as it is, where the paper adds and prunes nodes. Slopes
reach the places of nodes and of Gaussians through weights, turns and the network, where
the published code cuts them (of a node, through network and weights). Its further
coordinates of nodes and Gaussians, its mask of those that move, its scales that change
and its noise on the times of real captures are not there.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.init import path_fit
from gaussians_jax.init.path_fit import Guess, Paths, Points
from gaussians_jax.motion import skinning
from gaussians_jax.motion.blocks import in_blocks
from gaussians_jax.motion.bound import BoundMotion
from gaussians_jax.motion.skinning import Links, Moves
from nerfies_jax.geometry import quaternion
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import (
    FrameCondition,
    PenaltyContext,
    Term,
    from_step,
)
from nerfies_jax.training.step_counts import steps

NAME = "node_motion"
MOMENTS = 8  # of the film, at which the paths of nodes are compared
STRETCH = 1.2  # of a mask, see `openness`
ROWS_AT_ONCE, NODES_AT_ONCE = 512, 32  # blocks that are passed over where nothing moves


@dataclasses.dataclass(frozen=True)
class MaskSpec:
    """A learned mask that selects moving nodes (EDGS).

    Each node keeps a number of its own, where EDGS has a small network of an anchor's
    feature; its kernel and loss were not at hand. Sizes and weights are our choice.
    """

    # Weight of the mean of the logistic function of the mask; 0 leaves it out.
    sparsity: float = 3e-3
    rate: float = 1e-2  # of the mask's number
    moving: float = 2.0  # where it starts: 96 % open
    still: float = -1.0  # of a node at rest, where tracks tell: 22 % open

    def __post_init__(self):
        for name in ("sparsity", "rate"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name}={getattr(self, name)} is finite and not negative"
                )


@dataclasses.dataclass(frozen=True)
class NodeMotionSpec:
    """Number of nodes, nodes per Gaussian, and the network that moves the nodes.

    Nodes, nearest nodes and the network are the paper's; the number of links and the
    weight of the rigid term, of squared scene extents, are our choice. `moving_share`
    of the nodes lie on what moves where a motion starts from tracks. Rates of places
    and the answers of the network are in scene extents.
    """

    nodes: int = 512
    near: int = 3  # nodes that carry a Gaussian
    position: EncodingSpec = EncodingSpec(10)
    time: EncodingSpec = EncodingSpec(10)
    depth: int = 8
    width: int = 256
    skips: tuple[int, ...] = (5,)  # layers that read the input again
    links: int = 8  # of each node, to nodes that it is to be rigid with
    rigidity: float | None = 0.1  # weight; None leaves it out
    moving_share: float = 0.5
    mask: MaskSpec | None = None  # of the nodes that move; None: all may
    warm_up: int = steps(3000)  # steps without motion
    learning_rate: float = 8e-4  # of the network
    learning_rate_end: float = 1.6e-6
    place_rate: float = 1.6e-4  # both fall as the network's does
    radius_rate: float = 1e-3  # of the logarithm

    def __post_init__(self):
        for name in ("nodes", "near", "links"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        if self.rigidity is not None and not 0 < self.rigidity < math.inf:
            raise ValueError(
                f"rigidity={self.rigidity} is a weight, finite and positive; None "
                "leaves it out"
            )
        if not 0 < self.moving_share <= 1:
            raise ValueError(f"moving_share={self.moving_share} must lie in (0, 1]")
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        for name in ("place_rate", "radius_rate"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name}={getattr(self, name)} is finite and not negative"
                )
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        network_spec(self)  # checks its sizes

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.extent)


class Nodes(NamedTuple):
    """Trained parameters of the nodes, and their network."""

    position: Float[Array, "nodes 3"]  # scene units
    log_radius: Float[Array, " nodes"]  # of the influence, scene units
    network: MLP
    mask: Float[Array, " nodes"] | None  # see `openness`


class Found(NamedTuple):
    """Neighborhoods, which are updated when the number of Gaussians changes."""

    near: Int[Array, "gaussians near"]
    links: Links | None  # None where nothing asks for them
    moving: Bool[Array, " gaussians"] | None  # None: all of them may


def network_spec(spec: NodeMotionSpec) -> MLPSpec:
    """From [encoded place, encoded time] of a node to its turn and shift."""
    heads = (("turn", HeadSpec(3, "small")), ("shift", HeadSpec(3, "small")))
    inputs = spec.position.width(3) + spec.time.width(1)
    return MLPSpec(inputs, spec.depth, spec.width, heads, spec.skips, "relu", "he")


SMALL_NODE_MOTION = NodeMotionSpec(
    nodes=128,
    position=EncodingSpec(5),
    time=EncodingSpec(6),
    depth=4,
    width=96,
    skips=(2,),
)


def init(key: Key[Array, ""], spec: NodeMotionSpec, dtype=jnp.float32) -> Nodes:
    """Nodes that hardly move anything yet, all at the origin until they are placed."""
    return Nodes(
        position=jnp.zeros((spec.nodes, 3), dtype),
        log_radius=jnp.zeros(spec.nodes, dtype),
        network=mlp.init(network_spec(spec), key, dtype),
        mask=None
        if spec.mask is None
        else jnp.full(spec.nodes, spec.mask.moving, dtype),
    )


def openness(mask: Float[Array, " nodes"]) -> Float[Array, " nodes"]:
    """Compute the mask of each node in [0, 1], a stretched logistic function.

    It is exactly zero where the function is below 1/12 (and one above 11/12), without a
    gradient beyond. Such a node is static and nothing is computed for it. The stretch
    is that of Louizos et al. 2018, arXiv:1712.01312, without noise.

    Args:
      mask: Logits.

    Returns:
      The mask.
    """
    return jnp.clip(STRETCH * jax.nn.sigmoid(mask) - (STRETCH - 1) / 2, 0, 1)


def placed(nodes: Nodes, position: Float[np.ndarray, "places 3"]) -> Nodes:
    """Initialize nodes at positions, with the distance to their neighbors as radius.

    Args:
      nodes: Parameters of the nodes.
      position: Positions. Fewer than nodes are repeated, and coincident nodes share
        their influence.

    Returns:
      Parameters of the nodes.
    """
    count, kind = len(nodes.position), nodes.position.dtype
    everywhere = position[np.arange(count) % len(position)]
    radius = splats.neighbor_distance(everywhere, 1.0)
    return nodes._replace(
        position=jnp.asarray(everywhere, kind),
        log_radius=jnp.asarray(np.log(radius), kind),
    )


def moves(
    nodes: Nodes, spec: NodeMotionSpec, extent: float, time: Float[Array, ""]
) -> Moves:
    """Evaluate the motion of the nodes at a time, in units of `extent`."""
    place = jax.vmap(lambda one: encoding.encode(spec.position, one, None))
    moment = encoding.encode(spec.time, time[None], None)
    features = place(nodes.position)
    moment = jnp.broadcast_to(moment, (len(features), len(moment)))
    inputs = jnp.concatenate([features, moment], axis=1)

    def network(inputs):
        return mlp.apply(network_spec(spec), nodes.network, inputs)

    if spec.mask is None:
        made = network(inputs)
        turn, shift = made["turn"], made["shift"]
    else:
        assert nodes.mask is not None
        share = openness(nodes.mask)
        made = in_blocks(network, (inputs,), share > 0, NODES_AT_ONCE)
        turn, shift = (share[:, None] * made[name] for name in ("turn", "shift"))
    return Moves(jax.vmap(quaternion.exp)(turn), extent * shift)


def find(
    nodes: Nodes,
    spec: NodeMotionSpec,
    extent: float,
    mean: Float[Array, "gaussians 3"],
    linked: bool = True,
) -> Found:
    """The nodes near each Gaussian, and where asked for which stay near each other."""
    near = skinning.nearest(mean, nodes.position, spec.near)
    moving = None
    if spec.mask is not None:
        assert nodes.mask is not None
        moving = jnp.any((openness(nodes.mask) > 0)[near], axis=1)
    if spec.rigidity is None or not linked:
        return Found(near, None, moving)
    moments = jnp.linspace(0, 1, MOMENTS, dtype=mean.dtype)
    shifts = jax.vmap(lambda time: moves(nodes, spec, extent, time).shift)(moments)
    paths = jnp.swapaxes(nodes.position + shifts, 0, 1)
    return Found(near, skinning.links(paths, nodes.log_radius, spec.links), moving)


def displaced(
    nodes: Nodes, now: Moves, found: Found, mean: Float[Array, "gaussians 3"]
) -> skinning.Displaced:
    """Evaluate the motion of Gaussians by their nodes, skipping blocks that do not
    move.
    """

    def evaluate(near, mean):
        return skinning.displaced(nodes.position, nodes.log_radius, now, near, mean)

    if found.moving is None:
        return evaluate(found.near, mean)
    return in_blocks(evaluate, (found.near, mean), found.moving, ROWS_AT_ONCE)


def arap_loss(
    nodes: Nodes,
    spec: NodeMotionSpec,
    extent: float,
    linked: Links,
    times: tuple[Float[Array, ""], Float[Array, ""]],
) -> Float[Array, ""]:
    """Measure the deviation of linked nodes from rigid motion, in squared extents."""
    before, after = (
        (nodes.position + moves(nodes, spec, extent, time).shift) / extent
        for time in times
    )
    return skinning.arap_error(before, after, linked)


def fit_to_paths(
    spec: NodeMotionSpec, extent: float, paths: Paths, key: Key[Array, ""]
) -> Guess:
    """Distribute nodes over moving and static points, on the host.

    Paths are moved to the middle of the video by the rigid bodies they belong to. The
    network starts without motion, and is penalized for motion of static nodes.

    Args:
      spec: Settings.
      extent: Scene extent in scene units.
      paths: 3D paths of points.
      key: Random key.

    Returns:
      Initial guess of a fit.
    """
    unit, canonical = paths.unit, path_fit.places_at_one_moment(paths)
    still = np.zeros((0, 3))
    if paths.still is not None:
        still = np.asarray(paths.still, np.float64)
    moving = spec.nodes if not len(still) else round(spec.moving_share * spec.nodes)
    moving_nodes = canonical[skinning.farthest_points(canonical, max(moving, 1))]
    resting = still[skinning.farthest_points(still, spec.nodes - len(moving_nodes))]
    nodes = placed(init(key, spec), np.concatenate([moving_nodes, resting]))
    at_rest = slice(len(moving_nodes), len(moving_nodes) + len(resting))
    if spec.mask is not None:
        assert nodes.mask is not None
        nodes = nodes._replace(mask=nodes.mask.at[at_rest].set(spec.mask.still))

    def penalty(points, times):
        every = points.nets
        those = every._replace(position=every.position[at_rest])
        if every.mask is not None:
            those = those._replace(mask=every.mask[at_rest])

        def moved(time):
            now = moves(those, spec, extent, time)
            return now.turn[:, 1:], now.shift

        return path_fit.rest_loss(moved, unit, times)

    start = Points(jnp.asarray(canonical, jnp.float32), None, nodes)
    mask = None if spec.mask is None else 1.0
    node_rates = Nodes._make((0.0, 1.0, 0.4, mask))
    rates = Points._make((unit, None, node_rates, None))
    return Guess(start, rates, penalty if len(resting) else None)


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `NodeMotionSpec` in a run of `steps`."""

    spec: NodeMotionSpec
    extent: float  # of the scene, the unit of shifts, scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of the nodes and their network."""
        spec = self.spec
        now = self.rate(step)
        share = now / spec.learning_rate
        mask = None if spec.mask is None else spec.mask.rate * share
        place, radius = self.extent * spec.place_rate * share, spec.radius_rate * share
        return MotionParams(shared=Nodes._make((place, radius, now, mask)))

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the network, with nodes distributed over the Gaussians, on the
        host.
        """
        _, shared_key = jax.random.split(key)
        means = np.asarray(gaussians.mean)
        places = means[skinning.farthest_points(means, self.spec.nodes)]
        return MotionParams(shared=placed(init(shared_key, self.spec), places))

    def precompute(self, params: MotionParams, gaussians: Splats) -> Found:
        """Find the nodes near each Gaussian."""
        mean = gaussians.mean
        return find(params.shared, self.spec, self.extent, mean, linked=False)

    @functools.partial(jax.jit, static_argnums=0)
    def refresh(self, params: MotionParams, gaussians: Splats) -> Found:
        """Find nodes near Gaussians and each other, when Gaussians come and go."""
        return find(params.shared, self.spec, self.extent, gaussians.mean)

    def apply(
        self,
        params: MotionParams,
        cache: Found,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at a time."""
        now = moves(params.shared, self.spec, self.extent, frame.time)
        offsets = displaced(params.shared, now, cache, gaussians.mean)
        return skinning.apply(gaussians, offsets)

    def loss(self, params: MotionParams, context: PenaltyContext) -> dict[str, Term]:
        """Compute how little nodes move as rigid bodies, and how many move at all."""
        nodes, spec, time = params.shared, self.spec, context.condition.time
        terms = {}
        if spec.rigidity is not None:
            times = time, jax.random.uniform(context.key, (), time.dtype)
            value = arap_loss(nodes, spec, self.extent, context.state.links, times)
            terms["unrigidity"] = Term(value, spec.rigidity)
        if spec.mask is not None and spec.mask.sparsity > 0:
            used = jnp.mean(jax.nn.sigmoid(nodes.mask))
            terms["moving"] = Term(used, spec.mask.sparsity)
        return from_step(spec.warm_up, context.step, terms)

    def fit(self, paths: Paths, key: Key[Array, ""]) -> Guess:
        """Return nodes spread over moving and static points, to fit from."""
        return fit_to_paths(self.spec, self.extent, paths, key)
