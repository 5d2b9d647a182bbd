"""Render a trained model and score it on the frames it never learnt from."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.measure import image_quality
from nerfies_jax.training.model import Frames, Model, Rendering, View


class HeldOut(NamedTuple):
    """Held-out frames as rendered, and their scores; NumPy, one row per frame."""

    rows: np.ndarray  # of the capture
    colour: np.ndarray  # [frames, height, width, 3] float32, clipped to [0, 1]
    alpha: np.ndarray  # [frames, height, width]
    depth: np.ndarray  # [frames, height, width] z-depth, scene units
    psnr: np.ndarray  # dB, of the 8-bit picture
    ssim: np.ndarray  # scikit-image's Gaussian form
    ms_per_frame: float  # median after the first frame


def frames_of(capture: Capture) -> Frames:
    """The training frames on the device."""
    rows = capture.train
    return Frames(
        images=jnp.asarray(capture.images[rows]),
        cameras=jax.tree.map(lambda leaf: jnp.asarray(leaf[rows]), capture.cameras),
        times=jnp.asarray(capture.times[rows]),
        warp=jnp.asarray(capture.warp_ids[rows]),
        appearance=jnp.asarray(capture.appearance_ids[rows]),
        valid=None if capture.valid is None else jnp.asarray(capture.valid[rows]),
    )


def views_of(capture: Capture, rows: np.ndarray) -> list[View]:
    """The views in which these frames were filmed."""
    return [
        View(
            jax.tree.map(jnp.asarray, cameras.take(capture.cameras, row)),
            jnp.asarray(capture.times[row]),
            jnp.asarray(capture.warp_ids[row]),
            jnp.asarray(capture.appearance_ids[row]),
        )
        for row in rows
    ]


def path_views(path: Camera, times: np.ndarray, like: View) -> list[View]:
    """Views along a camera path; codes as in `like`."""
    return [
        like._replace(
            camera=jax.tree.map(jnp.asarray, cameras.take(path, row)),
            time=jnp.asarray(moment, like.time.dtype),
        )
        for row, moment in enumerate(times)
    ]


class Renderer:
    """A model's whole-frame function, compiled once, and what each frame took."""

    def __init__(self, model: Model, size: tuple[int, int]):
        self._render = jax.jit(lambda params, view: model.render(params, view, size))
        self.seconds = []

    def __call__(self, params, view: View) -> Rendering:
        start = time.perf_counter()
        rendering = jax.device_get(self._render(params, view))
        self.seconds.append(time.perf_counter() - start)
        return rendering

    @property
    def ms_per_frame(self) -> float:
        """Median over all frames but the first, which compiles."""
        return 1e3 * float(np.median(self.seconds[1:] or self.seconds))


def render_heldout(
    model: Model, params, capture: Capture, rows: np.ndarray | None = None
) -> HeldOut:
    """Render `rows` (all held-out frames by default) and score them.

    Scores are of the picture as an 8-bit file would hold it, over the filmed pixels.
    """
    rows = capture.heldout if rows is None else rows
    renderer = Renderer(model, capture.size)
    renderings, scores = [], []
    for row, view in zip(rows, views_of(capture, rows), strict=True):
        rendering = renderer(params, view)
        renderings.append(rendering)
        truth = capture.images[row].astype(np.float32) / 255
        valid = None if capture.valid is None else capture.valid[row]
        scores.append(jax.device_get(_score(rendering.colour, truth, valid)))
    return HeldOut(
        rows=rows,
        colour=np.clip(np.stack([r.colour for r in renderings]), 0, 1),
        alpha=np.stack([r.alpha for r in renderings]),
        depth=np.stack([r.depth for r in renderings]),
        psnr=np.asarray([psnr for psnr, _ in scores]),
        ssim=np.asarray([ssim for _, ssim in scores]),
        ms_per_frame=renderer.ms_per_frame,
    )


@jax.jit
def _score(colour, truth, valid):
    picture = image_quality.quantise(colour)
    if valid is None:
        return image_quality.psnr(picture, truth), image_quality.ssim(picture, truth)
    return (
        image_quality.masked_psnr(picture, truth, valid),
        image_quality.masked_ssim(picture, truth, valid),
    )
