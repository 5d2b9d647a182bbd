"""Ambient slicing surfaces: the template has extra dimensions, and frames slice it.

HyperNeRF (Park et al. 2021, arXiv:2106.13228, section 4). A topological change, such as
a mouth that opens, is not a warp of one template in space, but can be a slice of a
template with a few additional, ambient dimensions. A *bent* surface gives each observed
point its own ambient coordinates (equation 6). On an axis-aligned *plane* all points of
a frame share them.
"""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.fields.effects.effect import Vector, guides_of
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import TIMESTAMP, FrameCondition, Table
from nerfies_jax.training.step_counts import steps

KINDS = ("bent", "plane")
PLANE_TABLE = "ambient"
# Standard deviation of the weights of the head in ambient units per unit of feature, as
# in the published code. The surface starts as the plane through zero.
HEAD_DEVIATION = 1e-5


@dataclasses.dataclass(frozen=True)
class AmbientSpec:
    """Settings of the slicing surface. The defaults are those of HyperNeRF.

    `kind="bent"` is a network that reads the point, encoded by `position` with all
    bands open, and the code of the frame in `table`, which the warp shares.
    `kind="plane"` has a code of `dims` numbers per frame in its own table "ambient".
    (The published presets of this name use the code of the warp, which has eight
    numbers.)

    The template reads the ambient coordinates encoded by `encoding`. Its bands are
    closed for `closed_steps` and opened over the next `anneal_steps`. Without identity
    the template does not depend on them before. `guides` are those of the warp.
    """

    kind: str = "bent"
    dims: int = 2
    position: EncodingSpec = EncodingSpec(6, identity=False)
    depth: int = 6
    width: int = 64
    skips: tuple[int, ...] = (4,)
    table: str = "motion"
    code_width: int = 8
    encoding: EncodingSpec = EncodingSpec(1, identity=False)
    closed_steps: int = steps(1000)
    anneal_steps: int = steps(10_000)
    guides: tuple[str, ...] = ()

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(
                f"unknown kind of slicing surface {self.kind!r}; choose from {KINDS}"
            )
        if self.dims < 1:
            raise ValueError(
                f"dims={self.dims} must be at least 1; set the effect to none for no "
                "ambient dimensions"
            )
        if self.code_width < 1:
            raise ValueError(
                f"code_width={self.code_width} must be at least 1; with 0 all frames "
                "would share one slice"
            )
        if self.closed_steps < 0 or self.anneal_steps < 1:
            raise ValueError(
                "the window needs closed_steps >= 0 and anneal_steps >= 1, got "
                f"closed_steps={self.closed_steps}, anneal_steps={self.anneal_steps}"
            )
        network(self)  # checks depth, width and skips

    def bind(self, run_steps: int, metadata: Any) -> "Bound":
        """Return the conditioning of a scene with these settings."""
        return BentBound(self) if self.kind == "bent" else Bound(self)


def network(spec: AmbientSpec) -> MLPSpec:
    """Return the settings of the network of a bent surface.

    Args:
      spec: Settings of a bent surface.

    Returns:
      Settings of an MLP with the head "ambient".
    """
    return MLPSpec(
        inputs=spec.position.width(3) + spec.code_width + len(spec.guides),
        depth=spec.depth,
        width=spec.width,
        heads=(("ambient", HeadSpec(spec.dims, "small")),),
        skips=spec.skips,
    )


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Conditioning` of an `AmbientSpec` with a plane, which has no network.

    It reads the observed point before any warp.
    """

    spec: AmbientSpec

    name = "ambient"
    target = "trunk"

    @property
    def features(self) -> int:
        """Number of additional features that the trunk reads."""
        return self.spec.encoding.width(self.spec.dims)

    @property
    def tables(self) -> tuple[Table, ...]:
        """Table of the codes that it reads."""
        return (Table(PLANE_TABLE, TIMESTAMP, self.spec.dims),)

    def apply(
        self, params: MLP | None, point: Vector, frame: FrameCondition
    ) -> Float[Array, " features"]:
        """Compute the encoded ambient coordinates of a point."""
        return features(self.spec, params, point, frame)


@dataclasses.dataclass(frozen=True)
class BentBound(Bound):
    """The `Conditioning` of an `AmbientSpec` with a bent surface."""

    @property
    def tables(self) -> tuple[Table, ...]:
        """Table of the codes that it reads."""
        return (Table(self.spec.table, TIMESTAMP, self.spec.code_width),)

    def init(self, key: Key[Array, ""]) -> MLP:
        """Initialize the network."""
        return init(self.spec, key)


def init(spec: AmbientSpec, key: Key[Array, ""], dtype: DTypeLike = jnp.float32) -> MLP:
    """Initialize a bent surface near the plane through zero, for all codes.

    Args:
      spec: Settings.
      key: PRNG key.
      dtype: Floating-point type of the parameters.

    Returns:
      The parameters.
    """
    params = mlp.init(network(spec), key, dtype)
    # mlp.SMALL is the half-width of a uniform distribution, √3 standard deviations.
    factor = math.sqrt(3) * HEAD_DEVIATION / mlp.SMALL
    head = params.heads["ambient"]
    return params._replace(
        heads={"ambient": head._replace(weight=factor * head.weight)}
    )


def features(
    spec: AmbientSpec, params: MLP | None, point: Vector, condition: FrameCondition
) -> Float[Array, " features"]:
    """Compute the features for the template: the encoded ambient coordinates.

    Args:
      spec: Settings.
      params: Parameters, None for a plane.
      point: Observed point in units of the field, [3].
      condition: Conditioning of the frame.

    Returns:
      Features [features], weighted by the coarse-to-fine window.
    """
    ambient = ambient_point(spec, params, point, condition)
    weights = window(spec, condition.step, ambient)
    return encoding.encode(spec.encoding, ambient, weights)


def ambient_point(
    spec: AmbientSpec, params: MLP | None, point: Vector, condition: FrameCondition
) -> Float[Array, " dims"]:
    """Compute the ambient coordinates of an observed point, without encoding.

    They are used to visualize the slice, and to render along a path in it.

    Args:
      spec: Settings.
      params: Parameters, None for a plane.
      point: Observed point in units of the field, [3].
      condition: Conditioning of the frame.

    Returns:
      Ambient coordinates, [dims].
    """
    if spec.kind == "plane":
        return condition.codes[PLANE_TABLE]
    point_features = encoding.encode(spec.position, point, None)
    guides = guides_of(spec.guides, condition)
    inputs = jnp.concatenate([point_features, condition.codes[spec.table], *guides])
    assert params is not None  # a bent surface has parameters
    return mlp.apply(network(spec), params, inputs)["ambient"]


def window(
    spec: AmbientSpec, step: Int[Array, ""] | None, like: Float[Array, "..."]
) -> Float[Array, " bands"]:
    """Compute the coarse-to-fine window of the ambient encoding.

    Args:
      spec: Settings.
      step: Number of completed steps.
      like: Array of the type of the result.

    Returns:
      Weights in [0, 1], [bands].
    """
    assert step is not None
    return schedules.band_window(
        spec.encoding.bands,
        spec.anneal_steps,
        step,
        like.dtype,
        after=spec.closed_steps,
    )
