"""What is booked to which part of a training step, whatever the clock says."""

import dataclasses

import jax
import pytest

import gaussians_jax.scene.step_time
import nerfies_jax.scene.step_time
from gaussians_jax.scene import scene as splat_scene
from nerfies_jax import evaluation
from nerfies_jax.metrics import part_time
from nerfies_jax.scene import scene as field_scene
from nerfies_jax.training import rate
from tests import scenes


def clock(monkeypatch, module, *times, whole):
    """Each part takes the next of the times, and can be traced as it is called."""
    monkeypatch.setattr(module, "part", jax.eval_shape)
    monkeypatch.setattr(
        part_time, "parts_ms", lambda parts: dict(zip(parts, times, strict=True))
    )
    monkeypatch.setattr(rate, "step_ms", lambda *run: whole)


@pytest.mark.parametrize(
    ("batches", "whole", "rest"),
    [(2, 9.0, 3.25), pytest.param(1, 4.0, 0.0, id="nothing left")],
)
def test_what_parts_of_a_field_leave_of_a_step_is_never_negative(
    batches, whole, rest, monkeypatch
):
    spec = dataclasses.replace(scenes.TINY_FIELD, micro_batches=batches)
    whole += 5.5 * (batches - 1)
    clock(monkeypatch, nerfies_jax.scene.step_time, 0.5, 2.0, 5.0, 0.25, whole=whole)
    metadata, params, _ = scenes.tiny_field()
    model = field_scene.build(spec, metadata)
    state = model.example(None, jax.random.key(0))._replace(params=params)
    frames = evaluation.frames_of(scenes.tiny_capture())
    parts = nerfies_jax.scene.step_time.parts(spec, metadata, model, state, frames).ms()
    assert parts == {
        "rays": 0.5 * batches,
        "forward": 2.0 * batches,
        "backward": 3.0 * batches,
        "optimizer": 0.25,
        "rest": rest,
    }


def test_every_part_of_a_step_of_splats_is_measured(monkeypatch):
    clock(
        monkeypatch, gaussians_jax.scene.step_time, 2.0, 1.0, 4.0, 0.5, 0.25, whole=9.0
    )
    capture, spec = scenes.tiny_capture(), scenes.TINY_DEFORMABLE
    metadata = splat_scene.metadata_of(capture)
    model = splat_scene.build(spec, metadata)
    state = model.init(capture, jax.random.key(0))
    parts = gaussians_jax.scene.step_time.parts(
        spec, metadata, model, state, evaluation.frames_of(capture)
    ).ms()
    assert parts == {
        "project and blend": 2.0,
        "loss": 1.0,
        "mlp motion": 4.0,
        "optimizer": 0.5,
        "statistics": 0.25,
        "rest": 1.25,
    }
