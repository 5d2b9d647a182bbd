"""Reader of COLMAP reconstructions with pycolmap."""

import pathlib
from typing import Any, NamedTuple

import numpy as np

from nerfies_jax.capture import (
    colmap_models,
    frames,
    name_times,
    splits,
    text_files,
    world_points,
)
from nerfies_jax.capture import images as image_files
from nerfies_jax.capture.borders import without_black_borders
from nerfies_jax.capture.capture import Capture, CaptureError, PointCloud
from nerfies_jax.capture.colmap_lenses import undistort
from nerfies_jax.capture.colmap_library import MIN_TRACK, library
from nerfies_jax.capture.formats import sparse_models
from nerfies_jax.capture.json_files import AnyPath, inside
from nerfies_jax.capture.points import place_by_points
from nerfies_jax.capture.safe_files import confines
from nerfies_jax.geometry.camera import Camera

IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8", "input", "rgb", "")


class Model(NamedTuple):
    """Contents of a reconstruction, in world units and pixels of its own images."""

    names: tuple[str, ...]  # of the images, in natural order
    lenses: list[Any]  # one pycolmap.Camera per image
    camera_ids: np.ndarray
    rotations: np.ndarray  # [frames, 3, 3] camera from world
    positions: np.ndarray  # [frames, 3]
    points: np.ndarray  # [points, 3]
    colors: np.ndarray  # [points, 3] uint8
    depths: np.ndarray  # [observations] z-depths of the points


@confines
def read(
    path: AnyPath,
    factor: int | None = None,
    max_side: int | None = None,
    heldout: int | str | None = None,
    missing: str = "refuse",
) -> Capture:
    """Read a capture from a folder with images and a COLMAP model.

    The images may be integer reductions of those of the model (images_2 and so on).
    Images with unsupported lens models are undistorted to a pinhole. Times are derived
    from numbers in the image names, or else from their order. Masks in `masks/` are
    read (black is moving, as in COLMAP). If each image has a COLMAP camera of its own,
    each folder of images counts as a physical camera.

    Args:
      path: The folder.
      factor: Read images at 1/`factor` of the size of the model's.
      max_side: Longest side of the images in pixels. At most one of the two can be
        given.
      heldout: n for every n-th frame. None for every 8th.
      missing: "refuse" or "skip" frames without an image.

    Returns:
      The capture.

    Raises:
      CaptureError: If the capture cannot be used.
    """
    path = pathlib.Path(path)
    folder, notes = _best_model(path)
    model, moved_notes = _with_local_names(path, read_model(folder))
    model, lens_notes = _with_physical_cameras(model)
    notes += (*moved_notes, *lens_notes)
    if isinstance(heldout, str):
        raise CaptureError(
            f"{path}: COLMAP has no split {heldout!r}; pass a number n to hold out "
            "every n-th frame"
        )
    model, files, shrink_by, skip_notes = _with_images(
        path, model, factor, max_side, missing
    )
    # COLMAP reads pixels as stored and ignores the EXIF orientation.
    sequence = frames.read_frames(files, shrink_by, orientation="stored")
    images, valid, moving, lenses, pixel_notes = _as_pinholes(
        path, model, files, sequence, shrink_by
    )
    notes += (*sequence.notes, *pixel_notes)
    placement = place_by_points(model.points, model.positions, model.depths)
    center, scale = np.array(placement.center), placement.scale
    cameras = _cameras(lenses, model.rotations, (model.positions - center) * scale)
    ids = tuple(map(name_of, model.names))
    clock = name_times.clock(
        [pathlib.PurePosixPath(name).with_suffix("").as_posix() for name in model.names]
    )
    times = splits.spread(clock.times)
    notes += clock.notes
    if clock.cameras is not None:  # a camera has only one frame at a time
        model = model._replace(camera_ids=clock.cameras)
    interval = splits.HELD_OUT if heldout is None else heldout
    group = np.zeros(len(ids)) if clock.cameras is None else clock.cameras
    train, heldout_rows = splits.hold_out_in_time(times, group, interval, str(path))
    notes += (splits.held_out_note(heldout_rows, interval),)
    return Capture(
        name=path.resolve().name,
        source="colmap",
        ids=ids,
        images=images,
        cameras=cameras,
        times=times,
        train=train,
        heldout=heldout_rows,
        near=placement.near,
        far=placement.far,
        warp_ids=splits.dense(times),
        appearance_ids=np.arange(len(ids), dtype=np.int32),
        camera_ids=splits.dense(model.camera_ids),
        valid=valid,
        moving=moving,
        points=PointCloud(
            ((model.points - center) * scale).astype(np.float32), model.colors
        ),
        scale=scale,
        center=placement.center,
        up=world_points.up_direction(cameras),
        path=path,
        notes=(*notes, *skip_notes),
    )


def _with_local_names(path, model):
    """Return the model with names of images in this folder, and a note of changes."""
    for subfolder in IMAGE_FOLDERS:
        local = [frames.local_name(path / subfolder, name) for name in model.names]
        note = frames.moved_note(model.names, local)
        if note:
            return model._replace(names=tuple(local)), note
    return model, ()


def _with_physical_cameras(model):
    """Return the model with ids of physical cameras, and a note if they are guessed.

    By default COLMAP gives each image a camera of its own.
    """
    if len(np.unique(model.camera_ids)) < len(model.camera_ids):
        return model, ()
    folders = [pathlib.PurePosixPath(name).parent.as_posix() for name in model.names]
    camera_ids = splits.dense(folders)
    guess = "one camera per folder" if camera_ids.any() else "one camera"
    note = f"each image has a COLMAP camera of its own: taken as {guess}"
    return model._replace(camera_ids=camera_ids), (note,)


def _with_images(path, model, factor, max_side, missing):
    """The model of existing images, their files, a further reduction, and a note."""
    available, paths = _find_images(path, model)
    full = (model.lenses[0].width, model.lenses[0].height)
    source, shrink_by = frames.choose_source(
        available, full, factor, max_side, str(path)
    )
    rows, skip_notes = frames.keep_found(paths[source], model.names, missing, str(path))
    return (
        _take(model, rows),
        [paths[source][row] for row in rows],
        shrink_by,
        skip_notes,
    )


def _as_pinholes(path, model, files, sequence, shrink_by):
    """Images and masks with supported lenses, and notes."""
    images, valid = sequence.images, sequence.valid()
    size = (images.shape[2], images.shape[1])
    moving, mask_notes = _masks(path, model.names, size, shrink_by)
    valid, notes = without_black_borders(images, valid)
    notes += mask_notes
    full = image_files.read_header(files[0]).size
    lenses = [_scale(lens, full, size, path) for lens in model.lenses]
    fisheyes = {_is_fisheye(lens) for lens in lenses}
    if not all(map(_is_supported, lenses)) or len(fisheyes) > 1:
        names = sorted({lens.model_name for lens in lenses})
        notes += (f"images undistorted from {' and '.join(names)} to a pinhole",)
        images, exists, (valid, moving), pinhole = undistort(
            images, (valid, moving), lenses, str(path)
        )
        valid = exists if valid is None else valid
        lenses = [pinhole] * len(lenses)
    return images, valid, moving, lenses, notes


def name_of(image: str) -> str:
    """Return the id of an image: its path without suffix, usable as a file name.

    Args:
      image: Path of the image in the model.

    Returns:
      The id.
    """
    return pathlib.PurePosixPath(image).with_suffix("").as_posix().replace("/", "_")


def read_model(folder: pathlib.Path) -> Model:
    """Read the registered images and reliable points of one sparse model.

    Args:
      folder: Folder of the model.

    Returns:
      The model.

    Raises:
      CaptureError: If the model cannot be read, or has too few images or points.
    """
    about, arrays = colmap_models.tables(folder)
    names = about["names"]
    if len(names) < 2:
        raise CaptureError(
            f"{folder}: {len(names)} images have a pose; a reconstruction needs at "
            "least 2, so run COLMAP with more overlap"
        )
    if len(arrays["points"]) < 3:
        raise CaptureError(
            f"{folder}: {len(arrays['points'])} points observed in {MIN_TRACK} frames "
            "or more; at least 3 are needed to normalize the scene, so keep points3D "
            "or run COLMAP again"
        )
    rows = sorted(range(len(names)), key=lambda row: frames.natural(names[row]))
    try:
        cameras = {
            number: library().Camera(fields)
            for number, fields in about["cameras"].items()
        }
    except (ValueError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise CaptureError(
            f"{folder}: unknown camera model ({reason}); undistort to PINHOLE first"
        ) from None
    camera_ids = [about["camera_ids"][row] for row in rows]
    depths = arrays["depths"]
    return Model(
        # Of models made on Windows, folders of images end in backslashes.
        names=tuple(text_files.forward_slashes(names[row]) for row in rows),
        lenses=[cameras[str(number)] for number in camera_ids],
        camera_ids=np.array(camera_ids),
        rotations=arrays["rotations"][rows],
        positions=arrays["positions"][rows],
        points=arrays["points"],
        colors=arrays["colors"],
        depths=depths[depths > 0],
    )


def _best_model(path):
    """Return the folder of the model with most images, and notes.

    The numbers of models tell nothing about their size.
    """
    folders = sparse_models(path)
    if not folders:
        raise CaptureError(
            f"{path}: no COLMAP model; looked for cameras, images and points3D (.bin "
            "or .txt) in sparse/0, sparse and here"
        )
    if len(folders) == 1:
        return folders[0], ()
    counts, errors = {}, {}
    for folder in folders:
        try:
            counts[folder] = len(colmap_models.tables(folder).about["names"])
        except CaptureError as error:
            errors[folder] = error
    if not counts:
        raise next(iter(errors.values()))
    notes = tuple(
        f"skipped: {error}".replace(f"{path}/", "") for error in errors.values()
    )
    if len(counts) > 1:
        listing = ", ".join(f"{p.name}: {n}" for p, n in counts.items())
        notes = (f"several models, the largest is read (images: {listing})", *notes)
    return max(counts, key=counts.get), notes


def _find_images(path, model):
    """Find the folder of each stored reduction, and the file of each image or None."""
    first = model.lenses[0]
    available, paths = {}, {}
    for subfolder in IMAGE_FOLDERS:
        files = [_find(path, subfolder, name) for name in model.names]
        sample = next((file for file in files if file is not None), None)
        if sample is None:
            continue
        width, height = image_files.read_header(sample).size
        ratio = max(1, round(first.width / width))
        if (
            abs(first.width / ratio - width) >= 1
            or abs(first.height / ratio - height) >= 1
        ):
            raise CaptureError(
                f"{sample}: {width}x{height} pixels, but its camera is for "
                f"{first.width}x{first.height}; images must be an integer fraction of "
                "that"
            )
        if ratio not in available:
            available[ratio], paths[ratio] = path / subfolder, files
    if not available:
        listing = ", ".join(folder or "the folder itself" for folder in IMAGE_FOLDERS)
        raise CaptureError(
            f"{path}: a COLMAP model but none of its images ({model.names[0]}, ...); "
            f"looked in {listing}"
        )
    return available, paths


def _find(path, subfolder, name):
    """Find an image by its name. The suffix may differ, as often for reductions."""
    inside(path / subfolder, name, path)
    stem = pathlib.PurePosixPath(name).with_suffix("").as_posix()
    for each in (name, stem):
        # From the capture's folder, since the case of `subfolder` may differ as well.
        file = frames.find_image(path, f"{subfolder}/{each}" if subfolder else each)
        if file is not None:
            return file
    return None


def _take(model, rows):
    return model._replace(
        names=tuple(model.names[row] for row in rows),
        lenses=[model.lenses[row] for row in rows],
        camera_ids=model.camera_ids[rows],
        rotations=model.rotations[rows],
        positions=model.positions[rows],
    )


def _masks(path, names, size, shrink_by):
    folder = path / "masks"
    if not folder.is_dir():
        return None, ()
    paths = [
        frames.find_image(folder, f"{name}.png") or _find(path, "masks", name)
        for name in names
    ]
    if not any(paths):
        return None, ("no file in masks/ has the name of an image: masks not read",)
    white, notes = frames.read_masks(paths, size, shrink_by, "moving")
    return white < 1, notes


def _scale(lens, stored_size, size, path):
    """Return the lens for images of `size`, which are downscaled stored images."""
    if lens.is_spherical():
        raise CaptureError(
            f"{path}: camera {lens.camera_id} is {lens.model_name}, a full panorama; "
            "convert it to perspective images first"
        )
    ratio = max(1, round(lens.width / stored_size[0]))
    mismatch = abs(np.array((lens.width, lens.height)) / ratio - stored_size)
    if mismatch.max() >= 1:
        raise CaptureError(
            f"{path}: camera {lens.camera_id} is for {lens.width}x{lens.height} "
            f"pixels, but its images have {stored_size[0]}x{stored_size[1]}; images "
            "must be an integer fraction of that"
        )
    copy = library().Camera(lens.todict())
    copy.rescale(*stored_size)
    shrink_by = stored_size[0] // size[0]
    # Incomplete blocks are cropped at the right and bottom only.
    copy.width, copy.height = size[0] * shrink_by, size[1] * shrink_by
    copy.rescale(*size)
    return copy


def _is_fisheye(lens):
    return lens.model_name == "OPENCV_FISHEYE"


def _is_supported(lens):
    if lens.model_name == "FULL_OPENCV":
        return not np.any(lens.params[9:])  # k4 to k6 of the rational model
    return lens.model_name in {
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
        "OPENCV_FISHEYE",
    }


def _cameras(lenses, rotations, positions):
    radial = np.zeros((len(lenses), 3), np.float32)
    tangential = np.zeros((len(lenses), 2), np.float32)
    fisheye = None
    if _is_fisheye(lenses[0]):
        fisheye = np.array([lens.params[4:8] for lens in lenses], np.float32)
    for row, lens in enumerate(lenses if fisheye is None else ()):
        coefficients = np.asarray(lens.params)[2 + len(lens.focal_length_idxs()) :]
        radial[row, : min(2, len(coefficients))] = coefficients[:2]
        if len(coefficients) >= 4:
            tangential[row] = coefficients[2:4]
        if len(coefficients) >= 5:
            radial[row, 2] = coefficients[4]
    focal = np.array([[lens.focal_length_x, lens.focal_length_y] for lens in lenses])
    center = [[lens.principal_point_x, lens.principal_point_y] for lens in lenses]
    return Camera(
        camera_from_world=rotations.astype(np.float32),
        position=positions.astype(np.float32),
        focal_px=focal[:, 0].astype(np.float32),
        principal_point_px=np.array(center, np.float32),
        skew_px=np.zeros(len(lenses), np.float32),
        pixel_aspect=(focal[:, 1] / focal[:, 0]).astype(np.float32),
        radial=radial,
        tangential=tangential,
        fisheye=fisheye,
    )
