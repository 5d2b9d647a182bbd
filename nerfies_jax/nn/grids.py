"""Multi-resolution feature grids, dense or hashed.

Functions take one point, and callers `jax.vmap` them. A network that reads features of
its own for each place learns a scene in a tenth of the steps of one that reads a
positional encoding. On a CPU the cost is that of XLA's gather and scatter: rows of 2
floats take 3.9 and 2.4 ns each, rows of 16 floats 19 and 66, so rows are narrow and
levels many.
"""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.geometry.precision import exact_product

# Multipliers of the coordinates of a vertex (Müller et al. 2022, equation 4).
PRIMES = (1, 2654435761, 805459861)
FIRST = 1e-4  # half-width of the first features, as published
MAX_CELLS = 2**20  # along an axis: float32 places a point in a cell of that to 1/8

Tables = tuple[Float[Array, "_ features"], ...]


@dataclasses.dataclass(frozen=True)
class HashGridSpec:
    """Settings of a multi-resolution hash grid over a box.

    Müller et al. 2022, arXiv:2201.05989, section 3. Each level is finer than the last
    by the same factor. A level whose vertices fit into `rows` has a row for each. Finer
    ones share rows by a hash of the vertex, and the network resolves collisions. The
    box is [-half_side, half_side] in units of the field. Space outside is contracted
    into twice the box (Barron et al. 2022, arXiv:2111.12077, equation 10, in the
    maximum norm). If `contract` is false, a point there has the features of the nearest
    point in the box.
    """

    levels: int = 7
    features: int = 2  # floats of a row
    coarsest: int = 16  # cells along an axis of the first level
    finest: int = 256  # of the last
    rows: int = 2**16  # at most, of each level
    half_side: float = 1.0
    contract: bool = True

    def __post_init__(self):
        if self.levels < 1 or self.features < 1 or self.rows < 8:
            raise ValueError(
                "a hash grid needs levels >= 1, features >= 1 and rows >= 8, got "
                f"levels={self.levels}, features={self.features}, rows={self.rows}"
            )
        if not 1 <= self.coarsest <= self.finest <= MAX_CELLS:
            raise ValueError(
                f"need 1 <= coarsest <= finest <= {MAX_CELLS}, got "
                f"coarsest={self.coarsest} and finest={self.finest}"
            )
        if not 0 < self.half_side < math.inf:
            raise ValueError(f"half_side={self.half_side} must be positive and finite")

    def width(self, dimensions: int) -> int:
        """Return the number of features of a point.

        Args:
          dimensions: Number of coordinates of the point, which must be 3.

        Returns:
          The length of `encode`'s result.

        Raises:
          ValueError: If `dimensions` is not 3.
        """
        if dimensions != 3:
            raise ValueError(f"a hash grid is of 3 dimensions, not of {dimensions}")
        return self.levels * self.features

    def cells(self) -> tuple[int, ...]:
        """Return the number of cells along an axis of each level, from coarse to fine.

        Returns:
          One integer for each level.
        """
        return tuple(
            round(float(cells))
            for cells in np.geomspace(self.coarsest, self.finest, self.levels)
        )


def init(spec: HashGridSpec, key: Key[Array, ""], dtype=jnp.float32) -> Tables:
    """Initialize tables uniformly in [-1e-4, 1e-4].

    Args:
      spec: Settings of the grid.
      key: PRNG key.
      dtype: Floating-point type of the tables.

    Returns:
      One table [rows, features] for each level, with as many rows as vertices, at most
      `spec.rows`.
    """
    keys = jax.random.split(key, spec.levels)
    shapes = [(min((n + 1) ** 3, spec.rows), spec.features) for n in spec.cells()]
    return tuple(
        jax.random.uniform(key, shape, jnp.float32, -FIRST, FIRST).astype(dtype)
        for key, shape in zip(keys, shapes, strict=True)
    )


def encode(
    spec: HashGridSpec,
    tables: Tables,
    point: Float[Array, "3"],
    window: Float[Array, " levels"] | None = None,
) -> Float[Array, " encoded"]:
    """Interpolate the features of one point, the coarsest level first.

    Args:
      spec: Settings of the grid.
      tables: Tables of the levels.
      point: Point in units of the field, [3].
      window: Weights of the levels (`encoding.anneal`), [levels]. None is a weight of
        one for all levels.

    Returns:
      Features, [levels * features].
    """
    place = unit_place(point, spec.half_side, spec.contract)
    found = [
        level_features(table, place, cells)
        for table, cells in zip(tables, spec.cells(), strict=True)
    ]
    if window is not None:
        found = [part * window[level] for level, part in enumerate(found)]
    return jnp.concatenate(found)


def unit_place(
    point: Float[Array, "3"], half_side: float, contracted: bool
) -> Float[Array, "3"]:
    """Map a point to [0, 1]^3 over the box, or over its contracted surroundings.

    Args:
      point: Point in units of the field, [3].
      half_side: Half side of the box in units of the field.
      contracted: True to contract space, False to clamp to the box.

    Returns:
      The position in the unit cube, [3].
    """
    scaled = point / half_side
    if contracted:
        return (contract(scaled) + 2) / 4
    return (jnp.clip(scaled, -1, 1) + 1) / 2


def contract(point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Contract all of space into the cube [-2, 2]^3. The cube [-1, 1]^3 is unchanged.

    This is (2 - 1/|x|) x/|x| beyond a norm of one, with the maximum norm, so that cubes
    stay cubes. Its gradient is continuous along a ray from the center. A point at
    infinity has none.

    Args:
      point: Point in units of the half side of the box, [3].

    Returns:
      The contracted point, [3].

    References:
      Barron et al. 2022 (mip-NeRF 360), arXiv:2111.12077, equation 10.
    """
    # The norm is held out of the branch that is not taken, where it may be zero.
    size = jnp.max(jnp.abs(point))
    beyond = jnp.maximum(size, 1)
    return jnp.where(size > 1, (2 - 1 / beyond) * (point / beyond), point)


def level_features(
    table: Float[Array, "rows features"],
    place: Float[Array, "3"],
    cells: int,
    stride: int = 1,
) -> Float[Array, " features"]:
    """Interpolate trilinearly between the eight vertices around a position.

    The result is exact at a vertex and continuous across the faces of a cell. The
    gradient jumps there, and on a face it is that of the cell above.

    Args:
      table: Table of the level, [rows, features].
      place: Position in [0, 1]^3, [3].
      cells: Number of cells along an axis.
      stride: Use only every `stride`-th vertex. It divides `cells`.

    Returns:
      Features, [features].
    """
    return _between_vertices(table, place, cells, stride)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _between_vertices(table, place, cells, stride):
    rows, weights = _vertices_around(place, cells, stride, len(table))
    return sum(weight * table[row] for row, weight in zip(rows, weights, strict=True))


def _slope_between_vertices(cells, stride, primals, tangents):
    # One sum is fast to evaluate, one product to derive. ns a point of one core in a
    # loop of steps, 24,576 points, 7 levels of 2 features:
    #                               sum   product
    #   features                     72       229
    #   their slope by tables       514       499
    #   by places                  1610       386
    #   by both                    2124       651
    # An operation of its own over all points, its gradients by tables scattered corner
    # after corner, takes 195 for 480 of these by itself; whole steps and frames of
    # `d-nerf-grid-small` then take a tenth more.
    moved = [not isinstance(tangent, SymbolicZero) for tangent in tangents]

    def product(*given):
        given = iter(given)
        table, place = (
            next(given) if m else p for m, p in zip(moved, primals, strict=True)
        )
        rows, weights = _vertices_around(place, cells, stride, len(table))
        # By default a GPU may round factors to ten bits.
        return exact_product(jnp.stack(weights), table[jnp.stack(rows)])

    return jax.jvp(
        product,
        list(itertools.compress(primals, moved)),
        list(itertools.compress(tangents, moved)),
    )


_between_vertices.defjvp(_slope_between_vertices, symbolic_zeros=True)


def _vertices_around(place, cells, stride, rows):
    """The rows of the eight vertices of a cell, and the weight of each at a place.

    Coordinate by coordinate: a point in three lanes of a vector takes twice the time.
    """
    wide = cells // stride
    scaled = [along * wide for along in place]
    # A place at the far end belongs to the last cell.
    low = [jnp.clip(jnp.floor(along), 0, wide - 1) for along in scaled]
    above = [along - corner for along, corner in zip(scaled, low, strict=True)]
    share = [(1 - along, along) for along in above]
    corner = [along.astype(jnp.int32) for along in low]
    found, weights = [], []
    for x, y, z in itertools.product((0, 1), repeat=3):
        vertex = [
            stride * (along + up) for along, up in zip(corner, (x, y, z), strict=True)
        ]
        found.append(_row(vertex, cells, rows))
        weights.append(share[0][x] * share[1][y] * share[2][z])
    return found, weights


def vertex_row(
    vertex: Int[Array, "*batch 3"], cells: int, rows: int
) -> Int[Array, "*batch"]:
    """Return the table row of vertices: their own if there are enough, else by a hash.

    Args:
      vertex: Indices of vertices, [..., 3].
      cells: Number of cells along an axis.
      rows: Number of rows of the table. It need not be a power of two, unlike in the
        paper.

    Returns:
      Row indices, [...].

    References:
      Müller et al. 2022, arXiv:2201.05989, equation 4.
    """
    return _row([vertex[..., axis] for axis in range(3)], cells, rows)


def _row(vertex, cells, rows):
    """Same as `vertex_row`, with the three coordinates of a vertex as a list."""
    vertices = cells + 1
    if rows >= vertices**3:
        x, y, z = vertex
        return x + vertices * (y + vertices * z)
    x, y, z = (
        along.astype(jnp.uint32) * jnp.uint32(prime)
        for along, prime in zip(vertex, PRIMES, strict=True)
    )
    return ((x ^ y ^ z) % jnp.uint32(rows)).astype(jnp.int32)


def variation_at_random(
    spec: HashGridSpec, tables: Tables, key: Key[Array, ""], count: int
) -> Float[Array, ""]:
    """Estimate the mean of `total_variation` over levels from random vertices.

    The estimate is unbiased. A hashed level counts as well, with the rows of
    neighboring vertices, whatever else shares them. It sums squares, not norms, so
    constant features have gradient zero and not NaN.

    Args:
      spec: Settings of the grid.
      tables: Tables of the levels.
      key: PRNG key.
      count: Number of vertices per level.

    Returns:
      A scalar.
    """

    def of_level(key, table, cells):
        vertex = jax.random.randint(key, (count, 1, 3), 0, cells + 1, jnp.int32)
        # From the far end there is no next one: it is held against itself, and so many
        # of the differences are none.
        beyond = jnp.minimum(vertex + np.eye(3, dtype=np.int32), cells)
        here, there = (
            table[vertex_row(v, cells, len(table))] for v in (vertex, beyond)
        )
        return jnp.mean((there - here) ** 2) * ((cells + 1) / cells)

    keys = jax.random.split(key, spec.levels)
    levels = zip(keys, tables, spec.cells(), strict=True)
    return sum(of_level(*level) for level in levels) / spec.levels


def total_variation(
    table: Float[Array, "rows features"], cells: int
) -> Float[Array, ""]:
    """Compute the mean squared difference of neighboring vertices of a dense level.

    Args:
      table: Table of the level, [rows, features].
      cells: Number of cells along an axis.

    Returns:
      The mean over features and pairs of neighbors along an axis, a scalar.

    Raises:
      ValueError: If the level is hashed.
    """
    vertices = cells + 1
    if len(table) != vertices**3:
        raise ValueError(
            f"{len(table)} rows are not the {vertices}^3 vertices of {cells} cells: "
            "a hashed level has no neighbors"
        )
    grid = table.reshape(vertices, vertices, vertices, -1)
    # XLA:CPU adds floats to one sum one after the other, and squares them at that pace:
    # the squares of 97^3 rows of four take 35 ms, brought to one shape and summed by a
    # product 3 (27 and 14 with the gradient).
    squares = sum(_squared_differences(grid, axis) for axis in range(3))
    lines = squares.reshape(vertices**2, -1)
    total = jnp.sum(exact_product(lines, jnp.ones(lines.shape[1], lines.dtype)))
    return total / (3 * table.size * cells / vertices)


def _squared_differences(grid, axis):
    """Squared differences of each vertex and the next, with zeros at the end."""
    end = jnp.zeros_like(jax.lax.slice_in_dim(grid, 0, 1, axis=axis))
    squares = jnp.square(jnp.diff(grid, axis=axis))
    return jnp.concatenate([squares, end], axis)
