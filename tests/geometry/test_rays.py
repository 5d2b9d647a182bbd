"""Pixels to rays and distances along them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import rays

SIZE = (8, 6)

pixel_rays = jax.jit(lambda camera: rays.pixel_rays(camera, SIZE))
intersect_aabb = jax.jit(rays.intersect_aabb)
end_slope = jax.jit(
    jax.grad(
        lambda along, place, *box: jnp.clip(
            rays.intersect_aabb(place, along, *box)[1], 0, 9
        )
    )
)
seen_at = jax.jit(
    jax.vmap(jax.vmap(cameras.project, (None, 0)), (None, 0)),
)


def make_camera(dtype, **changes):
    plain = cameras.look_at([0.3, 0.2, -4], [0, 0, 0], [0, 1, 0], 9.0, SIZE, dtype)
    return jax.tree.map(jnp.asarray, plain._replace(**changes))


def test_rays_go_through_pixel_centers(dtype):
    camera = make_camera(dtype)
    grid = jax.tree.map(np.asarray, pixel_rays(camera))
    assert grid.direction.shape == (6, 8, 3)
    assert grid.direction.dtype == dtype
    assert np.all(grid.valid)
    np.testing.assert_allclose(np.linalg.norm(grid.direction, axis=-1), 1, atol=1e-6)
    back, _ = seen_at(camera, grid.origin + 2 * grid.direction)
    columns, rows = np.meshgrid(np.arange(8) + 0.5, np.arange(6) + 0.5)
    np.testing.assert_allclose(back, np.stack([columns, rows], axis=-1), atol=2e-5)


@pytest.mark.hard_cases
def test_pixels_without_a_ray_are_marked(dtype):
    """The corners of a strong barrel lens; no NaN and no made-up neighbor there."""
    camera = make_camera(dtype, radial=np.asarray([-0.8, 0, 0], dtype))
    grid = pixel_rays(camera)
    valid = np.asarray(grid.valid)
    assert valid[3, 4]
    assert not valid[0, 0]
    assert 0.5 < np.mean(valid) < 0.95
    assert np.all(np.isfinite(grid.direction))
    # r(1 - 0.8 r²) folds at r² = 1/2.4, where it has two thirds of r
    columns, rows = np.meshgrid(np.arange(8) + 0.5, np.arange(6) + 0.5)
    radius = np.hypot(columns - 4, rows - 3) / 9
    assert np.array_equal(valid, radius < 2 / 3 * np.sqrt(1 / 2.4))


@jax.jit
def depth_and_back(camera, direction, distance):
    depth = rays.depth_of_distance(camera, direction, distance)
    return depth, rays.distance_of_depth(camera, direction, depth)


def test_distance_and_depth_convert_both_ways(dtype):
    camera = make_camera(dtype)
    grid = jax.tree.map(np.asarray, pixel_rays(camera))
    distance = np.full((6, 8), 3, dtype)
    depth, again = depth_and_back(camera, grid.direction, distance)
    _, projected = seen_at(camera, grid.origin + 3 * grid.direction)
    np.testing.assert_allclose(depth, projected, rtol=1e-5)
    np.testing.assert_allclose(again, distance, rtol=1e-6)


def box_by_sampling(origin, direction, low, high):
    distances = np.linspace(0, 10, 200_001)
    points = origin + distances[:, None] * direction
    inside = np.all((points >= low) & (points <= high), axis=-1)
    return distances[inside]


@pytest.mark.parametrize("start", [(-3.0, 0.1, 0.2), (0.1, 0.0, -0.3), (0.0, 1.0, 0.0)])
def test_the_span_in_a_box_is_where_samples_are_inside(start, dtype, rng):
    low, high = np.array([-1, -0.5, -1]), np.array([1, 1, 0.7])
    for _ in range(20):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        inside = box_by_sampling(np.array(start), direction, low, high)
        enter, leave = intersect_aabb(
            *(np.asarray(x, dtype) for x in (start, direction, low, high))
        )
        if len(inside) > 1:
            np.testing.assert_allclose([enter, leave], inside[[0, -1]], atol=2e-4)
        else:
            assert leave < enter + 2e-4


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    ("origin", "direction", "span"),
    [
        ((-3, 0, 0), (1, 0, 0), (2, 4)),
        ((-3, 1, 0), (1, 0, 0), (2, 4)),  # slides along a face: 0/0 in the plain form
        ((-3, 2, 0), (1, 0, 0), None),
        ((0, 0, 0), (0, 0, 1), (0, 1)),
        ((3, 0, 0), (1, 0, 0), None),
    ],
)
def test_the_span_in_a_box_of_axis_parallel_rays(origin, direction, span, dtype):
    place, along, low, high = (
        np.asarray(x, dtype) for x in (origin, direction, [-1] * 3, [1] * 3)
    )
    enter, leave = intersect_aabb(place, along, low, high)
    if span is None:
        assert not enter < leave
    else:
        assert (enter, leave) == span
    assert np.all(np.isfinite(end_slope(along, place, low, high)))
