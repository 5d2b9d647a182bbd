"""What is booked to which part of a training step, whatever the clock says."""

import jax
import pytest

import gaussians_jax.step_time
import nerfies_jax.step_time
from gaussians_jax import scene as splat_scene
from nerfies_jax import evaluation
from nerfies_jax import scene as field_scene
from tests import scenes


@pytest.mark.parametrize(
    ("whole", "rest"), [(9.0, 4.0), pytest.param(4.0, 0.0, id="nothing left")]
)
def test_parts_of_a_field_are_differences_and_none_is_negative(
    whole, rest, monkeypatch
):
    clock = iter([2.0, 5.0, whole])
    monkeypatch.setattr(nerfies_jax.step_time, "part_ms", lambda *_: next(clock))
    metadata, params, _ = scenes.tiny_field()
    model = field_scene.build(scenes.TINY_FIELD, metadata)
    state = model.example(None, jax.random.key(0))._replace(params=params)
    frames = evaluation.frames_of(scenes.tiny_capture())
    parts = nerfies_jax.step_time.parts(
        scenes.TINY_FIELD, metadata, model, state, frames
    )
    assert parts == {"forward": 2.0, "backward": 3.0, "rays and optimiser": rest}


def test_what_parts_of_splats_leave_of_a_step_is_the_optimisers(monkeypatch):
    clock = iter([2.0, 1.0, 4.0, 9.0])
    monkeypatch.setattr(gaussians_jax.step_time, "part_ms", lambda *_: next(clock))
    capture, spec = scenes.tiny_capture(), scenes.TINY_DEFORMABLE
    metadata = splat_scene.metadata_of(capture)
    model = splat_scene.build(spec, metadata)
    state = model.init(capture, jax.random.key(0))
    parts = gaussians_jax.step_time.parts(
        spec, metadata, model, state, evaluation.frames_of(capture)
    )
    assert parts["optimiser and statistics"] == 2.0
    assert list(parts)[:2] == ["project and blend", "loss"]
    assert sum(parts.values()) == 9.0
