"""Warp from an observed point to its position in the template.

Nerfies (Park et al. 2021, arXiv:2011.12948) moves each point by its own rigid
transform, and D-NeRF (Pumarola et al. 2020, arXiv:2011.13961) translates it. Both map
the observation to the template. Both are computed here as the displacement of a point,
from which `matrix3.displacement_log_energy` computes an exact elastic energy.
"""

import dataclasses
import math

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.fields.effects.effect import Vector, guides_of
from nerfies_jax.geometry import lie
from nerfies_jax.nn import dense, encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import TIMESTAMP, FrameCondition, Table
from nerfies_jax.training.step_counts import steps

KINDS = ("se3", "translation")
CONDITIONS = ("code", "time")


@dataclasses.dataclass(frozen=True)
class WarpSpec:
    """Form and size of the warp. The defaults are those of Nerfies (Park et al. 2021).

    With `condition="code"` the warp reads a code of the frame from the table `table`.
    With "time" it reads the encoded time, and the observation at time 0 is the template
    (D-NeRF). `anneal_steps` is the number of steps over which the bands of `position`
    are opened one by one (coarse to fine). None opens all from the start. Without
    identity in `position`, an annealed warp moves all points of a frame alike at step
    0. `guides` names scalar per-point codes that the warp also reads. A field with a
    mask of moving points adds its code.
    """

    kind: str = "se3"
    condition: str = "code"
    position: EncodingSpec = EncodingSpec(8)
    time: EncodingSpec = EncodingSpec(10)
    code_width: int = 8
    table: str = "motion"
    depth: int = 6
    width: int = 128
    skips: tuple[int, ...] = (4,)
    anneal_steps: int | None = steps(None)
    guides: tuple[str, ...] = ()

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"unknown kind of warp {self.kind!r}; choose from {KINDS}")
        if self.condition not in CONDITIONS:
            raise ValueError(
                f"unknown condition {self.condition!r} of a warp; choose from "
                f"{CONDITIONS}"
            )
        if self.code_width < 1:
            raise ValueError(
                f"code_width={self.code_width} must be at least 1; with 0 all frames "
                "would share one warp"
            )
        if self.anneal_steps is not None and self.anneal_steps < 1:
            raise ValueError(
                f"anneal_steps={self.anneal_steps} must be at least 1, or None to open "
                "all bands from the start"
            )
        network(self)  # checks depth, width and skips

    @property
    def tables(self) -> tuple[Table, ...]:
        """Tables of the codes that the warp reads."""
        if self.condition != "code":
            return ()
        return (Table(self.table, TIMESTAMP, self.code_width),)

    @property
    def shortest_wave(self) -> float | None:
        """Shortest wavelength of the displacement, units of the field."""
        return self.position.shortest_wave

    def init(self, key: Key[Array, ""]) -> MLP:
        """Initialize the network."""
        return init(self, key)

    def apply(self, params: MLP, point: Vector, frame: FrameCondition) -> Vector:
        """Compute the displacement of a point."""
        return displace(self, params, point, frame)


def network(spec: WarpSpec) -> MLPSpec:
    """Return the settings of the network from [encoded point, condition] to motion.

    Args:
      spec: Settings.

    Returns:
      Settings of an MLP with the head "linear" and, for SE(3), "angular".
    """
    condition = spec.code_width if spec.condition == "code" else spec.time.width(1)
    names = ("angular", "linear") if spec.kind == "se3" else ("linear",)
    return MLPSpec(
        inputs=spec.position.width(3) + condition + len(spec.guides),
        depth=spec.depth,
        width=spec.width,
        heads=tuple((name, HeadSpec(3, "small")) for name in names),
        skips=spec.skips,
    )


def init(spec: WarpSpec, key: Key[Array, ""], dtype: DTypeLike = jnp.float32) -> MLP:
    """Initialize near the identity. In a box of side two, shifts are below 1.2e-4.

    Weights of an annealed band start at zero. They have no gradient until the band
    opens, and random weights would then deform a trained warp.

    Args:
      spec: Settings.
      key: PRNG key.
      dtype: Floating-point type of the parameters.

    Returns:
      The parameters.
    """
    params = mlp.init(network(spec), key, dtype)
    # mlp.SMALL bounds the contribution of one feature. They add up with random signs.
    heads = {
        name: head._replace(weight=head.weight / math.sqrt(network(spec).features))
        for name, head in params.heads.items()
    }
    hidden = list(params.hidden)
    if spec.anneal_steps is not None:
        for index in ({0} | set(spec.skips)) & set(range(spec.depth)):
            offset = spec.width if index else 0  # rows that read the previous layer
            hidden[index] = _without_bands(spec, hidden[index], offset)
        if not hidden:
            heads = {n: _without_bands(spec, head, 0) for n, head in heads.items()}
    return MLP(tuple(hidden), heads)


def _without_bands(spec, layer, offset):
    """Set the weights of the bands of the point, from row `offset` on, to zero."""
    first = 3 if spec.position.identity else 0
    rows = slice(offset + first, offset + spec.position.width(3))
    return layer._replace(weight=layer.weight.at[rows].set(0))


def displace(
    spec: WarpSpec, params: MLP, point: Vector, condition: FrameCondition
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
    features = encoding.encode(
        spec.position, point, window(spec, condition.step, point)
    )
    guides = guides_of(spec.guides, condition)
    if spec.condition == "code":
        code = jnp.concatenate([condition.codes[spec.table], *guides])
        return _move(spec, params, point, features, code)
    time = encoding.encode(spec.time, condition.time[None], None)
    shift = _move(spec, params, point, features, jnp.concatenate([time, *guides]))
    return jnp.where(condition.time == 0, 0, shift)


def window(
    spec: WarpSpec, step: Int[Array, ""] | None, like: Float[Array, "..."]
) -> Float[Array, " bands"] | None:
    """Compute the coarse-to-fine window of the point's encoding.

    Args:
      spec: Settings.
      step: Number of completed steps.
      like: Array of the type of the result.

    Returns:
      Weights in [0, 1] [bands], or None if all bands are open.
    """
    if spec.anneal_steps is None or spec.position.bands == 0:
        return None
    bands = spec.position.bands
    assert step is not None
    return schedules.band_window(bands, spec.anneal_steps, step, like.dtype)


def _move(spec, params, point, features, condition):
    hidden = _features(spec, params, features, condition)
    screw = {name: mlp.affine(head, hidden) for name, head in params.heads.items()}
    if spec.kind == "translation":
        return screw["linear"]
    return lie.displacement(screw["angular"], screw["linear"], point)


def _features(spec, params, features, condition):
    """Evaluate `mlp.hidden_features` of [features, condition].

    The contribution of the condition is computed separately: once per ray under vmap
    over samples, and without tangents in forward mode.
    """
    if not params.hidden:  # the heads read both
        return jnp.concatenate([features, condition])
    activation = mlp.ACTIVATIONS[network(spec).activation]
    hidden = features
    for index, layer in enumerate(params.hidden):
        if index in spec.skips:
            hidden = jnp.concatenate([hidden, features])
        if index == 0 or index in spec.skips:
            of_hidden, of_condition = jnp.split(layer.weight, [hidden.shape[-1]])
            offset = condition @ of_condition + layer.bias
            hidden = activation(dense.product(hidden, of_hidden) + offset)
        else:
            hidden = activation(mlp.affine(layer, hidden))
    return hidden
