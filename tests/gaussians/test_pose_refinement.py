"""Cameras that are refined while a scene of Gaussians is trained."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussians_jax.per_frame import poses as pose_refinement
from gaussians_jax.per_frame.poses import PoseRefinementSpec
from gaussians_jax.scene import presets, scene
from nerfies_jax import evaluation
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training import loop
from tests import gradients, scenes

DEPTH = 0.8
refined = jax.jit(pose_refinement.refine, static_argnums=2)
SPEC = dataclasses.replace(scenes.TINY_SPLATS, poses=PoseRefinementSpec(2e-3, 2e-4))
EVEN = scenes.tiny_capture()


def some_cameras(count, dtype):
    rng = np.random.default_rng(3)
    turns = Rotation.from_rotvec(rng.normal(size=(count, 3))).as_matrix()
    own = cameras.take(EVEN.cameras, np.zeros(count, int))
    own = own._replace(camera_from_world=turns, position=rng.normal(size=(count, 3)))
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype), own)


def by_scipy(screw, camera):
    """The same camera by a matrix exponential in float64."""
    from scipy.linalg import expm

    turn, shift = np.asarray(screw[:3], float), DEPTH * np.asarray(screw[3:], float)
    generator = np.zeros((4, 4))
    generator[:3, :3] = np.cross(np.eye(3), turn)  # [turn]
    generator[:3, 3] = shift
    pose = np.linalg.inv(cameras.world_from_camera(camera).astype(float))
    moved = expm(generator) @ pose
    return moved[:3, :3], -moved[:3, :3].T @ moved[:3, 3]


def test_cameras_move_by_what_their_screws_differ_from_the_mean(dtype):
    rng = np.random.default_rng(0)
    screws = (rng.normal(size=(4, 6)) + 0.3).astype(dtype)
    inputs = some_cameras(4, dtype)
    moved = refined(screws, inputs, DEPTH)
    for row in range(4):
        own = screws[row] - screws.mean(axis=0)
        turn, place = by_scipy(own, cameras.take(inputs, row))
        bound = {"float32": 3e-6, "float64": 1e-12}[dtype]
        np.testing.assert_allclose(moved.camera_from_world[row], turn, atol=bound)
        np.testing.assert_allclose(moved.position[row], place, atol=bound)


@pytest.mark.hard_cases
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-8])
def test_equal_screws_leave_every_camera_and_have_exact_slopes(size, dtype):
    inputs = some_cameras(3, dtype)
    screws = np.full((3, 6), size, dtype)
    moved = refined(screws, inputs, DEPTH)
    jax.tree.map(np.testing.assert_array_equal, moved, inputs)

    def place(screws):
        return refined(screws, inputs, DEPTH).position

    # By hand: a shift v moves a center by -R' v; of the mean there is no slope.
    slope = jax.jit(jax.jacfwd(place))(screws)[0, :, :, 3:]
    back = -DEPTH * np.asarray(inputs.camera_from_world[0]).T
    shares = np.arange(3) == 0
    np.testing.assert_allclose(
        slope, back[:, None, :] * shares[None, :, None], atol=1e-6
    )


def test_one_frame_alone_keeps_its_camera(dtype):
    inputs = some_cameras(1, dtype)
    moved = refined(np.ones((1, 6), dtype), inputs, DEPTH)
    jax.tree.map(np.testing.assert_array_equal, moved, inputs)


@pytest.mark.full
def test_slopes_of_the_loss_are_those_of_differences():
    with jax.enable_x64(True):
        metadata = scene.metadata_of(EVEN)
        model = scene.build(SPEC, metadata)
        state = model.init(EVEN, jax.random.key(0))
        frames = evaluation.frames_of(EVEN)
        view = evaluation.view_of(EVEN, int(EVEN.train[0]))
        truth = frames.images[0].astype(jnp.float64) / 255

        def loss(screws):
            own = screws - jnp.mean(screws, axis=0)  # the rest has no slope
            moved = refined(own, frames.cameras, metadata.depth)
            seen = view._replace(camera=cameras.take(moved, 0))
            rendering = model.render(state.params, seen, EVEN.size, state.step)
            return jnp.mean((rendering.color - truth) ** 2)

        screws = 1e-3 * np.random.default_rng(1).normal(size=(6, 6))
        assert gradients.directional_error(loss, screws, directions=2) < 1e-4


@pytest.mark.full
def test_a_step_moves_the_cameras_of_its_own_frames_and_no_other():
    """Or all walk off: Adam makes a whole step of the smallest slope."""
    model = scene.build(SPEC, scene.metadata_of(EVEN))
    state, _ = jax.jit(model.step)(
        model.init(EVEN, jax.random.key(0)), evaluation.frames_of(EVEN)
    )
    moved = np.abs(state.params.nets["poses"]).max(axis=1) > 0
    assert moved.sum() == SPEC.batch_size == 1


@pytest.mark.full
def test_cameras_that_are_off_are_found():
    """A scene that is known, cameras that are off: at most a fifth of that is left."""
    metadata = scene.metadata_of(EVEN)
    plain = dataclasses.replace(SPEC, strategy=None)
    whole = scene.build(dataclasses.replace(plain, poses=None), metadata)
    state = whole.init(EVEN, jax.random.key(0))
    trained = loop.fit(whole, state, evaluation.frames_of(EVEN), steps=150).state
    rendering = drawn_from(whole, trained, EVEN)
    rng = np.random.default_rng(0)
    error = 0.02 * rng.normal(size=(len(EVEN.train), 6)).astype(np.float32)
    error -= error.mean(axis=0)
    true = evaluation.frames_of(EVEN).cameras
    off = refined(error, true, metadata.depth)
    rates = dataclasses.replace(
        SPEC.learning_rates,
        **dict.fromkeys(
            ("mean", "log_scale", "quaternion", "opacity_logit", "sh_dc", "sh_rest"),
            0.0,
        ),
    )
    still = dataclasses.replace(plain, steps=120, learning_rates=rates)
    model = scene.build(still, metadata)
    began = model.init(EVEN, jax.random.key(0))
    nets = {**trained.params.nets, **began.params.nets}
    began = began._replace(params=trained.params._replace(nets=nets))
    frames = evaluation.frames_of(EVEN)._replace(cameras=off, images=rendering)
    ended = loop.fit(model, began, frames, steps=120).state
    actual = refined(ended.params.nets["poses"], off, metadata.depth)
    assert misplaced_px(actual, true) < misplaced_px(off, true) / 5


@jax.jit
def misplaced_px(estimated, true):
    """Median distance in an image of where points of the scene are seen."""
    see = jax.vmap(jax.vmap(cameras.project, (None, 0)), (0, None))
    points = jnp.asarray(EVEN.points.position)
    away = see(estimated, points)[0] - see(true, points)[0]
    return jnp.median(jnp.linalg.norm(away, axis=-1))


def drawn_from(model, state, capture):
    renderer = evaluation.Renderer(model, capture.size)
    views = [evaluation.view_of(capture, int(row)) for row in capture.train]
    colors = [renderer(state, view).color for view in views]
    return jnp.asarray(np.round(255 * np.clip(colors, 0, 1)), jnp.uint8)


def test_frames_between_lie_between_and_other_cameras_stay():
    held, rows = 3, np.array([0, 1, 2, 4, 5])
    one = dataclasses.replace(EVEN, train=rows, heldout=np.array([held]))
    rng = np.random.default_rng(2)
    screws = (1e-2 * rng.normal(size=(5, 6))).astype(np.float32)
    screws = screws - screws.mean(axis=0)
    actual = pose_refinement.refine_capture(jnp.asarray(screws), one, DEPTH).cameras
    learned = refined(screws, cameras.take(EVEN.cameras, rows), DEPTH)
    np.testing.assert_allclose(actual.position[rows], learned.position, atol=1e-6)
    between = (screws[2] + screws[3]) / 2  # times are even
    turn, place = by_scipy(between, cameras.take(EVEN.cameras, held))
    np.testing.assert_allclose(actual.position[held], place, atol=1e-6)
    np.testing.assert_allclose(actual.camera_from_world[held], turn, atol=1e-6)
    # The second camera, of which nothing was learned.
    np.testing.assert_array_equal(actual.position[6], EVEN.cameras.position[6])


def test_without_refinement_a_capture_is_as_it_was():
    model = scene.build(scenes.TINY_SPLATS, scene.metadata_of(EVEN))
    assert model.apply_to_capture is None
    state = model.init(EVEN, jax.random.key(0))
    assert evaluation.with_refined_cameras(model, state, EVEN) is EVEN


def test_rates_that_rise_are_refused():
    with pytest.raises(ValueError, match="learning_rate"):
        PoseRefinementSpec(learning_rate=1e-5, learning_rate_end=1e-4)
    assert all(spec.poses is None for spec in presets.PRESETS.values())
