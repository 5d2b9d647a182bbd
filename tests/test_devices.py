"""The number of devices, and training steps lowered for other platforms."""

import re

import jax
import numpy as np
import pytest

from gaussians_jax.scene import scene as splat_scene
from nerfies_jax import evaluation
from nerfies_jax.runtime import data_parallel
from nerfies_jax.scene import scene as field_scene
from tests import scenes


def model_of(spec, capture=None):
    """Return a model of the tiny capture, with its first state and frames."""
    capture = capture or scenes.tiny_capture()
    if isinstance(spec, field_scene.RadianceScene):
        model = field_scene.build(spec, field_scene.metadata_of(capture, spec))
    else:
        model = splat_scene.build(spec, splat_scene.metadata_of(capture))
    state = model.example(capture, jax.random.key(0))
    return model, state, evaluation.frames_of(capture, model.required_data)


def test_the_number_of_devices_can_be_limited(monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: 8)
    monkeypatch.setattr(data_parallel, "_limit", None)
    assert data_parallel.device_count(16) == 8
    data_parallel.limit_devices(3)
    assert data_parallel.device_count(16) == 2  # the largest divisor
    with pytest.raises(ValueError, match="devices=9: this process has 8 of kind cpu"):
        data_parallel.limit_devices(9)


@pytest.mark.parametrize(
    ("present", "used", "lines"),
    [
        (8, 8, []),
        (
            *(8, 2),
            [
                "2 of 8 devices train, and 6 stay idle: a step has 2 equal part(s); "
                "set batch_size to a multiple of 8 to use them all"
            ],
        ),
    ],
)
def test_idle_devices_are_named(present, used, lines, monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: present)
    monkeypatch.setattr(data_parallel, "_limit", None)
    assert data_parallel.idle_note(used, used, "batch_size") == lines


def test_an_uncommitted_state_is_bound_to_no_device():
    values = np.arange(4, dtype=np.float32)
    bound = jax.device_put((values, jax.random.key(3)), jax.devices()[0])
    free, key = data_parallel.uncommitted(bound)
    assert bound[0].committed
    assert not free.committed
    assert free.unsafe_buffer_pointer() != bound[0].unsafe_buffer_pointer()
    np.testing.assert_array_equal(free, values)
    assert key is bound[1]


SCENES = {
    "splats": scenes.TINY_DEFORMABLE,
    "field": scenes.TINY_FIELD,
}


@pytest.mark.full
@pytest.mark.parametrize("name", SCENES)
def test_a_step_is_lowered_for_other_platforms(name):
    """Without callbacks to the host, float64 or kernels that a platform may lack."""
    model, state, frames = model_of(SCENES[name])
    exported = jax.export.export(jax.jit(model.step), platforms=("cuda", "tpu"))
    text = exported(state, frames).mlir_module()
    assert re.findall(r"custom_call\s*@(\w+)", text) == []
    assert re.findall(r"\bf64\b", text) == []
