"""Feature planes over pairs of coordinates, with multi-resolution levels.

A box of space is represented by three planes (xy, xz, yz), and with time by three more
(xt, yt, zt), so memory grows with the square of the side. Tri-planes are summed (Chan
et al. 2022, arXiv:2112.07945). HexPlane (Cao and Johnson 2023, arXiv:2301.09632) and
K-Planes (Fridovich-Keil et al. 2023, arXiv:2301.10241, equation 2) multiply. The
equations here are those of K-Planes, because those of the other papers were not
available. Functions take one point. Use `jax.vmap` for several.

A table row holds all features of a vertex. On one core, 10,000 points in a plane of
64 x 64 vertices with 16 features take 0.43 ms, and 3.2 ms with the gradient, in this
layout. Eight tables of two features take 0.47 and 5.0 ms, and sixteen tables of one
feature 0.57 and 2.3 ms. If all points share one time, the planes of time are first
interpolated to lines (`at_time`), which take 0.12 and 0.48 ms.
"""

import dataclasses
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

COMBINATIONS = ("product", "sum")
OUTSIDE = ("clamp", "refuse")
MAX_VERTICES = 2**15 + 1  # along an axis, so that row indices of a plane fit int32
PAIRS = tuple(itertools.combinations(range(3), 2))  # xy, xz, yz
# Ranges of the initial features of space, as published. Those of time start with the
# neutral element.
FIRST = {"product": (0.1, 0.5), "sum": (-0.1, 0.1)}


@dataclasses.dataclass(frozen=True)
class PlanesSpec:
    """Settings of feature planes over [0, 1]^3, or [0, 1]^4 if there are `timestamps`.

    Each level has `vertices` times one of `multiples` vertices along an axis of space.
    All levels have `timestamps` vertices along time. The `combination` "product"
    multiplies the planes of a level, so that one plane can switch off the features of
    another. "sum" adds them. A point `outside` the box has the features of the nearest
    point of the box ("clamp") or NaN ("refuse"), which ends a run with an error that
    names the array.
    """

    vertices: int = 64
    multiples: tuple[int, ...] = (1, 2, 4)
    timestamps: int | None = None  # vertices along time; None for planes of space only
    features: int = 16  # of each level
    combination: str = "product"
    outside: str = "clamp"

    def __post_init__(self):
        if self.features < 1 or not self.multiples or min(self.multiples) < 1:
            raise ValueError(
                "planes need features >= 1 and a positive multiple for each level, got "
                f"features={self.features}, multiples={self.multiples}"
            )
        if not 2 <= self.vertices <= MAX_VERTICES // max(self.multiples):
            raise ValueError(
                f"vertices={self.vertices} times {max(self.multiples)} must lie "
                f"between 2 and {MAX_VERTICES}"
            )
        if self.timestamps is not None and not 2 <= self.timestamps <= MAX_VERTICES:
            raise ValueError(
                f"timestamps={self.timestamps} must lie between 2 and {MAX_VERTICES}, "
                "or be None for planes without time"
            )
        for name, options in (("combination", COMBINATIONS), ("outside", OUTSIDE)):
            if getattr(self, name) not in options:
                raise ValueError(
                    f"unknown {name} {getattr(self, name)!r}; choose from {options}"
                )

    @property
    def levels(self) -> int:
        """Number of levels. Training may enable them one by one from coarse to fine."""
        return len(self.multiples)

    def width(self, dimensions: int) -> int:
        """Return the number of features of a point.

        Args:
          dimensions: Number of coordinates of the point, 3 or, with time, 4.

        Returns:
          The length of `encode`'s result.

        Raises:
          ValueError: If the planes have another number of dimensions.
        """
        axes = 3 if self.timestamps is None else 4
        if dimensions != axes:
            raise ValueError(
                f"planes with timestamps={self.timestamps} have {axes} dimensions, but "
                f"the points have {dimensions}"
            )
        return len(self.multiples) * self.features


class Level(NamedTuple):
    """The planes of one level."""

    space: tuple[Float[Array, "vertices vertices features"], ...]  # as `PAIRS`
    time: tuple[Float[Array, "times vertices features"], ...]  # of x, y, z; or none


# The three lines of each level at one time.
Lines = tuple[tuple[Float[Array, "_ features"], ...], ...]


def init(
    spec: PlanesSpec, key: Key[Array, ""], dtype: DTypeLike = jnp.float32
) -> tuple[Level, ...]:
    """Initialize planes of space uniformly and planes of time to the neutral element.

    Args:
      spec: Settings of the planes.
      key: PRNG key.
      dtype: Floating-point type of the planes.

    Returns:
      The planes of each level. Those of time are ones, or zeros for a sum.
    """
    low, high = FIRST[spec.combination]
    levels = []
    for level_key, multiple in zip(
        jax.random.split(key, len(spec.multiples)), spec.multiples, strict=True
    ):
        side = spec.vertices * multiple
        shape = side, side, spec.features
        space = tuple(
            jax.random.uniform(plane_key, shape, jnp.float32, low, high).astype(dtype)
            for plane_key in jax.random.split(level_key, len(PAIRS))
        )
        time: tuple[jax.Array, ...] = ()
        if spec.timestamps is not None:
            neutral = 1 if spec.combination == "product" else 0
            plane = jnp.full((spec.timestamps, side, spec.features), neutral, dtype)
            time = (plane,) * 3
        levels.append(Level(space, time))
    return tuple(levels)


def encode(
    spec: PlanesSpec, levels: tuple[Level, ...], place: Float[Array, " dimensions"]
) -> Float[Array, " encoded"]:
    """Interpolate the features of one position, level by level from the first.

    If many points share one time, `at_time` and `features` compute the same faster.

    Args:
      spec: Settings of the planes.
      levels: The planes.
      place: Position in the unit cube, [3], or [4] with the time last.

    Returns:
      Features, [levels * features].
    """
    spec.width(len(place))
    encoding = space_features(spec, levels, place[:3])
    if spec.timestamps is not None:
        time, *axes = place[3], *place[:3]
        by_level = [
            [
                bilinear(plane, time, x)
                for plane, x in zip(level.time, axes, strict=True)
            ]
            for level in levels
        ]
        of_time = jnp.stack([_combine(spec, planes) for planes in by_level])
        inside = (time >= 0) & (time <= 1)
        encoding = _refuse_outside(spec, _combine(spec, [encoding, of_time]), inside)
    return encoding.reshape(-1)


def space_features(
    spec: PlanesSpec, levels: tuple[Level, ...], place: Float[Array, "3"]
) -> Float[Array, "levels features"]:
    """Interpolate the planes of space, whose features do not depend on time.

    Args:
      spec: Settings of the planes.
      levels: The planes.
      place: Position in the unit cube, [3].

    Returns:
      Features, [levels, features].
    """
    by_level = [
        [
            bilinear(plane, place[one], place[other])
            for (one, other), plane in zip(PAIRS, level.space, strict=True)
        ]
        for level in levels
    ]
    inside = jnp.all((place >= 0) & (place <= 1))
    encoding = jnp.stack([_combine(spec, planes) for planes in by_level])
    return _refuse_outside(spec, encoding, inside)


def at_time(levels: tuple[Level, ...], time: Float[Array, ""]) -> Lines:
    """Interpolate the planes of time to lines at one time, which points can share.

    Args:
      levels: The planes.
      time: Time in [0, 1].

    Returns:
      Three lines [vertices, features] of each level.
    """
    return tuple(tuple(linear(p, time) for p in level.time) for level in levels)


def time_features(
    spec: PlanesSpec, lines: Lines, place: Float[Array, "3"]
) -> Float[Array, "levels features"]:
    """Interpolate the planes of time at one position.

    Args:
      spec: Settings of the planes.
      lines: Lines from `at_time`.
      place: Position in the unit cube, [3].

    Returns:
      Features, [levels, features].
    """
    by_level = [
        [linear(line, x) for line, x in zip(level, place, strict=True)]
        for level in lines
    ]
    return jnp.stack([_combine(spec, level) for level in by_level])


def features(
    spec: PlanesSpec,
    space: Float[Array, "levels features"],
    time: Float[Array, "levels features"],
) -> Float[Array, " encoded"]:
    """Combine features of space and time, as `encode` does.

    Args:
      spec: Settings of the planes.
      space: Result of `space_features`, [levels, features].
      time: Result of `time_features`, [levels, features].

    Returns:
      Features, [levels * features].
    """
    return _combine(spec, [space, time]).reshape(-1)


def bilinear(
    plane: Float[Array, "first second features"],
    down: Float[Array, ""],
    across: Float[Array, ""],
) -> Float[Array, " features"]:
    """Interpolate bilinearly between the four vertices around a position.

    The result is exact at a vertex and continuous across the edges of a cell, where the
    gradient jumps. On an edge it is that of the cell above. A position outside is
    clamped to the box, with zero gradient along the clamped axis.

    Args:
      plane: Features of the vertices, [first, second, features].
      down: Position along the first axis, in [0, 1].
      across: Position along the second axis, in [0, 1].

    Returns:
      Features, [features].
    """
    first, second, _ = plane.shape
    row, down = _cell(down, first)
    column, across = _cell(across, second)
    flat = plane.reshape(first * second, -1)
    corner = row * second + column
    top = (1 - across) * flat[corner] + across * flat[corner + 1]
    below = corner + second
    bottom = (1 - across) * flat[below] + across * flat[below + 1]
    return (1 - down) * top + down * bottom


def linear(
    line: Float[Array, "vertices *rest"], place: Float[Array, ""]
) -> Float[Array, "*rest"]:
    """Interpolate linearly between the two vertices around a position.

    Args:
      line: Values at the vertices, [vertices, ...].
      place: Position in [0, 1]. It is clamped as in `bilinear`.

    Returns:
      Values, [...].
    """
    row, share = _cell(place, len(line))
    return (1 - share) * line[row] + share * line[row + 1]


def total_variation(plane: Float[Array, "first second features"]) -> Float[Array, ""]:
    """Compute the mean squared difference of neighboring vertices, per axis.

    4DGS uses this name for `time_smoothness` along one axis.

    Args:
      plane: A plane, [first, second, features].

    Returns:
      The sum of the means of the two axes, a scalar.

    References:
      K-Planes, arXiv:2301.10241, equation 3.
    """
    along, across = (jnp.mean(jnp.square(jnp.diff(plane, axis=a))) for a in (0, 1))
    return along + across


def time_smoothness(
    plane: Float[Array, "times vertices features"],
) -> Float[Array, ""]:
    """Compute the mean squared second difference along time.

    Args:
      plane: A plane of time, [times, vertices, features].

    Returns:
      A scalar, zero for features that change linearly and for fewer than three rows.

    References:
      K-Planes, arXiv:2301.10241, equation 4.
    """
    if plane.shape[0] < 3:
        return jnp.zeros((), plane.dtype)  # the mean of an empty array is NaN
    # Differences of differences, because p₊ + p₋ - 2p rounds the sum of close values.
    return jnp.mean(jnp.square(jnp.diff(jnp.diff(plane, axis=0), axis=0)))


def l1_time_planes(
    plane: Float[Array, "times vertices features"],
) -> Float[Array, ""]:
    """Compute the mean absolute distance from one, the neutral element of a product.

    This encourages static features to be explained by the planes of space.

    Args:
      plane: A plane of time, [times, vertices, features].

    Returns:
      A scalar.

    References:
      K-Planes, arXiv:2301.10241, equation 5 (L1).
    """
    difference = plane - 1
    # The gradient of `abs` at zero is one in JAX. Planes start at one, and all static
    # features would be pushed in the same direction.
    return jnp.mean(difference * jnp.sign(difference))


def _cell(
    place: Float[Array, ""], vertices: int
) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """Return the vertex before a position in [0, 1], and the fraction to the next."""
    coordinate = jnp.clip(place, 0, 1) * (vertices - 1)
    # The position 1 belongs to the last cell.
    before = jnp.clip(jnp.floor(coordinate), 0, vertices - 2)
    return before.astype(jnp.int32), coordinate - before


def _combine(spec, parts):
    total = parts[0]
    for part in parts[1:]:
        total = total * part if spec.combination == "product" else total + part
    return total


def _refuse_outside(spec, encoding, inside):
    if spec.outside == "clamp":
        return encoding
    return jnp.where(inside, encoding, jnp.full_like(encoding, jnp.nan))
