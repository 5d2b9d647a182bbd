"""Sparse control nodes: a network moves them, and they move all Gaussians.

SC-GS (Huang et al. 2024, CVPR, arXiv:2312.14937, "Sparse-Controlled Gaussian
Splatting"): nodes with a position and a radius of influence, a network that maps each
node and the time to a rotation and a translation, and linear blend skinning from the
nodes near a Gaussian (`motion.skinning`). A loss asks nodes that stay near each other
to move rigidly. The network is evaluated for the nodes only, so its cost does not
depend on the number of Gaussians.

With a mask (`MaskSpec`) this is the motion of EDGS (Kong et al. 2025, AAAI,
arXiv:2502.20378): sparse anchors move Gaussians by a radial kernel, and a learned mask
selects the moving anchors. The network is evaluated for those only, and Gaussians whose
anchors are all static are skipped. Its anchors also produce the colors of their
Gaussians. Here Gaussians have their own.

The papers were not available. SC-GS follows its code (yihua7/SC-GS), and EDGS, which
has no public code, its abstract and the caption of its pipeline.

Differences from SC-GS:

- Rotations are rotation vectors instead of quaternions.
- Neighborhoods are updated when the set of Gaussians changes, not in every step.
- The rigidity loss is a mean over a fixed number of links, not a sum over those within
  a radius, and compares any two times, in the code two within a twentieth of the video.
- Kernels have no weight of their own, as they have in the code. Their radius is
  initialized to the distance of the neighbors, not to a tenth of the scene.
- One rotation of a node moves and rotates its Gaussians, where the code has two.
- Nodes are initialized at Gaussians, or from tracks at moving and static points, half
  each, where the paper first trains them as Gaussians. Their number is constant, where
  the paper adds and prunes nodes.
- Gradients reach the positions of nodes and Gaussians through weights, rotations and
  the network, where the published code stops them (of a node, through network and
  weights).
- Missing are its hyper coordinates of nodes and Gaussians, its mask of moving
  Gaussians, its changing scales and its noise on the times of real captures.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import Number, SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.init import motion_fit
from gaussians_jax.init.motion_fit import Guess, Paths, Points
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
TIMES = 8  # frame times at which the paths of nodes are compared
STRETCH = 1.2  # of a mask, see `openness`
ROWS_AT_ONCE, NODES_AT_ONCE = 512, 32  # blocks that are skipped if nothing moves


@dataclasses.dataclass(frozen=True)
class MaskSpec:
    """A learned mask that selects moving nodes (EDGS).

    Each node has a logit, where EDGS has a small network of an anchor's feature. Its
    kernel and loss were not available. Sizes and weights are our choice.
    """

    # Weight of the mean of the logistic function of the logits. 0 disables it.
    sparsity: float = 3e-3
    rate: float = 1e-2  # learning rate of the logits
    moving: float = 2.0  # initial logit, 96 % open
    still: float = -1.0  # initial logit of nodes that are static by tracks, 22 % open

    def __post_init__(self):
        for name in ("sparsity", "rate"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name}={getattr(self, name)} must be finite and not negative"
                )


@dataclasses.dataclass(frozen=True)
class NodeMotionSpec:
    """Number of nodes, nodes per Gaussian, and the network that moves the nodes.

    The number of nodes, of nearest nodes and the network are the paper's. The number of
    links and the weight of the rigidity loss (of squared scene extents) are our choice.
    With an initialization from tracks, `moving_share` of the nodes lie on moving
    points. Rates of positions and the outputs of the network are in scene extents.
    """

    nodes: int = 512
    near: int = 3  # nodes that move a Gaussian
    position: EncodingSpec = EncodingSpec(10)
    time: EncodingSpec = EncodingSpec(10)
    depth: int = 8
    width: int = 256
    skips: tuple[int, ...] = (5,)  # layers that read the input again
    links: int = 8  # neighbors of each node in the rigidity loss
    rigidity: float | None = 0.1  # weight of the rigidity loss; None disables it
    moving_share: float = 0.5
    mask: MaskSpec | None = None  # selects moving nodes; None: all may move
    warm_up: int = steps(3000)  # steps without motion
    learning_rate: float = 8e-4  # of the network
    learning_rate_end: float = 1.6e-6
    place_rate: float = 1.6e-4  # both decay like that of the network
    radius_rate: float = 1e-3  # of the logarithm

    def __post_init__(self):
        for name in ("nodes", "near", "links"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        if self.rigidity is not None and not 0 < self.rigidity < math.inf:
            raise ValueError(
                f"rigidity={self.rigidity} must be finite and positive; None disables "
                "it"
            )
        if not 0 < self.moving_share <= 1:
            raise ValueError(f"moving_share={self.moving_share} must lie in (0, 1]")
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        for name in ("place_rate", "radius_rate"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name}={getattr(self, name)} must be finite and not negative"
                )
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        network_spec(self)  # validates the sizes

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.extent)


class Nodes(NamedTuple):
    """Trained parameters of the nodes, and their network."""

    position: Float[Array, "nodes 3"]  # scene units
    log_radius: Float[Array, " nodes"]  # of the influence, scene units
    network: MLP
    mask: Float[Array, " nodes"] | None  # see `openness`


class Neighborhoods(NamedTuple):
    """Neighborhoods, which are updated when the set of Gaussians changes."""

    near: Int[Array, "gaussians near"]
    links: Links | None  # None without a rigidity loss
    moving: Bool[Array, " gaussians"] | None  # None: all may move


def network_spec(spec: NodeMotionSpec) -> MLPSpec:
    """Settings of the network from [encoded position, encoded time] to rigid motions.

    Args:
      spec: Settings of the motion.

    Returns:
      Settings of the network.
    """
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


def init(
    key: Key[Array, ""], spec: NodeMotionSpec, dtype: DTypeLike = jnp.float32
) -> Nodes:
    """Initialize nodes at the origin that hardly move anything (`_place_nodes`).

    Args:
      key: PRNG key.
      spec: Settings of the motion.
      dtype: Type of the parameters.

    Returns:
      The nodes.
    """
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

    The mask is exactly zero where the function is below 1/12, and one above 11/12,
    without a gradient there. A node with a zero mask is static and is not evaluated.
    The stretch is that of Louizos et al. 2018, arXiv:1712.01312, without noise.

    Args:
      mask: Logits.

    Returns:
      The mask.
    """
    return jnp.clip(STRETCH * jax.nn.sigmoid(mask) - (STRETCH - 1) / 2, 0, 1)


def _place_nodes(nodes: Nodes, position: Float[np.ndarray, "places 3"]) -> Nodes:
    """Initialize nodes at positions, with the distance to their neighbors as radius.

    Positions are repeated if there are fewer than nodes.
    """
    count, dtype = len(nodes.position), nodes.position.dtype
    positions = position[np.arange(count) % len(position)]
    radius = splats.neighbor_distance(positions, 1.0)
    return nodes._replace(
        position=jnp.asarray(positions, dtype),
        log_radius=jnp.asarray(np.log(radius), dtype),
    )


def moves(
    nodes: Nodes, spec: NodeMotionSpec, extent: Number, time: Float[Array, ""]
) -> Moves:
    """Evaluate the motion of the nodes at a time.

    Args:
      nodes: Parameters of the nodes.
      spec: Settings.
      extent: Scene extent, the unit of the network's translations, in scene units.
      time: Normalized time.

    Returns:
      The motion.
    """
    encode_position = jax.vmap(
        lambda point: encoding.encode(spec.position, point, None)
    )
    time_features = encoding.encode(spec.time, time[None], None)
    features = encode_position(nodes.position)
    time_features = jnp.broadcast_to(time_features, (len(features), len(time_features)))
    inputs = jnp.concatenate([features, time_features], axis=1)

    def network(inputs):
        return mlp.apply(network_spec(spec), nodes.network, inputs)

    if spec.mask is None:
        outputs = network(inputs)
        turn, shift = outputs["turn"], outputs["shift"]
    else:
        assert nodes.mask is not None
        share = openness(nodes.mask)
        outputs = in_blocks(network, (inputs,), share > 0, NODES_AT_ONCE)
        turn, shift = (share[:, None] * outputs[name] for name in ("turn", "shift"))
    return Moves(jax.vmap(quaternion.exp)(turn), extent * shift)


def _find(
    nodes: Nodes,
    spec: NodeMotionSpec,
    extent: Number,
    mean: Float[Array, "gaussians 3"],
    with_links: bool = True,
) -> Neighborhoods:
    """Find the nodes near each Gaussian, and the links between nodes."""
    near = skinning.nearest(mean, nodes.position, spec.near)
    moving = None
    if spec.mask is not None:
        assert nodes.mask is not None
        moving = jnp.any((openness(nodes.mask) > 0)[near], axis=1)
    if spec.rigidity is None or not with_links:
        return Neighborhoods(near, None, moving)
    times = jnp.linspace(0, 1, TIMES, dtype=mean.dtype)
    shifts = jax.vmap(lambda time: moves(nodes, spec, extent, time).shift)(times)
    paths = jnp.swapaxes(nodes.position + shifts, 0, 1)
    return Neighborhoods(
        near, skinning.links(paths, nodes.log_radius, spec.links), moving
    )


_find_linked = functools.partial(jax.jit, static_argnums=1)(_find)


def displace(
    nodes: Nodes,
    now: Moves,
    neighborhoods: Neighborhoods,
    mean: Float[Array, "gaussians 3"],
) -> skinning.Displacement:
    """Evaluate the motion of Gaussians by their nodes, without static blocks.

    Args:
      nodes: Parameters of the nodes.
      now: Motion of the nodes at a time.
      neighborhoods: The neighborhoods.
      mean: Canonical means of the Gaussians.

    Returns:
      Displacements and rotations.
    """

    def evaluate(near, mean):
        return skinning.displace(nodes.position, nodes.log_radius, now, near, mean)

    if neighborhoods.moving is None:
        return evaluate(neighborhoods.near, mean)
    return in_blocks(
        evaluate, (neighborhoods.near, mean), neighborhoods.moving, ROWS_AT_ONCE
    )


def _arap_loss(
    nodes: Nodes,
    spec: NodeMotionSpec,
    extent: Number,
    links: Links,
    times: tuple[Float[Array, ""], Float[Array, ""]],
) -> Float[Array, ""]:
    """Compute the deviation of linked nodes from rigid motion, in squared extents."""
    before, after = (
        (nodes.position + moves(nodes, spec, extent, time).shift) / extent
        for time in times
    )
    return skinning.arap_error(before, after, links)


def fit_to_paths(
    spec: NodeMotionSpec, extent: Number, paths: Paths, key: Key[Array, ""]
) -> Guess:
    """Distribute nodes over moving and static points, on the host.

    Paths are moved to the middle of the video by the rigid bodies they belong to. The
    network is initialized without motion, and motion of static nodes is penalized.

    Args:
      spec: Settings.
      extent: Scene extent in scene units.
      paths: 3D paths of points.
      key: PRNG key.

    Returns:
      Initial guess of a fit.
    """
    canonical = motion_fit.positions_at_middle(paths)
    unit = motion_fit.captured(paths.unit)
    static_points = np.zeros((0, 3))
    if paths.static is not None:
        static_points = np.asarray(paths.static, np.float64)
    moving = (
        spec.nodes if not len(static_points) else round(spec.moving_share * spec.nodes)
    )
    moving_nodes = canonical[skinning.farthest_points(canonical, max(moving, 1))]
    static_nodes = static_points[
        skinning.farthest_points(static_points, spec.nodes - len(moving_nodes))
    ]
    nodes = _place_nodes(init(key, spec), np.concatenate([moving_nodes, static_nodes]))
    static_rows = slice(len(moving_nodes), len(moving_nodes) + len(static_nodes))
    if spec.mask is not None:
        assert nodes.mask is not None
        nodes = nodes._replace(mask=nodes.mask.at[static_rows].set(spec.mask.still))

    def penalty(points, times):
        all_nodes = points.nets
        static = all_nodes._replace(position=all_nodes.position[static_rows])
        if all_nodes.mask is not None:
            static = static._replace(mask=all_nodes.mask[static_rows])

        def motion(time):
            now = moves(static, spec, extent, time)
            return now.turn[:, 1:], now.shift

        return motion_fit.rest_loss(motion, unit, times)

    start = Points(motion_fit.captured(canonical), None, nodes)
    mask = None if spec.mask is None else 1.0
    node_rates = Nodes._make((0.0, 1.0, 0.4, mask))
    rates = Points._make((paths.unit, None, node_rates, None))
    return Guess(start, rates, penalty if len(static_nodes) else None)


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `NodeMotionSpec` in a run of `steps`."""

    spec: NodeMotionSpec
    extent: Number  # of the scene, the unit of translations, in scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of the nodes and their network."""
        spec = self.spec
        rate = self.rate(step)
        decay = rate / spec.learning_rate
        mask = None if spec.mask is None else spec.mask.rate * decay
        position, radius = (
            self.extent * spec.place_rate * decay,
            spec.radius_rate * decay,
        )
        return MotionParams(shared=Nodes._make((position, radius, rate, mask)))

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the network and nodes spread over the Gaussians, on the host."""
        _, shared_key = jax.random.split(key)
        means = np.asarray(gaussians.mean)
        places = means[skinning.farthest_points(means, self.spec.nodes)]
        return MotionParams(shared=_place_nodes(init(shared_key, self.spec), places))

    def precompute(self, params: MotionParams, gaussians: Splats) -> Neighborhoods:
        """Find the nodes near each Gaussian."""
        mean = gaussians.mean
        return _find(params.shared, self.spec, self.extent, mean, with_links=False)

    def refresh(self, params: MotionParams, gaussians: Splats) -> Neighborhoods:
        """Find nodes near Gaussians and each other, for a new set of Gaussians."""
        return _find_linked(params.shared, self.spec, self.extent, gaussians.mean)

    def apply(
        self,
        params: MotionParams,
        cache: Neighborhoods,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at a time."""
        now = moves(params.shared, self.spec, self.extent, frame.time)
        offsets = displace(params.shared, now, cache, gaussians.mean)
        return skinning.apply(gaussians, offsets)

    def loss(self, params: MotionParams, context: PenaltyContext) -> dict[str, Term]:
        """Compute the rigidity loss, and the mean of the mask."""
        nodes, spec, time = params.shared, self.spec, context.condition.time
        terms = {}
        if spec.rigidity is not None:
            times = time, jax.random.uniform(context.key, (), time.dtype)
            value = _arap_loss(nodes, spec, self.extent, context.state.links, times)
            terms["unrigidity"] = Term(value, spec.rigidity)
        if spec.mask is not None and spec.mask.sparsity > 0:
            open_share = jnp.mean(jax.nn.sigmoid(nodes.mask))
            terms["moving"] = Term(open_share, spec.mask.sparsity)
        return from_step(spec.warm_up, context.step, terms)

    def fit(self, paths: Paths, key: Key[Array, ""]) -> Guess:
        """Return nodes spread over moving and static points, to start a fit from."""
        return fit_to_paths(self.spec, self.extent, paths, key)
