"""Optical flow for a capture that came without, between frames to learn from."""

import dataclasses

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.evidence import dense_flow, view_set


def with_flow(capture: Capture) -> Capture:
    """The capture with flow to the next and the previous frame of the same camera.

    Frames that are held out neither give nor get any: what they show is not known while
    training. As `dense_flow` finds it, in the pictures as they are; wide steps of a
    film are searched again from where a still scene would be.
    """
    width, height = capture.size
    count = len(capture.images)
    shape = (count, height, width)
    own = np.arange(count, dtype=np.int32)
    flow = FrameFlow(
        np.zeros((*shape, 2), np.float32), np.zeros(shape, bool), own.copy(),
        np.zeros((*shape, 2), np.float32), np.zeros(shape, bool), own.copy(),
    )  # fmt: skip
    for camera in np.unique(capture.camera_ids[capture.train]):
        mine = capture.train[capture.camera_ids[capture.train] == camera]
        if len(mine) < 2:
            continue
        views = view_set.in_time_order(capture, mine)
        # Pictures of one moment are no film: there is nothing to search twice for.
        film = np.ptp(views.time) > 0
        span = view_set.depth_span(capture, views) if film else None
        pictures = dense_flow.leveled(views)
        neighbors = dense_flow.between_neighbors(views, pictures, span)
        flow.forward[views.row] = neighbors.forward
        flow.forward_seen[views.row] = neighbors.forward_seen & views.valid
        flow.next_row[views.row[:-1]] = views.row[1:]
        flow.backward[views.row] = neighbors.backward
        flow.backward_seen[views.row] = neighbors.backward_seen & views.valid
        flow.previous_row[views.row[1:]] = views.row[:-1]
    note = "optical flow between neighboring frames found in the pictures"
    if (flow.next_row == own).all():
        note = (
            "no optical flow: no camera has two frames to learn from, so no two frames "
            "are neighbors"
        )
    return dataclasses.replace(capture, flow=flow, notes=(*capture.notes, note))
