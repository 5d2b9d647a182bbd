"""Reader of synchronized cameras with `poses_bounds.npy`, as in Neural 3D Video.

Each row of `poses_bounds.npy` is a fixed camera, in the order of their names, and each
camera has one video (`cam00.mp4`) or one folder of images (`cam00/`, `cam00/images/`).
"""

import pathlib
from typing import NamedTuple

import numpy as np

from nerfies_jax.capture import (
    formats,
    frames,
    llff_format,
    name_times,
    splits,
    video,
    world_points,
)
from nerfies_jax.capture import images as image_files
from nerfies_jax.capture.capture import Capture, CaptureError, shrink
from nerfies_jax.capture.json_files import AnyPath
from nerfies_jax.capture.safe_files import confines
from nerfies_jax.geometry import camera
from nerfies_jax.runtime import events

SPARE = 8  # allocated frames in addition to the number in the headers of the videos


class _Recorded(NamedTuple):
    """The frames of all cameras, one camera after the other."""

    images: np.ndarray  # [frames, height, width, 3] uint8
    valid: np.ndarray | None  # [frames, height, width] bool
    camera_ids: np.ndarray  # [frames] int32
    numbers: np.ndarray  # [frames] index of the frame time
    names: tuple[str, ...]
    rate: float | None  # frames per second
    notes: tuple[str, ...]


@confines
def read(
    path: AnyPath,
    factor: int | None = None,
    max_side: int | None = None,
    heldout: int | str | None = None,
    missing: str = "refuse",
) -> Capture:
    """Read synchronized cameras in the layout of Neural 3D Video (Li et al. 2022).

    Args:
      path: The folder.
      factor: Read frames at 1/`factor` of the full size in `poses_bounds.npy`.
      max_side: Longest side of the frames in pixels. At most one of the two can be
        given.
      heldout: Name of the camera to hold out, or n for every n-th frame of all
        cameras. None for the first camera, as in the evaluation of the paper.
      missing: "refuse" or "skip". It has no effect in this format.

    Returns:
      The capture. Frames of equal time have equal `times` and `warp_ids`.

    Raises:
      CaptureError: If the capture cannot be used.
    """
    path = pathlib.Path(path)
    frames.check_missing(missing, str(path))
    poses = llff_format.read_poses(path / llff_format.POSES)
    available = _sources(path, poses)
    source, shrink_by = frames.choose_source(
        available, poses.size, factor, max_side, str(path)
    )
    cameras = available[source]
    reader = _read_folders if cameras[0].is_dir() else _read_videos
    recording = reader(path, cameras, shrink_by)
    names = [each.stem for each in cameras]
    train, heldout_rows, note = _split(recording, names, heldout, path)
    placement = llff_format.placed(poses)
    size = recording.images.shape[2:0:-1]
    rig_cameras = llff_format.cameras_of(poses, placement, size)
    times = splits.spread(recording.numbers)
    return Capture(
        name=path.resolve().name,
        source="rig",
        ids=recording.names,
        images=recording.images,
        cameras=camera.take(rig_cameras, recording.camera_ids),
        times=times,
        train=train,
        heldout=heldout_rows,
        near=placement.near,
        far=placement.far,
        warp_ids=splits.dense(recording.numbers),
        appearance_ids=recording.camera_ids,
        camera_ids=recording.camera_ids,
        valid=recording.valid,
        scale=placement.scale,
        center=placement.center,
        up=world_points.up_direction(rig_cameras),
        frames_per_second=recording.rate,
        path=path,
        notes=(*llff_format.order_note(names), *recording.notes, note),
    )


def _sources(path, poses):
    """The video or folder of each camera, for each stored reduction."""
    available = {}
    for kind, sources in (
        ("videos", formats.videos_in(path)),
        ("folders of images", formats.camera_folders(path)),
    ):
        if len(sources) < 2:
            continue
        count = len(poses.positions)
        if len(sources) != count:
            raise CaptureError(
                f"{path}: {len(sources)} {kind} ({sources[0].name}, ...) for {count} "
                f"cameras in {llff_format.POSES}; each row is the camera of one of "
                "them, in the order of their names, so restore or remove some"
            )
        size = _size_of(sources[0])
        ratio = llff_format.reduction_of(sources[0], size, poses)
        available.setdefault(ratio, sources)
    return available


def _size_of(source):
    if source.is_dir():
        first_file = frames.images_in(_images_folder(source))[0]
        return image_files.read_header(first_file).size
    _, first = next(video.read_video(source, most=1))
    return first.shape[1], first.shape[0]


def _images_folder(folder):
    inner = folder / "images"
    return inner if inner.is_dir() else folder


def _read_folders(path, folders, shrink_by):
    """Read the images of all cameras. Images of equal names have equal times."""
    files = [frames.images_in(_images_folder(folder)) for folder in folders]
    camera_ids = np.repeat(np.arange(len(files)), [len(group) for group in files])
    all_files = [file for group in files for file in group]
    names = [
        f"{folders[number].name}/{file.stem}"
        for number, file in zip(camera_ids, all_files, strict=True)
    ]
    clock = name_times.clock(names)
    notes: tuple[str, ...] = ()
    numbers = np.array(clock.times)
    if clock.cameras is None or not _same_groups(clock.cameras, camera_ids):
        numbers = np.concatenate(
            [name_times.order([file.stem for file in group]) for group in files]
        )
        notes = (
            "the names of the images give no times that cameras share: the n-th images "
            "of all cameras are assumed to have the same time",
        )
    sequence = frames.read_frames(all_files, shrink_by, orientation="stored")
    return _Recorded(
        images=sequence.images,
        valid=sequence.valid(),
        camera_ids=camera_ids.astype(np.int32),
        numbers=numbers,
        names=tuple(name.replace("/", "_") for name in names),
        rate=None,
        notes=(*notes, *sequence.notes, *_lengths(folders, camera_ids)),
    )


def _same_groups(first, second):
    """Test if two labelings define the same groups."""
    pairs = set(zip(first.tolist(), second.tolist(), strict=True))
    return len(pairs) == len(set(first.tolist())) == len(set(second.tolist()))


def _read_videos(path, files, shrink_by):
    """Decode all videos. Equal times are equal numbers of frame intervals."""
    count = sum(video.stated_frames(file) for file in files)
    width, height = (side // shrink_by for side in _size_of(files[0]))
    images = frames.allocated((count + SPARE, height, width, 3), str(path))
    seconds: list[float] = []
    camera_ids: list[int] = []
    notes: tuple[str, ...] = ()
    with events.stage("decoding videos", len(files)) as stage:
        for number, file in enumerate(files):
            first = len(seconds)
            for time, frame in video.read_video(file, damaged="skip"):
                if len(seconds) == len(images):  # more frames than in the headers
                    array = frames.allocated((2 * len(images), *images.shape[1:]), path)
                    array[: len(images)] = images
                    images = array
                images[len(seconds)] = _shrink(file, frame, shrink_by, (width, height))
                seconds.append(time)
                camera_ids.append(number)
            notes += tuple(
                f"{file.name}: {note}"
                for note in video.notes_of(file, len(seconds) - first, seconds[-1])
            )
            stage.advance()
    cameras = np.array(camera_ids, np.int32)
    numbers, interval = _intervals(np.array(seconds), cameras)
    names = [
        f"{files[row].stem}_{number:05d}"
        for row, number in zip(camera_ids, numbers.tolist(), strict=True)
    ]
    return _Recorded(
        images=images[: len(seconds)],
        valid=None,
        camera_ids=cameras,
        numbers=numbers,
        names=tuple(names),
        rate=1 / interval if interval > 0 else None,
        notes=(*notes, *_lengths(files, cameras)),
    )


def _shrink(file, frame, shrink_by, size):
    small = shrink(frame, shrink_by)
    if small.shape[1::-1] != size:
        raise CaptureError(
            f"{file}: frames of {frame.shape[1]}x{frame.shape[0]} pixels, unlike the "
            "first camera; all cameras of a rig share one size"
        )
    return small


def _intervals(seconds, camera_ids):
    """Number frames by the interval of the fastest camera, from the first of each."""
    groups = [seconds[camera_ids == number] for number in np.unique(camera_ids)]
    gaps = [np.median(np.diff(times)) for times in groups if len(times) > 1]
    interval = float(min(gaps, default=0.0))
    if not interval > 0:
        return np.concatenate([np.arange(len(times)) for times in groups]), 0.0
    numbers = [np.round((times - times[0]) / interval).astype(int) for times in groups]
    # If frames are closer than half an interval, as those of phones may be, all frames
    # are numbered in order.
    if any(len(np.unique(each)) < len(each) for each in numbers):
        numbers = [np.arange(len(times)) for times in groups]
    return np.concatenate(numbers), interval


def _lengths(cameras, camera_ids):
    """A note if cameras have different numbers of frames."""
    counts = np.bincount(camera_ids, minlength=len(cameras))
    if counts.min() == counts.max():
        return ()
    least, most = int(counts.argmin()), int(counts.argmax())
    return (
        f"cameras have different numbers of frames: {cameras[least].name} has "
        f"{counts.min()}, {cameras[most].name} has {counts.max()}",
    )


def _split(recording, names, heldout, path):
    """Training rows, held-out rows and a note."""
    if isinstance(heldout, int):
        train, heldout_rows = splits.hold_out_in_time(
            recording.numbers, recording.camera_ids, heldout, str(path)
        )
        return train, heldout_rows, splits.held_out_note(heldout_rows, heldout)
    test = names[0] if heldout is None else heldout
    if test not in names:
        raise CaptureError(
            f"{path}: no camera {test!r} to hold out; there are {', '.join(names)}, "
            "or a number n holds out every n-th frame"
        )
    is_heldout = recording.camera_ids == names.index(test)
    note = f"camera {test} is held out, {len(names) - 1} cameras are for training"
    return np.flatnonzero(~is_heldout), np.flatnonzero(is_heldout), note
