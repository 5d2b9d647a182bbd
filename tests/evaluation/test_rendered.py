"""Frames on the device, frames rendered, frames scored."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.metrics

from gaussians_jax.scene import scene
from nerfies_jax import evaluation
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training.model import Model, Rendering, Stages, Surveyed, TrainState
from tests import scenes

SIZE = (40, 30)


def state_at(step, level):
    zero = jnp.zeros((), jnp.int32)
    return TrainState(jnp.asarray(level, jnp.float32), (), (), zero + step, None)


def flat(params, view, size, step):
    """A gray image: parameters, time and step show in it."""
    shape = size[::-1]
    level = params + view.time / 10 + step.astype(jnp.float32) / 100
    return Rendering(
        jnp.broadcast_to(jnp.sum(level), (*shape, 3)), jnp.ones(shape), jnp.ones(shape)
    )


MODEL = Model("flat", None, None, flat, (), lambda state: {})


def test_only_what_a_model_wants_is_put_on_the_device():
    capture = scenes.tiny_capture()
    frames = evaluation.frames_of(capture)
    assert frames.depths is frames.points is frames.flow is None
    frames = evaluation.frames_of(capture, frozenset({"depths"}))
    assert frames.points is None
    np.testing.assert_array_equal(frames.depths, capture.depths[capture.train])
    frames = evaluation.frames_of(capture, frozenset({"points"}))
    assert frames.depths is None
    np.testing.assert_array_equal(frames.points, capture.points.position)


def test_what_a_capture_has_not_is_none_though_wanted():
    bare = dataclasses.replace(scenes.tiny_capture(), depths=None, points=None)
    frames = evaluation.frames_of(bare, frozenset({"depths", "points"}))
    assert frames.depths is frames.points is None


def test_a_renderer_sees_parameters_time_and_step_and_compiles_once_a_shape():
    capture = scenes.tiny_capture()
    traced = []

    def render(*args):
        traced.append(args)
        return flat(*args)

    renderer = evaluation.Renderer(MODEL._replace(render=render), SIZE)
    view = evaluation.view_of(capture, 3)
    for step, level in ((0, 0.1), (7, 0.4), (20, 0.2)):
        image = renderer(state_at(step, level), view).color
        expected = level + float(capture.times[3]) / 10 + step / 100
        np.testing.assert_allclose(image, expected, atol=1e-6)
    renderer(state_at(0, [0.1, 0.2]), view)
    assert len(renderer.seconds) == 4
    assert len(traced) == 2


def test_a_renderer_compiles_as_its_model_asks():
    model = MODEL._replace(compiler_options={"no_such_option": "1"})
    view = evaluation.view_of(scenes.tiny_capture(), 3)
    with pytest.raises(jax.errors.JaxRuntimeError, match="no_such_option"):
        evaluation.Renderer(model, SIZE)(state_at(0, 0.1), view)


class Counted:
    """A model in stages that counts how often each of them really runs."""

    def __init__(self):
        self.calls = {"prepare": 0, "deform": 0, "draw": 0}

        def prepare(params):
            self._count("prepare")
            return {"basis": 2 * params["weight"]}

        def deform(params, prepared, time):
            self._count("deform")
            return params["mean"] + time * prepared["basis"]

        def draw(params, deformed, view, size, step):
            self._count("draw")
            return flat(jnp.sum(deformed), view, size, step)

        def render(params, view, size, step):
            del params, view, size, step
            raise AssertionError("a model with stages is drawn by them")

        stages = Stages(prepare, deform, draw)
        self.model = MODEL._replace(render=render, stages=stages)

    def _count(self, name):
        def add():
            self.calls[name] += 1

        jax.debug.callback(add)

    def since(self, act):
        """What ran in the meantime, as (prepare, deform, draw)."""
        jax.effects_barrier()
        before = dict(self.calls)
        image = act()
        jax.effects_barrier()
        ran = tuple(self.calls[name] - before[name] for name in before)
        return ran, float(image.color[0, 0, 0])


def test_a_renderer_keeps_what_stays_and_drops_what_changes():
    counted, capture = Counted(), scenes.tiny_capture()
    renderer = evaluation.Renderer(counted.model, SIZE)
    here, later = (evaluation.view_of(capture, row) for row in (1, 3))
    aside = later._replace(time=here.time)  # another view of the same instant
    assert here.time != later.time
    params = {"mean": jnp.asarray(0.1), "weight": jnp.asarray(0.2)}

    def stages_run(params, view):
        state = TrainState(params, (), (), jnp.zeros((), jnp.int32), None)
        ran, gray = counted.since(lambda: renderer(state, view))
        time = float(view.time)
        exact = float(params["mean"]) + time * 2 * float(params["weight"]) + time / 10
        np.testing.assert_allclose(gray, exact, atol=1e-6)
        return ran

    assert stages_run(params, here) == (1, 1, 1)
    assert stages_run(params, here) == (0, 0, 1)
    assert stages_run(dict(params), aside) == (0, 0, 1)  # another dict, the same arrays
    assert stages_run(params, later) == (0, 1, 1)
    assert stages_run(params, here) == (0, 1, 1)
    for name in params:
        params = params | {name: params[name] + 0.3}
        assert stages_run(params, here) == (1, 1, 1)
        equal = params | {name: params[name] + 0.0}  # of equal value, but another array
        assert stages_run(equal, here) == (1, 1, 1)
        assert stages_run(params, later) == (1, 1, 1)
    assert renderer.newly_deformed == [True, False, False, *[True] * 8]


def test_a_survey_is_made_once_for_trained_parameters_and_their_step():
    surveyed = []

    def survey(params, step):
        jax.debug.callback(lambda: surveyed.append(None))
        return params + step.astype(params.dtype)

    def draw(params, known, view, size, step):
        return flat(known - step.astype(params.dtype), view, size, step)

    model = MODEL._replace(render=None, surveyed=Surveyed(survey, draw))
    renderer, view = (
        evaluation.Renderer(model, SIZE),
        evaluation.view_of(scenes.tiny_capture(), 0),
    )
    first, other = jnp.asarray(0.1), jnp.asarray(0.1)
    for number, (params, step) in enumerate(
        [(first, 0), (first, 0), (first, 7), (other, 7), (other, 7)]
    ):
        state = TrainState(params, (), (), jnp.int32(step), None)
        image = renderer(state, view).color
        expected = 0.1 + float(view.time) / 10 + step / 100
        np.testing.assert_allclose(image, expected, atol=1e-6)
        jax.effects_barrier()
        assert len(surveyed) == [1, 1, 2, 3, 3][number]


def test_nothing_is_kept_of_arrays_that_can_be_written_into():
    counted = Counted()
    renderer = evaluation.Renderer(counted.model, SIZE)
    view = evaluation.view_of(scenes.tiny_capture(), 0)
    params = {"mean": np.float32(0.1) + np.zeros((), np.float32), "weight": np.ones(1)}
    params = {name: np.asarray(x, np.float32) for name, x in params.items()}
    state = TrainState(params, (), (), jnp.zeros((), jnp.int32), None)
    _, before = counted.since(lambda: renderer(state, view))
    params["mean"][...] = 0.5
    ran, after = counted.since(lambda: renderer(state, view))
    assert ran == (1, 1, 1)
    np.testing.assert_allclose(after - before, 0.4, atol=1e-6)


def test_a_frame_costs_what_it_costs_with_its_share_of_the_poses():
    renderer = evaluation.Renderer(MODEL, SIZE)
    renderer.seconds = [9.0, 0.010, 0.002, 0.030, 0.004, 0.010, 0.003]
    renderer.newly_deformed = [True, True, False, True, False, True, False]
    # Medians 0.010 of the three new instants and 0.003 of the other three.
    np.testing.assert_allclose(renderer.ms_per_frame(6), (3 * 10 + 3 * 3) / 6)
    np.testing.assert_allclose(renderer.ms_per_frame(1), 3)
    renderer.cpu_seconds = [2 * seconds for seconds in renderer.seconds]
    np.testing.assert_allclose(renderer.ms_per_frame(1, cpu=True), 6)
    np.testing.assert_allclose(renderer.ms_per_frame(2), (10 + 3) / 2)


@pytest.fixture(scope="module")
def moving():
    """A deformable scene that moves, its state at the last step."""
    capture = scenes.tiny_capture()
    model = scene.build(scenes.TINY_DEFORMABLE, scene.metadata_of(capture))
    state = model.init(capture, jax.random.key(0))
    nets = jax.tree.map(lambda leaf: leaf + 0.02, state.params.nets)
    params = state.params._replace(nets=nets)
    return model, state._replace(params=params, step=jnp.asarray(20, jnp.int32))


@pytest.mark.full
def test_a_scene_in_stages_is_drawn_as_in_one(moving):
    model, state = moving
    capture = scenes.tiny_capture()
    staged = evaluation.Renderer(model, capture.size)
    whole = evaluation.Renderer(model._replace(stages=None), capture.size)
    views = [evaluation.view_of(capture, row) for row in (0, 3, 5)]
    first, last = (whole(state, view).color for view in (views[0], views[-1]))
    assert np.abs(first - last).max() > 0.05
    for view in views:
        image, expected = staged(state, view), whole(state, view)
        # Depth is a quotient by an opacity, and processors differ in how sums are cut.
        for name, rtol in (("color", 1e-7), ("alpha", 1e-7), ("depth", 3e-5)):
            np.testing.assert_allclose(
                getattr(image, name),
                getattr(expected, name),
                rtol=rtol,
                atol=3e-6,
                err_msg=name,
            )


def test_scores_are_those_of_the_image_as_eight_bits():
    capture = scenes.tiny_capture()
    renderer = evaluation.Renderer(MODEL, SIZE)
    scored = evaluation.score(renderer, state_at(10, 0.3), capture, capture.heldout)
    for place, row in enumerate(capture.heldout):
        level = 0.3 + 0.1 + float(capture.times[row]) / 10
        image = np.full((30, 40, 3), np.round(level * 255) / 255)
        truth = capture.images[row] / 255
        mse = np.mean((image - truth) ** 2)
        np.testing.assert_allclose(scored.psnr[place], -10 * np.log10(mse), atol=1e-4)
        ssim = skimage.metrics.structural_similarity(
            image,
            truth,
            channel_axis=-1,
            data_range=1,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
        np.testing.assert_allclose(scored.ssim[place], ssim, atol=1e-4)
    with pytest.raises(ValueError, match="no frames to evaluate; hold out frames"):
        evaluation.score(renderer, state_at(10, 0.3), capture, capture.heldout[:0])


def test_a_resized_view_shows_the_same_directions():
    view = evaluation.view_of(scenes.tiny_capture(), 0)
    small = evaluation.resized(view, SIZE, (20, 15))
    project, point = jax.jit(cameras.project), np.float32([0.02, -0.03, 0.1])
    here, depth = project(view.camera, point)
    there, same_depth = project(small.camera, point)
    assert depth == same_depth > 0
    np.testing.assert_allclose(2 * np.asarray(there), here, rtol=1e-5)


@pytest.mark.parametrize("masked", [False, True])
def test_the_code_sees_the_left_half_and_the_score_the_right(masked):
    capture = scenes.tiny_capture()
    valid = np.ones(capture.images.shape[:3], bool)
    valid[:, :, -4:] = False
    capture = dataclasses.replace(capture, valid=valid if masked else None)
    seen = []

    def fit_code(view, left, mask):
        seen.append((float(view.time), left, mask))
        return left.mean() / 255

    def render(view, code):
        image = np.full((30, 40, 3), code, np.float32)
        image[:, :20] = 5.0  # what is wrong on the left costs nothing
        return image

    scored = evaluation.score_halves(fit_code, render, capture, capture.heldout)
    np.testing.assert_array_equal(scored.rows, capture.heldout)
    for place, row in enumerate(capture.heldout):
        time, left, mask = seen[place]
        assert time == capture.times[row]
        np.testing.assert_array_equal(left, capture.images[row, :, :20])
        assert mask.shape == (30, 20) if masked else mask is None
        level = np.round(left.mean()) / 255
        right = capture.images[row, :, 20 : 36 if masked else 40] / 255
        exact = -10 * np.log10(np.mean((right - level) ** 2))
        np.testing.assert_allclose(scored.psnr[place], exact, atol=1e-3)
        assert 0 < scored.ssim[place] < 1
        np.testing.assert_allclose(scored.color[place], left.mean() / 255, rtol=1e-6)
