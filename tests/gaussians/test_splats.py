"""Rows: activation, first guesses, capacities, inactive rows."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core import splats as rows
from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.splatting import rendering
from nerfies_jax.geometry import camera as lenses
from nerfies_jax.geometry.camera import Camera
from tests import gradients
from tests.gaussians.shared import finite, full, jitted, put, same_bits


def some_splats(rng, count=7, dtype="float64", degree=3):
    rest = (degree + 1) ** 2 - 1
    leaves = (
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)) - 2,
        rng.normal(size=(count, 4)),
        rng.normal(size=count),
        rng.normal(size=(count, 1, 3)),
        rng.normal(size=(count, rest, 3)),
    )
    return put(Splats(*leaves), dtype)


def test_activation_is_exp_and_logistic(rng, dtype):
    splats = some_splats(rng, dtype=dtype)
    activated = jitted(rows.activate)(splats)
    scale = np.exp(np.asarray(splats.log_scale, np.float64))
    opacity = 1 / (1 + np.exp(-np.asarray(splats.opacity_logit, np.float64)))
    tolerance = {"float32": 3e-7, "float64": 1e-15}[dtype]
    np.testing.assert_allclose(activated.scale, scale, rtol=tolerance)
    np.testing.assert_allclose(activated.opacity, opacity, rtol=tolerance)
    assert {leaf.dtype.name for leaf in activated} == {dtype}


def test_activation_gradient(rng, float64):
    splats = some_splats(rng)

    def total(log_scale, logit):
        moved = splats._replace(log_scale=log_scale, opacity_logit=logit)
        activated = rows.activate(moved)
        return jnp.sum(activated.scale**2) + jnp.sum(activated.opacity**3)

    error = gradients.directional_error(total, splats.log_scale, splats.opacity_logit)
    assert error < 1e-8


@jax.jit
@jax.value_and_grad
def total_and_slope(raw, splats):
    moved = splats._replace(
        log_scale=jnp.full((7, 3), raw), opacity_logit=jnp.full(7, raw)
    )
    gaussians = rows.activate(moved)
    return jnp.sum(gaussians.scale**2) + jnp.sum(gaussians.opacity)


@pytest.mark.hard_cases
@pytest.mark.parametrize("raw", [-100.0, 100.0, -1e30, 1e30])
def test_raw_values_far_out_stay_finite_with_their_slopes(raw, dtype):
    splats = some_splats(np.random.default_rng(0), dtype=dtype)
    assert finite(total_and_slope(np.asarray(raw, dtype), splats))


def test_padding_repeats_the_first_row_and_marks_it_inactive(rng, dtype):
    splats = some_splats(rng, dtype=dtype)
    more = {"splats": splats, "label": np.arange(7)}
    params = Params(more, {"weight": np.ones((7, 2), dtype)})
    padded = jitted(rows.pad_rows, static_argnums=1)(params, 12)
    active = jitted(rows.active_mask)(padded.rows["splats"])
    assert list(active) == [True] * 7 + [False] * 5
    assert list(padded.rows["label"]) == [0, 1, 2, 3, 4, 5, 6, 0, 0, 0, 0, 0]
    assert padded.nets["weight"].shape == (7, 2)  # as many rows by chance, yet no row
    np.testing.assert_array_equal(padded.rows["splats"].mean[:7], splats.mean)
    same_bits(jitted(rows.take_rows)(padded, np.arange(7)), params)


def test_capacities_grow_by_half_and_stop_at_the_cap():
    sizes = sorted({rows.capacity_for(count) for count in range(1, 20_000, 37)})
    assert sizes[:5] == [256, 512, 768, 1280, 2048]
    assert all(b / a <= 2.0 for a, b in itertools.pairwise(sizes))
    assert all(b / a <= 1.67 for a, b in itertools.pairwise(sizes[2:]))
    assert rows.capacity_for(3073, most=3100) == 3100
    assert rows.capacity_for(4500, most=10_000) == 4608
    assert rows.capacity_for(6500, most=10_000) == 10_000


@pytest.mark.parametrize("degree", [0, 2, 3, *full(1)])
def test_a_traced_degree_hides_the_bands_above_it(degree, rng, dtype):
    splats = some_splats(rng, dtype=dtype)
    coefficients = (degree + 1) ** 2

    def total(splats, degree):
        shown = rows.active_harmonics(splats, degree)
        return jnp.sum(shown), shown

    run = jitted(jax.grad(total, has_aux=True))
    grads, shown = run(splats, np.int32(degree))
    every = np.concatenate([splats.sh_dc, splats.sh_rest], axis=1)
    np.testing.assert_array_equal(shown[:, :coefficients], every[:, :coefficients])
    assert not shown[:, coefficients:].any()
    assert (grads.sh_rest[:, : coefficients - 1] == 1).all()
    assert not grads.sh_rest[:, coefficients - 1 :].any()


def test_the_degree_grows_on_schedule():
    active_degree = jitted(rows.active_degree, static_argnums=(1, 2))
    steps = np.asarray([0, 999, 1000, 90_000], np.int32)
    assert [active_degree(step, 1000, 3) for step in steps] == [0, 0, 1, 3]


def test_first_scales_are_the_root_mean_square_of_three_distances(rng):
    points = rng.normal(size=(40, 3)).astype(np.float32)
    colors = rng.uniform(size=(40, 3))
    splats = rows.from_points(points, colors, degree=2)
    gap = np.linalg.norm(points[:, None].astype(float) - points[None], axis=-1)
    nearest = np.sort(gap, axis=1)[:, 1:4]
    expected = np.log(np.sqrt(np.mean(nearest**2, axis=1)))
    scale, dc = np.asarray(splats.log_scale), np.asarray(splats.sh_dc)
    np.testing.assert_allclose(scale[:, 0], expected, atol=1e-6)
    assert splats.sh_rest.shape == (40, 8, 3)
    np.testing.assert_allclose(splats.opacity_logit, np.log(0.1 / 0.9), rtol=1e-6)
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * dc[:, 0], colors, atol=1e-6)


@pytest.mark.hard_cases
@pytest.mark.parametrize("distinct", [1, 2, 3, *full(4)])
def test_few_points_and_duplicates_have_finite_first_scales(distinct, rng):
    points = np.repeat(rng.normal(size=(distinct, 3)), 4, axis=0)
    splats = rows.from_points(points, np.full_like(points, 0.5), lone_scale=0.25)
    scale = np.exp(np.asarray(splats.log_scale))
    assert (scale > 1e-3).all()
    if distinct == 1:
        np.testing.assert_allclose(scale, 0.25, rtol=1e-6)
    if distinct == 2:
        np.testing.assert_allclose(
            scale, np.linalg.norm(points[0] - points[-1]), rtol=1e-6
        )


def ring_of_cameras(count):
    angle = np.linspace(0, 2, count)
    forward = np.stack([np.sin(angle), np.zeros(count), np.cos(angle)], axis=-1)
    down = np.tile([0.0, 1.0, 0.0], (count, 1))
    right = np.cross(down, forward)
    return Camera(
        camera_from_world=np.stack([right, down, forward], axis=1),
        position=-3 * forward,
        focal_px=np.full(count, 80.0),
        principal_point_px=np.tile([30.0, 26.0], (count, 1)),
        skew_px=np.full(count, 4.0),
        pixel_aspect=np.full(count, 1.25),
        radial=np.zeros((count, 3)),
        tangential=np.zeros((count, 2)),
    )


def test_random_points_lie_where_a_camera_sees_them(rng):
    cameras = ring_of_cameras(5)
    points = rows.random_in_views(rng, cameras, (64, 48), 1.0, 4.0, 2000)
    seen = np.zeros(len(points), bool)
    for turn, center in zip(cameras.camera_from_world, cameras.position, strict=True):
        x, y, z = turn @ (points - center).T
        u = 80 * x / z + 4 * y / z + 30
        v = 100 * y / z + 26
        inside = (u >= 0) & (u <= 64) & (v >= 0) & (v <= 48)
        seen |= inside & (z >= 1 - 1e-9) & (z <= 4 + 1e-9)
    assert seen.all()


@pytest.mark.full
def test_random_points_fill_the_corners_that_a_lens_sees(rng):
    cameras = ring_of_cameras(2)
    cameras = cameras._replace(radial=np.tile([-0.3, 0.0, 0.0], (2, 1)))
    points = rows.random_in_views(rng, cameras, (64, 48), 1.0, 4.0, 400)
    first = lenses.take(jax.tree.map(np.float32, cameras), 0)
    second = lenses.take(jax.tree.map(np.float32, cameras), 1)
    seen, outside = np.zeros(400, bool), np.zeros(400, bool)
    for camera in (first, second):
        pixel, depth = lenses.project(camera, np.float32(points))
        inside = (np.asarray(pixel) > -0.01) & (np.asarray(pixel) < (64.01, 48.01))
        here = inside.all(axis=1) & (depth > 0.9)
        seen |= here
        x, y, z = camera.camera_from_world @ (points - camera.position).T
        outside |= here & (80 * x / z + 4 * y / z + 30 < -1)
    assert seen.all()
    assert outside.any()


def test_extent_is_the_reach_of_the_cameras():
    position = np.array([[0.0, 0, 0], [4, 0, 0], [2, 3, 0], [2, -3, 0]])
    assert rows.scene_extent(position) == pytest.approx(1.1 * 3)


@pytest.mark.hard_cases
def test_a_tripod_has_no_extent_of_its_own():
    position = np.tile([[1000.0, 2.0, 3.0]], (5, 1)) + np.float32(6e-5) * np.eye(5, 3)
    with pytest.raises(ValueError, match="cameras are static"):
        rows.scene_extent(position)
    assert rows.scene_extent(position, static=2.5) == 2.5
    # Nor has a hand that trembles before something meters away.
    tremor = 1e-3 * np.eye(5, 3)
    assert rows.scene_extent(tremor, static=2.5) == pytest.approx(0.25)


@pytest.mark.full
@pytest.mark.hard_cases
def test_inactive_rows_change_neither_the_image_nor_learn_anything(rng):
    splats = some_splats(rng, dtype="float32", degree=0)
    camera = jax.tree.map(lambda leaf: leaf[0], ring_of_cameras(1))
    camera = put(camera, "float32")

    def loss(splats):
        color = rendering.render_harmonics(
            rows.activate(splats), rows.active_harmonics(splats, 0), camera, (16, 12)
        ).rendering.color
        return jnp.sum(color**2), color

    # Five rows beyond the active hold numbers of their own, inactive in one of the two.
    pad = jitted(rows.pad_rows, static_argnums=1)
    padded = pad(Params({"splats": splats}, {}), 12).rows["splats"]
    other = jax.tree.map(
        lambda leaf: np.concatenate([leaf[:7], leaf[6:1:-1]]), padded
    )._replace(opacity_logit=padded.opacity_logit)
    run = jitted(jax.grad(loss, has_aux=True))
    grads, color = run(padded)
    assert color.max() > 0.1
    np.testing.assert_array_equal(color, run(other)[1])
    assert any(leaf[:7].any() for leaf in grads)
    assert not any(leaf[7:].any() for leaf in grads)
