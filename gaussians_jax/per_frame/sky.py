"""Sky model: the background of each photograph as spherical harmonics.

A small network maps the code of a photograph to the coefficients, as in Splatfacto-W
(Xu et al. 2024, arXiv:2407.12306). Outdoor photographs show another sky each, which
Gaussians could represent only as floaters in front of their cameras.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Key

from gaussians_jax.splatting import harmonics
from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.nn import mlp
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec

GRAY = 0.5  # initial color


@dataclasses.dataclass(frozen=True)
class SkySpec:
    """Settings of a sky.

    Attributes:
      degree: Degree of the spherical harmonics.
      width: Width of the hidden layer that reads the code.
    """

    degree: int = 2
    width: int = 32

    def __post_init__(self):
        if not 0 <= self.degree <= harmonics.MAX_DEGREE:
            raise ValueError(f"degree={self.degree} must be 0, 1, 2 or 3")
        if self.width < 1:
            raise ValueError(f"width={self.width} must be at least 1")


class Sky(NamedTuple):
    """Parameters of a sky."""

    mean: Float[Array, "coefficients 3"]
    network: MLP  # code -> change of the coefficients


def _network(spec, code):
    outputs = 3 * (spec.degree + 1) ** 2
    head = HeadSpec(outputs)
    return MLPSpec(code, 1, spec.width, (("out", head),), (), "relu", "he")


def init(
    key: Key[Array, ""], spec: SkySpec, code: int, dtype: DTypeLike = jnp.float32
) -> Sky:
    """Initialize a gray sky in all photographs.

    Args:
      key: PRNG key.
      spec: Settings.
      code: Length of a code.
      dtype: Floating-point type.

    Returns:
      The parameters.
    """
    mean = jnp.zeros(((spec.degree + 1) ** 2, 3), dtype)
    return Sky(mean, mlp.init(_network(spec, code), key, dtype))


def color(
    spec: SkySpec,
    params: Sky,
    direction: Float[Array, "*pixels 3"],
    code: Float[Array, " code"],
) -> Float[Array, "*pixels 3"]:
    """Compute the color of the sky in some directions.

    Args:
      spec: Settings.
      params: Parameters.
      direction: Unit directions in the world.
      code: Code of the photograph.

    Returns:
      sRGB colors, not clipped.
    """
    change = mlp.apply(_network(spec, code.shape[0]), params.network, code)["out"]
    coefficients = params.mean + change.reshape(params.mean.shape)
    values = jnp.stack(harmonics.basis(direction, spec.degree), axis=-1)
    return GRAY + exact_product(values, coefficients)
