"""Motion of TiNeuVox: a small network shifts points, given an embedding of the time.

Fang et al. 2022, arXiv:2205.15285, "coordinate deformation" and "radiance network". The
implementation follows the published code (hustvl/TiNeuVox), because the paper's
equations were not available. One network embeds the encoded time. A second small
network maps the embedding and the encoded point to the shift into the template. The
radiance network also reads the embedding and the encoded observed point, which
compensates for errors of the small deformation network. The shift at time 0 is not zero
by construction.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Key

from nerfies_jax.fields.effects.effect import Scalar, Vector
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training.effects import FrameCondition


@dataclasses.dataclass(frozen=True)
class TimeWarpSpec:
    """Sizes of the networks. The defaults are those of the larger published model.

    `embedding` is the width of the time embedding, whose network has one hidden layer
    of `width`. The network of the shift has `depth` hidden layers of `width`. The shift
    starts near zero. In the published code its layer is initialized like any other.
    """

    position: EncodingSpec = EncodingSpec(10)
    time: EncodingSpec = EncodingSpec(8)
    embedding: int = 30
    depth: int = 2
    width: int = 256

    def __post_init__(self):
        if self.embedding < 1:
            raise ValueError(
                f"embedding={self.embedding} must be at least 1; with 0 the scene "
                "would not depend on time"
            )
        _shift_network(self)  # checks depth and width

    @property
    def features(self) -> int:
        """Number of additional features that the trunk reads."""
        return self.position.width(3) + self.embedding

    def init(self, key: Key[Array, ""]) -> "TimeWarp":
        """Initialize the networks."""
        return init(self, key)

    def apply(self, params: "TimeWarp", point: Vector, frame: FrameCondition) -> Vector:
        """Compute the displacement of a point."""
        return displace(self, params, point, frame)

    def trunk_features(
        self, params: "TimeWarp", point: Vector, frame: FrameCondition
    ) -> Float[Array, " features"]:
        """Compute the additional features that the trunk reads."""
        return features(self, params, point, frame)


class TimeWarp(NamedTuple):
    """Parameters."""

    time: MLP  # head "embedding"
    shift: MLP  # reads [encoded point, embedding]; head "linear"


def _time_network(spec: TimeWarpSpec) -> MLPSpec:
    """Return the settings of the network that embeds the encoded time."""
    heads = (("embedding", HeadSpec(spec.embedding)),)
    return MLPSpec(spec.time.width(1), 1, spec.width, heads)


def _shift_network(spec: TimeWarpSpec) -> MLPSpec:
    """Return the settings of the network from the encoded point to the shift."""
    inputs = spec.position.width(3) + spec.embedding
    heads = (("linear", HeadSpec(3, "small")),)
    return MLPSpec(inputs, spec.depth, spec.width, heads)


def init(
    spec: TimeWarpSpec, key: Key[Array, ""], dtype: DTypeLike = jnp.float32
) -> TimeWarp:
    """Initialize near the identity. In a box of side two, shifts are at most 1e-4.

    Args:
      spec: Settings.
      key: PRNG key.
      dtype: Floating-point type of the parameters.

    Returns:
      The parameters.
    """
    time_key, shift_key = jax.random.split(key)
    network = _shift_network(spec)
    shift = mlp.init(network, shift_key, dtype)
    head = shift.heads["linear"]
    # mlp.SMALL bounds the contribution of one feature. They add up with random signs.
    head = head._replace(weight=head.weight / math.sqrt(network.features))
    shift = shift._replace(heads={"linear": head})
    return TimeWarp(mlp.init(_time_network(spec), time_key, dtype), shift)


def _embed(
    spec: TimeWarpSpec, params: TimeWarp, time: Scalar
) -> Float[Array, " embedding"]:
    """Embed a time."""
    time_features = encoding.encode(spec.time, time[None], None)
    return mlp.apply(_time_network(spec), params.time, time_features)["embedding"]


def displace(
    spec: TimeWarpSpec, params: TimeWarp, point: Vector, condition: FrameCondition
) -> Vector:
    """Compute the displacement from an observed point to the template.

    Args:
      spec: Settings.
      params: Parameters.
      point: Observed point in units of the field, [3].
      condition: Conditioning of the frame.

    Returns:
      Template point minus observed point in units of the field, [3].
    """
    network = _shift_network(spec)
    # Under vmap over the samples of a ray, the contribution of the time is computed
    # once.
    embedding = _embed(spec, params, condition.time)
    at_time = mlp.with_known(network, params.shift, embedding)
    point_features = encoding.encode(spec.position, point, None)
    return mlp.apply(network, at_time, point_features)["linear"]


def features(
    spec: TimeWarpSpec, params: TimeWarp, point: Vector, condition: FrameCondition
) -> Float[Array, " features"]:
    """Compute the features that the radiance network reads next to the grid.

    Args:
      spec: Settings.
      params: Parameters.
      point: Observed point in units of the field, [3].
      condition: Conditioning of the frame.

    Returns:
      The encoded observed point and the embedding of the time, [features].
    """
    point_features = encoding.encode(spec.position, point, None)
    return jnp.concatenate([point_features, _embed(spec, params, condition.time)])
