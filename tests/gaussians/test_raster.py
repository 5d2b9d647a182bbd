"""Chunks, ties, image edges, empty scenes, transformations, the CUDA lowering."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.splatting import binning, raster
from gaussians_jax.splatting.binning import Grid
from gaussians_jax.splatting.projection import Footprints
from gaussians_jax.splatting.raster_spec import GSPLAT
from tests.gaussians.shared import close, full, jitted, put
from tests.oracles import dense_splats

QUICK = dataclasses.replace(GSPLAT, batch=8, chunk=2)
composite = jitted(dense_splats.composite, static_argnums=(5, 6))
# Shared by the tests, so that they share programs: no whole number of tiles.
SIZE, COUNT = (21, 13), 40


def footprints_from(mean_px, sigma_px, angle, opacity, depth, dtype):
    """Footprints, and the conics of the same ellipses for the dense renderer."""
    cos, sin = np.cos(angle), np.sin(angle)
    one, two = np.square(sigma_px).T
    a, c = cos**2 * one + sin**2 * two, sin**2 * one + cos**2 * two
    b = cos * sin * (one - two)
    whitening = np.stack([np.sqrt(0.5 / a), b / a, np.sqrt(0.5 / (c - b * b / a))], 1)
    reach = 2 * np.log(np.maximum(opacity * 255, 1))[:, None]
    extent = np.sqrt(reach * np.stack([a, c], 1))
    fields = (mean_px, whitening, opacity, depth, extent)
    covariance = np.stack([a, b, b, c], -1).reshape(-1, 2, 2)
    return put(Footprints(*fields), dtype), np.linalg.inv(covariance).astype(dtype)


def some_footprints(rng, count, size, dtype, sigma=2.0):
    return footprints_from(
        rng.uniform(-0.1, 1.1, (count, 2)) * size,
        sigma * np.exp(rng.normal(0, 0.5, (count, 2))),
        rng.uniform(0, np.pi, count),
        rng.uniform(0.02, 1.0, count),
        rng.uniform(1, 9, count),
        dtype,
    )


@functools.partial(jax.jit, static_argnums=(2, 3))
def compiled_slopes(footprints, values, size, spec):
    def loss(mean_px, whitening, opacity, values):
        moved = footprints._replace(
            mean_px=mean_px, whitening=whitening, opacity=opacity
        )
        image, left = raster.rasterize(moved, values, size, spec)
        return jnp.sum(jnp.sin(3 * image)) + jnp.sum(left**2), (image, left)

    grads, image = jax.grad(loss, argnums=(0, 1, 2, 3), has_aux=True)(
        *footprints[:3], values
    )
    return image, grads


def image_and_slopes(*args):
    """Image and transmittance, and slopes in footprints and values, as NumPy's."""
    return jax.tree.map(np.asarray, compiled_slopes(*args))


@pytest.mark.full
def test_the_capacity_never_changes_image_or_gradient(float64, rng):
    footprints, _ = some_footprints(rng, COUNT, SIZE, "float64")
    # Three Gaussians cover every tile, 6 of them, more than a chunk of 5 pairs holds.
    whitening, extent = (np.array(x) for x in (footprints[1], footprints[4]))
    whitening[:3] *= [0.02, 1.0, 0.02]
    extent[:3] *= 50.0
    footprints = footprints._replace(whitening=whitening, extent_px=extent)
    values = rng.uniform(size=(COUNT, 3))
    whole = image_and_slopes(footprints, values, SIZE, QUICK)
    spec = dataclasses.replace(QUICK, capacity=5, kept_chunks=3)
    close(image_and_slopes(footprints, values, SIZE, spec), whole, 1e-12)
    # Slopes by each column of the whitening, against differences.
    for column in range(3):
        along = np.zeros_like(whitening)
        along[:, column] = rng.normal(size=COUNT) * whitening[:, column]

        def at(step, along=along):
            moved = footprints._replace(whitening=whitening + step * along)
            image, left = image_and_slopes(moved, values, SIZE, QUICK)[0]
            return np.sin(3 * image).sum() + (left**2).sum()

        slope = (at(1e-6) - at(-1e-6)) / 2e-6
        assert (whole[1][1] * along).sum() == pytest.approx(slope, rel=1e-5, abs=1e-6)


def check_against_dense(image, left, footprints, conics, values, size, dtype):
    expected = composite(
        footprints.mean_px,
        conics,
        footprints.opacity,
        footprints.depth,
        values,
        size,
        QUICK,
    )
    width, height = size
    assert image.shape == (height, width, 3)
    assert image.dtype == left.dtype == dtype
    tolerance = {"float32": 1e-5, "float64": 1e-13}[dtype]
    for result, wanted in zip((image, left), expected, strict=True):
        wanted = np.asarray(wanted).reshape(result.shape)
        np.testing.assert_allclose(result, wanted, atol=tolerance)


@pytest.mark.hard_cases
def test_tiles_cut_by_the_edge_equal_the_dense_compositor(dtype, rng):
    footprints, conics = some_footprints(rng, COUNT, SIZE, dtype)
    values = rng.normal(size=(COUNT, 3)).astype(dtype)  # of either sign
    (image, left), _ = image_and_slopes(footprints, values, SIZE, QUICK)
    check_against_dense(image, left, footprints, conics, values, SIZE, dtype)


@pytest.mark.full
def test_summed_weights_are_the_sums_of_the_dense_images_of_one_gaussian_each(
    dtype, rng
):
    footprints, conics = some_footprints(rng, COUNT, SIZE, dtype, sigma=6.0)
    spec = dataclasses.replace(QUICK, capacity=64)  # several chunks
    weights = jitted(raster.summed_weights, static_argnums=(1, 2))
    result = weights(footprints, SIZE, spec)
    each = np.eye(COUNT, dtype=dtype)
    images, _ = composite(
        footprints.mean_px, conics, *footprints[2:4], each, SIZE, QUICK
    )
    tolerance = {"float32": 1e-4, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(result, images.sum(0), rtol=tolerance, atol=tolerance)
    assert np.count_nonzero(result) > COUNT / 2


def rendered(mean_px, sigma_px, opacity, depth, values, dtype):
    """Image and what is left behind a few round Gaussians of one size.

    With rows that are not drawn they are `COUNT`, and go through the shared program.
    """
    count = len(mean_px)
    rows = np.minimum(np.arange(COUNT), count - 1)
    footprints, _ = footprints_from(
        np.array(mean_px)[rows], np.full((COUNT, 2), sigma_px), np.zeros(COUNT),
        np.full(COUNT, opacity), np.array(depth)[rows], dtype,
    )  # fmt: skip
    extent = np.where(np.arange(COUNT)[:, None] < count, footprints.extent_px, 0)
    footprints = footprints._replace(extent_px=extent)
    values = np.asarray(values, dtype)[rows]
    return image_and_slopes(footprints, values, SIZE, QUICK)[0]


@pytest.mark.hard_cases
def test_equal_depths_are_drawn_in_order_of_index(dtype):
    image, _ = rendered([[4.0, 4.0]] * 3, 3.0, 0.9, [2.0] * 3, np.eye(3), dtype)
    front, middle, back = image[4, 4]
    assert front > 5 * middle > 20 * back > 0


@pytest.mark.hard_cases
def test_two_opaque_gaussians_stop_a_pixel(dtype):
    """0.99 twice leaves 1e-4: float32 rounds it below the threshold, float64 above."""
    image, left = rendered(
        [[4.5, 4.5]] * 3, 100.0, 1.0, [1.0, 2.0, 3.0], np.eye(3), dtype
    )
    expected = {"float32": [0.99, 0, 0], "float64": [0.99, 0.0099, 0]}[dtype]
    np.testing.assert_allclose(image[4, 4], expected, atol=1e-6)
    np.testing.assert_allclose(image.sum(-1) + left, np.ones(SIZE[::-1]), atol=1e-6)


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    ("count", "dtype"),
    [(COUNT, "float32"), *full((0, "float32"), (COUNT, "float64"))],
    indirect=["dtype"],
)
def test_nothing_to_draw_leaves_the_background(count, dtype, rng):
    footprints, _ = some_footprints(rng, count, SIZE, dtype)
    footprints = footprints._replace(extent_px=np.zeros((count, 2), dtype))
    values = np.ones((count, 3), dtype)
    (image, left), grads = image_and_slopes(footprints, values, SIZE, QUICK)
    np.testing.assert_array_equal(image, np.zeros((*SIZE[::-1], 3)))
    np.testing.assert_array_equal(left, np.ones(SIZE[::-1]))
    assert not any(grad.any() for grad in grads)


@pytest.mark.hard_cases
def test_a_nan_value_shows_where_its_gaussian_is(dtype):
    image, left = rendered([[4.0, 4.0]], 0.8, 1.0, [1.0], [[np.nan, 1, 1]], dtype)
    assert np.isnan(image[4, 4, 0])
    assert not np.isnan(image[:, 8:]).any()
    assert not np.isnan(left).any()


@pytest.mark.full
def test_cameras_under_vmap_and_scan_equal_single_renders(float64, rng):
    footprints, _ = some_footprints(rng, COUNT, SIZE, "float64")
    values = rng.uniform(size=(COUNT, 3))
    shifts = rng.normal(size=(3, 1, 2))

    def one(shift):
        moved = footprints._replace(mean_px=footprints.mean_px + shift)
        return compiled_slopes(moved, values, SIZE, QUICK)

    single = [one(shift) for shift in shifts]
    single = jax.tree.map(lambda *leaves: np.stack(leaves), *single)
    close(jax.jit(jax.vmap(one))(shifts), single, 1e-13)
    scanned = jax.jit(lambda s: jax.lax.scan(lambda _, x: (None, one(x)), None, s)[1])
    close(scanned(shifts), single, 1e-13)


depth_order = jitted(binning.depth_order)


@pytest.mark.hard_cases
@pytest.mark.parametrize("count", [1000, *full(1, 70_000)])
def test_depth_order_is_a_stable_sort(count, dtype, rng):
    """70000 rows leave 15 bits a pass, so wide ranges take three."""
    rendered = rng.random(count) < 0.8
    for depth in (
        np.exp(rng.normal(0, 15, count)),
        rng.integers(-3, 3, count),
    ):
        depth = depth.astype(dtype)
        order = depth_order(depth, rendered.astype(np.int32))
        expected = np.argsort(np.where(rendered, depth, np.inf), kind="stable")
        np.testing.assert_array_equal(order, expected)


@pytest.mark.hard_cases
@pytest.mark.parametrize("tiles_per_side", [16, 1024], ids=["packed", "two keys"])
def test_pairs_are_sorted_by_tile_then_depth(tiles_per_side, dtype, rng):
    """2^20 tiles and 5003 ranks need 34 bits, so they take the sort of two arrays."""
    count, first = 5003, 7
    grid = Grid(8 * tiles_per_side, 8 * tiles_per_side, 8)
    rank = np.sort(rng.integers(first, first + count, count)).astype(np.int32)
    tile = rng.integers(0, min(grid.tiles, 300) + 1, count).astype(np.int32)
    tile = np.where(tile == 300, grid.tiles, tile)
    sort_pairs = jitted(binning.sort_pairs, static_argnums=(3, 4))
    isects = sort_pairs(tile, rank, np.int32(first), 20_000, grid)
    order = np.lexsort((rank, tile))
    pairs = int((tile < grid.tiles).sum())
    np.testing.assert_array_equal(isects.ranks[:pairs], rank[order][:pairs])
    numbers = np.bincount(tile, minlength=grid.tiles + 1)[:-1]
    np.testing.assert_array_equal(isects.ends - isects.starts, numbers)


def test_tiles_are_taken_from_the_longest_to_the_empty(rng):
    """2^18 tiles leave 14 bits of length: longer ones tie, and only empty ones end."""
    longest_first = jitted(binning.longest_first)
    for tiles, most in ((1, 5), (3000, 1), (3000, 1 << 19), (1 << 18, 1 << 19)):
        length = rng.integers(0, most, tiles, endpoint=True).astype(np.int32)
        length[rng.random(tiles) < 0.3] = 0
        length[-1] = most
        clipped = np.minimum(length, 2 ** (32 - max(1, (tiles - 1).bit_length())) - 1)
        expected = np.argsort(-clipped, kind="stable")
        np.testing.assert_array_equal(longest_first(length), expected)
    nothing = np.zeros(3000, np.int32)
    np.testing.assert_array_equal(longest_first(nothing), np.arange(3000))


@pytest.mark.hard_cases
def test_the_ellipse_test_keeps_every_tile_that_shows_a_gaussian(float64, rng):
    """And drops most of the others: needles' boxes are mostly empty."""
    size = (96, 64)
    footprints, conics = some_footprints(rng, 30, size, "float64", sigma=1.0)
    needles, sharp = footprints_from(
        rng.uniform(0, 1, (30, 2)) * size,
        np.tile([40.0, 0.6], (30, 1)),
        rng.uniform(0, np.pi, 30),
        rng.uniform(0.02, 1, 30),
        np.arange(30.0) + 1,
        "float64",
    )
    footprints = jax.tree.map(lambda *x: np.concatenate(x), footprints, needles)
    conics = np.concatenate([conics, sharp])
    grid = Grid(*size, 8)

    @jitted
    def first_intersections(footprints):
        rects = binning.tile_rects(footprints.mean_px, footprints.extent_px, grid)
        log_opacity = jnp.log(footprints.opacity)[:, None]
        table = [footprints.mean_px, footprints.whitening, log_opacity]
        cursor = binning.Cursor(jnp.int32(0), jnp.int32(0))
        every = jnp.ones(grid.tiles, bool)
        log_cut = float(np.log(1 / 255))
        isects, _ = binning.next_intersections(
            cursor, rects, jnp.concatenate(table, 1), every, log_cut, grid, 8192
        )
        return rects, isects

    rects, isects = first_intersections(footprints)
    pairs = np.zeros((60, grid.tiles), bool)
    for tile in range(grid.tiles):
        pairs[isects.ranks[isects.starts[tile] : isects.ends[tile]], tile] = True
    y, x = np.mgrid[:64, :96] + 0.5
    offset = np.stack([x, y], -1)[None] - np.asarray(footprints.mean_px)[:, None, None]
    exponent = np.einsum("nhwi,nij,nhwj->nhw", offset, np.asarray(conics), offset) / 2
    alpha = np.asarray(footprints.opacity)[:, None, None] * np.exp(-exponent)
    shows = (alpha >= 1 / 255).reshape(60, 8, 8, 12, 8).any((2, 4)).reshape(60, -1)
    np.testing.assert_array_equal(pairs, shows)
    assert shows.sum() < 0.5 * int(rects.tiles.sum())


@pytest.mark.full
def test_forward_and_backward_lower_for_cuda(dtype, rng):
    footprints, _ = some_footprints(rng, 50, (48, 32), dtype)
    values = np.ones((50, 4), dtype)
    traced = compiled_slopes.trace(footprints, values, (48, 32), QUICK)
    assert "stablehlo.while" in traced.lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.hard_cases
def test_more_pairs_than_an_int32_counts(dtype):
    """Totals wrap behind the chunk; the chunk and the one after it must not notice."""
    tiles, capacity = 1 << 14, 1 << 12
    count = np.full(300_000, tiles, np.int32)  # 4.9e9 pairs
    cursor = binning.Cursor(np.int32(0), np.int32(0))
    advance = jitted(binning.advance, static_argnums=2)
    for number in range(1, 7):
        cursor = advance(cursor, count, capacity)
        whole, part = divmod(number * capacity, tiles)
        assert (int(cursor.rank), int(cursor.skip)) == (whole, part)
    # From a cursor deep inside, too.
    cursor = advance(binning.Cursor(np.int32(200_000), np.int32(9)), count, capacity)
    assert (int(cursor.rank), int(cursor.skip)) == (200_000, 9 + capacity)
