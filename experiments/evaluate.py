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
from nerfies_jax.training.model import (
    Frames,
    Model,
    Rendering,
    TrainState,
    View,
    in_default_precision,
)


class Scored(NamedTuple):
    """Frames as rendered, and their scores; NumPy, one row per frame."""

    rows: np.ndarray  # of the capture
    colour: np.ndarray  # [frames, height, width, 3] float32, clipped to [0, 1]
    alpha: np.ndarray  # [frames, height, width]
    depth: np.ndarray  # [frames, height, width] z-depth, scene units
    psnr: np.ndarray  # dB, of the 8-bit picture
    ssim: np.ndarray  # scikit-image's Gaussian form


def frames_of(capture: Capture, required_data: frozenset[str] = frozenset()) -> Frames:
    """The training frames on the device, with what of `required_data` there is."""
    rows = capture.train
    beside = {}
    if "depths" in required_data and capture.depths is not None:
        beside["depths"] = capture.depths[rows]
    if "points" in required_data and capture.points is not None:
        beside["points"] = capture.points.position
    if "flow" in required_data and capture.flow is not None:
        beside["flow"] = training_flow(capture)
    frames = Frames(
        images=capture.images[rows],
        cameras=cameras.take(capture.cameras, rows),
        times=capture.times[rows],
        appearance=capture.appearance_ids[rows],
        valid=None if capture.valid is None else capture.valid[rows],
        **beside,
    )
    return in_default_precision(frames)


def view_of(capture: Capture, row: int) -> View:
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


class Halves(NamedTuple):
    """Scores of the right halves of frames whose codes were fitted to the left ones."""

    rows: np.ndarray  # of the capture
    psnr: np.ndarray  # dB, of the 8-bit picture
    ssim: np.ndarray


class Renderer:
    """A model's whole-frame function; compiled once for each shape of its state.

    Where the model is drawn in stages, what stays as it was is not computed again:
    the first stage as long as the parameters are the very same arrays, the second for
    all views of the same instant.
    """

    def __init__(self, model: Model, size: tuple[int, int]):
        self._model = model
        self._programs = {}
        self._prepared = _Kept()
        self._posed = _Kept()
        self.size = size  # width and height in pixels
        self.seconds: list[float] = []  # of every frame, without compiling
        self.cpu_seconds: list[float] = []  # the same, of the processor
        self.posed_anew: list[bool] = []  # whether that frame's instant was a new one

    def __call__(self, state: TrainState, view: View) -> Rendering:
        inputs = state.params, view, state.step
        shapes = tuple(jax.typeof(leaf) for leaf in jax.tree.leaves(inputs))
        if shapes not in self._programs:
            compiled = _whole if self._model.stages is None else _staged
            self._programs[shapes] = compiled(self._model, self.size, inputs)
        start, cpu_start = time.perf_counter(), time.process_time()
        rendering, anew = self._draw(self._programs[shapes], *inputs)
        rendering = jax.device_get(rendering)
        self.seconds.append(time.perf_counter() - start)
        self.cpu_seconds.append(time.process_time() - cpu_start)
        self.posed_anew.append(anew)
        return rendering

    def _draw(self, programs, params, view, step):
        """The picture, and whether what is in it had to be posed for it."""
        if self._model.stages is None:
            return programs(params, view, step), True
        prepared, _ = self._prepared.get(params, None, lambda: programs.prepare(params))
        instant = np.asarray(view.time).tobytes()
        posed, anew = self._posed.get(
            params, instant, lambda: programs.pose(params, prepared, view.time)
        )
        return programs.draw(params, posed, view, step), anew

    def ms_per_frame(self, frames: int, cpu: bool = False) -> float:
        """What one of the last `frames` frames took, on the wall or of the processor.

        The median, of frames at a new instant and of further views of the same instant
        apart, weighted by how many there were of each: the median of both together
        would leave out the poses altogether as soon as a second view shares them.
        """
        seconds = np.asarray((self.cpu_seconds if cpu else self.seconds)[-frames:])
        anew = np.asarray(self.posed_anew[-frames:])
        parts = [seconds[anew], seconds[~anew]]
        total = sum(len(part) * np.median(part) for part in parts if len(part))
        return 1e3 * float(total) / len(seconds)


class _Kept:
    """The last result of a function of parameters and a key.

    It is right as long as every leaf is the very same array; the leaves are held, so
    that no new array can be taken for an old one. NumPy arrays can be written into, so
    nothing is kept for parameters that contain one.
    """

    def __init__(self):
        self._leaves, self._key, self._result = None, None, None

    def get(self, params, key, compute):
        """The result, and whether it was computed now."""
        leaves, structure = jax.tree.flatten(params)
        if (
            self._leaves is not None
            and self._key == (key, structure)
            and all(a is b for a, b in zip(leaves, self._leaves, strict=True))
        ):
            return self._result, False
        self._leaves = self._result = None  # freed before the new one is made
        result = compute()
        if all(isinstance(leaf, jax.Array) for leaf in leaves):
            self._leaves, self._key, self._result = leaves, (key, structure), result
        return result, True


class _Programs(NamedTuple):
    """The stages of a model, compiled."""

    prepare: Callable
    pose: Callable
    draw: Callable


def _float32(rendering):
    """A picture needs no more, whatever precision it was computed in."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), rendering)


def _whole(model, size, inputs):
    def render(params, view, step):
        return _float32(model.render(params, view, size, step))

    return jax.jit(render).lower(*inputs).compile()


def _staged(model, size, inputs):
    stages, (params, view, step) = model.stages, inputs

    def draw(params, posed, view, step):
        return _float32(stages.draw(params, posed, view, size, step))

    prepare = jax.jit(stages.prepare).lower(params)
    pose = jax.jit(stages.pose).lower(params, prepare.out_info, view.time)
    drawn = jax.jit(draw).lower(params, pose.out_info, view, step)
    return _Programs(prepare.compile(), pose.compile(), drawn.compile())


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
