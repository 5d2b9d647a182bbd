"""Feature planes over pairs of coordinates, with multi-resolution levels.

A box of space is represented by three planes (xy, xz, yz), and with time by three more
(xt, yt, zt), so memory grows with the square of the side. Tri-planes are summed (Chan
et al. 2022, arXiv:2112.07945). HexPlane (Cao and Johnson 2023, arXiv:2301.09632) and
K-Planes (Fridovich-Keil et al. 2023, arXiv:2301.10241, equation 2) multiply. The
equations here are those of K-Planes, since those of the others were not at hand.
Functions take one point, and callers `jax.vmap` them.

A row holds all features of a vertex. On one core, 10,000 points in a plane of 64 x 64
with 16 features take, forward and with the gradient, 0.43 and 3.2 ms as one row, 0.47
and 5.0 as eight rows of two, and 0.57 and 2.3 as sixteen rows of one in as many tables.
Features that all points read at one time are a line and take 0.12 and 0.48 ms
(`at_time`).
"""

import dataclasses
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

COMBINATIONS = ("product", "sum")
OUTSIDE = ("clamp", "refuse")
MAX_VERTICES = 2**15 + 1  # along an axis: a row of a plane is counted in int32
PAIRS = tuple(itertools.combinations(range(3), 2))  # xy, xz, yz
# Features of space to start from, as published; those of time start where they change
# nothing.
FIRST = {"product": (0.1, 0.5), "sum": (-0.1, 0.1)}


@dataclasses.dataclass(frozen=True)
class PlanesSpec:
    """Settings of feature planes over [0, 1]^3, or [0, 1]^4 if there are `moments`.

    `vertices` counts those along an axis of space at the first level. Every level has
    one of the `multiples` of it, and all levels have as many `moments`. "product"
    multiplies the planes of a level, so that one plane can switch off the features of
    another. "sum" adds them. Outside the box a point has the features of the nearest
    point in it ("clamp"), or NaN ("refuse"), at which a run stops with the name of the
    array.
    """

    vertices: int = 64
    multiples: tuple[int, ...] = (1, 2, 4)
    moments: int | None = None  # along time; None: three planes of space alone
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
        if self.moments is not None and not 2 <= self.moments <= MAX_VERTICES:
            raise ValueError(
                f"moments={self.moments} must lie between 2 and {MAX_VERTICES}; None "
                "leaves the time out"
            )
        for name, options in (("combination", COMBINATIONS), ("outside", OUTSIDE)):
            if getattr(self, name) not in options:
                raise ValueError(
                    f"unknown {name} {getattr(self, name)!r}; choose from {options}"
                )

    @property
    def levels(self) -> int:
        """Number of levels, which open one by one from coarse to fine."""
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
        wanted = 3 if self.moments is None else 4
        if dimensions != wanted:
            raise ValueError(
                f"these planes are of {wanted} dimensions, not of {dimensions}"
            )
        return len(self.multiples) * self.features


class Level(NamedTuple):
    """The planes of one level."""

    space: tuple[Float[Array, "vertices vertices features"], ...]  # as `PAIRS`
    time: tuple[Float[Array, "moments vertices features"], ...]  # of x, y, z; or none


# The three lines of each level at one time.
Lines = tuple[tuple[Float[Array, "_ features"], ...], ...]


def init(spec: PlanesSpec, key: Key[Array, ""], dtype=jnp.float32) -> tuple[Level, ...]:
    """Initialize the planes: space uniformly, time to the neutral element.

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
            jax.random.uniform(one, shape, jnp.float32, low, high).astype(dtype)
            for one in jax.random.split(level_key, len(PAIRS))
        )
        rest = 1 if spec.combination == "product" else 0
        still = jnp.full((spec.moments or 0, side, spec.features), rest, dtype)
        levels.append(Level(space, () if spec.moments is None else (still,) * 3))
    return tuple(levels)


def encode(
    spec: PlanesSpec, levels: tuple[Level, ...], place: Float[Array, " dimensions"]
) -> Float[Array, " encoded"]:
    """Interpolate the features of one place, the first level first.

    If many points share one time, `at_time` and `features` give the same faster.

    Args:
      spec: Settings of the planes.
      levels: The planes.
      place: Position in the unit cube, [3], or [4] with the time last.

    Returns:
      Features, [levels * features].
    """
    spec.width(len(place))
    found = space_features(spec, levels, place[:3])
    if spec.moments is not None:
        moment, *axes = place[3], *place[:3]
        time = [
            [bilinear(plane, moment, x) for plane, x in zip(of.time, axes, strict=True)]
            for of in levels
        ]
        now = jnp.stack([_combined(spec, level) for level in time])
        inside = (moment >= 0) & (moment <= 1)
        found = _held(spec, _combined(spec, [found, now]), inside)
    return found.reshape(-1)


def space_features(
    spec: PlanesSpec, levels: tuple[Level, ...], place: Float[Array, "3"]
) -> Float[Array, "levels features"]:
    """Interpolate the planes of space alone, which are the same at all times.

    Args:
      spec: Settings of the planes.
      levels: The planes.
      place: Position in the unit cube, [3].

    Returns:
      Features, [levels, features].
    """
    found = [
        [
            bilinear(plane, place[one], place[other])
            for (one, other), plane in zip(PAIRS, level.space, strict=True)
        ]
        for level in levels
    ]
    inside = jnp.all((place >= 0) & (place <= 1))
    return _held(spec, jnp.stack([_combined(spec, one) for one in found]), inside)


def at_time(levels: tuple[Level, ...], moment: Float[Array, ""]) -> Lines:
    """Evaluate the planes of time at one time, which all points can share.

    Args:
      levels: The planes.
      moment: Time in [0, 1].

    Returns:
      Three lines [vertices, features] of each level.
    """
    return tuple(tuple(linear(p, moment) for p in level.time) for level in levels)


def time_features(
    spec: PlanesSpec, lines: Lines, place: Float[Array, "3"]
) -> Float[Array, "levels features"]:
    """Interpolate the planes of time at one place.

    Args:
      spec: Settings of the planes.
      lines: Lines from `at_time`.
      place: Position in the unit cube, [3].

    Returns:
      Features, [levels, features].
    """
    found = [
        [linear(line, x) for line, x in zip(level, place, strict=True)]
        for level in lines
    ]
    return jnp.stack([_combined(spec, level) for level in found])


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
    return _combined(spec, [space, time]).reshape(-1)


def bilinear(
    plane: Float[Array, "first second features"],
    down: Float[Array, ""],
    across: Float[Array, ""],
) -> Float[Array, " features"]:
    """Interpolate bilinearly between the four vertices around a position.

    The result is exact at a vertex and continuous across the edges of a cell, where the
    gradient jumps. On an edge it is that of the cell above. A position outside is
    clamped to the nearest inside, with zero gradient across the end.

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
    plane: Float[Array, "moments vertices features"],
) -> Float[Array, ""]:
    """Compute the mean squared second difference along time.

    Args:
      plane: A plane of time, [moments, vertices, features].

    Returns:
      A scalar, zero for features that change linearly and for fewer than three rows.

    References:
      K-Planes, arXiv:2301.10241, equation 4.
    """
    if plane.shape[0] < 3:
        return jnp.zeros((), plane.dtype)  # of nothing the mean is NaN
    # Differences of differences: each of close values is exact, their sum is not.
    return jnp.mean(jnp.square(jnp.diff(jnp.diff(plane, axis=0), axis=0)))


def l1_time_planes(
    plane: Float[Array, "moments vertices features"],
) -> Float[Array, ""]:
    """Compute the mean absolute distance from one, the neutral element of a product.

    This encourages static features to be explained by the planes of space.

    Args:
      plane: A plane of time, [moments, vertices, features].

    Returns:
      A scalar.

    References:
      K-Planes, arXiv:2301.10241, equation 5 (L1).
    """
    off = plane - 1
    # Not `abs`, whose gradient at zero is one: planes start at one, and all that rests
    # would be pushed one way.
    return jnp.mean(off * jnp.sign(off))


def _cell(
    place: Float[Array, ""], vertices: int
) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The vertex before a place in [0, 1], and how far beyond it the place is."""
    scaled = jnp.clip(place, 0, 1) * (vertices - 1)
    # The far end belongs to the last cell.
    before = jnp.clip(jnp.floor(scaled), 0, vertices - 2)
    return before.astype(jnp.int32), scaled - before


def _combined(spec, parts):
    total = parts[0]
    for part in parts[1:]:
        total = total * part if spec.combination == "product" else total + part
    return total


def _held(spec, found, inside):
    if spec.outside == "clamp":
        return found
    return jnp.where(inside, found, jnp.full_like(found, jnp.nan))
