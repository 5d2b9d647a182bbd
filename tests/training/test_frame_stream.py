"""Frames that are streamed to the device train as those that are there."""

import functools
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.training import loop
from nerfies_jax.training.frame_stream import FrameStream, Window
from nerfies_jax.training.model import Frames
from tests.training import toy

COUNT, SIZE = 64, (6, 5)
LIMIT = 40 * 6 * 5 * 3  # two windows of ten frames, and the cameras and times of all


def images():
    return np.random.default_rng(0).integers(0, 255, (COUNT, *SIZE, 3), np.uint8)


def without_pixels(rows, bad_step=0):
    camera = jax.tree.map(lambda leaf: np.zeros(0, np.float32), toy.frames().cameras)
    times = np.linspace(0, 1, len(rows), dtype=np.float32)
    ids, bad = np.zeros(0, np.int32), np.full((1, 3), bad_step, np.float32)
    none = np.zeros((0, *SIZE, 3), np.uint8)
    return Frames(none, camera, times, ids, None, points=bad)


def row_of(key, frames):
    return jax.random.randint(jax.random.split(key)[0], (), 0, len(frames.times))


def reads(key, step, frames):
    return (row_of(jax.random.fold_in(key, step), frames)[None],)


def step(state, frames):
    row = row_of(loop.step_key(state), frames)
    image = frames.images[frames.image_row(row)].astype(jnp.float32)
    # The toy reads the first frame of those that it gets.
    chosen = frames._replace(images=image[None], times=frames.times[row][None])
    after, metrics = toy.step(state, chosen)
    bad = after.step.astype(jnp.float32) == frames.points[0, 0]
    return after, metrics | {"loss": jnp.where(bad, jnp.nan, metrics["loss"])}


MODEL = toy.model(toy.ToySpec(grow_at=(23,)), change=step)._replace(reads=reads)
STEPS = 130
ALL = np.arange(COUNT)


def stream_of(rows, bad_step=0):
    frames = without_pixels(rows, bad_step)
    return FrameStream(MODEL, frames, {"images": images()}, rows, LIMIT)


@functools.cache
def whole(every=1, bad_step=0):
    """A run with all of its frames on the device."""
    frames = without_pixels(ALL[::every], bad_step)
    return fit(frames._replace(images=images()[::every]))


def fit(frames, state=None, steps=STEPS):
    return toy.fit(frames, state, MODEL, steps=steps)


@pytest.mark.parametrize("every", [1, 2])
def test_streamed_frames_give_the_same_states(every):
    """Bit for bit, with an event between whole scans."""
    streamed = fit(stream_of(ALL[::every]))
    assert toy.same(whole(every).state, streamed.state)
    assert not toy.same(whole(3 - every).state, streamed.state)


def test_a_resumed_run_reads_the_frames_of_its_steps():
    part = fit(stream_of(ALL), steps=37)
    assert toy.same(whole().state, fit(stream_of(ALL), part.state).state)


def test_a_replay_reads_the_frames_of_its_steps():
    """It begins at a snapshot that is older than the frames on the device."""
    expected, streamed = whole(bad_step=76), fit(stream_of(ALL, bad_step=76))
    assert streamed.stopped_by == "non-finite"
    assert streamed.steps == expected.steps == 75
    assert toy.same(expected.state, streamed.state)


def test_at_most_two_windows_are_on_the_device(monkeypatch):
    counted, alive = [], []
    load = FrameStream._load

    def counting(self, step, indices):
        counted.append(sum(reference() is not None for reference in alive))
        frames = load(self, step, indices)
        alive.append(weakref.ref(frames.images))
        return frames

    monkeypatch.setattr(FrameStream, "_load", counting)
    stream = stream_of(ALL)
    fit(stream)
    assert len(counted) > STEPS / 10
    assert max(counted) == 1  # besides the one that is loaded
    sizes = [leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(stream.layout)]
    assert 2 * sum(sizes) < LIMIT < images().nbytes


def test_a_limit_below_two_windows_is_refused():
    frames, gib = without_pixels(ALL), 2**30
    needed = 20 * 6 * 5 * 3 + 4 * COUNT + 12  # and times, and the point
    message = rf"frame_memory={1700 / gib:.3g}: {needed / gib:.3g} GiB .*of 20 steps"
    with pytest.raises(ValueError, match=message):
        FrameStream(MODEL, frames, {"images": images()}, ALL, 1700)


def test_an_event_gets_no_frames_rather_than_others():
    assert stream_of(ALL).frames.images.shape == (0, *SIZE, 3)


@pytest.mark.parametrize(
    ("run", "step", "steps", "covered"),
    [
        (b"a", 20, 10, True),
        (b"a", 25, 5, True),
        (b"a", 25, 6, False),
        (b"a", 19, 1, False),
        (b"b", 20, 10, False),
    ],
)
def test_a_window_is_of_ten_steps_of_one_run(run, step, steps, covered):
    assert Window(b"a", 20, None).covers(run, step, steps) == covered
