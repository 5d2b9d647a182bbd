"""Images to inspect a run: comparisons, color maps, contact sheets, curves.

Functions take NumPy arrays and return uint8 [height, width, 3], or write a PNG file.
"""

import functools
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
import skimage.color

from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.visualization import figures

PANEL_WIDTH = 240  # minimum in pixels. Smaller images are enlarged so that labels fit.
GAP = 6  # pixels between panels
TEXT_HEIGHT = 20
TEXT, BACKGROUND, CAPTION = (32, 33, 36), (255, 255, 255), (110, 113, 120)
UNKNOWN = (128, 128, 128)  # gray, which no color map contains
# Rows of color_maps.png, with the 256 colors of inferno and viridis (CC0) of
# matplotlib, which need not be installed.
ERROR_MAP, DEPTH_MAP = 0, 1
# Share of depths beyond each end of the color range. Otherwise a single outlier in
# front of the camera would turn the whole image into one color.
OUTLIER_SHARE = 0.01


class Colored(NamedTuple):
    """A color-mapped image, with the values of the two ends of the color map."""

    image: np.ndarray  # [..., height, width, 3] uint8
    low: float
    high: float


class History(NamedTuple):
    """PSNR over the course of a run, with one entry for each evaluation."""

    seconds: Sequence[float]  # of training, without compilation
    psnr: Sequence[float]  # dB, held-out frames


def color_depth(
    depth: np.ndarray,
    valid: np.ndarray | None = None,
    limits: tuple[float, float] | None = None,
) -> Colored:
    """Map depth to viridis: near is bright, far is dark, unknown is gray.

    All images share one range, so that frames can be compared.

    Args:
      depth: Depths, [..., height, width].
      valid: True for known depths, of the same shape. None for all. Depths that are not
        finite and positive are always unknown.
      limits: Lowest and highest value. None for the 1st and 99th percentile of known
        depths.

    Returns:
      The image and the range.
    """
    depth = np.asarray(depth, np.float32)
    positive = np.isfinite(depth) & (depth > 0)
    valid = positive if valid is None else positive & valid
    if limits is None:
        limits = _limits(depth[valid])
    low, high = limits
    nearness = 1 - np.where(valid, depth - low, 0) / _span(low, high)
    return Colored(_apply_map(nearness, valid, DEPTH_MAP), low, high)


def color_error(image: np.ndarray, truth: np.ndarray, largest: float | int) -> Colored:
    """Map the mean absolute difference over channels to inferno.

    Args:
      image: Images in [0, 1] or uint8, [..., height, width, 3].
      truth: Ground truth of the same shape.
      largest: Error shown in light yellow. Larger errors have the same color.

    Returns:
      The image, black for 0 and gray for values that are not finite.

    Raises:
      ValueError: If `largest` is not positive.
    """
    if not largest > 0:
        raise ValueError(f"largest={largest} must be positive")
    error = np.mean(np.abs(_as_unit(image) - _as_unit(truth)), axis=-1)
    valid = np.isfinite(error)
    unit = np.where(valid, error, 0) / largest
    return Colored(_apply_map(unit, valid, ERROR_MAP), 0, largest)


def color_distance(distance: np.ndarray, at_least: float | int = 0.0) -> Colored:
    """Map displacements to inferno, black for zero and gray for unknown.

    Args:
      distance: Displacements in scene units, [..., height, width].
      at_least: Lower bound of the bright end of the map, which is the 99th percentile.

    Returns:
      The image and the range.
    """
    valid = np.isfinite(distance)
    largest = max(float(at_least), _limits(distance[valid])[1] if valid.any() else 0.0)
    unit = np.where(valid, distance, 0) / _span(0.0, largest)
    return Colored(_apply_map(unit, valid, ERROR_MAP), 0.0, largest)


def color_flow(flow: np.ndarray, largest: float | int | None = None) -> Colored:
    """Map optical flow to colors: direction as hue, length as saturation.

    Zero is white, right is red, down is yellow-green, left is cyan, up is violet, and
    unknown is gray.

    Args:
      flow: Flow in pixels, [..., height, width, 2].
      largest: Length of full saturation in pixels. None for the 99th percentile.

    Returns:
      The image and the range.
    """
    flow = np.asarray(flow, np.float32)
    valid = np.all(np.isfinite(flow), axis=-1)
    flow = np.where(valid[..., None], flow, 0)
    length = np.linalg.norm(flow, axis=-1)
    if largest is None:
        largest = _limits(length[valid])[1]
    hue = np.arctan2(flow[..., 1], flow[..., 0]) / (2 * np.pi) % 1
    saturation = np.clip(length / (largest or 1), 0, 1)
    color = skimage.color.hsv2rgb(
        np.stack([hue, saturation, np.ones_like(hue)], axis=-1)
    )
    image = np.where(valid[..., None], as_bytes(color), np.array(UNKNOWN, np.uint8))
    return Colored(image, 0.0, float(largest))


def comparison(
    truth: np.ndarray,
    render: np.ndarray,
    depth: np.ndarray,
    captions: Sequence[str],
    largest_error: float = 0.2,
    known_depth: np.ndarray | None = None,
) -> np.ndarray:
    """Show ground truth, render, error and depth side by side, one row for each frame.

    Args:
      truth: Images in [0, 1] or uint8, [frames, height, width, 3].
      render: Renders of the same shape.
      depth: Depths in scene units, [frames, height, width]. They share a color range.
      captions: A caption for each row.
      largest_error: Error shown in light yellow.
      known_depth: True for known depths, [frames, height, width]. None for all.

    Returns:
      The image, with color bars below.

    Raises:
      ValueError: If the numbers of frames differ.
    """
    frames = len(truth)
    if not (len(render) == len(depth) == len(captions) == frames > 0):
        raise ValueError(
            "a comparison needs a true image, a render, a depth map and a caption for "
            f"each row, got {frames}, {len(render)}, {len(depth)} and {len(captions)}"
        )
    error = color_error(render, truth, largest_error)
    colored_depth = color_depth(depth, known_depth)
    columns = [as_bytes(truth), as_bytes(render), error.image, colored_depth.image]
    columns = [_enlarge(column) for column in columns]
    width = columns[0].shape[2]
    titles = ("truth", "render", "error", "depth")
    rows = [_join_horizontally([_text(title, width) for title in titles])]
    for frame, caption in enumerate(captions):
        rows.append(_text(caption, 4 * width + 3 * GAP, color=CAPTION))
        rows.append(_join_horizontally([column[frame] for column in columns]))
    blank = _blank(2 * TEXT_HEIGHT + GAP, width)
    far, near = colored_depth.high, colored_depth.low
    rows.append(
        _join_horizontally(
            [
                blank,
                blank,
                _bar(ERROR_MAP, f"{error.low:g}", f"{error.high:g} and more", width),
                _bar(DEPTH_MAP, f"{far:.3g} far", f"near {near:.3g}", width),
            ]
        )
    )
    return _add_margin(_join_vertically(rows))


def contact_sheet(
    cells: Sequence[np.ndarray], captions: Sequence[str], columns: int = 4
) -> np.ndarray:
    """Arrange captioned images of one size in a grid, row by row.

    Args:
      cells: Images, [height, width, 3].
      captions: One for each image.
      columns: Number of columns.

    Returns:
      The image.

    Raises:
      ValueError: If the numbers of images and captions differ.
    """
    if not len(cells) == len(captions) > 0:
        raise ValueError(
            f"a contact sheet needs a caption for each image, got {len(cells)} "
            f"images and {len(captions)} captions"
        )
    image_stack = _enlarge(np.stack([as_bytes(cell) for cell in cells]))
    tiles = [
        _join_vertically([image, _text(caption, image.shape[1], color=CAPTION)])
        for image, caption in zip(image_stack, captions, strict=True)
    ]
    columns = min(columns, len(tiles))
    tiles += [_blank(*tiles[0].shape[:2])] * (-len(tiles) % columns)
    rows = [
        _join_horizontally(tiles[i : i + columns])
        for i in range(0, len(tiles), columns)
    ]
    return _add_margin(_join_vertically(rows))


class Final(NamedTuple):
    """Final PSNR of a run, over more frames than its history."""

    seconds: float  # of training
    psnr: float  # dB
    frames: int  # number of frames that it is the mean of
    watched: int  # number of frames of the history


def curve(
    histories: Mapping[str, History],
    path: str | pathlib.Path,
    final: Final | None = None,
):
    """Plot the PSNR of held-out frames against seconds of training, as a PNG.

    Args:
      histories: Histories by name. Each is a line with a marker for every evaluation.
        Evaluations that are not finite leave a gap.
      path: The PNG file.
      final: Final PSNR of a single history, marked separately.

    Raises:
      ValueError: There are no evaluations.
    """
    if not any(len(history.seconds) for history in histories.values()):
        raise ValueError(f"{path}: no evaluations to plot; evaluate at least once")
    figure = figures.new_figure(figsize=(7.2, 4.2), dpi=130, layout="constrained")
    axes = figure.add_subplot()
    for name, history in histories.items():
        (line,) = axes.plot(
            history.seconds, history.psnr, marker="o", markersize=3.5, label=name
        )
        if len(history.psnr) and math.isfinite(history.psnr[-1]):
            axes.annotate(
                f"{history.psnr[-1]:.2f} dB",
                (history.seconds[-1], history.psnr[-1]),
                xytext=(0, 7),
                textcoords="offset points",
                ha="right",
                color=line.get_color(),
            )
    if final is not None:
        _mark_final(axes, final)
    axes.set_xlabel("training time without compilation (s)")
    axes.set_ylabel("mean PSNR of held-out frames (dB)")
    axes.margins(y=0.12)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    if len(histories) > 1 or final is not None:
        axes.legend(frameon=False, loc="lower right")
    with replaced_file(path) as partial:
        figure.savefig(partial)


def _mark_final(axes, final):
    """Mark the PSNR over all frames."""
    (line,) = axes.get_lines()
    line.set_label(f"{final.watched} frames during training")
    label = f"all {final.frames} frames after training"
    color = "#c2410c"
    axes.plot(
        [final.seconds], [final.psnr], "D", markersize=6, color=color, label=label
    )
    axes.annotate(
        f"{final.psnr:.2f} dB",
        (final.seconds, final.psnr),
        xytext=(-9, -4),
        textcoords="offset points",
        ha="right",
        va="top",
        color=color,
    )


def as_bytes(image: np.ndarray) -> np.ndarray:
    """Convert an image to uint8.

    Args:
      image: uint8, or floats in [0, 1].

    Returns:
      uint8 values, black for NaN.
    """
    if image.dtype == np.uint8:
        return image
    return np.round(np.clip(np.nan_to_num(image, nan=0.0), 0, 1) * 255).astype(np.uint8)


def _as_unit(image: np.ndarray) -> np.ndarray:
    """Convert an image to floats."""
    if image.dtype == np.uint8:
        return image.astype(np.float32) / 255
    return np.clip(image, 0, 1).astype(np.float32)


def _limits(values):
    if values.size == 0:
        return 0.0, 1.0
    low, high = np.quantile(values, [OUTLIER_SHARE, 1 - OUTLIER_SHARE])
    return float(low), float(high)


def _span(low, high):
    return high - low if high > low else 1.0  # a constant has one color


def _apply_map(unit, valid, row):
    """Map values in [0, 1] to a row of the color maps, unknown ones to gray."""
    table = _tables()[row]
    index = np.round(np.clip(unit, 0, 1) * 255).astype(np.uint8)
    return np.where(valid[..., None], table[index], np.array(UNKNOWN, np.uint8))


@functools.cache
def _tables():
    file = pathlib.Path(__file__).with_name("color_maps.png")
    with PIL.Image.open(file) as image:
        return np.asarray(image)


@functools.cache
def _font():
    return PIL.ImageFont.load_default(15)


def _text(text, width, color=TEXT, align="left"):
    strip = PIL.Image.new("RGB", (width, TEXT_HEIGHT), BACKGROUND)
    draw = PIL.ImageDraw.Draw(strip)
    start = 0 if align == "left" else width - draw.textlength(text, font=_font())
    draw.text((start, 0), text, fill=color, font=_font())
    return np.asarray(strip)


def _bar(row, left, right, width):
    """Show a color map, with the values of its two ends below it."""
    colors = _tables()[row][np.linspace(0, 255, width).astype(int)]
    ends = np.minimum(_text(left, width), _text(right, width, align="right"))
    return _join_vertically([np.repeat(colors[None], TEXT_HEIGHT, 0), ends])


def _enlarge(cells):
    """Enlarge by a whole factor without interpolation, so that pixels stay visible."""
    factor = max(1, math.ceil(PANEL_WIDTH / cells.shape[2]))
    return cells.repeat(factor, 1).repeat(factor, 2)


def _blank(height, width):
    return np.full((height, width, 3), BACKGROUND, np.uint8)


def _join_horizontally(panels):
    gap = _blank(panels[0].shape[0], GAP)
    parts = [part for panel in panels for part in (panel, gap)][:-1]
    return np.concatenate(parts, axis=1)


def _join_vertically(rows):
    gap = _blank(GAP, rows[0].shape[1])
    return np.concatenate([part for row in rows for part in (row, gap)][:-1], axis=0)


def _add_margin(image):
    return np.pad(image, ((GAP, GAP), (GAP, GAP), (0, 0)), constant_values=255)
