"""Writer of captures in nerfstudio's layout: transforms.json, images and points."""

import pathlib
from typing import Any

import numpy as np
import plyfile

from nerfies_jax.capture import images as image_files
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.json_files import AnyPath, replaced_folder, write_json
from nerfies_jax.capture.units import Units, places_in
from nerfies_jax.geometry.camera import Camera

POINTS = "points.ply"
_OPENGL = np.diag([1.0, -1.0, -1.0])  # (right, down, forward) to (right, up, back)


def write(
    capture: Capture, path: AnyPath, units: Units = "scene", overwrite: bool = False
) -> None:
    """Write a capture as transforms.json, `images`, `masks` and points.

    `train_filenames` lists the training frames, `val_filenames` and `test_filenames`
    the held-out ones. Masks are black where nothing was observed. Axes are those of the
    capture and are not rotated to a fixed up axis. The folder is written completely or
    not at all.

    Args:
      capture: The capture.
      path: The folder.
      units: "scene" for scene units, "world" for those of the capture's own files.
      overwrite: True to replace an existing folder.

    Raises:
      CaptureError: If the format cannot hold the capture, or the folder cannot be
        written.
    """
    check_names(capture, path)
    refuse_skew(capture, path, "transforms.json")
    with replaced_folder(path, overwrite) as folder:
        (folder / "images").mkdir()
        for name, image in zip(capture.ids, capture.images, strict=True):
            image_files.write_png(folder / "images" / f"{name}.png", image)
        if capture.valid is not None:
            (folder / "masks").mkdir()
            for name, valid in zip(capture.ids, capture.valid, strict=True):
                image_files.write_png(folder / "masks" / f"{name}.png", valid)
        if capture.points is not None:
            _write_points(folder / POINTS, capture, units)
        write_json(folder / "transforms.json", _transforms(capture, units))


def check_names(capture: Capture, path: AnyPath) -> None:
    """Check that all frame names can be file names.

    Args:
      capture: The capture.
      path: The folder to write, for error messages.

    Raises:
      CaptureError: If a name cannot be one.
    """
    for name in capture.ids:
        if name in ("", ".", "..") or set(name) & set("/\\\0"):
            raise CaptureError(
                f"{path}: frame {name!r} cannot be a file name; rename it without "
                "slashes"
            )


def refuse_skew(capture: Capture, path: AnyPath, what: str) -> None:
    """Check that cameras have no skew, for formats that cannot hold it.

    Args:
      capture: The capture.
      path: The folder to write, for error messages.
      what: Name of the format in error messages.

    Raises:
      CaptureError: If a camera has skew.
    """
    if np.any(capture.cameras.skew_px != 0):
        raise CaptureError(
            f"{path}: {what} cannot hold a skew of "
            f"{np.abs(capture.cameras.skew_px).max():g} px; export nerfies, which can"
        )


def _write_points(path: pathlib.Path, capture: Capture, units: Units) -> None:
    """Write the points of a capture with their colors as .ply."""
    cloud = capture.points
    assert cloud is not None
    # World coordinates may be large. Those of a map in meters exceed float32 precision.
    kind = "f4" if units == "scene" else "f8"
    fields = [(axis, kind) for axis in "xyz"]
    fields += [(name, "u1") for name in ("red", "green", "blue")]
    table = np.empty(len(cloud.position), fields)
    position = places_in(units, capture, cloud.position)
    for column, axis in enumerate("xyz"):
        table[axis] = position[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        table[name] = cloud.color[:, column]
    plyfile.PlyData([plyfile.PlyElement.describe(table, "vertex")]).write(str(path))


def opengl_pose(camera_from_world: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the camera-to-world matrix with OpenGL axes right, up and back.

    Args:
      camera_from_world: Rotation with rows right, down, forward, [3, 3].
      position: Camera center, [3].

    Returns:
      float64 matrix, [4, 4].
    """
    pose = np.eye(4)
    pose[:3, :3] = camera_from_world.T.astype(np.float64) @ _OPENGL
    pose[:3, 3] = position
    return pose


def _transforms(capture, units):
    width, height = capture.size
    cameras = capture.cameras
    lenses = [_lens(cameras, row) for row in range(len(capture.ids))]
    same_lens = all(lens == lenses[0] for lens in lenses)
    is_distorted = np.any(cameras.radial != 0) or np.any(cameras.tangential != 0)
    model = "OPENCV" if is_distorted else "PINHOLE"
    if cameras.fisheye is not None:
        model = "OPENCV_FISHEYE"
    table: dict[str, Any] = {
        "camera_model": model,
        "w": width,
        "h": height,
    }
    if same_lens:
        table |= lenses[0]
    if capture.points is not None:
        table["ply_file_path"] = POINTS
    if capture.background is not None:
        table["background"] = [float(x) for x in capture.background]
    if capture.up is not None:
        table["up"] = [float(x) for x in capture.up]
    if capture.frames_per_second is not None:
        table["fps"] = float(capture.frames_per_second)
    positions = places_in(units, capture, cameras.position)
    table["frames"] = [
        {
            "file_path": f"images/{name}.png",
            **({} if capture.valid is None else {"mask_path": f"masks/{name}.png"}),
            "time": float(capture.times[row]),
            **({} if same_lens else lenses[row]),
            "transform_matrix": opengl_pose(
                cameras.camera_from_world[row], positions[row]
            ).tolist(),
        }
        for row, name in enumerate(capture.ids)
    ]
    if len(capture.heldout):
        for split in ("train", "val", "test"):
            rows = capture.train if split == "train" else capture.heldout
            files = [f"images/{capture.ids[row]}.png" for row in rows]
            table[f"{split}_filenames"] = files
    return table


def _lens(cameras: Camera, row: int) -> dict[str, float]:
    """Intrinsics by nerfstudio's names, in pixels."""
    focal = float(cameras.focal_px[row])
    names: tuple[str, ...] = ("cx", "cy", "k1", "k2", "k3", "p1", "p2")
    values = (
        *cameras.principal_point_px[row],
        *cameras.radial[row],
        *cameras.tangential[row],
    )
    if cameras.fisheye is not None:
        names = ("cx", "cy", "k1", "k2", "k3", "k4")
        values = (*cameras.principal_point_px[row], *cameras.fisheye[row])
    lens = {"fl_x": focal, "fl_y": focal * float(cameras.pixel_aspect[row])}
    return lens | {n: float(v) for n, v in zip(names, values, strict=True)}
