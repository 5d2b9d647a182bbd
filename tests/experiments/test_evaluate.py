"""Frames on the device, frames rendered, frames scored."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import skimage.metrics

from experiments import evaluate
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training.model import Model, Rendering, TrainState
from tests import scenes

SIZE = (40, 30)


def state_at(step, level):
    zero = jnp.zeros((), jnp.int32)
    return TrainState(jnp.asarray(level, jnp.float32), (), (), zero + step, None)


def flat(params, view, size, step):
    """A grey picture: parameters, time and step show in it."""
    shape = size[::-1]
    level = params + view.time / 10 + step.astype(jnp.float32) / 100
    return Rendering(
        jnp.broadcast_to(jnp.sum(level), (*shape, 3)), jnp.ones(shape), jnp.ones(shape)
    )


MODEL = Model("flat", None, None, flat, (), lambda state: {})


def test_only_what_a_model_wants_is_put_on_the_device():
    capture = scenes.tiny_capture()
    frames = evaluate.frames_of(capture)
    assert frames.depths is frames.points is frames.flow is None
    frames = evaluate.frames_of(capture, frozenset({"depths"}))
    assert frames.points is None
    np.testing.assert_array_equal(frames.depths, capture.depths[capture.train])
    frames = evaluate.frames_of(capture, frozenset({"points"}))
    assert frames.depths is None
    np.testing.assert_array_equal(frames.points, capture.points.position)


def test_what_a_capture_has_not_is_none_though_wanted():
    bare = dataclasses.replace(scenes.tiny_capture(), depths=None, points=None)
    frames = evaluate.frames_of(bare, frozenset({"depths", "points"}))
    assert frames.depths is frames.points is None


def test_a_renderer_sees_parameters_time_and_step_and_compiles_once_a_shape():
    capture = scenes.tiny_capture()
    traced = []

    def render(*args):
        traced.append(args)
        return flat(*args)

    renderer = evaluate.Renderer(MODEL._replace(render=render), SIZE)
    view = evaluate.view_of(capture, 3)
    for step, level in ((0, 0.1), (7, 0.4), (20, 0.2)):
        picture = renderer(state_at(step, level), view).colour
        expected = level + float(capture.times[3]) / 10 + step / 100
        np.testing.assert_allclose(picture, expected, atol=1e-6)
    renderer(state_at(0, [0.1, 0.2]), view)
    assert len(renderer.seconds) == 4
    assert len(traced) == 2


def test_scores_are_those_of_the_picture_as_eight_bits():
    capture = scenes.tiny_capture()
    renderer = evaluate.Renderer(MODEL, SIZE)
    scored = evaluate.score(renderer, state_at(10, 0.3), capture, capture.heldout)
    for place, row in enumerate(capture.heldout):
        level = 0.3 + 0.1 + float(capture.times[row]) / 10
        picture = np.full((30, 40, 3), np.round(level * 255) / 255)
        truth = capture.images[row] / 255
        mse = np.mean((picture - truth) ** 2)
        np.testing.assert_allclose(scored.psnr[place], -10 * np.log10(mse), atol=1e-4)
        ssim = skimage.metrics.structural_similarity(
            picture,
            truth,
            channel_axis=-1,
            data_range=1,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
        np.testing.assert_allclose(scored.ssim[place], ssim, atol=1e-4)


@pytest.mark.parametrize("new", [(40, 30), (20, 15)])
def test_a_resized_view_shows_the_same_directions(new):
    view = evaluate.view_of(scenes.tiny_capture(), 0)
    small = evaluate.resized(view, SIZE, new)
    point = jnp.asarray([0.02, -0.03, 0.1], jnp.float32)
    here, depth = cameras.project(view.camera, point)
    there, same_depth = cameras.project(small.camera, point)
    assert depth == same_depth > 0
    np.testing.assert_allclose(there * (SIZE[0] / new[0]), here, rtol=1e-5)
