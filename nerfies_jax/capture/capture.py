"""The `Capture` record that all readers return, and its validation."""

import collections
import dataclasses
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from nerfies_jax.capture import external as external_results
from nerfies_jax.capture import flow as flows
from nerfies_jax.capture.errors import CaptureError as CaptureError
from nerfies_jax.capture.external import ExternalResults
from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.geometry import camera
from nerfies_jax.geometry.camera import Camera

# In scene units. float32 precision and all defaults assume lengths of order 1.
MAX_LENGTH = 1e6
MAX_SCALE = 1e12  # scene units per world unit, or its inverse
# Tables of latent codes have a row per id, so a larger id is taken for a damaged file.
MAX_ID = 2**20


class PointCloud(NamedTuple):
    """Static scene points, in scene units."""

    position: np.ndarray  # [points, 3] float32
    color: np.ndarray  # [points, 3] uint8 sRGB


@dataclasses.dataclass(frozen=True)
class Capture:
    """A captured scene on the host, in NumPy, with one row per frame.

    Everything geometric is in scene units: `scene_units = (world - center) * scale`.
    The constructor checks that shapes agree, every number is finite, and training and
    held-out rows are disjoint.
    """

    name: str
    source: str  # the format it was read from, "nerfies", "blender", "colmap", ...
    ids: tuple[str, ...]  # one per frame
    images: np.ndarray  # [frames, height, width, 3] uint8, sRGB, opaque
    cameras: Camera  # NumPy leaves, float32, leading axis frames
    times: np.ndarray  # [frames] float32 in [0, 1] over the whole capture
    train: np.ndarray  # indices of the training frames
    heldout: np.ndarray  # indices of the frames for evaluation, never trained on
    near: float  # scene units along the viewing axis
    far: float
    warp_ids: np.ndarray  # [frames] int32, 0..n-1: index of the frame time
    appearance_ids: np.ndarray  # [frames] int32: index of the exposure
    camera_ids: np.ndarray  # [frames] int32: index of the physical camera
    valid: np.ndarray | None = None  # [frames, height, width] bool: observed pixels
    moving: np.ndarray | None = None  # [frames, height, width] bool: dynamic pixels
    # [frames, height, width] float32 z-depth, 0 where unknown
    depths: np.ndarray | None = None
    flow: FrameFlow | None = None  # to the next and previous frame, in pixels
    external: ExternalResults | None = None  # results that replace our preprocessing
    points: PointCloud | None = None
    background: tuple[float, float, float] | None = None  # sRGB in [0, 1], if known
    scale: float = 1.0
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] | None = None  # unit vector, scene axes, if known
    frames_per_second: float | None = None  # of the video, if known
    path: pathlib.Path | None = None
    notes: tuple[str, ...] = ()  # what the reader assumed, repaired or left out
    preprocessing: float = 1.0  # relative effort for flow, tracks and masks

    def __post_init__(self):
        validate(self)

    @property
    def centre(self) -> tuple[float, float, float]:
        """Alias of `center`, its name in earlier versions."""
        return self.center

    @property
    def given(self) -> ExternalResults | None:
        """Alias of `external`, its name in earlier versions."""
        return self.external

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.images.shape[2], self.images.shape[1]


def point_depths(capture: Capture) -> np.ndarray:
    """Compute the z-depths of all points in all training frames, beyond the near plane.

    Args:
      capture: The capture.

    Returns:
      Depths in scene units, in no particular order. Empty if the capture has no points.
    """
    if capture.points is None:
        return np.zeros(0)
    axes = capture.cameras.camera_from_world[capture.train, 2]
    position = capture.cameras.position[capture.train, None]
    depth = np.einsum("fk,fnk->fn", axes, capture.points.position[None] - position)
    return depth[depth > capture.near]


def validate(capture: Capture):
    """Check a capture.

    Args:
      capture: The capture.

    Raises:
      CaptureError: For the first inconsistency, in one line.
    """
    where = str(capture.path or capture.name)
    frames = len(capture.ids)
    if frames < 2:
        raise CaptureError(
            f"{where}: {frames} frame(s); a reconstruction needs at least 2 views, "
            "so record or select more"
        )
    name, times = collections.Counter(capture.ids).most_common(1)[0]
    if times > 1:
        raise CaptureError(f"{where}: frame {name!r} appears {times} times; keep one")
    _check_shapes(capture, where, frames)
    check_cameras(capture.cameras, capture.ids, capture.size, where)
    if capture.flow is not None:
        try:
            flows.validate(capture.flow, capture.ids, capture.size, capture.camera_ids)
        except ValueError as error:
            raise CaptureError(f"{where}: {error}") from None
    _check_numbers(capture, where)
    _check_rows(capture, where, frames)


def _check_shapes(capture, where, frames):
    images = capture.images
    if images.ndim != 4 or images.shape[3] != 3 or images.dtype != np.uint8:
        raise CaptureError(
            f"{where}: images are {images.dtype} of shape {images.shape}; "
            "expected uint8 [frames, height, width, 3]"
        )
    shape = images.shape[:3]
    if shape[0] != frames or min(shape) < 1:
        raise CaptureError(
            f"{where}: {frames} ids but images of shape {images.shape}; "
            "there must be one image per id"
        )
    for name in ("valid", "moving", "depths"):
        array = getattr(capture, name)
        dtype = np.float32 if name == "depths" else np.bool_
        if array is not None and (array.shape != shape or array.dtype != dtype):
            raise CaptureError(
                f"{where}: {name} is {array.dtype} of shape {array.shape}; "
                f"expected {np.dtype(dtype)} of shape {shape}, as the images"
            )
    for name in ("times", "warp_ids", "appearance_ids", "camera_ids"):
        array = getattr(capture, name)
        if array.shape != (frames,):
            raise CaptureError(
                f"{where}: {name} has shape {array.shape}; expected one per frame, "
                f"({frames},)"
            )
    points = capture.points
    if points is not None and (
        points.position.shape != points.color.shape
        or points.position.ndim != 2
        or points.position.shape[1] != 3
    ):
        raise CaptureError(
            f"{where}: point positions {points.position.shape} and colors "
            f"{points.color.shape}; expected both [points, 3]"
        )


def check_cameras(
    cameras: Camera, ids: tuple[str, ...], size: tuple[int, int], where: str
):
    """Check that there is one usable camera for each id.

    Args:
      cameras: Cameras, [frames].
      ids: Names of the frames.
      size: Width and height of the images in pixels.
      where: Name of the capture in error messages.

    Raises:
      CaptureError: If a camera cannot be used, with the name of its frame.
    """
    leaves = jax.tree.leaves(cameras)
    leaf = next((leaf for leaf in leaves if leaf.shape[:1] != (len(ids),)), None)
    if leaf is not None:
        raise CaptureError(
            f"{where}: {len(ids)} frames but cameras of shape {leaf.shape}; there must "
            "be one per frame"
        )
    try:
        camera.validate(cameras, size, where)
    except ValueError as error:
        for row, name in enumerate(ids):
            try:
                camera.validate(camera.take(cameras, [row]), size, f"camera {name!r}")
            except ValueError as reason:
                # The row number is that in a batch of this one camera.
                message = str(reason).replace(" (row 0)", "")
                raise CaptureError(f"{where}: {message}") from None
        raise CaptureError(str(error)) from None


def check_times(times: np.ndarray, names: Sequence[str], where: str):
    """Check that times lie in [0, 1].

    Args:
      times: Times, [frames].
      names: Names of the frames.
      where: The file, for the message.

    Raises:
      CaptureError: If a time lies outside or is not a number.
    """
    bad = ~((times >= 0) & (times <= 1))  # also true for NaN
    if bad.any():
        row = int(np.argmax(bad))
        raise CaptureError(
            f"{where}: frame {names[row]!r} has time {times[row]:g}; times run from 0 "
            "to 1 over the capture, so divide by the last one"
        )


def _check_numbers(capture, where):
    check_times(capture.times, capture.ids, where)
    if not 0 < capture.near < capture.far < np.inf:
        raise CaptureError(
            f"{where}: near = {capture.near:g} and far = {capture.far:g}; "
            "expected 0 < near < far"
        )
    if not (0 < capture.scale < np.inf and np.isfinite(capture.center).all()):
        raise CaptureError(
            f"{where}: scale = {capture.scale:g} and center = {capture.center}; "
            "expected a positive scale and a finite center"
        )
    rate = capture.frames_per_second
    if rate is not None and not 0 < rate < np.inf:
        raise CaptureError(
            f"{where}: {rate:g} frames per second; expected a positive rate, or None "
            "if it is unknown"
        )
    if capture.depths is not None:
        bad = ~(capture.depths >= 0) | np.isinf(capture.depths)
        if bad.any():
            row = int(np.argmax(bad.any((1, 2))))
            raise CaptureError(
                f"{where}: the depth of frame {capture.ids[row]!r} has "
                f"{bad[row].sum()} negative, infinite or NaN pixels; write 0 where "
                "depth is unknown"
            )
    if capture.points is not None and not np.isfinite(capture.points.position).all():
        count = (~np.isfinite(capture.points.position).all(1)).sum()
        raise CaptureError(
            f"{where}: {count} scene points are not finite; remove them from the cloud"
        )
    _check_range(capture, where)


def _check_range(capture, where):
    """Refuse lengths beyond the precision of float32."""
    depths = capture.depths
    deepest = 0.0 if depths is None or not depths.size else float(depths.max())
    for name, value, least, most in (
        ("near", capture.near, 1 / MAX_LENGTH, MAX_LENGTH),
        ("far", capture.far, 1 / MAX_LENGTH, MAX_LENGTH),
        ("the largest depth", deepest, 0.0, MAX_LENGTH),
        ("scale", capture.scale, 1 / MAX_SCALE, MAX_SCALE),
    ):
        if not least <= value <= most:
            raise CaptureError(
                f"{where}: {name} is {value:.3g}; expected {least:g} to {most:g} "
                "(scene units); check the unit of the files, and write 0 where a depth "
                "is unknown"
            )


def _check_rows(capture, where, frames):
    for name in ("warp_ids", "appearance_ids", "camera_ids"):
        ids = getattr(capture, name)
        bad = (ids < 0) | (ids >= MAX_ID)
        if bad.any():
            row = int(np.argmax(bad))
            raise CaptureError(
                f"{where}: frame {capture.ids[row]!r} has {name[:-1]} {ids[row]}; "
                f"expected 0 to {MAX_ID - 1}"
            )
    for name in ("train", "heldout"):
        rows = getattr(capture, name)
        if rows.ndim != 1 or (rows.size and not np.issubdtype(rows.dtype, np.integer)):
            raise CaptureError(f"{where}: {name} must be a list of row numbers")
        bad = rows[(rows < 0) | (rows >= frames)]
        if bad.size:
            raise CaptureError(
                f"{where}: {name} names row {bad[0]}, but the {frames} frames are rows "
                f"0 to {frames - 1}"
            )
        if np.unique(rows).size != rows.size:
            raise CaptureError(f"{where}: {name} names a row twice")
    if not capture.train.size:
        raise CaptureError(f"{where}: no training frames; hold out fewer frames")
    shared_rows = np.intersect1d(capture.train, capture.heldout)
    if shared_rows.size:
        raise CaptureError(
            f"{where}: frame {capture.ids[shared_rows[0]]!r} is both a training and a "
            f"held-out frame ({shared_rows.size} such); keep it in one of the splits"
        )


def select(capture: Capture, rows: np.ndarray) -> Capture:
    """Select frames of a capture.

    Args:
      capture: The capture.
      rows: Indices of the frames, in the order of the result.

    Returns:
      The capture of these frames. Warp, appearance and camera ids are not renumbered.
    """
    rows = np.asarray(rows, np.int64)
    new_index = np.full(len(capture.ids), -1)
    new_index[rows] = np.arange(rows.size)

    def reindex(old):
        return np.sort(new_index[old][new_index[old] >= 0])

    def take(array):
        return None if array is None else array[rows]

    return dataclasses.replace(
        capture,
        ids=tuple(capture.ids[row] for row in rows),
        images=capture.images[rows],
        cameras=camera.take(capture.cameras, rows),
        times=capture.times[rows],
        train=reindex(capture.train),
        heldout=reindex(capture.heldout),
        warp_ids=capture.warp_ids[rows],
        appearance_ids=capture.appearance_ids[rows],
        camera_ids=capture.camera_ids[rows],
        valid=take(capture.valid),
        moving=take(capture.moving),
        depths=take(capture.depths),
        flow=None if capture.flow is None else flows.take(capture.flow, rows),
        external=None
        if capture.external is None
        else external_results.take(capture.external, rows),
    )


def downscale(capture: Capture, factor: int) -> Capture:
    """Shrink the images of a capture by area averaging.

    Incomplete blocks at the right and bottom are cropped. A block is observed if all
    its pixels are, moving if any of them is, and its depth is the mean of the known
    depths. Its flow is the mean, in pixels of the smaller image. Colors are averaged as
    stored (sRGB), as in every published evaluation of these captures.

    Args:
      capture: The capture.
      factor: Integer factor.

    Returns:
      The capture with smaller images and cameras to match.

    Raises:
      CaptureError: If the factor is below 1 or above the size of the images.
    """
    width, height = capture.size
    if not 1 <= factor <= min(width, height):
        raise CaptureError(
            f"{capture.path or capture.name}: cannot downscale {width}x{height} images "
            f"by {factor}; expected an integer from 1 to {min(width, height)}"
        )
    if factor == 1:
        return capture
    valid, moving = capture.valid, capture.moving
    return dataclasses.replace(
        capture,
        images=np.stack([shrink(image, factor) for image in capture.images]),
        cameras=camera.resize(capture.cameras, (factor, factor), (1, 1)),
        valid=None if valid is None else blocks(valid, factor).all((-3, -1)),
        moving=None if moving is None else blocks(moving, factor).any((-3, -1)),
        depths=None
        if capture.depths is None
        else np.stack([shrink_depth(depth, factor) for depth in capture.depths]),
        flow=None if capture.flow is None else flows.shrink(capture.flow, factor),
    )


def blocks(array, factor):
    """View images as blocks of pixels.

    Args:
      array: Images, [..., height, width].
      factor: Side of a block in pixels.

    Returns:
      A view [..., rows, factor, columns, factor] without incomplete blocks.
    """
    rows, columns = array.shape[-2] // factor, array.shape[-1] // factor
    crop = array[..., : rows * factor, : columns * factor]
    return crop.reshape(*array.shape[:-2], rows, factor, columns, factor)


def shrink(image: np.ndarray, factor: int) -> np.ndarray:
    """Shrink a uint8 image by area averaging, rounding half up.

    Args:
      image: uint8 image, [height, width, 3].
      factor: Integer factor.

    Returns:
      uint8 image, [height // factor, width // factor, 3].
    """
    if factor == 1:
        return image
    parts = blocks(np.moveaxis(image, -1, 0), factor)
    total = parts.sum((-3, -1), dtype=np.uint32)
    area = factor * factor
    return np.moveaxis((total + area // 2) // area, 0, -1).astype(np.uint8)


def shrink_depth(depth: np.ndarray, factor: int) -> np.ndarray:
    """Average the known depths of each block.

    Args:
      depth: Depths, [height, width], 0 where unknown.
      factor: Integer factor.

    Returns:
      float32 depths [height // factor, width // factor], 0 where all are unknown.
    """
    parts = blocks(depth, factor)
    count = (parts > 0).sum((-3, -1))
    mean = parts.sum((-3, -1), dtype=np.float64) / np.maximum(count, 1)
    return mean.astype(np.float32)


def describe(capture: Capture) -> tuple[str, ...]:
    """Describe a capture in a few lines of text.

    Args:
      capture: The capture.

    Returns:
      Lines of text. The notes of the reader come last.
    """
    width, height = capture.size
    cameras = np.unique(capture.camera_ids).size
    lines = [
        f"{capture.name}: {capture.source} capture, {len(capture.ids)} frames of "
        f"{width}x{height}, {capture.train.size} for training, "
        f"{capture.heldout.size} held out",
        f"{np.unique(capture.warp_ids).size} timestamps, {cameras} camera(s), focal "
        f"length {np.median(capture.cameras.focal_px):.4g} px, depth "
        f"{capture.near:.3g} to {capture.far:.3g} scene units (1 unit = "
        f"{1 / capture.scale:.3g} world units)",
    ]
    extras = []
    if capture.points is not None:
        extras.append(f"{len(capture.points.position)} static points")
    if capture.valid is not None:
        extras.append(f"{1 - capture.valid.mean():.1%} of pixels not observed")
    if capture.moving is not None:
        extras.append(f"{capture.moving.mean():.1%} of pixels marked moving")
    if capture.depths is not None:
        extras.append(f"depth on {(capture.depths > 0).mean():.1%} of pixels")
    if capture.flow is not None:
        extras.append(f"flow on {capture.flow.forward_valid.mean():.1%} of pixels")
    if extras:
        lines.append("; ".join(extras))
    return (*lines, *capture.notes)
