"""Starts that nobody would choose, for radiance fields.

A start changes numbers alone, never a shape, so one compiled field serves all of them.
Frames and parameters are NumPy's: each jax operation outside would be a program.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.fields.effects.time_warp import TimeWarp
from nerfies_jax.training.model import Frames
from tests.hard_cases import hostile

PyTree = Any


def as_is(x: Any) -> Any:
    """Nothing changes."""
    return x


class Start(NamedTuple):
    """What is unusual, on the way from the capture to the first step."""

    capture: Callable[[Capture], Capture] = as_is
    frames: Callable[[Frames], Frames] = as_is
    params: Callable[[PyTree], PyTree] = as_is
    speed: float = 1.0  # times the learning rate
    # Effects one of which must be there for the start to differ from any other.
    needs: tuple[str, ...] = ()


def scaled(factor: float) -> Callable[[Capture], Capture]:
    """The same capture in other units."""

    def change(capture):
        cameras = capture.cameras
        position = (cameras.position * factor).astype(np.float32)
        points = (capture.points.position * factor).astype(np.float32)
        return dataclasses.replace(
            capture,
            cameras=cameras._replace(position=position),
            points=capture.points._replace(position=points),
            depths=(capture.depths * factor).astype(np.float32),
            near=capture.near * factor,
            far=capture.far * factor,
        )

    return change


def inside(capture: Capture) -> Capture:
    """All cameras amid the points, looking the ways they did."""
    middle = np.median(capture.points.position, axis=0)
    position = np.broadcast_to(middle, capture.cameras.position.shape).copy()
    return dataclasses.replace(
        capture, cameras=capture.cameras._replace(position=position)
    )


def thin(share: float) -> Callable[[Capture], Capture]:
    """A near plane that share of the depth before the far one."""
    return lambda capture: dataclasses.replace(
        capture, near=capture.far * (1 - share), points=None
    )


def from_the_lens(capture: Capture) -> Capture:
    """A near plane as near as a capture may have it."""
    return dataclasses.replace(capture, near=1e-6, points=None)


def rounded(frames: Frames) -> Frames:
    """Images as bfloat16 shares."""
    shares = (frames.images / 255).astype(jnp.bfloat16)
    return frames._replace(images=255 * shares.astype(np.float32))


def unobserved_nan(frames: Frames) -> Frames:
    """`hostile.unobserved`, where nothing is but NaN."""
    frames = hostile.unobserved(frames)
    images = np.where(frames.valid[..., None], frames.images, np.float32(np.nan))
    return frames._replace(images=images)


def nothing_observed(frames: Frames) -> Frames:
    """No pixel at all, and NaN everywhere."""
    images = np.full_like(frames.images, np.nan)
    return frames._replace(images=images, valid=np.zeros_like(frames.valid))


def one_exposure(frames: Frames) -> Frames:
    """All frames under one appearance id."""
    return frames._replace(appearance=np.zeros_like(frames.appearance))


def points_at(factor: float) -> Callable[[Frames], Frames]:
    """Static points that far out, or all in one."""

    def change(frames):
        if frames.points is None:
            return frames
        return frames._replace(points=frames.points * np.float32(factor))

    return change


def flow_times(factor: float, *names: str) -> Callable[[Frames], Frames]:
    """These arrays of the optical flow so many times as large."""

    def change(frames):
        if frames.flow is None:
            return frames
        old = {name: getattr(frames.flow, name) for name in names}
        new = {name: (factor * x).astype(x.dtype) for name, x in old.items()}
        return frames._replace(flow=frames.flow._replace(**new))

    return change


def denser(raw: float) -> Callable[[PyTree], PyTree]:
    """That much on every density before its activation, of every medium."""

    def change(params):
        return jax.tree_util.tree_map_with_path(
            lambda path, leaf: leaf + np.float32(raw * _is_density_bias(path)), params
        )

    return change


def _is_density_bias(path):
    return jax.tree_util.keystr(path).endswith("['density'].bias")


def bent(factor: float) -> Callable[[PyTree], PyTree]:
    """The read-outs of the warp so many times as large."""

    def read_out(network):
        heads = jax.tree.map(lambda leaf: leaf * np.float32(factor), network.heads)
        return network._replace(heads=heads)

    def change(params):
        if "warp" not in params:
            return params
        warp = params["warp"]
        if isinstance(warp, TimeWarp):  # its second network
            return params | {"warp": warp._replace(shift=read_out(warp.shift))}
        return params | {"warp": read_out(warp)}

    return change


def coded(deviation: float) -> Callable[[PyTree], PyTree]:
    """Codes as far apart as that."""

    def normal(shape):
        return np.random.default_rng(9).normal(size=shape).astype(np.float32)

    def change(params):
        tables = {
            name: np.float32(deviation) * normal(table.shape)
            for name, table in params["codes"].items()
        }
        return params | {"codes": tables}

    return change


def times(factor: float) -> Callable[[PyTree], PyTree]:
    """Every parameter so many times as large."""
    return lambda params: jax.tree.map(lambda leaf: leaf * np.float32(factor), params)


BY_CODE = ("appearance",)  # codes of motion come with them in all these papers
FLOW = ("scene_flow",)
SEEN = ("forward_valid", "backward_valid")
NEEDS = {
    "no depth known": FLOW,
    "constant depth": FLOW,
    "unobserved depth not a number": FLOW,
}
OF_FRAMES = {
    name: Start(frames=change, needs=NEEDS.get(name, ()))
    for name, change in hostile.CAPTURES.items()
}
OF_CAPTURES = {
    "bfloat16 images": Start(frames=rounded),
    "unobserved not a number": Start(frames=unobserved_nan),
    "nothing observed": Start(frames=nothing_observed),
    "one exposure": Start(frames=one_exposure, needs=("appearance",)),
    "no flow known": Start(frames=flow_times(0, *SEEN), needs=FLOW),
    "wild flow": Start(frames=flow_times(1e4, "forward", "backward"), needs=FLOW),
    "points in one place": Start(frames=points_at(0.0), needs=("background",)),
    "points at 1e20": Start(frames=points_at(1e20), needs=("background",)),
    "cameras inside": Start(capture=inside),
    "near 1e-6 before far": Start(capture=thin(1e-6)),
    "near as far as far": Start(capture=thin(1e-9)),
    "near at the lens": Start(capture=from_the_lens),
    "box of 1e-5 units": Start(capture=scaled(1e-5)),
    "box of 1e5 units": Start(capture=scaled(1e5)),
}
OF_PARAMETERS = {
    "opaque": Start(params=denser(100.0)),
    "opaque by far": Start(params=denser(1e6)),
    "empty": Start(params=denser(-100.0)),
    # Weights of 1e-22: their squares are below float32
    "next to empty": Start(params=denser(-75.0)),
    "folded warp": Start(params=bent(1e3), needs=("warp",)),
    "shattered warp": Start(params=bent(1e6), needs=("warp",)),
    "codes of 1e3": Start(params=coded(1e3), needs=BY_CODE),
    "codes of 1e9": Start(params=coded(1e9), needs=BY_CODE),
    "all zero": Start(params=times(0.0)),
    "all a hundredfold": Start(params=times(100.0)),
    "rate tenfold": Start(speed=10.0),
    "rate a thousandfold": Start(speed=1e3),
}
