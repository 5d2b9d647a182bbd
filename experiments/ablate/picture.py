"""One held-out frame as every arm renders it, and the points that it follows."""

import math
import pathlib
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import PIL.ImageDraw

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.protocol import GroundTruth
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.visualization import panels

WIDTH = 352  # pixels of a panel, at least
DRAWN = 24  # tracks
LARGEST_ERROR = 0.2
TRUE, FOUND, APART = (255, 255, 255), (255, 140, 0), (230, 30, 30)


def shown_row(known: GroundTruth, capture: Capture) -> int:
    """Choose the rendered frame in which points are farthest from the start.

    Args:
      known: Ground truth.
      capture: The capture.

    Returns:
      Index of the frame, the middle one if nothing moves.
    """
    if not len(known.path):
        return len(known.rows) // 2
    away = np.linalg.norm(known.path - known.start_points[:, None], axis=-1).mean(
        axis=0
    )
    return int(np.argmax([away[_moment(known, capture, row)] for row in known.rows]))


def draw(
    capture: Capture,
    known: GroundTruth,
    color: Mapping[str, np.ndarray],
    depth: Mapping[str, np.ndarray],
    path: Mapping[str, np.ndarray | None],
    captions: Mapping[str, str],
    shown: int,
) -> np.ndarray:
    """Draw the ground truth above render, error, depth and tracks of every method.

    Points are white where they are and were, orange where a model moves them, and red
    lines connect both. Without ground truth there are images only, and depths share the
    limits of the first method.

    Args:
      capture: The capture.
      known: Ground truth.
      color: Renders of the shown frame, by method.
      depth: Depths of the shown frame, by method.
      path: Tracked points, by method.
      captions: Captions, by method.

    Returns:
      The image.
    """
    row = int(known.rows[shown])
    if not known.exact:
        return _draw_filmed(capture, row, color, depth)
    assert capture.depths is not None
    assert capture.moving is not None
    truth, true_depth = capture.images[row], capture.depths[row]
    colored = panels.color_depth(true_depth)
    limits = colored.low, colored.high
    moving = np.where(capture.moving[row][..., None], truth, truth // 4)
    tiles = [truth, moving, colored.picture]
    tiles = [_enlarged(panel) for panel in tiles]
    tiles.append(_tracks(capture, known, known.path, row))
    labels = [f"truth: {capture.ids[row]}", "what moves", "true depth", "true tracks"]
    for arm, rendered in color.items():
        error = panels.color_error(rendered, truth, LARGEST_ERROR).picture
        deep = panels.color_depth(depth[arm], limits=limits).picture
        tiles += [_enlarged(panel) for panel in (rendered, error, deep)]
        tiles.append(_tracks(capture, known, path[arm], row))
        labels += [arm, f"error, to {LARGEST_ERROR:g}", "depth", captions[arm]]
    return panels.contact_sheet(tiles, labels)


def _draw_filmed(capture, row, color, depth):
    truth, limits, tiles, labels = capture.images[row], None, [], []
    for arm, rendered in color.items():
        error = panels.color_error(rendered, truth, LARGEST_ERROR).picture
        colored = panels.color_depth(depth[arm], limits=limits)
        limits = colored.low, colored.high
        shown = (truth, rendered, error, colored.picture)
        tiles += [_enlarged(panel) for panel in shown]
        labels += [capture.ids[row], arm, f"error, to {LARGEST_ERROR:g}", "depth"]
    return panels.contact_sheet(tiles, labels)


def _enlarged(picture):
    factor = math.ceil(WIDTH / picture.shape[1])
    return panels.as_bytes(picture).repeat(factor, 0).repeat(factor, 1)


def _moment(known, capture, row):
    """Return the ground-truth time that is nearest to a frame."""
    return np.argmin(np.abs(capture.times[known.moments] - capture.times[row]))


def _tracks(capture, known, path, row):
    """Draw tracks over the darkened frame; a `path` of None does not move."""
    picture = _enlarged(capture.images[row] // 2)
    factor = picture.shape[1] / capture.size[0]
    image = PIL.Image.fromarray(picture)
    if len(known.path):
        pen = PIL.ImageDraw.Draw(image)
        few = np.linspace(0, len(known.path) - 1, min(DRAWN, len(known.path)))
        few = few.round().astype(int)
        now = _moment(known, capture, row)
        if path is None:
            path = np.broadcast_to(known.start_points[:, None], known.path.shape)
        camera = jax.tree.map(jnp.asarray, cameras.take(capture.cameras, row))
        true, followed = (
            factor * np.asarray(_pixels(camera, points[few]))
            for points in (known.path, path)
        )
        # The truth last: a point that is followed well is white.
        for points, color in ((followed, FOUND), (true, TRUE)):
            for line in points:
                pen.line([tuple(p) for p in line.tolist()], fill=color, width=1)
        for there, here in zip(true[:, now], followed[:, now], strict=True):
            pen.line([*there.tolist(), *here.tolist()], fill=APART, width=2)
            _dot(pen, here.tolist(), FOUND)
            _dot(pen, there.tolist(), TRUE)
    return np.asarray(image)


def _dot(pen, place, color, radius=3):
    x, y = place
    pen.ellipse([x - radius, y - radius, x + radius, y + radius], fill=color)


@jax.jit
def _pixels(camera, points):
    project = jax.vmap(jax.vmap(lambda point: cameras.project(camera, point)[0]))
    return project(points)


def save(picture: np.ndarray, path: pathlib.Path) -> None:
    """Save an image as PNG, atomically."""
    panels.save(picture, path)
