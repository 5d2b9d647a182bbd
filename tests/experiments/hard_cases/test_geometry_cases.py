"""Cameras, lenses and rays at their hard points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.hard_cases.geometry import CASES
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import distortion, lie, rays
from tests.experiments.hard_cases import checks

SIZE = (640, 480)


pytestmark = pytest.mark.hard_cases


def test_values_are_held():
    checks.hold_values(CASES)


@checks.by_case(CASES)
def test_held(case, dtype):
    checks.hold(case, dtype)


@pytest.mark.full
def test_one_alone_is_held():
    checks.hold_alone(CASES)


@checks.each(CASES)
def test_the_textbook_form_is_caught(case):
    checks.catches_the_textbook(case)


def some_camera(dtype):
    plain = cameras.look_at([1, -2, 3], [0, 0.2, 0], [0, 1, 0], 500.0, SIZE, dtype)
    return plain._replace(
        radial=np.asarray([0.1, -0.2, 0.05], dtype),
        tangential=np.asarray([1e-3, -2e-3], dtype),
    )


def everything(camera, point, pixel):
    ends = jnp.full(3, -1, point.dtype), jnp.full(3, 1, point.dtype)
    seen, depth = cameras.project(camera, point)
    ray = rays.pixel_ray(camera, pixel)
    span = rays.box_span(ray.origin, ray.direction, *ends)
    distance = rays.distance_of_depth(camera, ray.direction, depth)
    return {
        "pixel": seen / 500,
        "depth": depth,
        "direction": ray.direction,
        "span": jnp.stack(span),
        "distance": distance,
    }


jitted = jax.jit(everything)
in_rows = jax.jit(jax.vmap(everything, (None, 0, 0)))


@pytest.mark.parametrize("kind", ["bfloat16", "float16"])
def test_cameras_of_half_precision_are_refused(kind):
    """bfloat16 holds a pixel of 1000 to 8 px; nothing computed from it is right."""
    wide, kind = some_camera("float32"), jnp.dtype(kind)
    half = jax.tree.map(lambda leaf: leaf.astype(kind), wide)
    point, pixel = np.zeros(3, kind), np.zeros(2, kind)
    wide, half, point, pixel = jax.tree.map(jnp.asarray, (wide, half, point, pixel))
    attempts = [
        lambda: cameras.project(half, point),
        lambda: cameras.project(wide, point),
        lambda: cameras.projectable(half, point),
        lambda: cameras.unproject(half, pixel),
        lambda: cameras.unproject(wide, pixel),
        lambda: rays.pixel_rays(half, (2, 2)),
        lambda: distortion.undistort(half.radial, half.tangential, pixel),
    ]
    for attempt in attempts:
        with pytest.raises(ValueError, match=f"is {kind}.*px.*cast it to float32"):
            attempt()


@pytest.mark.full
def test_float32_stays_float32_with_x64_on_and_every_way_of_calling_agrees():
    args = (
        some_camera("float32"),
        np.float32([0.2, 0.1, -0.3]),
        np.float32([300.0, 100.0]),
    )
    eager = everything(*jax.tree.map(jnp.asarray, args))
    with jax.enable_x64(True):
        wide = jitted(*args)
        rows = in_rows(args[0], *(np.stack([x, x]) for x in args[1:]))
    for name, value in eager.items():
        assert wide[name].dtype == rows[name].dtype == jnp.float32, name
        for other in (wide[name], np.asarray(rows[name])[1]):
            np.testing.assert_allclose(other, value, rtol=2e-6, atol=1e-6)


def test_projection_is_continuous_where_the_depth_is_held(dtype):
    """Adjacent depths on either side of a slope of 1e4."""
    camera = some_camera(dtype)._replace(
        camera_from_world=np.eye(3, dtype=dtype),
        position=np.zeros(3, dtype),
        radial=np.zeros(3, dtype),
        tangential=np.zeros(2, dtype),
    )
    edge = np.asarray(1 / cameras.MAX_SLOPE, dtype)
    depths = [np.nextafter(edge, np.asarray(x, dtype)) for x in (0, 1)]
    points = np.asarray([[1, -0.5, depth] for depth in depths], dtype)
    project = jax.jit(jax.vmap(cameras.project, (None, 0)))
    pixels = np.asarray(project(camera, points)[0])
    bound = 8 * np.finfo(dtype).eps * np.max(abs(pixels))
    assert np.max(abs(pixels[1] - pixels[0])) < bound


@jax.jit
def span_and_slopes(*args):
    def span(direction, origin, low, high):
        return jnp.stack(rays.box_span(origin, direction, low, high))

    return span(*args), jax.jacrev(span, argnums=(0, 1, 2, 3))(*args)


SLANTS = [0, 1e-38, 1e-30, 1e-20, 1e-13, 1e-11, 1e-6]


@pytest.mark.parametrize("side", [-1, 1])
def test_slopes_of_a_box_span_are_finite_for_every_slant(side, dtype):
    """In direction, origin and box; a slope over slant² overflows at 1e-20."""
    for slant in SLANTS:
        args = [[1, side * slant, 0], [-3, 0.5, 0.25], [-1] * 3, [1] * 3]
        span, slopes = span_and_slopes(*(np.asarray(arg, dtype) for arg in args))
        assert np.allclose(span, [2, 4], rtol=1e-5), slant
        for slope in slopes:
            assert np.all(np.isfinite(slope)), slant


numbers = st.floats(-1, 1, width=32)
triples = st.tuples(numbers, numbers, numbers)
axioms = settings(max_examples=40, deadline=None, derandomize=True, database=None)


@jax.jit
def _views(camera, point, angular, linear):
    """One point, seen by one camera; then both moved, and both made larger."""
    rotation, shift = lie.exp_se3(angular, linear)
    moved = camera._replace(
        camera_from_world=camera.camera_from_world @ rotation.T,
        position=rotation @ camera.position + shift,
    )
    larger = camera._replace(position=4 * camera.position)
    seen, depth = cameras.project(camera, point)
    along, found = cameras.unproject(camera, seen)
    straight = point - camera.position
    return {
        "moved": cameras.project(moved, rotation @ point + shift)[0] - seen,
        "larger": cameras.project(larger, 4 * point)[0] - seen,
        "back": 500 * (along - straight / jnp.sqrt(jnp.sum(straight**2))),
        "found": 1.0 - found.astype(depth.dtype),
        "depth": depth - rays.depth_per_distance(camera, straight),
    }


@pytest.mark.full
@pytest.mark.parametrize("kind", ["float32", "float64"])
@axioms
@given(point=triples, angular=triples, linear=triples)
def test_pixels_know_neither_the_world_s_frame_nor_its_unit(
    kind, point, angular, linear
):
    with jax.enable_x64(kind == "float64"):
        args = [np.asarray(x, kind) for x in (point, angular, linear)]
        for name, rest in _views(some_camera(kind), *args).items():
            # px; pixels to 600 and points two units away, over a few operations
            assert (
                np.max(abs(np.asarray(rest)))
                < {"float32": 2e-3, "float64": 5e-12}[kind]
            ), name
