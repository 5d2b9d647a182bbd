"""Render a trained model and score it on the frames it never learnt from."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.flow import training_flow
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.measure import image_quality
from nerfies_jax.training.model import Frames, Model, Rendering, TrainState, View


class Scored(NamedTuple):
    """Frames as rendered, and their scores; NumPy, one row per frame."""

    rows: np.ndarray  # of the capture
    colour: np.ndarray  # [frames, height, width, 3] float32, clipped to [0, 1]
    alpha: np.ndarray  # [frames, height, width]
    depth: np.ndarray  # [frames, height, width] z-depth, scene units
    psnr: np.ndarray  # dB, of the 8-bit picture
    ssim: np.ndarray  # scikit-image's Gaussian form


def frames_of(capture: Capture, wants: frozenset[str] = frozenset()) -> Frames:
    """The training frames on the device, with what a model `wants` and there is."""
    rows = capture.train
    beside = {}
    if "depths" in wants and capture.depths is not None:
        beside["depths"] = jnp.asarray(capture.depths[rows])
    if "points" in wants and capture.points is not None:
        beside["points"] = jnp.asarray(capture.points.position)
    if "flow" in wants and capture.flow is not None:
        beside["flow"] = jax.tree.map(jnp.asarray, training_flow(capture))
    return Frames(
        images=jnp.asarray(capture.images[rows]),
        cameras=jax.tree.map(jnp.asarray, cameras.take(capture.cameras, rows)),
        times=jnp.asarray(capture.times[rows]),
        warp=jnp.asarray(capture.warp_ids[rows]),
        appearance=jnp.asarray(capture.appearance_ids[rows]),
        valid=None if capture.valid is None else jnp.asarray(capture.valid[rows]),
        **beside,
    )


def view_of(capture: Capture, row: int) -> View:
    """The view in which a frame was filmed."""
    return View(
        jax.tree.map(jnp.asarray, cameras.take(capture.cameras, row)),
        jnp.asarray(capture.times[row]),
        jnp.asarray(capture.warp_ids[row]),
        jnp.asarray(capture.appearance_ids[row]),
    )


def resized(view: View, old: tuple[int, int], new: tuple[int, int]) -> View:
    """The same view as a picture of another (width, height)."""
    if old == new:
        return view
    return view._replace(camera=cameras.resize(view.camera, old, new))


def path_views(path: Camera, times: np.ndarray, like: View) -> list[View]:
    """Views along a camera path, one for each time; codes as in `like`."""
    return [
        like._replace(
            camera=jax.tree.map(jnp.asarray, cameras.take(path, row)),
            time=jnp.asarray(moment, like.time.dtype),
        )
        for row, moment in enumerate(times)
    ]


class Halves(NamedTuple):
    """Scores of the right halves of frames whose codes were fitted to the left ones."""

    rows: np.ndarray  # of the capture
    psnr: np.ndarray  # dB, of the 8-bit picture
    ssim: np.ndarray


class Renderer:
    """A model's whole-frame function; compiled once for each shape of its state."""

    def __init__(self, model: Model, size: tuple[int, int]):
        self._render = jax.jit(
            lambda params, view, step: model.render(params, view, size, step)
        )
        self._programs = {}
        self.size = size  # width and height in pixels
        self.seconds: list[float] = []  # of every frame, without compiling

    def __call__(self, state: TrainState, view: View) -> Rendering:
        inputs = state.params, view, state.step
        shapes = tuple(jax.typeof(leaf) for leaf in jax.tree.leaves(inputs))
        if shapes not in self._programs:
            self._programs[shapes] = self._render.lower(*inputs).compile()
        start = time.perf_counter()
        rendering = jax.device_get(self._programs[shapes](*inputs))
        self.seconds.append(time.perf_counter() - start)
        return rendering

    def ms_per_frame(self, frames: int) -> float:
        """Median over the last `frames` frames."""
        return 1e3 * float(np.median(self.seconds[-frames:]))


def score(
    renderer: Renderer, state: TrainState, capture: Capture, rows: np.ndarray
) -> Scored:
    """Render frames of a capture and compare them with what was filmed.

    Scores are of the picture as an 8-bit file would hold it, over the filmed pixels.
    """
    renderings, scores = [], []
    for row in rows:
        rendering = renderer(state, view_of(capture, row))
        truth = capture.images[row].astype(np.float32) / 255
        valid = None if capture.valid is None else capture.valid[row]
        scores.append(jax.device_get(_score(rendering.colour, truth, valid)))
        renderings.append(rendering)
    psnr, ssim = np.asarray(scores).T
    return Scored(
        rows=np.asarray(rows),
        colour=np.clip(np.stack([r.colour for r in renderings]), 0, 1),
        alpha=np.stack([r.alpha for r in renderings]),
        depth=np.stack([r.depth for r in renderings]),
        psnr=psnr,
        ssim=ssim,
    )


def score_halves(
    fit_code: Callable[[View, np.ndarray, np.ndarray | None], Any],
    render: Callable[[View, Any], Rendering],
    capture: Capture,
    rows: np.ndarray,
) -> Halves:
    """Score frames whose appearance was never learnt, by NeRF-W's protocol.

    `fit_code(view, left, valid)` finds the codes of a frame from its left half alone,
    uint8 [height, width // 2, 3] and which of it was filmed (or None), with the network
    frozen; `render(view, codes)` draws the whole frame with them, and its right half
    is scored (Martin-Brualla et al. 2021, section 5).
    """
    colours = []
    for row in rows:
        view, picture = view_of(capture, row), capture.images[row]
        half = picture.shape[1] // 2
        left = None if capture.valid is None else capture.valid[row, :, :half]
        codes = fit_code(view, picture[:, :half], left)
        colours.append(np.asarray(render(view, codes).colour))
    return score_right_halves(capture, rows, colours)


def score_right_halves(
    capture: Capture, rows: np.ndarray, colours: Sequence[np.ndarray]
) -> Halves:
    """Scores of the right halves of rendered frames [height, width, 3]."""
    scores = []
    for row, colour in zip(rows, colours, strict=True):
        half = colour.shape[1] // 2
        truth = capture.images[row, :, half:].astype(np.float32) / 255
        valid = None if capture.valid is None else capture.valid[row, :, half:]
        scores.append(jax.device_get(_score(colour[:, half:], truth, valid)))
    psnr, ssim = np.asarray(scores).T
    return Halves(np.asarray(rows), psnr, ssim)


@jax.jit
def _score(colour, truth, valid):
    picture = image_quality.quantise(colour)
    if valid is None:
        return image_quality.psnr(picture, truth), image_quality.ssim(picture, truth)
    return (
        image_quality.masked_psnr(picture, truth, valid),
        image_quality.masked_ssim(picture, truth, valid),
    )


def as_picture(colour: np.ndarray) -> np.ndarray:
    """A rendered colour as 8 bits."""
    return np.round(np.clip(colour, 0, 1) * 255).astype(np.uint8)


def spread(rows: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of the rows, evenly spread."""
    picked = np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)
    return rows[picked]
