"""The flow of Gaussians and of cameras, pixel by pixel and Gaussian by Gaussian."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform

from gaussians_jax.core.splats import Gaussians
from gaussians_jax.losses import flow as motion_flow
from gaussians_jax.losses.flow import FlowSpec
from gaussians_jax.per_frame import poses as pose_refinement
from gaussians_jax.per_frame.poses import PoseRefinementSpec
from gaussians_jax.scene import scene, view_order
from gaussians_jax.splatting.raster_spec import GSPLAT
from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.evaluation import frames_of
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training.effects import Observation, PenaltyContext
from nerfies_jax.training.model import Frames
from tests import gradients, scenes
from tests.gaussians.shared import jitted, put
from tests.oracles import dense_splats

SIZE = (13, 9)


def pair(dtype, turned=0.1):
    """Two cameras side by side, one turned a little, and focal lengths of their own."""
    first = cameras.look_at((0.0, 0.0, -4.0), (0.0, 0.0, 0.0), (0, 1.0, 0), 12.0, SIZE)
    away = (0.4, 0.1, -3.7)
    second = cameras.look_at(away, (turned, 0.0, 0.0), (0.1, 1.0, 0), 13.0, SIZE)
    return tuple(put(one, dtype) for one in (first, second))


def scattered(dtype, count=7, seed=0):
    """Gaussians before the cameras, and the same a little later."""
    rng = np.random.default_rng(seed)
    here = Gaussians(
        rng.uniform(-1, 1, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.2, 0.6, (count, 3)),
        rng.uniform(0.3, 0.9, count),
    )
    there = here._replace(
        mean=here.mean + rng.normal(size=(count, 3)) / 4,
        quaternion=here.quaternion + rng.normal(size=(count, 4)) / 5,
        scale=here.scale * rng.uniform(0.8, 1.2, (count, 3)),
    )
    return put(here, dtype), put(there, dtype)


def footprint(gaussians, row, camera):
    """Mean, Cholesky factor of the dilated covariance, and z; NumPy."""
    one = (gaussians.mean[row], gaussians.quaternion[row], gaussians.scale[row])
    mean, covariance, depth = dense_splats.footprint(*one, camera, SIZE, GSPLAT)
    dilated = np.asarray(covariance, np.float64) + GSPLAT.eps2d * np.eye(2)
    return np.asarray(mean), np.linalg.cholesky(dilated), float(depth)


def by_hand(here, there, both):
    """(flow, share, depth) of every pixel, front to back."""
    width, height = SIZE
    rows = range(len(here.mean))
    first = [footprint(here, row, both[0]) for row in rows]
    start = [footprint(here, row, both[1]) for row in rows]
    end = [footprint(there, row, both[1]) for row in rows]
    order = np.argsort([f[2] for f in first])
    flow, share, depth = np.zeros((height, width, 2)), *np.zeros((2, height, width))
    for line in range(height):
        for column in range(width):
            pixel, left = np.array([column + 0.5, line + 0.5]), 1.0
            for row in order:
                mean, factor, z = first[row]
                inside = np.linalg.solve(factor, pixel - mean)
                alpha = float(here.opacity[row]) * np.exp(-inside @ inside / 2)
                alpha = min(alpha, GSPLAT.alpha_max)
                if alpha < GSPLAT.alpha_threshold:
                    continue
                goes = end[row][0] + end[row][1] @ inside
                came = start[row][0] + start[row][1] @ inside
                flow[line, column] += left * alpha * (goes - came)
                share[line, column] += left * alpha
                depth[line, column] += left * alpha * z
                left *= 1 - alpha
    some = np.where(share > 0, share, 1)
    return flow / some[..., None], share, depth / some


drawn_flow = jitted(motion_flow.render_flow, static_argnums=(3, 4))
camera_flow = jitted(motion_flow.camera_flow)


def test_the_gaussians_flow_is_that_of_a_loop(dtype):
    here, there = scattered(dtype)
    rendered = drawn_flow(here, there, pair(dtype), SIZE, GSPLAT)
    assert rendered.flow.dtype == dtype
    atol = {"float32": 2e-4, "float64": 1e-9}[dtype]  # px
    for actual, expected in zip(
        rendered, by_hand(here, there, pair(dtype)), strict=True
    ):
        np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=atol)


@pytest.mark.parametrize("depth", [0.5, 3.0, 80.0])
def test_a_still_scene_goes_as_its_points_project(depth, dtype):
    """A pixel's point by SciPy's rotations, through both pinholes."""
    both = pair(dtype)
    width, height = SIZE
    actual = camera_flow(both, np.full((height, width), depth, dtype))
    assert actual.dtype == dtype
    first, second = jax.tree.map(lambda x: np.asarray(x, np.float64), both)
    turn = scipy.spatial.transform.Rotation.from_matrix(first.camera_from_world)
    for line, column in np.ndindex(height, width):
        pixel = np.array([column + 0.5, line + 0.5])
        slope = (pixel - first.principal_point_px) / first.focal_px
        place = first.position + turn.inv().apply(depth * np.array([*slope, 1]))
        seen = second.camera_from_world @ (place - second.position)
        goes = second.focal_px * seen[:2] / seen[2] + second.principal_point_px
        rtol = {"float32": 2e-5, "float64": 1e-12}[dtype]
        np.testing.assert_allclose(
            actual[line, column], goes - pixel, rtol=rtol, atol=20 * rtol
        )


def test_what_stands_still_has_no_flow_of_its_own(dtype):
    """Whatever the cameras do; so all of its optical flow is the camera's."""
    here, _ = scattered(dtype)
    rendered = drawn_flow(here, here, pair(dtype), SIZE, GSPLAT)
    # Both ends are projected, each in an order of its own.
    assert np.abs(rendered.flow).max() < {"float32": 2e-5, "float64": 1e-13}[dtype]
    assert rendered.share.max() > 0.5


def test_the_error_is_that_of_a_loop(dtype, rng):
    rendered, things = rng.normal(size=(2, 9, 13, 2)).astype(dtype) * 4
    rendered[2, 3, 0], things[2, 3, 0] = 100, 1  # held to one width of 13
    seen = rng.uniform(size=(9, 13)) < 0.6
    seen[2, 3] = True
    things[~seen] = np.nan
    actual = jitted(motion_flow.error)(rendered, things, seen)
    terms = []
    for line, column in np.argwhere(seen):
        for axis, side in enumerate(SIZE):
            one, other = (
                np.clip(flow[line, column, axis] / side, -1, 1)
                for flow in (np.float64(rendered), np.float64(things))
            )
            terms.append(abs(one - other))
    rtol = {"float32": 1e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(actual, np.mean(terms), rtol=rtol)
    for slope in jitted(jax.grad(motion_flow.error, (0, 1)))(rendered, things, seen):
        assert np.isfinite(slope).all()
        assert slope.any()
        np.testing.assert_array_equal(slope[~seen], 0)


HARD = {
    "nothing drawn": lambda g: g._replace(opacity=0 * g.opacity),
    "behind the next camera": lambda g: g._replace(mean=g.mean - 30),
    "at a camera": lambda g: g._replace(mean=0 * g.mean + np.array([0.4, 0.1, -3.7])),
    "as wide as the sky": lambda g: g._replace(scale=1e6 * g.scale),
    "points": lambda g: g._replace(scale=0 * g.scale),
    "no turn": lambda g: g._replace(quaternion=0 * g.quaternion),
    "not numbers": lambda g: g._replace(mean=np.nan * g.mean),
}


@jitted
def error_and_slopes(here, there, both):
    def total(here, there):
        rendered = motion_flow.render_flow(here, there, both, SIZE, GSPLAT)
        things = motion_flow.camera_flow(both, rendered.depth)
        return motion_flow.error(rendered.flow, things, rendered.share > 0.01)

    return jax.value_and_grad(total, (0, 1))(here, there)


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", HARD)
def test_flow_and_slopes_are_finite_of(name, dtype):
    both = pair(dtype)
    here, there = scattered(dtype)
    there = HARD[name](jax.tree.map(np.asarray, there))
    there = jax.tree.map(lambda x: np.asarray(x, dtype), there)
    value, slopes = error_and_slopes(here, there, both)
    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


@pytest.mark.full
def test_gradients_go_through_both_ends_and_no_weight(float64):
    """Of the way alone: means, turns and sizes in the next camera's image."""
    here, there = scattered("float64")
    both, weight = pair("float64"), np.random.default_rng(5).normal(size=(9, 13, 2))

    def total(start, end):
        # As blended where the first are, which get no slope.
        first = jax.lax.stop_gradient(
            motion_flow.projection.project(here, both[0], SIZE, GSPLAT)
        )
        ends = (
            motion_flow.projection.project(g, both[1], SIZE, GSPLAT)
            for g in (start, end)
        )
        stretch, shift = motion_flow.linear_flow(first, *ends)
        values = jnp.concatenate([stretch.reshape(-1, 4), shift], axis=1)
        image, _ = motion_flow.raster.rasterize(first, values, SIZE, GSPLAT)
        return jnp.sum(jnp.sin(image[..., 4:6]) * weight)

    assert gradients.directional_error(total, here, there) < 1e-5

    def blended(here, there):
        rendered = motion_flow.render_flow(here, there, both, SIZE, GSPLAT)
        return jnp.sum(rendered.flow * weight)

    slopes = jitted(jax.grad(blended, (0, 1)))(here, there)
    assert all(one.mean.any() and one.scale.any() for one in slopes)
    assert not any(one.opacity.any() for one in slopes)


DEPTH = 4.0


@pytest.mark.full
def test_flow_pulls_both_cameras_by_how_they_move_and_no_weight(float64):
    """Cameras that are refined beside the flow, against central differences.

    The first camera, too, counts by its way to the next alone: where it draws what, and
    how deep that lies, is held still.
    """
    both, rng = pair("float64"), np.random.default_rng(4)
    here, there = scattered("float64", count=20)
    opaque = np.full(20, 0.9)
    here, there = here._replace(opacity=opaque), there._replace(opacity=opaque)
    inputs = cameras.stack([*both, both[0]])
    shift = rng.normal(size=(3, 9, 13, 2))
    flow = FrameFlow(shift, np.ones((3, 9, 13), bool), np.array([1, 2, 2]), *[None] * 3)
    images, times = np.zeros((3, 9, 13, 3), np.uint8), np.array([0.0, 0.5, 1.0])
    frames = Frames(images, inputs, times, np.zeros(3, np.int32), None, flow=flow)
    refined = jax.jit(
        functools.partial(pose_refinement.refine, cameras=inputs, depth=DEPTH)
    )

    def at_time(_, time):
        return jax.tree.map(lambda *ends: jnp.where(time < 0.25, *ends), here, there)

    def term(screws):
        posed = frames._replace(cameras=refined(screws))
        observation = Observation(None, None, None, None, posed, 0)
        context = PenaltyContext(
            None, None, None, None, observation=observation, at_time=at_time
        )
        return motion_flow.flow_error(FlowSpec(), GSPLAT, None, context)

    screws = 0.02 * rng.normal(size=(3, 6))
    still = cameras.take(refined(screws), 0)

    @jax.jit
    def held(screws):
        first, second = (cameras.take(refined(screws), row) for row in (0, 1))
        rendered = motion_flow.render_flow(here, there, (still, second), SIZE, GSPLAT)
        things = shift[0] - motion_flow.camera_flow((first, second), rendered.depth)
        return motion_flow.error(rendered.flow, things, rendered.share >= 0.5)

    slopes, known = jitted(jax.grad(term, has_aux=True))(screws)
    assert 0.3 < known < 1
    np.testing.assert_array_equal(np.any(slopes, axis=1), [True, True, False])
    for row in (0, 1):
        for axis in range(6):
            # The mean, which has no slope, stays: the third camera makes up for it.
            way = np.zeros((3, 6))
            way[row, axis], way[2, axis] = 1e-6, -1e-6
            difference = (held(screws + way) - held(screws - way)) / 2e-6
            np.testing.assert_allclose(slopes[row, axis], difference, atol=1e-7)


SCENE = dataclasses.replace(scenes.TINY_DEFORMABLE, flow=FlowSpec(start=3))


@pytest.mark.full
def test_a_penalty_compares_frames_with_the_next_and_begins_at_its_start():
    capture = scenes.tiny_capture()
    model = scene.build(SCENE, scene.metadata_of(capture))
    assert {"flow", "moving"} <= model.required_data
    frames = frames_of(capture, model.required_data)
    regularizer = motion_flow.Bound(SCENE.flow, GSPLAT)
    unmasked = dataclasses.replace(SCENE.flow, moving_only=False)
    assert motion_flow.Bound(unmasked, GSPLAT).required_data == {"flow"}
    state = model.init(capture, jax.random.key(0))

    def still(params, time):
        return scene.splats.activate(params.rows["splats"])

    def terms(step, frames, row):
        observation = Observation(None, None, None, None, frames, row)
        context = PenaltyContext(
            None, step, None, state.params, observation=observation, at_time=still
        )
        return regularizer.loss(state.params, context)

    everywhere = frames._replace(moving=None)
    early, late = (jax.jit(terms)(jnp.int32(step), everywhere, 1) for step in (2, 3))
    assert early["error"].value == 0
    assert late["error"].value > 0
    assert late["error"].weight == 0.5
    assert 0 < late["known"].value <= 1
    # Of what moves alone: every other column and the rest make up the whole.
    some = np.arange(frames.images.shape[2]) % 2 == np.zeros(frames.images.shape[:3])
    halves = [
        jax.jit(terms)(jnp.int32(3), frames._replace(moving=half), 1)
        for half in (some, ~some)
    ]
    sums = [half["known"].value * half["error"].value for half in halves]
    assert 0 < min(half["known"].value for half in halves) < late["known"].value
    np.testing.assert_allclose(
        sum(sums), late["known"].value * late["error"].value, rtol=1e-5
    )
    # Of a frame without a next one nothing is seen.
    last = int(
        np.argmax(np.asarray(frames.flow.next_row) == np.arange(len(frames.times)))
    )
    nothing = jax.jit(terms)(jnp.int32(3), frames, last)
    assert nothing["error"].value == nothing["known"].value == 0
    assert terms(jnp.int32(3), frames._replace(flow=None), 1) == {}
    assert isinstance(frames.flow, FrameFlow)


@pytest.mark.full
def test_a_step_with_flow_moves_its_own_camera_and_the_next_one_alone():
    capture = scenes.tiny_capture()
    spec = dataclasses.replace(
        SCENE,
        flow=FlowSpec(start=0, moving_only=False),
        poses=PoseRefinementSpec(2e-3, 2e-4),
    )
    model = scene.build(spec, scene.metadata_of(capture))
    state = model.init(capture, jax.random.key(0))
    frames = frames_of(capture, model.required_data)
    row = int(view_order.shuffled_row(state.key, state.step, len(frames.times)))
    other = int(frames.flow.next_row[row])
    state, metrics = jax.jit(model.step)(state, frames)
    assert metrics["flow/known"] > 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.params))
    moved = np.flatnonzero(np.any(state.params.nets["poses"], axis=1))
    assert moved.tolist() == sorted({row, other})
    assert row != other


def test_flow_without_a_motion_is_refused():
    capture = scenes.tiny_capture()
    still = dataclasses.replace(SCENE, motion=None)
    model = scene.build(still, scene.metadata_of(capture))
    with pytest.raises(ValueError, match="flow without a motion"):
        model.init(capture, jax.random.key(0))
