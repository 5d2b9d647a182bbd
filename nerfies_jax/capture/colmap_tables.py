"""COLMAP models as plain arrays. `decoder_child` runs this, so it imports no JAX."""

import contextlib
import pathlib
import tempfile
from typing import Any

import numpy as np

from nerfies_jax.capture import text_files
from nerfies_jax.capture.colmap_library import MIN_TRACK, library

MAX_ERROR_PX = 2.0  # largest mean reprojection error of a point that is kept
# pycolmap reads these if there are no binary files of that name.
TEXT_FILES = ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt")
# Least bytes of a row of a binary file, behind the number of its rows.
_ROW_BYTES = {
    "cameras.bin": 24,
    "images.bin": 73,
    "points3D.bin": 51,
    "rigs.bin": 8,
    "frames.bin": 8,
}


def read(folder: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the registered images and reliable points of a sparse model.

    In text files, image names may have spaces, and the encoding may be any Unicode
    encoding with or without a byte order mark.

    Args:
      folder: Folder of the model.

    Returns:
      Names, camera ids and cameras of the registered images; and poses, points, their
      colors and the z-depths of their observations as arrays.
    """
    model = _reconstruction(pathlib.Path(folder))
    posed = [image for image in model.images.values() if image.has_pose]
    poses = np.array([image.cam_from_world().matrix() for image in posed])
    rotations = poses.reshape(-1, 3, 4)[:, :, :3]
    positions = np.array([image.projection_center() for image in posed]).reshape(-1, 3)
    row_of = {image.image_id: row for row, image in enumerate(posed)}
    places, colors, depths = [], [], [np.zeros(0)]
    for point in model.points3D.values():
        if point.track.length() < MIN_TRACK or not point.error <= MAX_ERROR_PX:
            continue
        rows = [
            row_of[e.image_id] for e in point.track.elements if e.image_id in row_of
        ]
        places.append(point.xyz)
        colors.append(point.color)
        depths.append(((point.xyz - positions[rows]) * rotations[rows, 2]).sum(1))
    about = {
        "names": [image.name for image in posed],
        "camera_ids": [image.camera_id for image in posed],
        "cameras": {
            str(number): _plain(model.cameras[number])
            for number in {image.camera_id for image in posed}
        },
    }
    return about, {
        "rotations": rotations,
        "positions": positions,
        "points": np.array(places, float).reshape(-1, 3),
        "colors": np.array(colors, np.uint8).reshape(-1, 3),
        "depths": np.concatenate(depths),
    }


def _plain(camera):
    """A camera as the constructor of pycolmap's takes it, for JSON."""
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
    """Raise ValueError if a binary file claims more than it holds.

    pycolmap believes it, and allocates until it may not.
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
    for name, fixed, named, each in (
        ("images.bin", 64, True, 24),
        ("points3D.bin", 43, False, 8),
    ):
        if (folder / name).is_file():
            _check_lists((folder / name).read_bytes(), name, fixed, named, each)


def _check_lists(data, name, fixed, named, each):
    """Walk over rows of `fixed` bytes, maybe a name, and a list with its length."""
    at, size = 8, len(data)
    for row in range(int.from_bytes(data[:8], "little")):
        at += fixed
        if named:
            end = data.find(b"\0", at)
            at = size if end < 0 else end + 1
        length = int.from_bytes(data[at : at + 8], "little")
        at += 8 + length * each
        if at > size:
            raise ValueError(f"{name} ends in its row {row}")


def _as_utf8(folder, stack):
    """The folder, or a temporary copy of its text files in UTF-8."""
    files = [folder / name for name in TEXT_FILES if (folder / name).is_file()]
    if all(_is_plain(file) for file in files) or (folder / "images.bin").is_file():
        return folder
    copy = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
    for file in files:
        (copy / file.name).write_bytes(text_files.utf8(file.read_bytes()))
    return copy


def _is_plain(file):
    with file.open("rb") as stream:
        return text_files.encoding_of(stream.read(4)) == "utf-8"


def _restore_names(model, file):
    """Give images their whole names: pycolmap ends them at the first space."""
    lines = file.read_text(encoding="utf-8", errors="surrogateescape").split("\n")
    lines = [line.strip() for line in lines]
    lines = [line for line in lines if not line.startswith("#")]
    for line in _pose_lines(lines):
        parts = line.split(maxsplit=9)
        if len(parts) == 10 and " " in parts[9] and int(parts[0]) in model.images:
            model.images[int(parts[0])].name = parts[9]


def _pose_lines(lines):
    """Every other line: each image has a line of its observations, maybe empty."""
    rows = iter(lines)
    for line in rows:
        if line:  # an empty line before the next image is none of its observations
            yield line
            next(rows, None)
