"""What a run tells of its size and speed, and what it keeps where a part fails."""

import dataclasses
import pathlib
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.capture import images, nerfies_format
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.evaluation.representation import Saved
from nerfies_jax.evaluation.scores import Scored
from nerfies_jax.metrics import perceptual
from nerfies_jax.runs import (
    curve_figure,
    products,
    quality,
    representations,
    step_profile,
)
from nerfies_jax.runs.captures import stored_capture
from nerfies_jax.runs.config import CaptureSource, MoreMetrics, RunConfig
from nerfies_jax.runs.run import Run, scene_spec
from nerfies_jax.runs.train import Trained
from nerfies_jax.training.loop import History
from nerfies_jax.training.model import Model, Rendering, TrainState
from nerfies_jax.visualization import panels
from tests import scenes


def test_the_size_of_a_model_is_a_metric_where_there_is_one():
    (size,) = products.model_size(Saved(2_345_678))
    assert (size.key, size.value) == ("file.bytes", 2_345_678)
    assert products.model_size(Saved()) == []


def test_a_run_that_learned_nothing_has_no_report():
    image, nan = np.zeros((1, 4, 5)), np.full(1, np.nan)
    scored = Scored(np.arange(1), image, image, image, nan + 0, nan + 0)
    known = scored._replace(psnr=np.float32([20.0]))
    learned = History(({"step": 5, "loss": 0.0}, {"step": 9, "loss": 0.1}))
    quality.check_learned(learned, known)
    quality.check_learned(History(), known)
    with pytest.raises(FloatingPointError, match="the loss was 0 in all steps"):
        quality.check_learned(History(learned.rows[:1]), known)
    with pytest.raises(
        FloatingPointError, match="none of the 1 scored held-out frames"
    ):
        quality.check_learned(learned, scored)


def test_installed_lpips_is_left_out_where_images_are_too_small(monkeypatch):
    monkeypatch.setattr(perceptual, "installed_weights", lambda network: None)
    assert quality.prepared(MoreMetrics()) == quality.NOTHING
    monkeypatch.setattr(perceptual, "installed_weights", lambda network: "a file")
    params = perceptual.LpipsParams((), ())
    monkeypatch.setattr(perceptual, "load", lambda network, files: params)
    extra = quality.prepared(MoreMetrics())
    assert quality.fitting(extra, (64, 31)).lpips.params == params
    assert quality.fitting(extra, (64, 30)).lpips is None
    extra_lpips = quality.prepared(MoreMetrics(lpips_weights=("a.npz",)))
    with pytest.raises(ValueError, match="at least 31 pixels"):
        quality.fitting(extra_lpips, (64, 30))


def test_a_run_on_nothing_does_not_begin(tmp_path):
    nerfies_format.write(scenes.tiny_capture(), tmp_path / "a")
    for file in (tmp_path / "a/rgb/1x").iterdir():
        color = images.read_pixels(file)
        alpha = np.ones_like(color[..., :1])  # of 255: 0 and 1 instead of 0 and 255
        images.write_png(file, np.concatenate([color, alpha], -1))
    with pytest.raises(CaptureError, match=r"255, so no pixel is opaque"):
        stored_capture(CaptureSource(capture=tmp_path / "a"))


def test_depths_of_two_cameras_are_two_files(tmp_path):
    capture = scenes.tiny_capture()
    ids = ("cam0/000", "cam1/000", *capture.ids[2:])
    depth = np.ones((2, 4, 5), np.float32)
    some = np.zeros(2)
    scored = Scored(np.arange(2), depth, depth, depth, some, some)
    products.save_depth(tmp_path, dataclasses.replace(capture, ids=ids), scored)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["cam0_000.exr", "cam1_000.exr"]


def test_a_player_that_fails_loses_nothing_but_itself(tmp_path):
    def write(*_):
        raise KeyError("mean")

    capture = scenes.tiny_capture()
    gaussians = representations.named("gaussians")
    kind = gaussians._replace(products=gaussians.products._replace(player=write))
    config = RunConfig("splats-static-small")
    run = Run(config, capture, capture, kind, None, None, None)
    black = Rendering(np.zeros((30, 40, 3), np.float32), None, None)
    result = types.SimpleNamespace(state=None)
    trained = Trained(result, lambda *_: black, None)
    assert products.save_player(tmp_path, run, trained) == (
        [],
        ["The interactive player could not be created: KeyError: 'mean'"],
    )
    without = gaussians._replace(products=gaussians.products._replace(player=None))
    run = run._replace(representation=without)
    figures, (note,) = products.save_player(tmp_path, run, trained)
    assert (figures, "has no interactive player" in note) == ([], True)
    assert not list(tmp_path.iterdir())


def test_a_profile_that_fails_loses_nothing_but_itself():
    def refuses(*_, **__):
        raise KeyError("kept")

    capture, config = scenes.tiny_capture(), RunConfig("splats-static-small")
    kind = representations.named("gaussians")
    model = Model(None, None, None, None, (), None)
    state = TrainState(None, None, None, jnp.int32(0), jax.random.key(0))
    unready = types.SimpleNamespace(ms=refuses)
    for step_parts in (refuses, lambda *_, **__: unready):
        resources = kind.resources._replace(
            step_parts=step_parts, estimate_memory_bytes=None
        )
        failing = kind._replace(resources=resources)
        run = Run(config, capture, capture, failing, None, None, model)
        with step_profile.profiling(run, state) as profile:
            step_ms, (note,) = profile()
        assert step_ms == {}
        assert "could not be measured: KeyError: 'kept'" in note


def test_the_curve_and_the_headline_agree_visibly(tmp_path, monkeypatch):
    """The curve is of a few frames; its figure and caption have the score as well."""
    curves = []
    monkeypatch.setattr(panels, "curve", lambda *parts: curves.append(parts))
    capture = scenes.tiny_capture()
    config = RunConfig("splats-static-small")
    run = Run(config, capture, capture, None, None, None, None)
    rows = ({"seconds": 1.0, "psnr": 20.0}, {"seconds": 3.0, "psnr": 30.61})
    history = types.SimpleNamespace(evaluations=rows)
    result = types.SimpleNamespace(history=history, seconds=3.5)
    score = curve_figure.Result(29.5, 3, is_fitted=False)
    for watched, final in ((np.arange(2), (3.5, 29.5, 3, 2)), (np.arange(3), None)):
        trained = Trained(result, None, watched)
        path = tmp_path / "curve.png"
        assert curve_figure.save(path, run, trained, score) == path
        (history, _, mark) = curves.pop()
        assert history["splats-static-small"].psnr == [20.0, 30.61]
        assert mark == final
        caption = curve_figure.caption(run, trained, score)
        assert "protocol" not in caption
        fitted = score._replace(is_fitted=True)
        assert "NeRF-W's protocol" in curve_figure.caption(run, trained, fitted)
        assert "ends at 30.61 dB" in caption
        assert ("over all 3 frames" in caption) == (final is not None)
        assert ("29.50 dB" in caption) == (final is not None)
        names = ", ".join(capture.ids[:2])
        assert (f"2 of the 3 scored held-out frames ({names})" in caption) == (
            final is not None
        )


def test_the_comparison_shows_right_halves_with_fitted_codes(tmp_path, monkeypatch):
    capture = scenes.tiny_capture()
    rows = np.arange(2)
    truth = capture.images[rows] / np.float32(255)
    height, width = truth.shape[1:3]
    depth = np.arange(width) + np.zeros((2, height, 1))
    unfitted = Scored(rows, 0 * truth, depth * 0 + 1, depth, np.ones(2), np.ones(2))
    halves = evaluation.score_right_halves(capture, rows[1:], truth[1:])
    shown = {}

    def comparison(true, color, depth, captions, known_depth):
        shown.update(true=true, color=color, depth=depth, captions=captions)
        return np.zeros((4, 4, 3), np.uint8)

    monkeypatch.setattr(panels, "comparison", comparison)
    fitted = products._right_halves(unfitted, halves)
    products._save_comparison(tmp_path / "comparison.png", capture, fitted)
    half = width // 2
    np.testing.assert_array_equal(shown["true"], capture.images[rows[1:], :, half:])
    np.testing.assert_array_equal(shown["color"], truth[1:, :, half:])
    np.testing.assert_array_equal(shown["depth"], depth[1:, :, half:])
    (caption,) = shown["captions"]
    assert capture.ids[rows[1]] in caption
    assert f"{halves.psnr[0]:.2f} dB" in caption


def test_twice_as_long_is_twice_as_long_whoever_set_the_steps():
    config = RunConfig("splats-static-small", overrides=("steps=40", "sh_degree=0"))
    run = types.SimpleNamespace(config=config, spec=scene_spec(config), code=())
    result = types.SimpleNamespace(stopped_by="steps", steps=40)
    *_, longer = products._next(
        pathlib.Path("run"), run, types.SimpleNamespace(result=result)
    )
    assert longer.line.endswith("--steps 80 --set sh_degree=0")
