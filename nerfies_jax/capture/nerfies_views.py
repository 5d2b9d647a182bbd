"""Cameras, times and splits of a Nerfies directory, without its images."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from nerfies_jax.capture import frames, name_times, splits, unread_keys
from nerfies_jax.capture.capture import (
    MAX_ID,
    Capture,
    CaptureError,
    check_cameras,
    check_times,
)
from nerfies_jax.capture.json_files import AnyPath, inside, named_file, read_json
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.capture.safe_files import confines
from nerfies_jax.geometry import camera
from nerfies_jax.geometry.camera import Camera

Pair = tuple[float, float]
Triple = tuple[float, float, float]


class CameraFile(msgspec.Struct):
    """`camera/<id>.json`, in pixels of the full-size image."""

    orientation: tuple[Triple, Triple, Triple]  # camera from world
    position: Triple
    focal_length: float
    principal_point: Pair
    image_size: Pair
    skew: float = 0.0
    pixel_aspect_ratio: float = 1.0
    radial_distortion: Triple = (0.0, 0.0, 0.0)
    tangential_distortion: Pair | None = None
    tangential: Pair | None = None  # the name that early files use
    time: float | None = None  # our extension for camera paths, in [0, 1]
    # Our extension, k1 to k4 of OpenCV's fisheye model, which replaces the other two.
    fisheye_distortion: tuple[float, float, float, float] | None = None


class SceneFile(msgspec.Struct):
    """`scene.json`: near and far in scene units, scale and center in world units."""

    scale: float
    center: Triple
    near: float
    far: float
    background: Triple | None = None  # our extension


class DatasetFile(msgspec.Struct):
    """`dataset.json`, in which ids may also be numbers."""

    ids: list[str | int] = []
    train_ids: list[str | int] = []
    val_ids: list[str | int] = []


class SplitFile(msgspec.Struct):
    """DyCheck's `splits/<name>.json`."""

    frame_names: list[str]


class FrameEntry(msgspec.Struct):
    """One entry of `metadata.json`.

    Triples are HyperNeRF's interpolated ids: left id, right id, weight of the right.
    """

    warp_id: int | Triple | None = None
    appearance_id: int | Triple = 0
    camera_id: int = 0
    time_id: float | None = None
    time: float | None = None  # our extension, in [0, 1]


class ExtraFile(msgspec.Struct):
    """The supported part of DyCheck's `extra.json`."""

    factor: int | None = None
    fps: float | None = None
    up: Triple | None = None


class NerfiesViews(NamedTuple):
    """Cameras and metadata of a directory, without images."""

    ids: tuple[str, ...]
    cameras: Camera  # scene units; pixels of the full-size image
    size: tuple[int, int]  # width and height of the full-size image
    times: np.ndarray
    train: np.ndarray
    heldout: np.ndarray
    warp_ids: np.ndarray
    appearance_ids: np.ndarray
    camera_ids: np.ndarray
    scene: SceneFile
    extra: ExtraFile
    notes: tuple[str, ...]


@confines
def read_cameras(
    path: AnyPath, heldout: int | str | None = None, missing: str = "refuse"
) -> NerfiesViews:
    """Read cameras, times, ids and splits.

    Args:
      path: The directory.
      heldout: None for the split in the files, n for every n-th frame, "interp" for
        HyperNeRF's interpolation protocol (train on ids[::4], evaluate on ids[2::4]),
        or the name of one of DyCheck's splits ("val", "val_intl", ...).
      missing: "refuse" or "skip" frames without a camera file, such as those that could
        not be registered.

    Returns:
      The cameras, in scene units.

    Raises:
      CaptureError: If the directory cannot be used.
    """
    path = pathlib.Path(path)
    scene = read_json(path / "scene.json", SceneFile)
    if not scene.scale > 0:
        raise CaptureError(
            f"{path / 'scene.json'}: scale = {scene.scale:g}; it must be positive"
        )
    extra_file = path / "extra.json"
    extra = read_json(extra_file, ExtraFile) if extra_file.exists() else ExtraFile()
    train, heldout_ids, notes = _splits(path, heldout)
    names = sorted(set(train) | set(heldout_ids), key=frames.natural)
    ids, skip_notes = _with_camera_files(path, names, missing)
    files = [_camera_file(path, name) for name in ids]
    size = _common_size(path, ids, files)
    cameras = cameras_of(files, scene.scale, scene.center)
    check_cameras(cameras, ids, size, str(path / "camera"))
    entries, entry_notes = _frame_entries(path, ids)
    row = {name: number for number, name in enumerate(ids)}
    return NerfiesViews(
        ids=ids,
        cameras=cameras,
        size=size,
        times=_times(entries, path, ids),
        train=np.sort([row[name] for name in train if name in row]).astype(int),
        heldout=np.sort([row[name] for name in heldout_ids if name in row]).astype(int),
        warp_ids=splits.dense([_number(e.warp_id) for e in entries]),
        appearance_ids=splits.dense([_number(e.appearance_id) for e in entries]),
        camera_ids=splits.dense([e.camera_id for e in entries]),
        scene=scene,
        extra=extra,
        notes=(*notes, *skip_notes, *entry_notes, *_unread(path, ids)),
    )


def _unread(path, ids):
    """Notes of unknown keys, which may affect the scene."""
    files = {
        path / "scene.json": {*SceneFile.__struct_fields__},
        path / "dataset.json": {
            *DatasetFile.__struct_fields__,
            *("count", "num_exemplars"),
        },
        path / "extra.json": {
            *ExtraFile.__struct_fields__,
            *("bbox", "lookat", "lookats"),
        },
        path / "camera" / f"{ids[0]}.json": {*CameraFile.__struct_fields__},
    }
    notes = [
        note
        for file, keys in files.items()
        if file.is_file()
        for note in unread_keys.notes(file, keys)
    ]
    file = path / "metadata.json"
    if file.is_file():
        notes += unread_keys.notes(file, None, {None: {*FrameEntry.__struct_fields__}})
    return tuple(notes)


def _splits(path, heldout):
    """Names of the training and held-out frames, and notes."""
    file = path / "dataset.json"
    notes = ()
    if file.exists():
        dataset = read_json(file, DatasetFile)
        ids, train, val = (
            [str(name) for name in names]
            for names in (dataset.ids, dataset.train_ids, dataset.val_ids)
        )
    else:
        ids, train, val = [], [], []
        notes = ("no dataset.json: all camera files are frames",)
    if not ids and not train and not val:
        ids = [file.stem for file in (path / "camera").glob("*.json")]
    all_names = sorted({*ids, *train, *val}, key=frames.natural)
    if not all_names:
        raise CaptureError(f"{file}: no frames; list them under ids or train_ids")
    if heldout == "interp":
        sorted_ids = sorted(ids or all_names, key=frames.natural)
        return sorted_ids[::4], sorted_ids[2::4], notes
    if isinstance(heldout, str):
        return *_named_split(path, heldout), notes
    if isinstance(heldout, int) or not val:
        step = splits.HELD_OUT if heldout is None else heldout
        pool = all_names if isinstance(heldout, int) or not train else train
        pool = sorted(pool, key=frames.natural)
        train_rows, heldout_rows = splits.hold_out_every(len(pool), step, str(path))
        if heldout is None:
            notes += (f"no validation ids: {splits.held_out_note(heldout_rows, step)}",)
        return (
            [pool[row] for row in train_rows],
            [pool[row] for row in heldout_rows],
            notes,
        )
    left_out = len(all_names) - len({*train, *val})
    if train and left_out:
        notes += (f"{left_out} frames in neither split are not read",)
    return train or [name for name in all_names if name not in set(val)], val, notes


def _named_split(path, heldout):
    folder = path / "splits"
    file = inside(folder, f"{heldout}.json", folder)
    if not file.is_file():
        names = sorted(f.stem for f in folder.glob("*.json"))
        raise CaptureError(f"{file}: no such split; {known_names(heldout, names)}")
    # DyCheck pairs its splits: val_intl belongs to train_intl.
    partner = folder / f"{heldout.replace('val', 'train', 1)}.json"
    if partner == file or not partner.is_file():
        partner = folder / "train.json"
    return [read_json(each, SplitFile).frame_names for each in (partner, file)]


def _with_camera_files(path, names, missing):
    """Names of the frames with a camera file, and a note about the others."""
    frames.check_missing(missing, str(path))
    present = tuple(name for name in names if _camera_path(path, name).is_file())
    absent = [name for name in names if name not in set(present)]
    if not absent:
        return present, ()
    listing = ", ".join(f"camera/{name}.json" for name in absent[:5])
    listing += ", ..." if len(absent) > 5 else ""
    if missing == "refuse" or not present:
        raise CaptureError(
            f"{path / 'dataset.json'}: {len(absent)} of {len(names)} frames have no "
            f"camera file ({listing}); restore those files, or leave the frames out "
            'with missing="skip"'
        )
    return present, (
        f"{len(absent)} frames left out, they have no camera file: {listing}",
    )


def _camera_path(path, name):
    return named_file(path / "camera", f"{name}.json", path / "dataset.json")


def _camera_file(path, name):
    return read_json(_camera_path(path, name), CameraFile)


def _common_size(path, ids, files):
    size = files[0].image_size
    for name, file in zip(ids, files, strict=True):
        if file.image_size != size or min(size) < 1:
            raise CaptureError(
                f"{path / 'camera' / name}.json: image_size {file.image_size}, but "
                f"{ids[0]} has {size}; the frames of a capture share one positive size"
            )
    return round(size[0]), round(size[1])


def cameras_of(
    files: Sequence[CameraFile], scale: float, center: Sequence[float]
) -> Camera:
    """Convert camera files, in world units, to cameras in scene units.

    Args:
      files: Camera files.
      scale: Scene units per world unit.
      center: Origin of scene units, in world units.

    Returns:
      Cameras, [files].
    """

    def column(values, dtype=np.float32):
        return np.array(values, dtype)

    world = column([file.position for file in files], np.float64)
    tangential = [
        file.tangential_distortion or file.tangential or (0.0, 0.0) for file in files
    ]
    return Camera(
        camera_from_world=column([file.orientation for file in files]),
        position=((world - np.asarray(center)) * scale).astype(np.float32),
        focal_px=column([file.focal_length for file in files]),
        principal_point_px=column([file.principal_point for file in files]),
        skew_px=column([file.skew for file in files]),
        pixel_aspect=column([file.pixel_aspect_ratio for file in files]),
        radial=column([file.radial_distortion for file in files]),
        tangential=column(tangential),
        fisheye=_fisheye(files),
    )


def _fisheye(files):
    """Coefficients [files, 4] of fisheyes, None if no file has any."""
    coefficients = [file.fisheye_distortion for file in files]
    if not any(coefficients):
        return None
    if not all(coefficients):
        raise CaptureError(
            f"{coefficients.count(None)} of {len(files)} cameras have no "
            "fisheye_distortion; cameras of one capture are all fisheyes or none is"
        )
    return np.array(coefficients, np.float32)


def camera_entry(one: Camera, capture: Capture, size: tuple[int, int]) -> dict:
    """Return the contents of `camera/<id>.json` for a camera.

    Args:
      one: The camera, in scene units.
      capture: The capture, for its scale and center.
      size: Width and height of the image in pixels.

    Returns:
      JSON values, in world units.
    """
    position = np.asarray(one.position, np.float64) / capture.scale + capture.center
    ours = {} if one.fisheye is None else {"fisheye_distortion": one.fisheye.tolist()}
    return {
        "orientation": one.camera_from_world.tolist(),
        "position": position.tolist(),
        "focal_length": float(one.focal_px),
        "principal_point": one.principal_point_px.tolist(),
        "skew": float(one.skew_px),
        "pixel_aspect_ratio": float(one.pixel_aspect),
        "radial_distortion": one.radial.tolist(),
        "tangential_distortion": one.tangential.tolist(),
        "image_size": list(size),
        **ours,
    }


def _number(frame_id):
    """An id as a number, fractional for HyperNeRF's interpolated ids."""
    if isinstance(frame_id, tuple):
        left, right, weight = frame_id
        return left + (right - left) * weight
    return frame_id


def _frame_entries(path, ids):
    file = path / "metadata.json"
    if not file.exists():
        entries = [FrameEntry(appearance_id=row) for row in range(len(ids))]
        note = "no metadata.json: each frame has a time of its own"
        return _times_of_names(entries, ids, note)
    table = read_json(file, dict[str, FrameEntry])
    absent = [name for name in ids if name not in table]
    if absent:
        raise CaptureError(
            f"{file}: no entry for frame {absent[0]!r} ({len(absent)} missing); add "
            "one with warp_id, appearance_id and camera_id"
        )
    entries = [table[name] for name in ids]
    for name, entry in zip(ids, entries, strict=True):
        for key in ("warp_id", "appearance_id", "camera_id"):
            value = _number(getattr(entry, key))
            if value is not None and not 0 <= value < MAX_ID:
                raise CaptureError(
                    f"{file}: frame {name!r} has {key} {value}; expected 0 to "
                    f"{MAX_ID - 1}"
                )
    entries, notes = _complete_warp_ids(entries, file, ids)
    interpolations = sum(isinstance(entry.warp_id, tuple) for entry in entries)
    if interpolations:
        notes += (f"{interpolations} frames have interpolated warp ids (HyperNeRF)",)
    return entries, notes


def _complete_warp_ids(entries, file, ids):
    """Entries that all have a warp_id, and notes on its source."""
    absent = [
        name for name, entry in zip(ids, entries, strict=True) if entry.warp_id is None
    ]
    if not absent:
        return entries, ()
    for key in ("time_id", "time"):
        values = [getattr(entry, key) for entry in entries]
        if None not in values:
            return _with_warp_ids(entries, values), ()
    if len(absent) < len(ids):
        raise CaptureError(
            f"{file}: {len(absent)} of {len(ids)} frames have no warp_id "
            f"({', '.join(absent[:5])}); add it, or remove it from all so that times "
            "are taken from the names"
        )
    note = f"no warp_id, time_id or time in {file.name}: taken from names"
    return _times_of_names(entries, ids, note)


def _times_of_names(entries, ids, note):
    clock = name_times.clock(ids)
    entries = _with_warp_ids(entries, clock.times)
    if clock.cameras is not None and not any(entry.camera_id for entry in entries):
        entries = [
            msgspec.structs.replace(entry, camera_id=camera_id)
            for entry, camera_id in zip(entries, clock.cameras.tolist(), strict=True)
        ]
    times = splits.spread(clock.times).tolist()
    entries = [
        msgspec.structs.replace(entry, time=time)
        for entry, time in zip(entries, times, strict=True)
    ]
    return entries, (note, *clock.notes)


def _with_warp_ids(entries, values):
    return [
        msgspec.structs.replace(entry, warp_id=warp_id)
        for entry, warp_id in zip(entries, splits.dense(values).tolist(), strict=True)
    ]


def _times(entries, path, ids):
    if all(entry.time is not None for entry in entries):
        times = np.array([entry.time for entry in entries], np.float32)
        check_times(times, ids, str(path / "metadata.json"))
        return times
    if all(entry.time_id is not None for entry in entries):
        return splits.spread([entry.time_id for entry in entries])
    return splits.spread([_number(entry.warp_id) for entry in entries])


def only(views, rows):
    """Select frames.

    Args:
      views: Cameras of a directory.
      rows: Indices of the frames.

    Returns:
      The views of these frames.
    """
    if len(rows) == len(views.ids):
        return views
    new_index = np.full(len(views.ids), -1)
    new_index[rows] = np.arange(len(rows))
    columns = ("times", "warp_ids", "appearance_ids", "camera_ids")
    return views._replace(
        ids=tuple(views.ids[row] for row in rows),
        cameras=camera.take(views.cameras, rows),
        train=new_index[views.train][new_index[views.train] >= 0],
        heldout=new_index[views.heldout][new_index[views.heldout] >= 0],
        **{name: getattr(views, name)[rows] for name in columns},
    )
