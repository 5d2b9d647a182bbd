"""Writer of captures as COLMAP text models with their images."""

import numpy as np
import scipy.spatial.transform

from nerfies_jax.capture import frames
from nerfies_jax.capture import images as pictures
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.json_files import AnyPath, replaced_folder
from nerfies_jax.capture.transforms_writer import check_names, refuse_skew
from nerfies_jax.capture.units import Units, places_in

# Frames that a point is listed in, evenly spread over those that show it: a point of a
# long film would take a line of thousands, and readers use a few.
MOST_SEEN = 16


def write(
    capture: Capture, path: AnyPath, units: Units = "scene", overwrite: bool = False
) -> None:
    """Write a capture as a COLMAP text model, completely or not at all.

    It writes `sparse/0/*.txt`, `images` and, if they are known, `masks`. Each of the
    capture's points is listed in some of the frames at its projection. Occlusion is not
    known. Masks follow COLMAP, black where something moves. Images are transparent
    where nothing was observed. The format has no times, so readers use the names.

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
    refuse_skew(capture, path, "a COLMAP model")
    spaced = [name for name in capture.ids if len(name.split()) != 1]
    if spaced:
        raise CaptureError(
            f"{path}: frame {spaced[0]!r} has a space in its name, which ends a name "
            "in COLMAP's text; rename it, or export transforms"
        )
    with replaced_folder(path, overwrite) as folder:
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        (folder / "images").mkdir()
        for row, name in enumerate(capture.ids):
            pictures.write_png(
                folder / "images" / f"{name}.png", _picture(capture, row)
            )
        if capture.moving is not None:
            (folder / "masks").mkdir()
            for name, moving in zip(capture.ids, capture.moving, strict=True):
                pictures.write_png(folder / "masks" / f"{name}.png.png", ~moving)
        lenses = [_lens(capture, row) for row in range(len(capture.ids))]
        numbers = {lens: number for number, lens in enumerate(dict.fromkeys(lenses), 1)}
        lines = (f"{number} {lens}" for lens, number in numbers.items())
        _write_lines(model / "cameras.txt", lines)
        seen, pixels = _observations(capture)
        of_cameras = [numbers[lens] for lens in lenses]
        lines = _image_lines(capture, units, of_cameras, seen, pixels)
        _write_lines(model / "images.txt", lines)
        _write_lines(model / "points3D.txt", _point_lines(capture, units, seen))


def _write_lines(path, lines):
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _text(values):
    return " ".join(repr(float(value)) for value in values)


def _picture(capture, row):
    if capture.valid is None:
        return capture.images[row]
    filmed = np.where(capture.valid[row], np.uint8(255), np.uint8(0))
    return np.concatenate([capture.images[row], filmed[..., None]], axis=-1)


def _lens(capture, row):
    """MODEL WIDTH HEIGHT PARAMETERS, in pixels."""
    cameras = capture.cameras
    focal = float(cameras.focal_px[row])
    across = (focal, focal * float(cameras.pixel_aspect[row]))
    numbers = [*across, *cameras.principal_point_px[row]]
    k1, k2, k3 = cameras.radial[row]
    bent = [k1, k2, *cameras.tangential[row]]
    model = "PINHOLE"
    if k3 != 0:
        model, numbers = "FULL_OPENCV", [*numbers, *bent, k3, 0, 0, 0]
    elif any(bent):
        model, numbers = "OPENCV", [*numbers, *bent]
    return f"{model} {capture.size[0]} {capture.size[1]} {_text(numbers)}"


def _observations(capture):
    """Return the points that each frame lists [frames, points], and all pixels."""
    count = len(capture.ids)
    if capture.points is None:
        return np.zeros((count, 0), bool), np.zeros((count, 0, 2))
    position = capture.points.position
    rows = [
        frames.pixels_of(capture.cameras, row, position, capture.size)
        for row in range(count)
    ]
    pixels = np.stack([np.asarray(pixel) for pixel, _, _ in rows])
    seen = np.stack([np.asarray(inside) for _, _, inside in rows])
    # The n-th of those that show a point is listed where n * MOST_SEEN / all is new.
    place = np.cumsum(seen, axis=0) - seen
    all_of_them = np.maximum(seen.sum(axis=0), 1)
    few = np.minimum(all_of_them, MOST_SEEN)
    first = (place * few) // all_of_them != ((place - 1) * few) // all_of_them
    return seen & first, pixels


def _image_lines(capture, units, of_cameras, seen, pixels):
    """Two lines for each frame: its pose, then its points."""
    turns = scipy.spatial.transform.Rotation.from_matrix(
        capture.cameras.camera_from_world.astype(np.float64)
    )
    positions = places_in(units, capture, capture.cameras.position)
    shifts = -turns.apply(positions)
    for row, name in enumerate(capture.ids):
        x, y, z, w = turns[row].as_quat()
        pose = _text((w, x, y, z, *shifts[row]))
        yield f"{row + 1} {pose} {of_cameras[row]} {name}.png"
        places = zip(*pixels[row][seen[row]].T, np.flatnonzero(seen[row]), strict=True)
        yield " ".join(f"{x:.3f} {y:.3f} {number + 1}" for x, y, number in places)


def _point_lines(capture, units, seen):
    """A line for each point: place, color, error, and frame and place of each view."""
    if capture.points is None:
        return
    positions = places_in(units, capture, capture.points.position)
    place = np.cumsum(seen, axis=1) - 1  # of a point in its frame's line
    for number, color in enumerate(capture.points.color):
        rows = np.flatnonzero(seen[:, number])
        views = " ".join(f"{row + 1} {place[row, number]}" for row in rows)
        shade = " ".join(str(int(part)) for part in color)
        # The error is that of the pixels listed: none but their rounding.
        yield f"{number + 1} {_text(positions[number])} {shade} 0.0 {views}"
