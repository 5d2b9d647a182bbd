"""Flow for a capture that came without."""

import dataclasses

import numpy as np

from nerfies_jax.evidence import frame_flow
from tests.evidence import films


def test_flow_leads_to_the_next_frame_of_the_same_camera_and_past_held_out_ones():
    capture = films.film(frames=8)
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
    assert not flow.forward_seen[alone].any()
    # A wall at z = FAR before cameras that only shift moves by their parallax.
    position = capture.cameras.position
    shift = films.FOCAL * (position[0] - position[1])[:2] / films.FAR
    wall = flow.forward_seen[0] & ~capture.moving[0]
    assert wall.mean() > 0.5
    off = np.linalg.norm(flow.forward[0][wall] - shift, axis=-1)
    assert np.median(off) < 0.2
