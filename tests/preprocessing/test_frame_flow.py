"""Flow for a capture that came without."""

import dataclasses

import numpy as np

from nerfies_jax.preprocessing import frame_flow
from tests.preprocessing import two_planes


def test_flow_leads_to_the_next_frame_of_the_same_camera_and_past_held_out_ones():
    # 18 px of 96 a frame, and 36 past one held out: the latter are found only by a
    # search from where a still scene would be.
    capture = two_planes.make(camera=lambda t: (2.8 * t - 1.4, 0.0, 0.0), frames=8)
    capture = dataclasses.replace(
        capture,
        train=np.array([0, 1, 2, 4, 5, 7]),
        heldout=np.array([3, 6]),
        camera_ids=np.array([0, 0, 0, 0, 0, 1, 1, 1]),
    )
    flow = frame_flow.with_flow(capture).flow
    assert flow.next_row.tolist() == [1, 2, 4, 3, 4, 7, 6, 7]
    assert flow.previous_row.tolist() == [0, 0, 1, 3, 2, 5, 6, 5]
    alone = flow.next_row == np.arange(8)
    assert not flow.forward_valid[alone].any()
    # A wall at z = FAR before cameras that only shift moves by their parallax.
    position = capture.cameras.position
    for row in (0, 2):
        step = position[row] - position[flow.next_row[row]]
        wall = flow.forward_valid[row] & ~capture.moving[row]
        assert wall.mean() > 0.5
        off = flow.forward[row][wall] - two_planes.FOCAL * step[:2] / two_planes.FAR
        assert np.median(np.linalg.norm(off, axis=-1)) < 0.2


def test_cameras_of_one_frame_have_no_flow_and_a_note_says_so():
    capture = two_planes.make(frames=3)
    capture = dataclasses.replace(capture, camera_ids=np.arange(3, dtype=np.int32))
    actual = frame_flow.with_flow(capture)
    assert not actual.flow.forward_valid.any()
    assert actual.notes[-1].startswith("no optical flow: no camera has two training")
