"""Cameras, rays, and what is seen along them: what they keep and cannot depend on.

Bounds count roundings. A pixel of a lens with focal length f is known to the residual
of its inverse, 32 eps (1 + |slopes|), times f; positions of up to 20 units in front of
a camera at a depth d round to 20 eps f / d. A weight is the exponential of a sum of n
depths, each rounded, times a number below one: the derivative of exp(-x) is nowhere
more than 1 / x, so a weight is off by n eps, whatever the depths.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import distortion, rays
from nerfies_jax.radiance import compositing, sampling
from tests.hard_cases import properties
from tests.hard_cases.properties import cast, close, compiled, eps, norm, same

pytestmark = [pytest.mark.hard_cases, pytest.mark.full]
SAMPLES = 8
PINHOLE, LENS = properties.cameras(), properties.cameras(lens=True)
SLOPES = properties.many(2, -0.8, 0.8)  # 39 degrees off the axis each way
DEPTH = properties.magnitudes(0.1, 100).filter(lambda depth: depth > 0)
DEPTHS, DISTANCES = properties.optical_depths(), properties.distances()
COLOURS = properties.many((SAMPLES, 3), 0, 1)


def pixel_error(camera, dtype, slopes, depth):
    """px. See above; ten roundings of a pixel itself."""
    focal = 2 * float(camera.focal_px)  # times the aspect
    world = 1 + norm(camera.position) + depth * (1 + norm(slopes))
    return eps(dtype) * (focal * (64 * (1 + norm(slopes)) + 4 * world / depth) + 300)


@compiled
def out_and_back(camera, slopes, depth, other):
    """A point given by slopes and depth in the camera; its pixel; that pixel's ray.

    And the same from another pixel on, at the same depth: the first of each pair is
    the point's, the second the other pixel's.
    """
    in_camera = depth * jnp.concatenate([slopes, jnp.ones_like(slopes[:1])])
    point = camera.position + in_camera @ camera.camera_from_world
    pixel, found = cameras.project(camera, point)

    def back(pixel):
        ray = rays.pixel_ray(camera, pixel)
        distance = rays.distance_of_depth(camera, ray.direction, depth)
        again = rays.point_at(ray.origin, ray.direction, distance)
        at_pixel, at_depth = cameras.project(camera, again)
        return ray, again, at_pixel, at_depth, cameras.projectable(camera, again)

    ray, again, pixel_again, depth_again, projectable = jax.vmap(back)(
        jnp.stack([pixel, other])
    )
    return {
        "point": point,
        "pixel": pixel,
        "depth": found,
        "ray": ray,
        "again": again,
        "pixel again": pixel_again,
        "depth again": depth_again,
        "projectable": projectable,
        "one to one": distortion.one_to_one(camera.radial, camera.tangential, slopes),
        "stretch": jax.jacfwd(distortion.distort, argnums=2)(
            camera.radial, camera.tangential, slopes
        ),
    }


@given(camera=LENS, slopes=SLOPES, depth=DEPTH)
def test_points_and_pixels_are_inverse_inside_the_lens(camera, slopes, depth, dtype):
    """Where the lens is one to one and not about to fold."""
    found = out_and_back(*cast(dtype, camera, slopes, depth, np.zeros(2)))
    stretch = np.linalg.svd(np.asarray(found["stretch"], np.float64), compute_uv=False)
    assume(bool(found["one to one"]) and stretch[-1] > 0.05)
    bound = pixel_error(camera, dtype, slopes, depth)
    assert found["ray"].valid[0]
    assert found["projectable"][0]
    world = norm(camera.position) + 2 * depth
    close(found["depth"], depth, 16 * eps(dtype) * (1 + world))
    close(norm(found["ray"].direction[0]), 1, 8 * eps(dtype))
    close(found["pixel again"][0], found["pixel"], 4 * bound)
    # px to slopes by the inverse of the lens, and slopes to units by the depth
    bound = 2 * bound / camera.focal_px / stretch[-1] * depth
    close(found["again"][0], found["point"], bound)


project = compiled(cameras.project)


span = compiled(rays.box_span)


@given(
    origin=properties.many(3, -3, 3).map(properties.rounded),
    direction=properties.directions().map(properties.rounded),
    corner=properties.many(3, -1, 0).map(properties.rounded),
    size=properties.many(3, 0, 2).map(properties.rounded),
    factor=st.sampled_from([2.0**-8, 0.5, 4.0]),
)
def test_a_box_is_met_in_order_and_scales_with_the_world(
    origin, direction, corner, size, factor, dtype
):
    """Both ends are on the box's surface, or the ray starts inside, or it misses."""
    low, high = corner, corner + size
    origin, direction, low, high = cast(dtype, origin, direction, low, high)
    enter, leave = span(origin, direction, low, high)
    same(
        span(origin * factor, direction, low * factor, high * factor),
        (enter * factor, leave * factor),
    )
    assert enter >= 0
    assert not np.isnan(leave)
    if enter < leave:
        for distance in (enter, leave):
            point = np.asarray(origin + distance * direction, np.float64)
            # the distance is off by eps of itself
            slack = 8 * eps(dtype) * (8 + float(distance))
            assert np.all(point >= np.asarray(low) - slack)
            assert np.all(point <= np.asarray(high) + slack)


weights = compiled(compositing.weights)
SUM = 4 * SAMPLES  # eps: n roundings of the sum of depths, n of the sum of weights


@given(depth=DEPTHS, empty=st.integers(0, SAMPLES))
def test_weights_are_shares_of_the_light(depth, empty, dtype):
    """Not negative, at most one in all, what is left is exp of minus the whole depth.

    Empty samples, anywhere, weigh nothing and change nothing.
    """
    found = np.asarray(weights(cast(dtype, depth)), np.float64)
    depth = np.asarray(cast(dtype, depth), np.float64)
    assert np.all(found >= 0)
    assert found.sum() <= 1 + SUM * eps(dtype)
    close(found.sum(), -np.expm1(-depth.sum()), SUM * eps(dtype))
    more = np.insert(np.append(depth, np.zeros(SAMPLES - 1)), empty, 0.0)
    among = np.asarray(weights(cast(dtype, more)), np.float64)
    # other lengths are summed in another order
    close(np.delete(among, empty)[:SAMPLES], found, SUM * eps(dtype))
    same(np.delete(among, empty)[SAMPLES:], np.zeros(SAMPLES - 1))
    assert among[empty] == 0


@compiled
def seen(depth, colours, distances, background):
    return compositing.composite(
        compositing.weights(depth), colours, distances, background
    )


@given(
    depth=DEPTHS,
    colours=COLOURS,
    distances_=DISTANCES,
    background=properties.many(3, 0, 1),
    shift=properties.numbers(0, 10),
)
def test_what_a_ray_sees_lies_among_what_is_there(
    depth, colours, distances_, background, shift, dtype
):
    inputs = cast(dtype, depth, colours, distances_, background)
    found = seen(*inputs)
    rounding = SUM * eps(dtype)
    there = np.vstack([inputs[1], inputs[3][None]])
    assert np.all(found.colour >= there.min(axis=0) - rounding)
    assert np.all(found.colour <= there.max(axis=0) + rounding)
    near, far = float(inputs[2][0]), float(inputs[2][-1])
    # Divided by an opacity of at least EMPTY_BELOW, which is itself off by n eps.
    slack = rounding * far / compositing.EMPTY_BELOW
    assert near - slack <= found.distance <= far + slack
    assert near <= found.median_distance <= far
    later = seen(inputs[0], inputs[1], cast(dtype, distances_ + shift), inputs[3])
    close(
        later.distance, float(found.distance) + shift, 12 * slack / far * (far + shift)
    )


stratified = compiled(sampling.stratified, static_argnums=(3, 4))
from_weights = compiled(sampling.from_weights, static_argnums=3)
refine = compiled(sampling.refine, static_argnums=3)
SEEDS = st.integers(0, 2**31 - 1)
ANY_WEIGHT = st.one_of(
    properties.magnitudes(1e-44, 1e-30), properties.magnitudes(1e-30, 1e30)
)


@pytest.mark.parametrize("ratio", [1.0, 1 + 1e-6, 10.0, 1e4, 1e7, 1e12])
def test_the_last_sample_in_disparity_is_the_far_end(ratio, dtype):
    """Written 1 / near + (1 / far - 1 / near) share it was 18 % short at 1e7 nears."""
    near, far = cast(dtype, np.array(1e-3), np.array(1e-3 * ratio))
    found = np.asarray(stratified(None, near, far, 64, "disparity"), np.float64)
    share = np.linspace(0, 1, 64)
    low, high = float(near), float(far)
    exact = 1 / ((1 - share) / low + share / high)
    # share is rounded, and 1 - share magnifies that up to 63 times before the last
    close(found, exact, 64 * eps(dtype) * exact)
    assert np.all(np.diff(found) >= 0)


@given(
    seed=SEEDS,
    edges=DISTANCES,
    weight=st.lists(ANY_WEIGHT, min_size=SAMPLES - 1, max_size=SAMPLES - 1),
    power=st.integers(-30, 30),
)
def test_fine_samples_are_sorted_in_range_and_where_weights_are(
    seed, edges, weight, power, dtype
):
    """For any weights; and a common factor of all weights does not matter."""
    edges, weight = cast(dtype, edges, np.array(weight))
    key = jax.random.key(seed)
    found = from_weights(key, edges, weight, 16)
    assert np.all(np.diff(found) >= 0)
    assert np.all((found >= edges[0]) & (found <= edges[-1]))
    largest = float(weight.max())
    tiny = float(np.finfo(dtype).tiny)
    scaled = weight * weight.dtype.type(2.0**power)
    if min(largest, largest * 2.0**power) > tiny and np.all(
        (scaled > tiny) | (weight == 0)
    ):
        same(from_weights(key, edges, scaled, 16), found)
    all_ = refine(key, edges, np.append(weight, weight[-1]), 16)
    assert np.all(np.diff(all_) >= 0)
    assert np.all(np.isin(edges, all_))
