"""Multi-resolution feature grids, dense or hashed.

Functions take one point. Use `jax.vmap` for several. A network on grid features learns
a scene in a tenth of the steps that it needs on a positional encoding. On a CPU, XLA's
gather and scatter dominate the cost. They take 3.9 and 2.4 ns for a row of 2 floats and
19 and 66 ns for a row of 16, so the default is many levels of few features.
"""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.geometry.precision import exact_product

# Factors of the coordinates of a vertex in the hash (Müller et al. 2022, equation 4).
PRIMES = (1, 2654435761, 805459861)
FIRST = 1e-4  # half-width of the initial features, as published
MAX_CELLS = 2**20  # along an axis, where float32 resolves 1/8 of a cell

Tables = tuple[Float[Array, "_ features"], ...]


@dataclasses.dataclass(frozen=True)
class HashGridSpec:
    """Settings of a multi-resolution hash grid over a box.

    Müller et al. 2022, arXiv:2201.05989, section 3. Each level is finer than the
    previous one by the same factor. A level with at most `rows` vertices has a row for
    each. Vertices of finer levels share rows by a hash, and the network resolves
    collisions. The box is [-half_side, half_side]^3 in units of the field. Space
    outside is contracted into twice the box (Barron et al. 2022, arXiv:2111.12077,
    equation 10, in the maximum norm). If `contract` is false, a point outside has the
    features of the nearest point of the box.
    """

    levels: int = 7
    features: int = 2  # floats per row
    coarsest: int = 16  # cells along an axis of the first level
    finest: int = 256  # cells along an axis of the last level
    rows: int = 2**16  # maximum per level
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
            raise ValueError(
                f"a hash grid has 3 dimensions, but the points have {dimensions}"
            )
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


def init(
    spec: HashGridSpec, key: Key[Array, ""], dtype: DTypeLike = jnp.float32
) -> Tables:
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
    by_level = [
        level_features(table, place, cells)
        for table, cells in zip(tables, spec.cells(), strict=True)
    ]
    if window is not None:
        by_level = [part * window[level] for level, part in enumerate(by_level)]
    return jnp.concatenate(by_level)


def unit_place(
    point: Float[Array, "3"], half_side: float, is_contracted: bool
) -> Float[Array, "3"]:
    """Map a point to [0, 1]^3 over the box, or over its contracted surroundings.

    Args:
      point: Point in units of the field, [3].
      half_side: Half side of the box in units of the field.
      is_contracted: True to contract space, False to clamp to the box.

    Returns:
      The position in the unit cube, [3].
    """
    coordinates = point / half_side
    if is_contracted:
        return (contract(coordinates) + 2) / 4
    return (jnp.clip(coordinates, -1, 1) + 1) / 2


def contract(point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Contract all of space into the cube [-2, 2]^3. The cube [-1, 1]^3 is unchanged.

    This is (2 - 1/|x|) x/|x| for |x| > 1 in the maximum norm, which maps cubes to
    cubes. Its gradient is continuous along a ray from the center, and undefined at
    infinity.

    Args:
      point: Point in units of the half side of the box, [3].

    Returns:
      The contracted point, [3].

    References:
      Barron et al. 2022 (mip-NeRF 360), arXiv:2111.12077, equation 10.
    """
    # Clamped, so that the unused branch does not divide by zero.
    norm = jnp.max(jnp.abs(point))
    divisor = jnp.maximum(norm, 1)
    return jnp.where(norm > 1, (2 - 1 / divisor) * (point / divisor), point)


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


def _between_vertices_jvp(cells, stride, primals, tangents):
    # Values are computed as a sum and derivatives as a matrix product. Measured on one
    # core in a loop of steps, in ns per point, with 24,576 points and 7 levels of 2
    # features:
    #                                     sum   product
    #   features                           72       229
    #   gradient by tables                514       499
    #   gradient by positions            1610       386
    #   gradient by both                 2124       651
    # A custom operation over all points, which scatters its gradient by tables corner
    # after corner, takes 195 ns on its own instead of 480. But complete steps and
    # frames of `d-nerf-grid-small` then take a tenth longer.
    nonzero = [not isinstance(tangent, SymbolicZero) for tangent in tangents]

    def product(*inputs):
        arguments = iter(inputs)
        table, place = (
            next(arguments) if flag else primal
            for flag, primal in zip(nonzero, primals, strict=True)
        )
        rows, weights = _vertices_around(place, cells, stride, len(table))
        # At its default precision a GPU may round factors to ten bits.
        return exact_product(jnp.stack(weights), table[jnp.stack(rows)])

    return jax.jvp(
        product,
        list(itertools.compress(primals, nonzero)),
        list(itertools.compress(tangents, nonzero)),
    )


_between_vertices.defjvp(_between_vertices_jvp, symbolic_zeros=True)


def _vertices_around(place, cells, stride, rows):
    """Return rows and trilinear weights of the eight vertices around a position.

    Coordinates are separate scalars, because arrays of three take twice the time.
    """
    wide_cells = cells // stride
    coordinates = [x * wide_cells for x in place]
    # The position 1 belongs to the last cell.
    low = [jnp.clip(jnp.floor(x), 0, wide_cells - 1) for x in coordinates]
    fractions = [x - corner for x, corner in zip(coordinates, low, strict=True)]
    axis_weights = [(1 - fraction, fraction) for fraction in fractions]
    corner = [x.astype(jnp.int32) for x in low]
    vertex_rows, weights = [], []
    for offset in itertools.product((0, 1), repeat=3):
        vertex = [stride * (x + step) for x, step in zip(corner, offset, strict=True)]
        vertex_rows.append(_row(vertex, cells, rows))
        x, y, z = offset
        weights.append(axis_weights[0][x] * axis_weights[1][y] * axis_weights[2][z])
    return vertex_rows, weights


def vertex_row(
    vertex: Int[Array, "*batch 3"], cells: int, rows: int
) -> Int[Array, "*batch"]:
    """Return the table rows of vertices, by index if there are enough rows or by hash.

    Args:
      vertex: Indices of vertices, [..., 3].
      cells: Number of cells along an axis.
      rows: Number of rows of the table. Unlike in the paper it need not be a power of
        two.

    Returns:
      Row indices, [...].

    References:
      Müller et al. 2022, arXiv:2201.05989, equation 4.
    """
    return _row([vertex[..., axis] for axis in range(3)], cells, rows)


def _row(vertex, cells, rows):
    """Return the row of a vertex, given as a list of three coordinates."""
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

    The estimate is unbiased. Hashed levels contribute as well, by the rows of
    neighboring vertices, whether or not other vertices share them. Squares are summed
    instead of norms, so that the gradient of constant features is zero and not NaN.

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
        # The last vertex along an axis is compared with itself. The factor corrects the
        # mean for these zeros.
        neighbor = jnp.minimum(vertex + np.eye(3, dtype=np.int32), cells)
        first, second = (
            table[vertex_row(v, cells, len(table))] for v in (vertex, neighbor)
        )
        return jnp.mean((second - first) ** 2) * ((cells + 1) / cells)

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
            f"a table of {len(table)} rows is not dense for {cells} cells, which have "
            f"{vertices}^3 vertices; use variation_at_random for hashed levels"
        )
    grid = table.reshape(vertices, vertices, vertices, -1)
    # XLA:CPU does not vectorize the sum of all squares. With 97^3 rows of four it takes
    # 35 ms. This product takes 3 ms (27 and 14 with the gradient).
    squares = sum(_squared_differences(grid, axis) for axis in range(3))
    lines = squares.reshape(vertices**2, -1)
    total = jnp.sum(exact_product(lines, jnp.ones(lines.shape[1], lines.dtype)))
    return total / (3 * table.size * cells / vertices)


def _squared_differences(grid, axis):
    """Return squared differences of neighboring vertices, with zeros at the end."""
    end = jnp.zeros_like(jax.lax.slice_in_dim(grid, 0, 1, axis=axis))
    squares = jnp.square(jnp.diff(grid, axis=axis))
    return jnp.concatenate([squares, end], axis)
