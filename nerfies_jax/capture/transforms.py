"""File layout of transforms*.json, and the split into training and held-out frames."""

import collections
import pathlib

import msgspec
import numpy as np

from nerfies_jax.capture import frames, name_times, splits, text_files, unread_keys
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.json_files import read_json
from nerfies_jax.capture.nearest import known_names


class Lens(msgspec.Struct, kw_only=True):
    """Intrinsics of a whole file or of one frame, in pixels of `w` by `h`."""

    camera_angle_x: float | None = None  # horizontal field of view, rad
    camera_angle_y: float | None = None  # vertical field of view, rad
    x_fov: float | None = None  # the same in degrees, instant-ngp's
    y_fov: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: float | None = None
    h: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    k5: float | None = None
    k6: float | None = None
    p1: float | None = None
    p2: float | None = None
    is_fisheye: bool | None = None  # instant-ngp's
    camera_model: str | None = None


# Groups of keys. If a frame has any key of a group, none of the file's group is used.
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
CENTER, SIZE, MODEL = ("cx", "cy"), ("w", "h"), ("camera_model", "is_fisheye")
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
UNITS = (FOCAL, CENTER, SIZE, MODEL, DISTORTION)


class Frame(Lens, kw_only=True):
    """One image."""

    file_path: str
    transform_matrix: list[list[float]] | None = None  # None without a pose
    time: float | None = None
    mask_path: str | None = None  # black pixels are not used
    depth_file_path: str | None = None  # nerfstudio's; not read, with a note


class Transforms(Lens, kw_only=True):
    """One file."""

    frames: list[Frame] = []
    ply_file_path: str | None = None
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    # Extensions of this library.
    background: tuple[float, float, float] | None = None  # of opaque images
    up: tuple[float, float, float] | None = None
    fps: float | None = None


# Keys that do not affect the result: scene boxes and viewer cameras of other programs,
# and transforms that the poses already include.
HARMLESS = {
    *("aabb", "aabb_scale", "scale", "offset", "n_extra_learnable_dims", "n_frames"),
    *("applied_transform", "applied_scale", "colmap_im_id", "sharpness", "rotation"),
    *("orientation_override", "render_aabb", "up_vector", "image_id", "frame_id"),
}


ROUNDING = 1e-6  # tolerance of times, which may be stored in float32


class Split(msgspec.Struct):
    """Training and held-out frames."""

    file: pathlib.Path
    transforms: Transforms  # of the training file
    train: list[Frame]
    heldout: list[Frame]
    notes: tuple[str, ...] = ()


def read_split(
    path: pathlib.Path, heldout: int | str | None, missing: str = "refuse"
) -> Split:
    """Read the frames of a folder or file.

    Args:
      path: The folder or file.
      heldout: As in `blender_format.read`.
      missing: "refuse" or "skip" frames without a `transform_matrix`.

    Returns:
      The split.

    Raises:
      CaptureError: If the file cannot be read or the split does not exist.
    """
    file = path if path.is_file() else path / "transforms_train.json"
    if path.is_dir() and not file.is_file() and (path / "transforms.json").is_file():
        file = path / "transforms.json"
    transforms, notes = _with_poses(file, missing)
    notes += _fill_times(file, transforms.frames)
    split = _split(file, transforms, heldout, missing)
    return msgspec.structs.replace(split, notes=(*split.notes, *notes, *_unread(file)))


def _with_poses(file, missing):
    """Read a file. Frames without a pose are refused, or left out with a note."""
    transforms = read_json(file, Transforms)
    frames.check_missing(missing, str(file))
    entries = [each for each in transforms.frames if each.transform_matrix is not None]
    absent = [
        each.file_path for each in transforms.frames if each.transform_matrix is None
    ]
    if not absent:
        return transforms, ()
    listing = ", ".join(absent[:5]) + (", ..." if len(absent) > 5 else "")
    if missing == "refuse" or not entries:
        raise CaptureError(
            f"{file}: {len(absent)} of {len(transforms.frames)} frames have no "
            f"transform_matrix ({listing}); add their poses, or leave those frames out "
            'with missing="skip"'
        )
    absent_paths = {text_files.forward_slashes(name) for name in absent}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = getattr(transforms, key)
        if names is not None:
            used_names = [
                n for n in names if text_files.forward_slashes(n) not in absent_paths
            ]
            setattr(transforms, key, used_names)
    transforms.frames = entries
    note = f"{len(absent)} frames left out, they have no transform_matrix: {listing}"
    return transforms, (note,)


def _fill_times(file, entries):
    """Interpolate missing times from the neighbors in the order of names, by folder.

    If no frame has a time, all stay without.
    """
    gaps = [entry for entry in entries if entry.time is None]
    if not gaps or len(gaps) == len(entries):
        return ()
    folders = collections.defaultdict(list)
    for entry in entries:
        path = text_files.forward_slashes(entry.file_path)
        folders[pathlib.PurePosixPath(path).parent].append(entry)
    for group in folders.values():
        _fill_folder(file, group)
    return (f"{len(gaps)} frames have no time: interpolated between neighbors",)


def _fill_folder(file, entries):
    gaps = [entry for entry in entries if entry.time is None]
    anchors = [entry for entry in entries if entry.time is not None]
    if not gaps:
        return
    clock = name_times.clock(stems(entries)).times
    name_time = dict(zip(map(id, entries), clock, strict=True))
    knots, rows = np.unique([float(name_time[id(entry)]) for entry in anchors], True)
    times = np.array([anchors[row].time for row in rows.tolist()], float)
    for entry in gaps:
        knot = name_time[id(entry)]
        time = -1.0
        if len(knots) > 1:
            row = int(np.clip(np.searchsorted(knots, knot), 1, len(knots) - 1))
            share = (knot - knots[row - 1]) / (knots[row] - knots[row - 1])
            time = float(times[row - 1] + share * (times[row] - times[row - 1]))
        if not -ROUNDING <= time <= 1 + ROUNDING:
            raise CaptureError(
                f"{file}: frame {entry.file_path!r} has no time, and none can be "
                f"derived from the {len(anchors)} other frames of its folder; add it"
            )
        entry.time = min(max(time, 0.0), 1.0)


def _fill_file(file, entries, other_entries):
    """Space times evenly over a split without any, as in D-NeRF, if the other has."""
    if not entries or entries[0].time is not None:
        return ()
    if not other_entries or other_entries[0].time is None:
        return ()
    for entry, time in zip(entries, np.linspace(0, 1, len(entries)), strict=True):
        entry.time = float(time)
    return (f"no times in {file.name}: spaced evenly in the order of its frames",)


def stems(entries: list[Frame]) -> list[str]:
    """Return the image paths of frames without image suffixes.

    Args:
      entries: The frames.

    Returns:
      Paths with forward slashes.
    """
    paths = [text_files.forward_slashes(entry.file_path) for entry in entries]
    return [
        path.removesuffix(suffix)
        if (suffix := pathlib.PurePosixPath(path).suffix).lower() in frames.SUFFIXES
        else path
        for path in paths
    ]


def _unread(file):
    """Notes of unknown keys, which may affect the scene."""
    fields = HARMLESS.union(Transforms.__struct_fields__)
    known_of_frames = HARMLESS.union(Frame.__struct_fields__)
    return unread_keys.notes(file, fields, {"frames": known_of_frames})


def _split(file, transforms, heldout, missing):
    if not transforms.frames:
        raise CaptureError(f"{file}: no frames; list them under frames")
    if isinstance(heldout, str) and heldout not in ("val", "test"):
        raise CaptureError(
            f"{file}: no split {heldout!r}; {known_names(heldout, ('val', 'test'))}, "
            "or a number n holds out every n-th frame"
        )
    split_names = ("test", "val") if heldout is None else (heldout,)
    # nerfstudio's lists in one file. If only the training frames are listed, some of
    # them are held out below.
    lists = transforms.val_filenames or transforms.test_filenames
    has_split = isinstance(heldout, str) or (heldout is None and lists)
    if transforms.train_filenames is not None and has_split:
        return _listed_split(file, transforms, split_names)
    empty: tuple[str, ...] = ()
    if not isinstance(heldout, int) and file.name == "transforms_train.json":
        for name in split_names:
            other = file.with_name(f"transforms_{name}.json")
            if other.is_file():
                second, skip_notes = _with_poses(other, missing)
                if not second.frames:
                    empty += (f"{other.name} has no frames",)
                    continue
                split_notes = skip_notes + _fill_times(other, second.frames)
                split_notes += _fill_file(file, transforms.frames, second.frames)
                split_notes += _fill_file(other, second.frames, transforms.frames)
                return Split(
                    file,
                    transforms,
                    transforms.frames,
                    _with_intrinsics(second),
                    (f"the {name} split is held out", *empty, *split_notes),
                )
    if isinstance(heldout, str):
        raise CaptureError(
            f"{file}: no {heldout} split next to it; pass a number n to hold out every "
            "n-th frame"
        )
    # Files list frames in any order, and a video is split in the order of time.
    pool = transforms.frames
    if transforms.train_filenames is not None and heldout is None:
        pool = _frames_named(file, transforms, transforms.train_filenames)
    times = [0.0 if entry.time is None else entry.time for entry in pool]
    if not any(times):
        times = name_times.clock(stems(pool)).times
    order = sorted(
        range(len(pool)),
        key=lambda row: (times[row], frames.natural(pool[row].file_path)),
    )
    entries = [pool[row] for row in order]
    interval = splits.HELD_OUT if heldout is None else heldout
    train_rows, heldout_rows = splits.hold_out_every(len(entries), interval, str(file))
    return Split(
        file,
        transforms,
        [entries[row] for row in train_rows],
        [entries[row] for row in heldout_rows],
        (f"no other split: {splits.held_out_note(heldout_rows, interval)}", *empty),
    )


def _with_intrinsics(transforms):
    """Frames with the intrinsics of their file."""
    for entry in transforms.frames:
        for unit in UNITS:
            if all(getattr(entry, key) is None for key in unit):
                for key in unit:
                    setattr(entry, key, getattr(transforms, key))
    return transforms.frames


def _listed_split(file, transforms, split_names):
    """The split of nerfstudio's lists of file names."""
    for name in split_names:
        heldout_names = getattr(transforms, f"{name}_filenames", None)
        if heldout_names:
            break
    else:
        raise CaptureError(
            f"{file}: lists no {' or '.join(map(str, split_names))}_filenames; add "
            "them, or pass a number n to hold out every n-th frame"
        )
    return Split(
        file,
        transforms,
        _frames_named(file, transforms, transforms.train_filenames),
        _frames_named(file, transforms, heldout_names),
        (f"the {name} split is held out",),
    )


def _frames_named(file, transforms, names):
    normalize = text_files.forward_slashes
    table = {normalize(entry.file_path): entry for entry in transforms.frames}
    names = [normalize(name) for name in names]
    absent = [name for name in names if name not in table]
    if absent:
        raise CaptureError(
            f"{file}: {absent[0]!r} is in a split but not in frames; add it"
        )
    return [table[each] for each in names]
