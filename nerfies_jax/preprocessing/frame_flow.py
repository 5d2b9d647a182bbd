"""Optical flow between training frames, for a capture without flow."""

import dataclasses

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.preprocessing import dense_flow, view_set


def with_flow(capture: Capture) -> Capture:
    """Compute flow to the next and the previous frame of the same camera.

    Held-out frames have no flow and do not affect it, because they are unknown during
    training. Flow is computed by `dense_flow` at full resolution. Large displacements
    of a video are searched for again, starting from the flow of a static scene.

    Args:
      capture: The capture.

    Returns:
      The capture with its flow.
    """
    width, height = capture.size
    count = len(capture.images)
    shape = (count, height, width)
    rows = np.arange(count, dtype=np.int32)
    one_way = np.zeros((*shape, 2), np.float32), np.zeros(shape, bool), rows
    flow = FrameFlow._make(leaf.copy() for leaf in one_way * 2)
    for camera in np.unique(capture.camera_ids[capture.train]):
        mine = capture.train[capture.camera_ids[capture.train] == camera]
        if len(mine) < 2:
            continue
        views = view_set.in_time_order(capture, mine)
        # Images with one timestamp are not a video and need no second search.
        is_video = np.ptp(views.time) > 0
        span = view_set.depth_span(capture, views) if is_video else None
        images = dense_flow.leveled(views)
        neighbors = dense_flow.between_neighbors(views, images, span)
        flow.forward[views.row] = neighbors.forward
        flow.forward_valid[views.row] = neighbors.forward_valid & views.valid
        flow.next_row[views.row[:-1]] = views.row[1:]
        flow.backward[views.row] = neighbors.backward
        flow.backward_valid[views.row] = neighbors.backward_valid & views.valid
        flow.previous_row[views.row[1:]] = views.row[:-1]
    note = "optical flow between neighboring frames was computed from the images"
    if (flow.next_row == rows).all():
        note = "no optical flow: no camera has two training frames"
    return dataclasses.replace(capture, flow=flow, notes=(*capture.notes, note))
