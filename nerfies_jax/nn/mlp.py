"""Multilayer perceptrons with explicit parameters: a spec, `init`, `apply`."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Key

from nerfies_jax.nn import dense

ACTIVATIONS = {
    "relu": jax.nn.relu,
    "softplus": jax.nn.softplus,
    "silu": jax.nn.silu,
    "tanh": jnp.tanh,
    "sine": jnp.sin,
    "none": lambda x: x,
}
INITIALIZERS = ("glorot", "he", "zero", "small")
# Half-width of "small": displacements of 1e-4 scene units per unit of feature, as in
# the heads of Nerfies. Its range is one-sided, which moves all points in one direction.
SMALL = 1e-4


class Layer(NamedTuple):
    """An affine map, `features @ weight + bias`."""

    weight: Float[Array, "inputs outputs"]
    bias: Float[Array, " outputs"]


class MLP(NamedTuple):
    """Parameters of one network."""

    hidden: tuple[Layer, ...]
    heads: dict[str, Layer]  # linear read-outs of the last hidden layer


@dataclasses.dataclass(frozen=True)
class HeadSpec:
    """Settings of a linear output layer. `init` names its weight initializer."""

    width: int
    init: str = "glorot"

    def __post_init__(self):
        if self.width < 1:
            raise ValueError(
                f"a head needs at least one output, got width={self.width}"
            )
        _check_init(self.init)


@dataclasses.dataclass(frozen=True)
class MLPSpec:
    """Settings of a multilayer perceptron with skip connections and named heads.

    It has `depth` hidden layers of `width`. `heads` pairs names with linear output
    layers. Without heads the network returns its last hidden layer. `skips` counts
    layers from 0 and names those that read the concatenation [hidden, input]. The trunk
    of NeRF, which joins the input to the output of its fifth layer, is (5,). That of
    Nerfies, which joins it to the fourth's, is (4,).
    """

    inputs: int
    depth: int
    width: int
    heads: tuple[tuple[str, HeadSpec], ...] = ()
    skips: tuple[int, ...] = ()
    activation: str = "relu"
    init: str = "glorot"

    def __post_init__(self):
        if self.inputs < 1 or self.width < 1 or self.depth < 0:
            raise ValueError(
                f"an MLP needs inputs >= 1, width >= 1 and depth >= 0, got inputs="
                f"{self.inputs}, width={self.width}, depth={self.depth}"
            )
        outside = [layer for layer in self.skips if not 0 < layer < self.depth]
        if outside:
            raise ValueError(
                f"skips={self.skips}: layer {outside[0]} is not in 1 .. "
                f"{self.depth - 1}; the first layer always reads the input"
            )
        if self.activation not in ACTIVATIONS:
            raise ValueError(
                f"unknown activation {self.activation!r}; choose from "
                f"{sorted(ACTIVATIONS)}"
            )
        _check_init(self.init)
        names = [name for name, _ in self.heads]
        if len(set(names)) < len(names):
            raise ValueError(f"heads must have different names, got {names}")

    @property
    def features(self) -> int:
        """Number of features that the heads read."""
        return self.width if self.depth else self.inputs


def init(spec: MLPSpec, key: Key[Array, ""], dtype: DTypeLike = jnp.float32) -> MLP:
    """Initialize the parameters, with zero biases.

    All types start from the same numbers.

    Args:
      spec: The network's settings.
      key: PRNG key.
      dtype: Floating-point type of the parameters.

    Returns:
      The parameters, a pytree of arrays.
    """
    keys = jax.random.split(key, spec.depth + len(spec.heads))
    hidden = tuple(
        init_layer(keys[layer], _fan_in(spec, layer), spec.width, spec.init, dtype)
        for layer in range(spec.depth)
    )
    heads = {
        name: init_layer(head_key, spec.features, head.width, head.init, dtype)
        for (name, head), head_key in zip(spec.heads, keys[spec.depth :], strict=True)
    }
    return MLP(hidden, heads)


def init_layer(
    key: Key[Array, ""],
    inputs: int,
    outputs: int,
    init: str,
    dtype: DTypeLike = jnp.float32,
) -> Layer:
    """Initialize one affine map, with zero bias.

    Args:
      key: PRNG key.
      inputs: Number of inputs.
      outputs: Number of outputs.
      init: One of `INITIALIZERS`. "glorot" and "he" are uniform (Glorot 2010, He 2015).
      dtype: Floating-point type of the parameters.

    Returns:
      The layer.
    """
    bounds = {
        "glorot": math.sqrt(6 / (inputs + outputs)),
        "he": math.sqrt(6 / inputs),
        "zero": 0.0,
        "small": SMALL,
    }
    uniform = jax.random.uniform(key, (inputs, outputs), jnp.float32, -1, 1)
    return Layer(bounds[init] * uniform.astype(dtype), jnp.zeros(outputs, dtype))


def hidden_features(
    spec: MLPSpec, params: MLP, inputs: Float[Array, "*batch inputs"]
) -> Float[Array, "*batch features"]:
    """Evaluate the hidden layers.

    Args:
      spec: The network's settings.
      params: Parameters from `init`.
      inputs: Inputs, [..., inputs].

    Returns:
      The last hidden layer after its activation, [..., features].
    """
    activation = ACTIVATIONS[spec.activation]
    hidden = inputs
    for index, layer in enumerate(params.hidden):
        if index in spec.skips:
            hidden = jnp.concatenate([hidden, inputs], axis=-1)
        hidden = activation(affine(layer, hidden))
    return hidden


def apply(
    spec: MLPSpec, params: MLP, inputs: Float[Array, "*batch inputs"]
) -> dict[str, Float[Array, "*batch outputs"]]:
    """Evaluate the heads of a network, without an activation on their outputs.

    Args:
      spec: The network's settings.
      params: Parameters from `init`.
      inputs: Inputs, [..., inputs].

    Returns:
      The output [..., width] of each head, by its name.
    """
    hidden = hidden_features(spec, params, inputs)
    return {name: affine(layer, hidden) for name, layer in params.heads.items()}


def affine(
    layer: Layer, inputs: Float[Array, "*batch inputs"]
) -> Float[Array, "*batch outputs"]:
    """Evaluate one affine map.

    Args:
      layer: The layer.
      inputs: Inputs, [..., inputs].

    Returns:
      Outputs, [..., outputs].
    """
    return dense.product(inputs, layer.weight) + layer.bias


def with_known(spec: MLPSpec, params: MLP, known_inputs: Float[Array, " known"]) -> MLP:
    """Fold known inputs into the biases of a network.

    If the last inputs are the same for a whole batch, their contribution is computed
    once and added to the bias of each layer that reads the input: the first and those
    of `skips`, or each head of a network without hidden layers.

    Args:
      spec: Settings of the network with all inputs.
      params: Parameters from `init`.
      known_inputs: Values of the last inputs, [known].

    Returns:
      Parameters of a network of the other inputs.
    """

    def fold(index, layer):
        if index != 0 and index not in spec.skips:
            return layer
        weight = layer.weight[-len(known_inputs) :]
        return Layer(
            layer.weight[: -len(known_inputs)], layer.bias + known_inputs @ weight
        )

    hidden = tuple(fold(*item) for item in enumerate(params.hidden))
    heads = params.heads
    if not hidden:
        heads = {name: fold(0, layer) for name, layer in heads.items()}
    return MLP(hidden, heads)


def _fan_in(spec, layer):
    if layer == 0:
        return spec.inputs
    return spec.width + (spec.inputs if layer in spec.skips else 0)


def _check_init(name):
    if name not in INITIALIZERS:
        raise ValueError(f"unknown initializer {name!r}; choose from {INITIALIZERS}")
