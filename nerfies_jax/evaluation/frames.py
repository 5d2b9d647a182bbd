"""The frames of a capture on the device, and views to render."""

from collections.abc import Set

import jax.numpy as jnp
import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.flow import training_flow
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training.model import (
    Frames,
    Model,
    TrainState,
    View,
    in_default_precision,
)


def frames_of(capture: Capture, required_data: Set[str] = frozenset()) -> Frames:
    """The training frames on the device, with what of `required_data` there is."""
    rows = capture.train
    extras = {}
    if "depths" in required_data and capture.depths is not None:
        extras["depths"] = capture.depths[rows]
    if "points" in required_data and capture.points is not None:
        extras["points"] = capture.points.position
    if "flow" in required_data and capture.flow is not None:
        extras["flow"] = training_flow(capture)
    if "moving" in required_data and capture.moving is not None:
        extras["moving"] = capture.moving[rows]
    frames = Frames(
        images=capture.images[rows],
        cameras=cameras.take(capture.cameras, rows),
        times=capture.times[rows],
        appearance=capture.appearance_ids[rows],
        valid=None if capture.valid is None else capture.valid[rows],
        **extras,
    )
    return in_default_precision(frames)


def as_found(model: Model, state: TrainState, capture: Capture) -> Capture:
    """A capture with the cameras that training found; as it is where it looks for none.

    It need not be the one that was learned from: with a lens, or without, of the same
    frames.
    """
    if model.found is None:
        return capture
    return model.found(state.params, capture)


def view_of(capture: Capture, row: int | np.integer) -> View:
    """The view in which a frame was filmed."""
    view = View(
        cameras.take(capture.cameras, row),
        capture.times[row],
        capture.appearance_ids[row],
    )
    return in_default_precision(view)


def resized(view: View, old: tuple[int, int], new: tuple[int, int]) -> View:
    """The same view as a picture of another (width, height)."""
    if old == new:
        return view
    return view._replace(camera=cameras.resize(view.camera, old, new))


def path_views(path: Camera, times: np.ndarray, like: View) -> list[View]:
    """Views along a camera path, one for each time; codes as in `like`."""
    return [
        like._replace(
            camera=in_default_precision(cameras.take(path, row)),
            time=jnp.asarray(moment, like.time.dtype),
        )
        for row, moment in enumerate(times)
    ]


def spread(rows: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of the rows [rows, ...], evenly spread and in their order."""
    picked = np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)
    return rows[picked]
