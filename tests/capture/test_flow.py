"""Optical flow in a capture: validated, thinned out, shrunk, stored and read."""

import json

import numpy as np
import pytest

from nerfies_jax.capture import capture as capturing
from nerfies_jax.capture import flow as flows
from nerfies_jax.capture import nerfies_format
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.flow import FrameFlow
from tests import scenes
from tests.capture.test_capture import make


def some_flow(frames=4, size=(6, 4)):
    rng = np.random.default_rng(1)
    shape = (frames, size[1], size[0])
    leaves = []
    for step in (1, -1):
        rows = np.clip(np.arange(frames) + step, 0, frames - 1).astype(np.int32)
        alone = rows == np.arange(frames)
        shift = rng.normal(size=(*shape, 2)).astype(np.float32)
        seen = rng.random(shape) < 0.7
        shift[alone], seen[alone] = 0, False
        leaves += [shift, seen, rows]
    return FrameFlow(*leaves)


def test_selected_frames_keep_their_neighbors_and_lose_those_that_went():
    whole = make(flow=some_flow())
    part = capturing.select(whole, np.array([3, 0, 1])).flow
    assert part.next_row.tolist() == [0, 2, 2]  # f3 none, f0 to f1, f1 lost f2
    assert part.previous_row.tolist() == [0, 1, 1]  # f3 lost f2, f0 none, f1 to f0
    np.testing.assert_array_equal(part.forward[1], whole.flow.forward[0])
    np.testing.assert_array_equal(part.backward[2], whole.flow.backward[1])
    np.testing.assert_array_equal(part.forward_valid[1], whole.flow.forward_valid[0])
    for gone in (part.forward[2], part.forward_valid[2], part.backward[0]):
        assert not gone.any()
    assert whole.flow.forward[1].any()  # the whole capture is as it was


def test_training_flow_counts_the_frames_that_are_learned_from():
    whole = make(flow=some_flow(), train=np.array([1, 2]), heldout=np.array([0, 3]))
    flow = flows.training_flow(whole)
    assert flow.next_row.tolist() == [1, 1]
    assert flow.previous_row.tolist() == [0, 0]
    assert flow.forward_valid[0].any()
    assert not flow.forward_valid[1].any()
    assert flows.training_flow(make()) is None


@pytest.mark.parametrize(("size", "factor"), [((7, 5), 2), ((9, 7), 3)])
def test_shrunk_flow_is_the_mean_of_each_block_in_larger_pixels(size, factor):
    whole = make(size=size, flow=some_flow(size=size))
    small = capturing.downscale(whole, factor).flow
    width, height = size[0] // factor, size[1] // factor
    assert small.forward.shape == (4, height, width, 2)
    for frame in range(4):
        for row in range(height):
            for column in range(width):
                lines = slice(row * factor, (row + 1) * factor)
                columns = slice(column * factor, (column + 1) * factor)
                block = whole.flow.forward[frame, lines, columns].reshape(-1, 2)
                np.testing.assert_allclose(
                    small.forward[frame, row, column],
                    block.astype(np.float64).mean(0) / factor,
                    rtol=1e-6,
                )
                seen = whole.flow.forward_valid[frame, lines, columns]
                assert small.forward_valid[frame, row, column] == seen.all()
    np.testing.assert_array_equal(small.next_row, whole.flow.next_row)


def test_flow_is_stored_beside_a_nerfies_capture_and_read_back(tmp_path):
    first = scenes.tiny_capture()
    nerfies_format.write(first, tmp_path / "copy", factors=(1, 2))
    second = nerfies_format.read(tmp_path / "copy")
    for one, other in zip(first.flow, second.flow, strict=True):
        np.testing.assert_array_equal(one, other)
    stored = nerfies_format.read(tmp_path / "copy", factor=2).flow
    smaller = capturing.downscale(first, 2).flow
    for one, other in zip(stored, smaller, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    shrunk = nerfies_format.read(tmp_path / "copy", factor=4).flow  # 2x, averaged
    assert shrunk.forward.shape == (len(first.ids), 7, 10, 2)


def test_stored_flow_that_does_not_fit_is_refused_with_its_file(tmp_path):
    first = scenes.tiny_capture()
    nerfies_format.write(first, tmp_path / "copy")
    folder = tmp_path / "copy" / "flow"
    file = folder / "1x" / "forward" / f"{first.ids[0]}.npy"
    np.save(file, np.zeros((30, 40, 2), np.float32))
    with pytest.raises(CaptureError, match=r"forward/.*\.npy: flow of shape"):
        nerfies_format.read(tmp_path / "copy")
    file.unlink()  # a frame may lack its flow
    assert not nerfies_format.read(tmp_path / "copy").flow.forward_valid[0].any()
    (folder / "neighbors.json").write_text(json.dumps({"forward": [1, 2]}))
    with pytest.raises(CaptureError, match=r"neighbors\.json"):
        nerfies_format.read(tmp_path / "copy")
