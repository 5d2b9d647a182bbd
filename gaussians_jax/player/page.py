"""`player.html`: a trained dynamic scene in one file that plays in any browser.

Nothing is fetched: Gaussians, program and poster are in the file. The color of a
Gaussian does not depend on the direction, but is its mean color in the training views.
Motion is linear between the stored times.
"""

import base64
import html
import importlib.resources
import io
import json
import pathlib
import re

import numpy as np
import PIL.Image
from jaxtyping import Array, Int

from gaussians_jax.io.keyframes import (
    Keyframes,
    count_for,
    measure_contributions,
    sample,
)
from gaussians_jax.io.single_time import gaussians_at, written_rows
from gaussians_jax.player import packing
from gaussians_jax.player.limits import camera_limits
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax.capture import camera_paths
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.evaluation.representation import Player
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training.model import Model, TrainState

# A larger page takes seconds to open in a browser. Larger scenes get fewer times, at
# least enough to resolve the motion.
MOST_BYTES, FEWEST_KEYFRAMES = 48 * 2**20, 8
# Rasterizer settings that project() of the page reads.
# Settings that the page's own project() reads.
RASTER = (
    *("alpha_threshold", "alpha_max", "eps2d", "antialiased", "near", "far"),
    "tangent_margin",
)
PROGRAM = ("splats", "camera", "painter", "controls", "player")  # in this order
LARGEST = 1e30  # stands for an infinite far plane, which JSON cannot represent


def write(
    path: pathlib.Path,
    title: str,
    model: Model,
    raster: RasterSpec,
    degree: Int[Array, ""],
    state: TrainState,
    capture: Capture,
    poster: np.ndarray,
) -> Player:
    """Write the page, which opens with the first training camera.

    Args:
      path: File to write.
      title: Title of the page.
      model: The model.
      raster: Settings of the rasterizer.
      degree: Degree of the spherical harmonics in use.
      state: Trained state.
      capture: The capture.
      poster: uint8 [height, width, 3] image that is shown until the first frame is
        rendered, and where rendering is not possible.

    Returns:
      Summary of the player.
    """
    at, rows = gaussians_at(model, state), written_rows(model, state)
    statistics = measure_contributions(at, rows, raster, degree, capture)
    count = count_for(capture)
    keyframes, packed_scene = _pack(at, rows, capture, statistics, count)
    if len(packed_scene.data) > MOST_BYTES:
        fewer = int(count * MOST_BYTES / len(packed_scene.data))
        count = max(fewer, FEWEST_KEYFRAMES)
        keyframes, packed_scene = _pack(at, rows, capture, statistics, count)
    return compose(
        path,
        title,
        packed_scene,
        _about(keyframes, packed_scene, capture),
        raster,
        capture,
        poster,
    )


def compose(
    path: pathlib.Path,
    title: str,
    packed: packing.Packed,
    about: str,
    raster: RasterSpec,
    capture: Capture,
    poster: np.ndarray,
) -> Player:
    """Write the page of encoded Gaussians.

    Args:
      path: File to write.
      title: Title of the page.
      packed: The encoded Gaussians.
      about: Sentences about them, for the caption.
      raster: Thresholds of the image.
      capture: Provides the first view and the limits of the camera.
      poster: Image [height, width, 3] (uint8) that is shown until the first frame.

    Returns:
      The file and its caption.
    """
    background = capture.background or (0.0, 0.0, 0.0)
    parts = {
        "title": html.escape(title),
        "about": html.escape(about),
        "background": "#" + bytes(round(255 * part) for part in background).hex(),
        "poster": _data_url(poster),
        # A "</script>" in a name must not end the header.
        "header": json.dumps(header(packed, raster, capture)).replace("<", "\\u003c"),
        "data": base64.b64encode(packed.data).decode("ascii"),
        **{name: _file(f"{name}.js") for name in PROGRAM},
    }
    # In one pass, so that a placeholder inside a name is not replaced.
    page = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _file("player.html"))
    with replaced_file(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return Player(path, f"{about} {path.stat().st_size / 1e6:.1f} MB.")


def _pack(at, rows, capture, statistics, count):
    keyframes = sample(at, rows, statistics, count)
    return keyframes, packing.pack(keyframes, _still_distance(keyframes, capture))


def header(packed: packing.Packed, raster: RasterSpec, capture: Capture) -> dict:
    """Collect everything except the Gaussians that the page needs, as JSON.

    Args:
      packed: The encoded Gaussians.
      raster: Settings of the rasterizer.
      capture: The capture.

    Returns:
      The header.
    """
    train = cameras.take(capture.cameras, capture.train)
    first = cameras.take(train, 0)
    forward = np.asarray(first.camera_from_world, np.float64)[2]
    focus = camera_paths.focus_point(train, capture.near, capture.far)
    distance = float(
        np.clip((focus - first.position) @ forward, capture.near, capture.far)
    )
    target = np.asarray(first.position) + distance * forward
    up = camera_paths.up_axis(capture)
    half_diagonal = float(np.hypot(*capture.size) / 2 / first.focal_px)
    view = {
        "rotation": first.camera_from_world.ravel(),
        "position": first.position,
        "focal": first.focal_px,
        "aspect": first.pixel_aspect,
        "skew": first.skew_px,
        "center": first.principal_point_px,
        "size": capture.size,
        # On the viewing axis, so that orbiting starts from the first image.
        "target": target,
    }
    return {
        "keyframes": packed.entries["mean.change"]["shape"][0],
        "seconds": camera_paths.playing_seconds(capture),
        "up": up.tolist(),
        "limits": camera_limits(train, target, up, half_diagonal),
        "view": {name: np.asarray(part).tolist() for name, part in view.items()},
        "raster": {
            name: min(getattr(raster, name), LARGEST)
            if name == "far"
            else getattr(raster, name)
            for name in RASTER
        },
        "arrays": packed.entries,
    }


def _still_distance(keyframes: Keyframes, capture: Capture) -> np.ndarray:
    """Compute the displacement that is invisible: a tenth of a pixel."""
    train = cameras.take(capture.cameras, capture.train)
    nearest = np.full(keyframes.mean.shape[1], np.inf)
    for position, focal in zip(train.position, train.focal_px, strict=True):
        distance = np.linalg.norm(keyframes.mean[0] - position, axis=1)
        nearest = np.minimum(nearest, distance / focal)
    return packing.STILL_PX * nearest


def _about(keyframes, packed_scene, capture):
    count = keyframes.mean.shape[1]
    return (
        f"{count:,} Gaussians, {packing.moving_rows(packed_scene):,} of them moving, "
        f"at {len(keyframes.mean)} times. {keyframes.left_out:,} that no camera saw "
        f"are left out. One scene unit is {1 / capture.scale:.3g} of the capture's."
    )


def _data_url(image):
    content = io.BytesIO()
    PIL.Image.fromarray(image).save(content, "JPEG", quality=85)
    return "data:image/jpeg;base64," + base64.b64encode(content.getvalue()).decode()


def _file(name):
    resource = importlib.resources.files("gaussians_jax.player").joinpath(name)
    return resource.read_text(encoding="utf-8")
