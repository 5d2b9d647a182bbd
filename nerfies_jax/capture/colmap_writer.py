"""Writer of captures as COLMAP text models with their images."""

import numpy as np
import scipy.spatial.transform

from nerfies_jax.capture import images as image_files
from nerfies_jax.capture import world_points
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.json_files import AnyPath, replaced_folder
from nerfies_jax.capture.transforms_writer import check_names, refuse_skew
from nerfies_jax.capture.units import Units, places_in

# Largest number of observations stored per point, evenly spread over the frames that
# show it. In a long video a point has thousands, and readers use a few.
MOST_SEEN = 16


def write(
    capture: Capture, path: AnyPath, units: Units = "scene", overwrite: bool = False
) -> None:
    """Write a capture as a COLMAP text model, completely or not at all.

    It writes `sparse/0/*.txt`, `images` and, if the capture has any, `masks`. The
    observations of a point are its projections into some of the frames, without a test
    of occlusion. Masks are black where something moves, as in COLMAP. Images are
    transparent where nothing was observed. The format has no times, so readers derive
    them from the names.

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
    bad_names = [name for name in capture.ids if len(name.split()) != 1]
    if bad_names:
        raise CaptureError(
            f"{path}: the name of frame {bad_names[0]!r} has a space, which COLMAP's "
            "text format cannot hold; rename it, or export transforms"
        )
    with replaced_folder(path, overwrite) as folder:
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        (folder / "images").mkdir()
        for row, name in enumerate(capture.ids):
            image = _with_alpha(capture, row)
            image_files.write_png(folder / "images" / f"{name}.png", image)
        if capture.moving is not None:
            (folder / "masks").mkdir()
            for name, moving in zip(capture.ids, capture.moving, strict=True):
                image_files.write_png(folder / "masks" / f"{name}.png.png", ~moving)
        lenses = [_lens(capture, row) for row in range(len(capture.ids))]
        numbers = {lens: number for number, lens in enumerate(dict.fromkeys(lenses), 1)}
        lines = (f"{number} {lens}" for lens, number in numbers.items())
        _write_lines(model / "cameras.txt", lines)
        is_observed, pixels = _observations(capture)
        camera_numbers = [numbers[lens] for lens in lenses]
        lines = _image_lines(capture, units, camera_numbers, is_observed, pixels)
        _write_lines(model / "images.txt", lines)
        _write_lines(model / "points3D.txt", _point_lines(capture, units, is_observed))


def _write_lines(path, lines):
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _text(values):
    return " ".join(repr(float(value)) for value in values)


def _with_alpha(capture, row):
    """The image of a frame, with the mask of observed pixels as alpha, if any."""
    if capture.valid is None:
        return capture.images[row]
    alpha = np.where(capture.valid[row], np.uint8(255), np.uint8(0))
    return np.concatenate([capture.images[row], alpha[..., None]], axis=-1)


def _lens(capture, row):
    """Fields MODEL WIDTH HEIGHT PARAMETERS of a camera, in pixels."""
    cameras = capture.cameras
    focal = float(cameras.focal_px[row])
    focal_xy = (focal, focal * float(cameras.pixel_aspect[row]))
    parameters = [*focal_xy, *cameras.principal_point_px[row]]
    k1, k2, k3 = cameras.radial[row]
    distortion = [k1, k2, *cameras.tangential[row]]
    model = "PINHOLE"
    if cameras.fisheye is not None:
        model, parameters = "OPENCV_FISHEYE", [*parameters, *cameras.fisheye[row]]
    elif k3 != 0:
        model, parameters = "FULL_OPENCV", [*parameters, *distortion, k3, 0, 0, 0]
    elif any(distortion):
        model, parameters = "OPENCV", [*parameters, *distortion]
    return f"{model} {capture.size[0]} {capture.size[1]} {_text(parameters)}"


def _observations(capture):
    """The observations to store [frames, points], and the pixels of all points."""
    count = len(capture.ids)
    if capture.points is None:
        return np.zeros((count, 0), bool), np.zeros((count, 0, 2))
    position = capture.points.position
    rows = [
        world_points.pixels_of(capture.cameras, row, position, capture.size)
        for row in range(count)
    ]
    pixels = np.stack([np.asarray(pixel) for pixel, _, _ in rows])
    visible = np.stack([np.asarray(inside) for _, _, inside in rows])
    # Of the frames that show a point, numbered from 0 to count - 1, those are kept in
    # which number * kept / count reaches the next integer.
    number = np.cumsum(visible, axis=0) - visible
    count = np.maximum(visible.sum(axis=0), 1)
    limit = np.minimum(count, MOST_SEEN)
    is_kept = (number * limit) // count != ((number - 1) * limit) // count
    return visible & is_kept, pixels


def _image_lines(capture, units, camera_numbers, is_observed, pixels):
    """Two lines for each frame: its pose, then its observations."""
    rotations = scipy.spatial.transform.Rotation.from_matrix(
        capture.cameras.camera_from_world.astype(np.float64)
    )
    positions = places_in(units, capture, capture.cameras.position)
    translations = -rotations.apply(positions)
    for row, name in enumerate(capture.ids):
        x, y, z, w = rotations[row].as_quat()
        pose = _text((w, x, y, z, *translations[row]))
        yield f"{row + 1} {pose} {camera_numbers[row]} {name}.png"
        points = np.flatnonzero(is_observed[row])
        observations = zip(*pixels[row][points].T, points, strict=True)
        yield " ".join(f"{x:.3f} {y:.3f} {point + 1}" for x, y, point in observations)


def _point_lines(capture, units, is_observed):
    """A line for each point: position, color, error, and its track.

    The track lists the frames and the indices of the observations in their lines.
    """
    if capture.points is None:
        return
    positions = places_in(units, capture, capture.points.position)
    index = np.cumsum(is_observed, axis=1) - 1
    for number, color in enumerate(capture.points.color):
        rows = np.flatnonzero(is_observed[:, number])
        track = " ".join(f"{row + 1} {index[row, number]}" for row in rows)
        rgb = " ".join(str(int(part)) for part in color)
        # Observations are exact projections, so the reprojection error is 0.
        yield f"{number + 1} {_text(positions[number])} {rgb} 0.0 {track}"
