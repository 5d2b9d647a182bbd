"""Reader of LLFF: `poses_bounds.npy` with images in `images`, `images_2`, and so on."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerfies_jax.capture import frames, name_times, npz_files, splits, world_points
from nerfies_jax.capture import images as image_files
from nerfies_jax.capture.borders import without_black_borders
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.json_files import AnyPath
from nerfies_jax.capture.points import Placement, place_by_points
from nerfies_jax.capture.safe_files import confines
from nerfies_jax.geometry import camera
from nerfies_jax.geometry.camera import Camera

POSES = "poses_bounds.npy"
MOST_NUMBERS = 17 * frames.MAX_FRAMES


class Poses(NamedTuple):
    """Contents of the file, in world units and full-size pixels."""

    rotations: np.ndarray  # [frames, 3, 3] camera from world
    positions: np.ndarray  # [frames, 3]
    size: tuple[int, int]  # width and height of the full-size images
    focal_px: np.ndarray  # [frames]
    bounds: np.ndarray  # [frames, 2] nearest and farthest depth


@confines
def read(
    path: AnyPath,
    factor: int | None = None,
    max_side: int | None = None,
    heldout: int | str | None = None,
    missing: str = "refuse",
) -> Capture:
    """Read a capture in the layout of LLFF (Mildenhall et al. 2019), NSFF and others.

    Poses belong to the images in the order of their names, so none may be missing. The
    columns of a pose are the camera's down, right and backward axes. The principal
    point is the center of the image. Times are derived from the names as for COLMAP.

    Args:
      path: The folder.
      factor: Read images at 1/`factor` of the full size in the file.
      max_side: Longest side of the images in pixels. At most one of the two can be
        given.
      heldout: n for every n-th frame. None for every 8th.
      missing: "refuse" or "skip". It has no effect in this format.

    Returns:
      The capture.

    Raises:
      CaptureError: If the capture cannot be used.
    """
    path = pathlib.Path(path)
    frames.check_missing(missing, str(path))
    if isinstance(heldout, str):
        raise CaptureError(
            f"{path}: LLFF has no split {heldout!r}; pass a number n to hold out every "
            "n-th frame"
        )
    poses = read_poses(path / POSES)
    available = _folders(path, poses)
    source, shrink_by = frames.choose_source(
        available, poses.size, factor, max_side, str(path)
    )
    # In lexicographic order, as in LLFF's script.
    files = frames.images_in(available[source])
    sequence = frames.read_frames(files, shrink_by, orientation="stored")
    images = sequence.images
    valid, notes = without_black_borders(images, sequence.valid())
    notes += sequence.notes
    placement = placed(poses)
    cameras = cameras_of(poses, placement, (images.shape[2], images.shape[1]))
    names = tuple(file.stem for file in files)
    clock = name_times.clock(names)
    times = splits.spread(clock.times)
    notes += (*order_note(names), *clock.notes)
    camera_ids = np.zeros(len(files), np.int32)
    if clock.cameras is not None:
        camera_ids = clock.cameras
    interval = splits.HELD_OUT if heldout is None else heldout
    train, heldout_rows = splits.hold_out_in_time(
        times, camera_ids, interval, str(path)
    )
    return Capture(
        name=path.resolve().name,
        source="llff",
        ids=names,
        images=images,
        cameras=cameras,
        times=times,
        train=train,
        heldout=heldout_rows,
        near=placement.near,
        far=placement.far,
        warp_ids=splits.dense(times),
        appearance_ids=np.arange(len(files), dtype=np.int32),
        camera_ids=camera_ids,
        valid=valid,
        scale=placement.scale,
        center=placement.center,
        up=world_points.up_direction(cameras),
        path=path,
        notes=(*notes, splits.held_out_note(heldout_rows, interval)),
    )


def order_note(names: Sequence[str]) -> tuple[str, ...]:
    """Describe the order of poses if lexicographic and numeric order differ.

    Args:
      names: Names in the order of the poses, which is lexicographic.

    Returns:
      A note, or an empty tuple if both orders are equal.
    """
    if list(names) == sorted(names, key=frames.natural):
        return ()
    listing = ", ".join(names[:3])
    return (
        f"the rows of {POSES} are assumed to be in the lexicographic order of the "
        f"names ({listing}, ...): if they are in the order of the numbers, rename the "
        "files with leading zeros",
    )


def placed(poses: Poses) -> Placement:
    """Normalize the scene by points on each viewing axis at the depth bounds.

    Args:
      poses: The cameras.

    Returns:
      The placement.
    """
    offset = poses.rotations[:, None, 2] * poses.bounds[..., None]
    points = (poses.positions[:, None] + offset).reshape(-1, 3)
    return place_by_points(points, poses.positions, poses.bounds.ravel())


def cameras_of(poses: Poses, placed: Placement, size: tuple[int, int]) -> Camera:
    """Make cameras in scene units for images of a size.

    Args:
      poses: The cameras, in world units and full-size pixels.
      placed: Placement of the world in the scene.
      size: Width and height of the images.

    Returns:
      A batch of one camera for each pose.
    """
    positions = (poses.positions - np.array(placed.center)) * placed.scale
    full = [
        camera.pinhole(rotation, position, focal, poses.size)
        for rotation, position, focal in zip(
            poses.rotations, positions, poses.focal_px, strict=True
        )
    ]
    return camera.resize(camera.stack(full), poses.size, size)


def read_poses(path: pathlib.Path) -> Poses:
    """Read the poses, rotated to axes right, down and forward.

    Args:
      path: The file.

    Returns:
      The poses.

    Raises:
      CaptureError: If the file does not have this layout.
    """
    table = npz_files.load_array(path, MOST_NUMBERS)
    if table.ndim != 2 or table.shape[1] != 17 or len(table) < 2:
        raise CaptureError(
            f"{path}: shape {table.shape}; expected [images, 17] with at least two "
            "rows, each a 3x5 matrix and two bounds"
        )
    if not np.isfinite(table).all():
        row = int(np.argmin(np.isfinite(table).all(1)))
        raise CaptureError(f"{path}: row {row} is not finite; remove it and its image")
    pose, bounds = table[:, :15].reshape(-1, 3, 5).astype(float), table[:, 15:]
    down, right, back, position, shape = np.moveaxis(pose, -1, 0)
    if np.ptp(shape[:, :2], axis=0).any():
        raise CaptureError(f"{path}: images of several sizes; keep those of one size")
    if not ((bounds > 0).all() and (bounds[:, 0] < bounds[:, 1]).all()):
        row = int(np.argmin((bounds[:, 0] > 0) & (bounds[:, 0] < bounds[:, 1])))
        raise CaptureError(
            f"{path}: row {row} has bounds {bounds[row].tolist()}; expected 0 < near < "
            "far"
        )
    height, width = shape[0, :2]
    rotations = np.stack([right, down, -back], axis=1)
    return Poses(
        rotations, position, (round(width), round(height)), shape[:, 2], bounds
    )


def reduction_of(file: pathlib.Path, size: tuple[int, int], poses: Poses) -> int:
    """Return the integer factor by which a stored image is smaller.

    Args:
      file: The image.
      size: Its width and height in pixels.
      poses: The cameras, with the full size.

    Returns:
      The factor, 1 for an image of full size.

    Raises:
      CaptureError: If its size is not an integer fraction of the full one.
    """
    ratio = max(1, round(poses.size[0] / size[0]))
    if np.abs(np.array(poses.size) / ratio - size).max() > 1:
        raise CaptureError(
            f"{file}: {size[0]}x{size[1]} pixels, but {POSES} is for "
            f"{poses.size[0]}x{poses.size[1]}; images must be an integer fraction of "
            "that"
        )
    return ratio


def _folders(path, poses):
    """Folders by reduction, with as many images as there are poses."""
    available = {}
    for folder in sorted(path.glob("images*")):
        files = frames.images_in(folder) if folder.is_dir() else []
        if not files:
            continue
        if len(files) != len(poses.positions):
            raise CaptureError(
                f"{folder}: {len(files)} images for {len(poses.positions)} poses in "
                f"{POSES}; they are matched in the order of the names, so restore "
                "missing files or remove extra ones"
            )
        ratio = reduction_of(files[0], image_files.read_header(files[0]).size, poses)
        available.setdefault(ratio, folder)
    if not available:
        raise CaptureError(
            f"{path}: {POSES} but no images; put them into images, or for synchronized "
            "cameras, put one video per camera next to it (cam00.mp4, cam01.mp4, ...) "
            "or one folder of images per camera (cam00/, cam01/, ...)"
        )
    return available
