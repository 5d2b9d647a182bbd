"""COLMAP models as plain arrays. It runs in `decoder_child`, so it imports no JAX."""

import contextlib
import pathlib
import tempfile
from typing import Any

import numpy as np

from nerfies_jax.capture import text_files
from nerfies_jax.capture.colmap_library import MIN_TRACK, library

MAX_ERROR_PX = 2.0  # largest mean reprojection error of a reliable point
# pycolmap reads these if there is no binary file of the same stem.
TEXT_FILES = ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt")
# Smallest size of a row in bytes. In each file the number of rows comes first.
_ROW_BYTES = {
    "cameras.bin": 24,
    "images.bin": 73,
    "points3D.bin": 51,
    "rigs.bin": 8,
    "frames.bin": 8,
}


def read(folder: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the registered images and reliable points of a sparse model.

    In text files, image names may contain spaces, and the text may be in any Unicode
    encoding with or without a byte order mark.

    Args:
      folder: Folder of the model.

    Returns:
      Names, camera ids and cameras of the registered images as a dict; and poses,
      points, their colors and the z-depths of their observations as arrays.
    """
    model = _reconstruction(pathlib.Path(folder))
    images = [image for image in model.images.values() if image.has_pose]
    poses = np.array([image.cam_from_world().matrix() for image in images])
    rotations = poses.reshape(-1, 3, 4)[:, :, :3]
    positions = np.array([image.projection_center() for image in images])
    positions = positions.reshape(-1, 3)
    row_of = {image.image_id: row for row, image in enumerate(images)}
    points, colors, depths = [], [], [np.zeros(0)]
    for point in model.points3D.values():
        if point.track.length() < MIN_TRACK or not point.error <= MAX_ERROR_PX:
            continue
        rows = [
            row_of[e.image_id] for e in point.track.elements if e.image_id in row_of
        ]
        points.append(point.xyz)
        colors.append(point.color)
        depths.append(((point.xyz - positions[rows]) * rotations[rows, 2]).sum(1))
    about = {
        "names": [image.name for image in images],
        "camera_ids": [image.camera_id for image in images],
        "cameras": {
            str(number): _camera_fields(model.cameras[number])
            for number in {image.camera_id for image in images}
        },
    }
    return about, {
        "rotations": rotations,
        "positions": positions,
        "points": np.array(points, float).reshape(-1, 3),
        "colors": np.array(colors, np.uint8).reshape(-1, 3),
        "depths": np.concatenate(depths),
    }


def _camera_fields(camera):
    """Arguments of `pycolmap.Camera` that reproduce a camera, for JSON."""
    fields = camera.todict()
    fields["params"] = [float(value) for value in fields["params"]]
    fields["model"] = camera.model_name
    return {
        key: fields[key] for key in ("camera_id", "model", "width", "height", "params")
    }


def _reconstruction(folder):
    _check_counts(folder)
    with contextlib.ExitStack() as stack:
        source = _as_utf8(folder, stack)
        model = library().Reconstruction(str(source))
        if not (folder / "images.bin").is_file():
            _restore_names(model, source / "images.txt")
        return model


def _check_counts(folder):
    """Raise ValueError if a binary file claims more rows than it holds.

    pycolmap does not check the counts and allocates memory for them.
    """
    for name, row in _ROW_BYTES.items():
        path = folder / name
        if not path.is_file():
            continue
        size = path.stat().st_size
        with path.open("rb") as file:
            count = int.from_bytes(file.read(8), "little")
        if 8 + count * row > size:
            raise ValueError(f"{name} claims {count} rows in {size} bytes")
    for name, fixed_bytes, has_name, item_bytes in (
        ("images.bin", 64, True, 24),
        ("points3D.bin", 43, False, 8),
    ):
        if (folder / name).is_file():
            data = (folder / name).read_bytes()
            _check_lists(data, name, fixed_bytes, has_name, item_bytes)


def _check_lists(data, name, fixed_bytes, has_name, item_bytes):
    """Walk over rows of fixed fields, a name (optional), and a list with its length."""
    offset, size = 8, len(data)
    for row in range(int.from_bytes(data[:8], "little")):
        offset += fixed_bytes
        if has_name:
            end = data.find(b"\0", offset)
            offset = size if end < 0 else end + 1
        length = int.from_bytes(data[offset : offset + 8], "little")
        offset += 8 + length * item_bytes
        if offset > size:
            raise ValueError(f"{name} is truncated in row {row}")


def _as_utf8(folder, stack):
    """Return the folder, or a temporary copy of its text files in UTF-8."""
    files = [folder / name for name in TEXT_FILES if (folder / name).is_file()]
    if all(_is_utf8(file) for file in files) or (folder / "images.bin").is_file():
        return folder
    copy = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
    for file in files:
        (copy / file.name).write_bytes(text_files.utf8(file.read_bytes()))
    return copy


def _is_utf8(file):
    with file.open("rb") as stream:
        return text_files.encoding_of(stream.read(4)) == "utf-8"


def _restore_names(model, file):
    """Restore image names with spaces, which pycolmap cuts at the first space."""
    lines = file.read_text(encoding="utf-8", errors="surrogateescape").split("\n")
    lines = [line.strip() for line in lines]
    lines = [line for line in lines if not line.startswith("#")]
    for line in _pose_lines(lines):
        parts = line.split(maxsplit=9)
        if len(parts) == 10 and " " in parts[9] and int(parts[0]) in model.images:
            model.images[int(parts[0])].name = parts[9]


def _pose_lines(lines):
    """Lines with poses. Each is followed by a line of observations, maybe empty."""
    rows = iter(lines)
    for line in rows:
        if line:  # further empty lines may separate images
            yield line
            next(rows, None)
