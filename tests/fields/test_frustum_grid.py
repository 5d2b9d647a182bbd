"""Warps read between the corners of a frame's grid, against the warps themselves."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.fields import frustum_grid
from nerfies_jax.fields.effects.ambient import AmbientSpec
from nerfies_jax.fields.effects.records import FieldRecord
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.fields.field_ray import Ray, field_ray_through
from nerfies_jax.fields.render_ray import Bound
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.scene import scene
from nerfies_jax.scene.scene import RadianceScene
from nerfies_jax.training.effects import FrameCondition
from tests import gradients

SIZE = (50, 31)
METADATA = SceneMetadata(0.5, 3.5, (0.1, 0.0, 0.2), 0.8, None, (0.0, 1.0), ())
TURN = np.array([[0.3, -0.2, 0.1], [0.0, 0.5, -0.4], [0.2, 0.1, 0.7]])
SHIFT = np.array([0.02, -0.3, 0.1])


def bound_of(*effects, metadata=METADATA):
    return Bound(RadianceScene(steps=1), metadata, effects, {})


def read(displace, dtype, size=SIZE, metadata=METADATA):
    """(points, their displacements as read on the grid) in an image of that size."""
    bound = bound_of(FieldRecord("own", displace=displace), metadata=metadata)

    @jax.jit
    def every(camera, position, share):
        condition = FrameCondition(jnp.zeros((), dtype), {}, jnp.int32(0))
        grid = frustum_grid.displacements(bound, camera, condition, size)

        def one(position, share):
            ray, _ = field_ray_through(metadata, camera, position)
            distance = ray.near + share * (ray.far - ray.near)
            column = frustum_grid.column(grid, position, size)
            (moved,) = frustum_grid.along(column, ray, distance[None])
            return ray.origin + distance * ray.direction, moved

        return jax.vmap(one)(position, share)

    rng = np.random.default_rng(0)
    position = jnp.asarray(rng.uniform(0, 1, (300, 2)) * size, dtype)
    share = jnp.asarray(rng.uniform(0, 1, 300), dtype)
    camera = cameras.look_at((0.4, -0.3, -2.0), (0, 0, 0), (0, 1, 0), 40.0, size)
    camera = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), camera)
    return every(camera, position, share)


def linear(_, point, condition):
    return jnp.asarray(TURN, point.dtype) @ point + jnp.asarray(SHIFT, point.dtype)


FLAT = dataclasses.replace(METADATA, far=METADATA.near)


@pytest.mark.parametrize(
    ("size", "metadata"),
    [(SIZE, METADATA), ((1, 1), FLAT), ((130, 1), METADATA)],
    ids=["an image", "a pixel without depth", "a row"],
)
def test_what_is_linear_in_space_comes_back_as_it_is(size, metadata, dtype):
    point, moved = read(linear, dtype, size, metadata)
    assert moved.dtype == dtype
    truth = np.asarray(point, np.float64) @ TURN.T + SHIFT
    # In float64 what is left of the lens' iteration, for corners and samples apart.
    atol = {"float32": 3e-6, "float64": 1e-11}[dtype]
    np.testing.assert_allclose(moved, truth, rtol=0, atol=atol)


def test_a_wave_of_the_fewest_cells_is_read_to_two_hundredths(float64):
    """Straight between corners h apart a sine is (2πh / wave)² / 8 off at most."""
    wave = frustum_grid.CELLS_A_WAVE * (3.5 - 0.5) * 0.8 / frustum_grid.DEEP
    axis = np.array([-0.4, 0.3, 2.0]) / np.linalg.norm([-0.4, 0.3, 2.0])

    def ripple(_, point, condition):
        phase = 2 * jnp.pi / wave * (point @ jnp.asarray(axis))
        return jnp.stack([jnp.sin(phase), jnp.cos(phase), 0 * phase])

    point, moved = read(ripple, "float64")  # along the way the camera looks
    phase = 2 * np.pi / wave * np.asarray(point) @ axis
    truth = np.stack([np.sin(phase), np.cos(phase), 0 * phase], axis=-1)
    most = (2 * np.pi / frustum_grid.CELLS_A_WAVE) ** 2 / 8
    assert 0.5 * most < np.abs(moved - truth).max() < 1.001 * most < 0.02


def test_beyond_its_ends_a_column_says_what_they_say():
    ends = jnp.asarray([[1.0, 2.0, 3.0], [5.0, 5.0, 5.0]])
    ray = Ray(jnp.zeros(3), jnp.zeros(3), jnp.float32(2), jnp.float32(4))
    read = frustum_grid.along(ends, ray, jnp.asarray([-1e30, 0.0, 3.0, 1e30]))
    np.testing.assert_array_equal(read, [ends[0], ends[0], ends.mean(0), ends[1]])


def test_slopes_of_what_is_read_are_those_of_differences(float64):
    rng = np.random.default_rng(1)
    grid = rng.normal(size=(3, 4, 5, 3))

    def value(grid, position, distance):
        ray = Ray(np.zeros(3), np.zeros(3), 1.0, 2.0)
        column = frustum_grid.column(grid, position, SIZE)
        return jnp.sum(frustum_grid.along(column, ray, distance) ** 3)

    position, distance = np.array([11.3, 20.2]), np.array([1.1, 1.61, 1.95])
    assert gradients.directional_error(value, grid, position, distance) < 1e-7


WARP = WarpSpec(position=EncodingSpec(3), depth=1, width=8, skips=())


@pytest.mark.parametrize(
    ("spec", "own", "expected"),
    [
        ({}, None, False),
        ({"warp": WARP}, None, True),
        ({"warp": dataclasses.replace(WARP, position=EncodingSpec(9))}, None, False),
        ({"warp": WARP, "ambient": AmbientSpec()}, None, False),
        ({"warp": WARP}, FieldRecord("own", displace=linear), False),
        ({"warp": WARP}, FieldRecord("own", displace=linear, shortest_wave=1.0), True),
    ],
    ids=["at rest", "warped", "of fine waves", "lifted", "unknown", "known"],
)
def test_only_warps_of_waves_that_are_known_and_long_are_read(spec, own, expected):
    spec = RadianceScene(steps=1, **spec)
    more = () if own is None else (own,)
    effects = scene.field(spec, METADATA, effects=more).effects
    assert frustum_grid.resolves(bound_of(*effects)) == expected
    # A scene ten times as deep, in cells as many.
    deep = dataclasses.replace(METADATA, far=10 * METADATA.far)
    assert not frustum_grid.resolves(bound_of(*effects, metadata=deep))
