"""Hits, motion and textures of synthetic scenes against float64 NumPy and SciPy."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.capture import images
from nerfies_jax.capture.synthetic import presets, rendering, texture, trace
from nerfies_jax.capture.synthetic.spec import SceneSpec
from nerfies_jax.geometry import camera as cameras
from tests import gradients, scene_oracle

# Every shape and motion in one scene, so that one program serves most tests.
SPEC = SceneSpec(
    "all",
    (
        presets.WALL,
        presets.FLOOR,
        presets.CLOTH,
        presets.CUBE,
        presets.BALL,
        presets.UPPER_ARM,
        presets.FOREARM,
        dataclasses.replace(presets.PASSER, place=(-0.3, 0.0, -0.1)),
    ),
    size=(48, 36),
    frames=9,
)
MOVING = [i for i, thing in enumerate(SPEC.things) if thing.moves()]

ONE_MOVING = [
    MOVING[0],
    *(pytest.param(thing, marks=pytest.mark.full) for thing in MOVING[1:]),
]


@functools.partial(jax.jit, static_argnums=0)
def cast(spec, origins, directions, time):
    return jax.vmap(lambda o, d: trace.cast(spec, o, d, time, jnp.asarray(True)))(
        origins, directions
    )


def rays_of(row, rng, count):
    plan = rendering.schedule(SPEC, 0)
    camera = cameras.take(plan.cameras, row)
    pixels = rng.uniform(0, 1, (count, 2)) * SPEC.size
    along = scene_oracle.directions(camera, pixels)
    origin = np.broadcast_to(camera.position.astype(float), along.shape)
    return origin, along, float(plan.time[row])


@functools.cache
def met_by_numpy(row):
    """300 rays of a row, and how far off the first thing is that each meets."""
    origin, along, time = rays_of(row, np.random.default_rng(0), 300)
    exact = [
        scene_oracle.first(SPEC.things, o, d, time)
        for o, d in zip(origin, along, strict=True)
    ]
    return origin, along, time, *(np.array(part) for part in zip(*exact, strict=True))


@pytest.mark.parametrize(
    ("row", "dtype"),
    [
        (2, "float64"),
        pytest.param(2, "float32", marks=pytest.mark.full),
        pytest.param(10, "float32", marks=pytest.mark.full),
    ],
)
def test_cast_meets_what_numpy_meets_where_numpy_meets_it(row, dtype):
    origin, along, time, distance, thing = met_by_numpy(row)
    rays = (np.asarray(x, dtype) for x in (origin, along, time))
    with jax.enable_x64(dtype == "float64"):
        hit = jax.tree.map(np.asarray, cast(SPEC, *rays))
    # float32 may fall on the other side of a silhouette; float64 never does.
    same = hit.thing == thing
    assert np.mean(same) >= {"float32": 0.99, "float64": 1.0}[dtype]
    assert len(set(thing)) >= 6
    # float32: 2e-6 measured but at grazing silhouettes, where the slope is unbounded.
    error = np.abs(hit.distance - distance)[same]
    assert np.quantile(error, 0.98) < {"float32": 4e-6, "float64": 1e-13}[dtype]
    assert error.max() < {"float32": 1e-3, "float64": 1e-10}[dtype]


@pytest.mark.full
@pytest.mark.hard_cases
def test_cloth_seen_edge_on_is_missed_by_few_rays(float64, rng):
    thing = dataclasses.replace(presets.CLOTH, place=(0.0, 0.0, 0.0))
    spec = dataclasses.replace(SPEC, things=(thing,))
    angle = rng.uniform(-0.25, 0.25, 400)  # to the cloth's own plane, radians
    origin = 0.6 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    aim = rng.uniform(-0.09, 0.09, (400, 3)) * (1, 1, 0.3)
    along = aim - origin
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    hit = cast(spec, origin, along, np.asarray(0.3))
    exact = np.array(
        [
            scene_oracle.enters(thing, o, d, 0.3)
            for o, d in zip(origin, along, strict=True)
        ]
    )
    distance = np.asarray(hit.distance)
    met = np.isfinite(exact)
    assert met.sum() > 200
    wrong = np.abs(np.where(np.isfinite(distance), distance, -1) - exact) > 1e-9
    # Two crossings between two probes are lost: 0.3% measured.
    assert np.mean(wrong[met]) < 0.01
    assert not np.isfinite(distance[~met]).any()


def test_a_ray_along_a_face_or_through_nothing_gives_no_nan(dtype):
    spec = dataclasses.replace(SPEC, things=(presets.PLINTH, presets.CLOTH))
    x, y, z = presets.PLINTH.place
    hx, _, hz = presets.PLINTH.shape.half
    origins = np.asarray([[x + hx, y, z + 1], [x, y, z + 1], [9, 9, 9]], dtype)
    along = np.asarray([[0, 0, -1], [0, 0, -1], [0, 1, 0]], dtype)
    hit = cast(spec, origins, along, np.zeros((), dtype))
    assert abs(float(hit.distance[1]) - (1 - hz)) < 1e-6
    assert float(hit.distance[2]) == np.inf
    assert hit.thing[2] == trace.NOTHING
    assert np.isfinite(np.asarray(hit.normal)).all()
    assert np.isfinite(np.asarray(hit.material[:2])).all()


@pytest.mark.parametrize("thing", MOVING, ids=lambda i: SPEC.things[i].name)
def test_observe_is_numpy_s_map_and_canonical_its_inverse(thing, dtype, rng):
    body = SPEC.things[thing]
    start = scene_oracle.pose(body, 0.0)[:3, 3]
    point = start + rng.uniform(-0.05, 0.05, (20, 3))
    time = 0.37
    over = functools.partial(jax.vmap, in_axes=(0, None))

    @jax.jit
    def both(point, time):
        there = over(lambda p, t: trace.observe(SPEC, thing, p, t))(point, time)
        back = over(lambda p, t: trace.canonical(SPEC, thing, p, t))(there, time)
        return there, back

    there, back = both(point.astype(dtype), np.asarray(time, dtype))
    exact = scene_oracle.observe(body, point, time)
    assert np.abs(exact - point).max() > 0.01
    bound = {"float32": 1e-6, "float64": 1e-14}[dtype]
    assert np.abs(np.asarray(there) - exact).max() < bound
    assert np.abs(np.asarray(back) - point).max() < bound


@pytest.mark.parametrize("thing", ONE_MOVING)
def test_observe_and_canonical_have_right_gradients(thing, float64):
    weight = np.array([0.3, -1.1, 0.7])
    point = np.array(SPEC.things[thing].place) + 0.02
    for function in (trace.observe, trace.canonical):
        error = gradients.directional_error(
            lambda p, t, f=function: weight @ f(SPEC, thing, p, t),
            point,
            np.asarray(0.37),
        )
        assert error < 1e-7


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    "name",
    [
        "cloth",
        *(pytest.param(name, marks=pytest.mark.full) for name in ("cube", "ball")),
    ],
)
def test_a_crossing_has_the_gradient_of_its_distance(name, float64):
    thing = SPEC.things[SPEC.id_of(name)]
    time = np.asarray(0.37)
    middle = jax.jit(thing.shape.deform)(np.array([0.01, 0.02, 0.0]), time)
    origin = np.array([0.1, 0.1, 0.6])

    def distance(origin, along, time):
        return thing.shape.cross(origin, along, time).distance

    along = np.asarray(middle) - origin
    assert np.isfinite(jax.jit(distance)(origin, along, time))
    assert gradients.directional_error(distance, origin, along, time) < 1e-6


def test_normals_are_those_of_the_surface(float64, rng):
    origin, along, time = rays_of(2, rng, 300)
    shifts = 1e-5 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    hits = [cast(SPEC, origin, along + shift, np.asarray(time)) for shift in shifts]
    middle, right, up = (
        origin + np.asarray(hit.distance)[:, None] * (along + shift)
        for hit, shift in zip(hits, shifts, strict=True)
    )
    one_thing = np.all([h.thing == hits[0].thing for h in hits], axis=0)
    exact = np.cross(right - middle, up - middle)
    exact /= np.linalg.norm(exact, axis=-1, keepdims=True)
    cosine = np.sum(exact * np.asarray(hits[0].normal), -1)[one_thing]
    # All but the few rays that fall across an edge of a box.
    assert np.quantile(np.abs(cosine), 0.02) > 1 - 1e-4
    assert np.all(np.sum(np.asarray(hits[0].normal) * along, -1) <= 0)


def test_value_noise_is_the_blend_of_hashed_corners(dtype, rng):
    def corner(x, y, z, seed):
        mask = 2**32 - 1
        bits = seed * 0x9E3779B9 + x * 0x8DA6B343 + y * 0xD8163841 + z * 0xCB1AB31F
        bits &= mask
        bits = (bits ^ (bits >> 16)) * 0x85EBCA6B & mask
        bits = (bits ^ (bits >> 13)) * 0xC2B2AE35 & mask
        return ((bits ^ (bits >> 16)) >> 9) / 2**22 - 1

    def slow(point, seed):
        total = 0.0
        for offset in np.ndindex(2, 2, 2):
            cell = np.floor(point)
            part = point - cell
            ease = 6 * part**5 - 15 * part**4 + 10 * part**3
            share = np.prod(
                [e if o else 1 - e for e, o in zip(ease, offset, strict=True)]
            )
            total += share * corner(
                *(int(c) + o for c, o in zip(cell, offset, strict=True)), seed
            )
        return total

    points = rng.uniform(-40, 40, (50, 3)).astype(dtype)
    noise = jax.jit(jax.vmap(lambda p: texture.value_noise(p, 5)))(points)
    exact = [slow(point.astype(float), 5) for point in points]
    assert (
        np.abs(np.asarray(noise) - exact).max()
        < {"float32": 1e-4, "float64": 1e-12}[dtype]
    )
    assert np.std(exact) > 0.2


@pytest.mark.full
def test_albedo_is_smooth_and_lies_between_black_and_white(float64, rng):
    textures = [thing.texture for thing in SPEC.things]
    points = rng.uniform(-0.2, 0.2, (500, 3))
    ids = rng.integers(0, len(textures), 500)
    albedo = jax.vmap(lambda i, p: texture.albedo(textures, i, p))
    color = np.asarray(jax.jit(albedo)(ids, points))
    assert 0 < color.min() < color.max() < 1
    assert np.std(color, axis=0).min() > 0.05
    weight = np.array([0.2, 0.5, -0.4])
    error = gradients.directional_error(
        lambda p: jnp.sum(weight * albedo(ids[:9], p)), points[:9], step=1e-7
    )
    assert error < 1e-5


@pytest.mark.hard_cases
def test_srgb_undoes_linear_and_has_a_slope_at_black(float64):
    coded = np.linspace(0, 1, 101)
    back = jax.jit(texture.srgb)(np.asarray(images.linear_from_srgb(coded)))
    assert np.abs(back - coded).max() < 1e-7
    # Tables of IEC 61966-2-1.
    assert abs(float(images.linear_from_srgb(0.5)) - 0.21404114) < 1e-8
    assert float(jax.jit(jax.grad(texture.srgb))(0.0)) == 12.92
