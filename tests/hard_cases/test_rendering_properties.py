"""What a picture of Gaussians must not depend on, and what it must keep.

Bounds. Where a footprint is off by δ px, its alpha is off by at most 1.1 δ: exp(-u²) is
nowhere steeper than 0.86, and u grows by at most 1 / sqrt(2 * 0.3 px²) per px. Each of
the Gaussians changes a pixel's colour by at most that. World coordinates of up to 30
units are rounded to 15 eps each and stand for focal / depth = 40 / 3 px a unit, so δ is
a few times 200 eps px, and needles, turned by a few eps, move less at the ends that are
in the picture.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians_jax import rendering
from gaussians_jax.raster_spec import RasterSpec
from tests.hard_cases import properties
from tests.hard_cases.properties import (
    GAUSSIANS,
    PICTURE,
    cast,
    close,
    compiled,
    eps,
    same,
)

pytestmark = pytest.mark.full
# Without jumps: at the cut a Gaussian's edge is as faint as rounding.
SMOOTH = RasterSpec(
    alpha_threshold=1e-6, transmittance_threshold=0.0, near=1e-9, far=1e12, chunk=2
)
OTHERWISE_CUT = dataclasses.replace(SMOOTH, tile=4, capacity=5)
ROWS = st.integers(0, GAUSSIANS - 1)
SCENE = properties.gaussians()
COLOURS = properties.many((GAUSSIANS, 3), 0, 1)
CAMERA = properties.cameras().map(
    lambda camera: camera._replace(camera_from_world=np.eye(3), position=np.zeros(3))
)
# What has its own program of seconds to compile, and no bound that float64 tightens.
in_float32 = pytest.mark.parametrize("dtype", ["float32"], indirect=True)


def picture_error(dtype):
    return 1.1 * GAUSSIANS * 200 * eps(dtype)


def drawn(gaussians, colours, camera, spec):
    """Colour, alpha, and depth times alpha."""
    frame = rendering.render(gaussians, colours, camera, PICTURE, spec).rendering
    return frame.colour, frame.alpha, frame.depth * frame.alpha


draw = compiled(drawn, static_argnums=3)


@compiled
def slopes(gaussians, colours, camera, weight):
    """A weighted sum of the smooth picture, the picture, and the gradient of the sum.

    It also draws wherever only the smooth picture is asked for: one program to compile.
    """

    def loss(*inputs):
        picture = drawn(*inputs, SMOOTH)
        return jnp.sum(weight * picture[0]), picture

    inputs = gaussians, colours, camera
    return jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)(*inputs)


def smooth(scene, colours, camera):
    weight = np.zeros((PICTURE[1], 1, 3), scene.mean.dtype)
    return slopes(scene, colours, camera, weight)[0][1]


def replaced(gaussians, row, **fields):
    """One row with other values."""
    changed = {name: getattr(gaussians, name).copy() for name in fields}
    for name, value in fields.items():
        changed[name][row] = value
    return gaussians._replace(**changed)


@given(scene=SCENE, colours=COLOURS, camera=CAMERA, motion=properties.motions())
def test_a_rigid_motion_of_world_and_camera_cannot_be_seen(
    scene, colours, camera, motion, dtype
):
    here = smooth(*cast(dtype, scene, colours, camera))
    world = properties.moved(scene, motion)
    there = smooth(
        *cast(dtype, world, colours, properties.moved_camera(camera, motion))
    )
    for found, expected, largest in zip(there, here, (1, 1, 5), strict=True):
        close(found, expected, largest * picture_error(dtype))


@given(
    scene=SCENE,
    colours=COLOURS,
    camera=CAMERA,
    order=st.permutations(range(GAUSSIANS)),
)
def test_the_order_of_the_rows_does_not_matter(scene, colours, camera, order, dtype):
    """For Gaussians at one depth it does, by design: ties go by row."""
    scene, colours, camera = cast(dtype, scene, colours, camera)
    order = np.array(order)
    shuffled = jax.tree.map(lambda leaf: leaf[order], scene)
    here = smooth(scene, colours, camera)
    same(smooth(shuffled, colours[order], camera), here)


PLACES = {
    "behind": lambda mean: mean * [1, 1, -1],
    "beside": lambda mean: mean + np.array([1000, 0, 0]),
    "above": lambda mean: mean - [0, 1000, 0],
    "in the camera": lambda mean: mean * 0,
    "in its plane": lambda mean: mean * [1, 1, 0],
    "too far": lambda mean: mean * 1e12,
    "nowhere": lambda mean: mean * np.nan,
}


@settings(max_examples=40)
@given(
    scene=SCENE,
    colours=COLOURS,
    camera=CAMERA,
    row=ROWS,
    place=st.sampled_from(sorted(PLACES)),
)
def test_what_is_out_of_sight_is_as_if_absent_and_has_no_slope(
    scene, colours, camera, row, place, dtype
):
    away = replaced(scene, row, mean=PLACES[place](scene.mean[row]))
    away, colours, camera = cast(dtype, away, colours, camera)
    weight = np.ones((PICTURE[1], 1, 3), dtype)
    (_, here), gradient = slopes(away, colours, camera, weight)
    # Absent: the rows behind it move up, and a clear one fills the end.
    others = np.array([*(k for k in range(GAUSSIANS) if k != row), row])
    rest = jax.tree.map(lambda leaf: leaf[others], away)
    rest = replaced(rest, GAUSSIANS - 1, opacity=0)
    same(here, smooth(rest, colours[others], camera))
    for leaf in jax.tree.leaves(gradient[:2]):
        same(leaf[row], np.zeros_like(leaf[row]))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


@in_float32
@given(scene=SCENE, colours=COLOURS, camera=CAMERA)
def test_tiles_and_chunks_do_not_show(scene, colours, camera, dtype):
    inputs = cast(dtype, scene, colours, camera)
    here, there = smooth(*inputs), draw(*inputs, OTHERWISE_CUT)
    close(there[0], here[0], picture_error(dtype))
    close(there[1], here[1], picture_error(dtype))


@given(
    scene=SCENE,
    colours=COLOURS,
    camera=CAMERA,
    motion=properties.motions(),
    weight=properties.many((PICTURE[1], 1, 3), -1, 1),
)
def test_slopes_know_the_symmetries_of_the_picture(
    scene, colours, camera, motion, weight, dtype
):
    """What cannot be seen has no slope: shifts, scales, lengths of quaternions.

    And the slope in the colours, of which the picture is linear, returns the picture.
    """
    scene = properties.moved(scene, motion)
    camera = properties.moved_camera(camera, motion)
    inputs = cast(dtype, scene, colours, camera, weight)
    (value, _), gradient = slopes(*inputs)
    scene, colours, camera = cast("float64", *inputs[:3])
    of_scene, of_colours, of_camera = cast("float64", gradient)

    def vanishes(terms, axis, rounded):
        """A sum of slopes is zero up to the rounding of what they are made of."""
        bound = 100 * eps(dtype) * np.sum(np.abs(rounded))
        close(np.sum(terms, axis=axis), 0, bound)

    along = of_scene.scale * scene.scale
    vanishes(np.vstack([of_scene.mean, of_camera.position]), 0, of_scene.mean)
    # A slope of a rotation is a difference of slopes of shapes.
    vanishes(of_scene.quaternion * scene.quaternion, 1, along)
    towards = of_scene.mean * (scene.mean - camera.position)
    vanishes(np.concatenate([towards, along], axis=1), None, towards)
    vanishes([np.sum(of_colours * colours), -value], 0, of_colours)
