"""Procedural solid textures with detail at several scales, fixed to the material.

A texture is a function of the material point, so it moves with the object and needs no
UV map. All objects share one formula with different coefficients, so that it is
evaluated once per ray.
"""

import dataclasses
import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nerfies_jax.capture.images import linear_from_srgb
from nerfies_jax.capture.synthetic.motion import Vector

OCTAVES = 3
LATTICE_FACTORS = (0x8DA6B343, 0xD8163841, 0xCB1AB31F)  # odd, for hashing
EDGE = 6.0  # steepness of a checker edge, which spans about a tenth of a square


@dataclasses.dataclass(frozen=True)
class Texture:
    """Two colors mixed by a checkerboard, stripes and noise, with blots of a third.

    Colors are sRGB in [0, 1]. `checker`, `stripes`, `noise` and `blots` are the
    strengths of the patterns.
    """

    dark: Vector = (0.2, 0.2, 0.25)
    light: Vector = (0.85, 0.8, 0.7)
    blot: Vector = (0.6, 0.3, 0.2)
    checker: float = 0.3
    checker_size: float = 0.05  # edge of a square, scene units
    stripes: float = 0.0
    stripes_per_unit: Vector = (0.0, 0.0, 0.0)  # wave vector, cycles per scene unit
    noise: float = 0.3
    noise_size: float = 0.03  # of the largest lump, scene units
    blots: float = 0.5
    blot_size: float = 0.08

    def __post_init__(self):
        for name in ("checker_size", "noise_size", "blot_size"):
            if not getattr(self, name) > 0:
                raise ValueError(
                    f"{name}={getattr(self, name)} must be positive; to disable a "
                    "pattern, set its strength to 0"
                )
        for name in ("dark", "light", "blot"):
            if min(getattr(self, name)) < 0 or max(getattr(self, name)) > 1:
                raise ValueError(
                    f"{name}={getattr(self, name)} must lie in [0, 1]; divide 8-bit "
                    "values by 255"
                )


def albedo(
    textures: Sequence[Texture], thing: Int[Array, ""], material: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Evaluate the albedo of a material point.

    Args:
      textures: Textures of all objects.
      thing: Index of the object's texture.
      material: Material point, [3].

    Returns:
      Linear albedo for each channel, [3].
    """
    # Scalars instead of arrays of three let a batch of rays fill the vector registers,
    # which is six times faster on a CPU. `where` is faster than a gather, too.
    x, y, z = material

    def select(coefficient):
        values = [coefficient(each) for each in textures]
        choice = jnp.full_like(x, values[0])
        for index, value in enumerate(values[1:], 1):
            choice = jnp.where(thing == index, jnp.asarray(value, x.dtype), choice)
        return choice

    # With cosines, faces through the body's origin lie inside squares and not on edges.
    scale = jnp.pi / select(lambda t: t.checker_size)
    squares = jnp.tanh(
        EDGE * jnp.cos(scale * x) * jnp.cos(scale * y) * jnp.cos(scale * z)
    )
    wave_x, wave_y, wave_z = (
        select(lambda t, i=axis: 2 * math.pi * t.stripes_per_unit[i])
        for axis in range(3)
    )
    bands = jnp.sin(wave_x * x + wave_y * y + wave_z * z)
    frequency = 1 / select(lambda t: t.noise_size)
    grain = sum(
        value_noise(material * (frequency * 2**octave), 7 * octave + thing) / 2**octave
        for octave in range(OCTAVES)
    )
    mix = 0.5 + 0.5 * (
        select(lambda t: t.checker) * squares
        + select(lambda t: t.stripes) * bands
        + select(lambda t: t.noise) * grain
    )
    mix = jnp.clip(mix, 0, 1)
    spot = value_noise(material / select(lambda t: t.blot_size), 101 + thing)
    # Blots have soft edges.
    spot = select(lambda t: t.blots) / (1 + jnp.exp(-12 * (spot - 0.2)))
    channels = []
    for channel in range(3):
        dark, light, blot = (
            select(
                lambda t, n=name, i=channel: float(linear_from_srgb(getattr(t, n)[i]))
            )
            for name in ("dark", "light", "blot")
        )
        ground = dark + mix * (light - dark)
        channels.append(ground + spot * (blot * (0.6 + 0.4 * mix) - ground))
    return jnp.stack(channels)


def value_noise(
    point: Float[Array, "3"], seed: Int[Array, ""] | int
) -> Float[Array, ""]:
    """Evaluate value noise: smoothly interpolated random values on the integers.

    It is twice differentiable, and the same on all platforms, since the lattice is
    hashed in integers.

    Args:
      point: Position in lattice units, [3].
      seed: Seed of the hash.

    Returns:
      A scalar in [-1, 1].
    """
    start = jnp.asarray(seed).astype(jnp.uint32) * np.uint32(0x9E3779B9)
    low_bits, high_bits, weights = [], [], []
    for coordinate, factor in zip(point, LATTICE_FACTORS, strict=True):
        cell = jnp.floor(coordinate)
        part = coordinate - cell
        weights.append(part**3 * (part * (part * 6 - 15) + 10))
        low_bits.append(cell.astype(jnp.int32).astype(jnp.uint32) * np.uint32(factor))
        high_bits.append(low_bits[-1] + np.uint32(factor))

    def blend(axis, bits):
        if axis == 3:
            return _mix(bits).astype(point.dtype)
        low = blend(axis + 1, bits + low_bits[axis])
        high = blend(axis + 1, bits + high_bits[axis])
        return low + weights[axis] * (high - low)

    return blend(0, start) * 2.0**-22 - 1


def _mix(bits):
    """23 well-mixed bits: Murmur3's final mixer."""
    bits = (bits ^ (bits >> 16)) * np.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * np.uint32(0xC2B2AE35)
    return (bits ^ (bits >> 16)) >> 9


def srgb(light: Float[Array, "*any"]) -> Float[Array, "*any"]:
    """Convert linear light to sRGB, with a finite gradient at zero.

    Args:
      light: Linear light in [0, 1].

    Returns:
      sRGB values in [0, 1].
    """
    low = light <= 0.0031308
    # The gradient of the power is infinite at zero, also in the unselected branch.
    positive = jnp.where(low, 1, light)
    return jnp.where(low, 12.92 * light, 1.055 * positive ** (1 / 2.4) - 0.055)
