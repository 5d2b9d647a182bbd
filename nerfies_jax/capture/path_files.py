"""Camera path files: nerfstudio's camera_path.json and Nerfies' folder of cameras.

nerfstudio's files are in scene units and hold pinholes with square pixels, a centered
principal point and a vertical field of view. Nerfies' are in world units and hold all
intrinsics.
"""

import math
import pathlib
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from nerfies_jax.capture import camera_paths, frames, keyframes
from nerfies_jax.capture.camera_paths import CameraPath
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.images import MAX_PIXELS
from nerfies_jax.capture.json_files import (
    AnyPath,
    read_json,
    refuse_existing,
    replaced_folder,
    write_json,
)
from nerfies_jax.capture.keyframes import Keyframe
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.capture.nerfies_views import CameraFile, camera_entry, cameras_of
from nerfies_jax.capture.transforms_writer import opengl_pose
from nerfies_jax.geometry import camera

FRAMES = 96  # default length of a path of one of the `KINDS`


class PathCamera(msgspec.Struct):
    """One image of `camera_path.json`."""

    camera_to_world: list[float]  # 4x4, row by row; right, up, back
    fov: float  # vertical, degrees
    render_time: float | None = None  # in [0, 1]


class PathFile(msgspec.Struct):
    """`camera_path.json`, without the keys that do not affect images."""

    camera_path: list[PathCamera]
    render_width: float
    render_height: float
    camera_type: str = "perspective"
    # Keyframes of nerfstudio's editor, whose layout differs between versions.
    keyframes: list[dict[str, Any]] = []


def named(name: str, capture: Capture, count: int | None) -> CameraPath:
    """Return a camera path by its name or file.

    Args:
      name: One of the `KINDS`, or a file or folder of a path.
      capture: The capture that it belongs to.
      count: Number of cameras of a path of one of the `KINDS`. None for `FRAMES`.

    Returns:
      The path.

    Raises:
      CaptureError: If there is no such path or the file cannot be read.
    """
    if name in camera_paths.KINDS:
        return camera_paths.planned(name, capture, count or FRAMES)
    if not pathlib.Path(name).exists():
        raise CaptureError(
            f"{name}: neither a file nor the name of a camera path; "
            + known_names(name, camera_paths.KINDS)
        )
    return read(name, capture)


def read(path: AnyPath, capture: Capture) -> CameraPath:
    """Read a camera path from nerfstudio's file or Nerfies' folder.

    Args:
      path: File or folder.
      capture: The capture that it belongs to.

    Returns:
      The path in scene units.

    Raises:
      CaptureError: If it cannot be read, or only some of the images have a time.
    """
    path = pathlib.Path(path)
    if path.is_dir():
        cameras, size, times = _nerfies(path, capture)
    else:
        cameras, size, times = _nerfstudio(path)
    return _camera_path(path, cameras, size, times)


def _camera_path(path, cameras, size, times):
    """Make a `CameraPath` after checking that it can be rendered."""
    if not 1 <= min(size) <= max(size) <= MAX_PIXELS // min(size):
        raise CaptureError(
            f"{path}: images of {size[0]}x{size[1]} pixels; expected 1 to "
            f"{MAX_PIXELS} pixels in all"
        )
    try:
        camera.validate(cameras, size, str(path))
    except ValueError as error:
        raise CaptureError(str(error)) from None
    return CameraPath(cameras, size, _times(path, times))


def _times(path, times):
    absent = sum(time is None for time in times)
    if absent == len(times):
        return None
    if absent:
        raise CaptureError(
            f"{path}: {absent} of {len(times)} cameras have no time; add it to all "
            "or to none"
        )
    times = np.array(times, np.float32)
    bad = ~((times >= 0) & (times <= 1))
    if bad.any():
        row = int(np.argmax(bad))
        raise CaptureError(
            f"{path}: camera {row} has time {times[row]:g}; times run from 0 to 1"
        )
    return times


def _nerfstudio(path):
    table = read_json(path, PathFile)
    if table.camera_type != "perspective":
        raise CaptureError(
            f"{path}: camera_type {table.camera_type}; only perspective is rendered"
        )
    if not table.camera_path:
        raise CaptureError(f"{path}: no cameras in it; add some under camera_path")
    size = round(table.render_width), round(table.render_height)
    return _pinholes(path, table.camera_path, size)


def _pinholes(path, entries, size):
    """Cameras, size and times of the entries of a file."""
    pinholes = []
    for row, each in enumerate(entries):
        if len(each.camera_to_world) != 16 or not 0 < each.fov < 180:
            raise CaptureError(
                f"{path}: camera {row} has {len(each.camera_to_world)} numbers in "
                f"camera_to_world and a fov of {each.fov:g}; expected 16, and degrees "
                "between 0 and 180"
            )
        pose = np.reshape(each.camera_to_world, (4, 4))
        rotation = (pose[:3, :3] * [1, -1, -1]).T
        focal = 0.5 * size[1] / math.tan(math.radians(each.fov) / 2)
        pinholes.append(camera.pinhole(rotation, pose[:3, 3], focal, size))
    return camera.stack(pinholes), size, [each.render_time for each in entries]


def _nerfies(path, capture):
    files = sorted(path.glob("*.json"), key=lambda file: frames.natural(file.name))
    if not files:
        raise CaptureError(f"{path}: no camera files (*.json) in it")
    entries = [read_json(file, CameraFile) for file in files]
    first = entries[0].image_size
    for file, entry in zip(files, entries, strict=True):
        if entry.image_size != first:
            raise CaptureError(
                f"{file}: image_size {entry.image_size}, but {files[0].name} has "
                f"{first}; all images of a video have one size"
            )
    size = round(first[0]), round(first[1])
    cameras = cameras_of(entries, capture.scale, capture.center)
    return cameras, size, [entry.time for entry in entries]


def read_keyframes(path: AnyPath, capture: Capture) -> list[Keyframe]:
    """Read the keyframes of a camera path, to edit it.

    Args:
      path: nerfstudio's `camera_path.json`, or a folder of Nerfies' camera files.
      capture: The capture that it belongs to.

    Returns:
      The keyframes of the file. If it has none, at most `MOST_KEYFRAMES` evenly spaced
      cameras of the path, so that the interpolated path only approximates the file's.
      If it has no times, those of `camera_paths.times`, from 0 to 1 and back.

    Raises:
      CaptureError: If the file cannot be read or is not a camera path.
    """
    path = pathlib.Path(path)
    camera_path = read(path, capture)
    if not path.is_dir():
        entries = [_as_camera(each) for each in read_json(path, PathFile).keyframes]
        if len(entries) >= 2 and None not in entries:
            parts = _pinholes(path, entries, camera_path.size)
            camera_path = _camera_path(path, *parts)
    return spaced_keyframes(camera_path)


def spaced_keyframes(camera_path: CameraPath) -> list[Keyframe]:
    """Choose evenly spaced cameras of a path as its keyframes.

    Args:
      camera_path: The path. Without times it gets those of `camera_paths.times`.

    Returns:
      All cameras of a short path, otherwise `MOST_KEYFRAMES`.
    """
    cameras, times = camera_path.cameras, camera_path.times
    rows = np.arange(len(cameras.focal_px))
    if len(rows) > keyframes.MOST_KEYFRAMES:
        rows = np.linspace(0, rows[-1], keyframes.MOST_KEYFRAMES).round().astype(int)
    if times is None:
        times = camera_paths.times(len(cameras.focal_px))
    return [Keyframe(camera.take(cameras, row), float(times[row])) for row in rows]


def _as_camera(entry):
    """Convert a keyframe of nerfstudio's editor, or return None for another layout."""
    try:
        entry = {**entry, "camera_to_world": entry.get("matrix")}
        return msgspec.convert(entry, PathCamera)
    except msgspec.ValidationError:
        return None


def write_nerfstudio(
    path: AnyPath,
    planned: CameraPath,
    rate: float,
    overwrite: bool = False,
    keyframes: Sequence[Keyframe] = (),
) -> None:
    """Write `camera_path.json`, for nerfstudio's renderer and viewer and for ours.

    Poses, times and the vertical field of view are stored. The format holds no other
    intrinsics.

    Args:
      path: The file.
      planned: The cameras.
      rate: Frames per second.
      overwrite: True to replace an existing file.
      keyframes: Keyframes of the path, so that it can be edited later.
    """
    refuse_existing(path, overwrite)
    width, height = planned.size
    count = len(planned.cameras.focal_px)
    entries: list[dict[str, Any]] = []
    for row in range(count):
        pose, fov = _pose_and_fov(camera.take(planned.cameras, row), height)
        entry = {"camera_to_world": pose, "fov": fov, "aspect": width / height}
        if planned.times is not None:
            entry["render_time"] = float(planned.times[row])
        entries.append(entry)
    keyframe_entries = []
    for keyframe in keyframes:
        pose, fov = _pose_and_fov(keyframe.camera, height)
        keyframe_entries.append(
            {
                "matrix": pose,
                "fov": fov,
                "aspect": width / height,
                "render_time": keyframe.time,
                "override_time_enabled": True,
                "override_transition_enabled": False,
                "override_transition_sec": None,
            }
        )
    seconds = count / rate
    table = {
        "default_fov": entries[0]["fov"],
        "default_time": entries[0].get("render_time"),
        "default_transition_sec": seconds / max(1, len(keyframe_entries) - 1),
        "is_cycle": False,
        "smoothness_value": 0.0,
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": rate,
        "seconds": seconds,
        "keyframes": keyframe_entries,
        "camera_path": entries,
    }
    write_json(path, table)


def _pose_and_fov(view, height):
    """The row-major OpenGL pose, and the vertical field of view in degrees."""
    focal = float(view.focal_px) * float(view.pixel_aspect)
    pose = opengl_pose(view.camera_from_world, view.position).ravel().tolist()
    return pose, math.degrees(2 * math.atan2(height, 2 * focal))


def write_nerfies(
    path: AnyPath, planned: CameraPath, capture: Capture, overwrite: bool = False
) -> None:
    """Write a camera path as a folder of numbered camera files, in world units.

    `time` is an additional key, which other readers ignore.

    Args:
      path: The folder.
      planned: The path.
      capture: The capture, for its scale and center.
      overwrite: True to replace an existing folder.

    Raises:
      CaptureError: If the folder cannot be written.
    """
    with replaced_folder(path, overwrite) as folder:
        for row in range(len(planned.cameras.focal_px)):
            view = camera.take(planned.cameras, row)
            entry = camera_entry(view, capture, planned.size)
            if planned.times is not None:
                entry["time"] = float(planned.times[row])
            write_json(folder / f"{row:06d}.json", entry)
