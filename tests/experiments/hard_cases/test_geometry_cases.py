"""Cameras, lenses and rays at their hard points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.hard_cases.geometry import CASES
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import distortion, rays
from tests.experiments.hard_cases import checks

SIZE = (640, 480)

pytestmark = pytest.mark.hard_cases
test_held = checks.by_case(CASES)


def some_camera(dtype):
    plain = cameras.look_at([1, -2, 3], [0, 0.2, 0], [0, 1, 0], 500.0, SIZE, dtype)
    return plain._replace(
        radial=np.asarray([0.1, -0.2, 0.05], dtype),
        tangential=np.asarray([1e-3, -2e-3], dtype),
    )


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
        return jnp.stack(rays.intersect_aabb(origin, direction, low, high))

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
