"""Scenes of both representations train on streamed frames as on those on the device."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.capture import frame_memory, synthetic
from nerfies_jax.fields.spec import OccupancySpec
from nerfies_jax.runtime import data_parallel
from nerfies_jax.training.frame_stream import FrameStream
from tests import fresh_process, scenes
from tests.test_devices import model_of
from tests.training import toy

RAYS = dataclasses.replace(scenes.TINY_FIELD, steps=100, rays=16)
SPECS = {
    "splats with depths": dataclasses.replace(scenes.TINY_SONATA, strategy=None),
    "two views": dataclasses.replace(scenes.TINY_SPLATS, strategy=None, batch_size=2),
    "curriculum and candidates": dataclasses.replace(
        RAYS,
        warp=None,
        appearance=None,
        curriculum_steps=50,
        sampling=dataclasses.replace(RAYS.sampling, occupancy=OccupancySpec()),
    ),
    "two parts": dataclasses.replace(RAYS, micro_batches=2),
}
SHARED = "two views", "two parts"  # by two devices


@functools.cache
def capture():
    """A capture of 64 frames with masks, every fourth held out."""
    spec = dataclasses.replace(scenes.TINY_SCENE, size=(20, 15), frames=64)
    made = synthetic.make(spec)[0]
    valid = np.random.default_rng(0).random(made.images.shape[:3]) < 0.8
    rows = np.arange(64)
    train, heldout = rows[rows % 4 > 0], rows[rows % 4 == 0]
    return dataclasses.replace(made, valid=valid, train=train, heldout=heldout)


def limit(monkeypatch, model, share):
    """Limit the memory of frames to a share of that of all of them."""
    names = {"images", "valid", *model.required_data & {"depths"}}
    each = sum(getattr(capture(), name)[:1].nbytes for name in names)
    limit = share * each * len(capture().train)
    monkeypatch.setattr(frame_memory, "_device_limit", limit)


def both(name, monkeypatch):
    spec = SPECS[name]
    model, state, frames = model_of(spec, capture())
    limit(monkeypatch, model, 1)
    assert isinstance(evaluation.training_frames(model, capture()), type(frames))
    limit(monkeypatch, model, 0.98)
    streamed = evaluation.training_frames(model, capture())
    assert isinstance(streamed, FrameStream)
    return [toy.fit(each, state, model, steps=24) for each in (frames, streamed)]


@pytest.mark.full
@pytest.mark.parametrize("name", [name for name in SPECS if name not in SHARED])
def test_streamed_frames_give_the_same_states(name, monkeypatch):
    """Bit for bit, with depths, and with the curriculum and selection of rays."""
    one, other = both(name, monkeypatch)
    assert toy.same(one.state, other.state)


@pytest.mark.full
def test_two_devices_train_on_streamed_frames():
    fresh_process.run(
        "import os; os.environ['JAX_NUM_CPU_DEVICES'] = '2';"
        "os.environ['XLA_FLAGS'] = '--xla_backend_optimization_level=0';"
        "from tests.evaluation import test_streamed_frames as t; t.on_two_devices()"
    )


def on_two_devices():
    assert data_parallel.available() == 2
    for name in SHARED:
        with pytest.MonkeyPatch.context() as patch:
            one, other = both(name, patch)
        assert toy.same(one.state, other.state)


@pytest.mark.full
def test_frames_of_a_model_that_reads_any_pixel_must_fit(monkeypatch):
    model, _, _ = model_of(RAYS, capture())
    limit(monkeypatch, model, 0.98)
    message = "which has 0.0 GiB for them; read smaller images"
    with pytest.raises(ValueError, match=message):
        evaluation.training_frames(model._replace(reads=None), capture())
    limit(monkeypatch, model, 1e-6)
    for function in (evaluation.training_frames, evaluation.check_frames):
        with pytest.raises(ValueError, match=r"GiB of device memory .* 20 steps"):
            function(model, capture())


@pytest.mark.parametrize("size", [0, -1.0, np.inf, np.nan])
def test_the_memory_of_frames_is_a_positive_number(size):
    with pytest.raises(ValueError, match=f"frame_memory={size} must be a positive"):
        frame_memory.limit_device(size)


def test_training_needs_memory_besides_its_frames(monkeypatch):
    device = type("Device", (), {"memory_stats": lambda self: {"bytes_limit": 100}})
    monkeypatch.setattr(jax, "local_devices", lambda: [device()])
    monkeypatch.setattr(frame_memory, "_device_limit", 60)
    assert [frame_memory.device_limit(most) for most in (0, 40, 70, 200)] == [
        60,
        60,
        30,
        0,
    ]
