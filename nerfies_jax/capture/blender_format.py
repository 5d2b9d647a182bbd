"""Reader of transforms*.json: Blender's scenes, D-NeRF, nerfstudio and instant-ngp.

Poses are camera-to-world with OpenGL axes (x right, y up, z back).
"""

import pathlib

import numpy as np

from nerfies_jax.capture import (
    frames,
    name_times,
    splits,
    text_files,
    transforms_lens,
    world_points,
)
from nerfies_jax.capture import images as image_files
from nerfies_jax.capture.capture import Capture, CaptureError, check_times
from nerfies_jax.capture.json_files import AnyPath, inside, named_file
from nerfies_jax.capture.points import (
    Placement,
    place_by_cameras,
    place_by_points,
    read_ply,
)
from nerfies_jax.capture.safe_files import confines
from nerfies_jax.capture.transforms import read_split, stems
from nerfies_jax.geometry import camera
from nerfies_jax.geometry.camera import Camera

WHITE = (1.0, 1.0, 1.0)
# Cameras of the Blender and D-NeRF data sets have distance 4 from the origin, and their
# readers use near 2 and far 6.
USUAL_RADIUS, USUAL_NEAR, USUAL_FAR = 4.0, 2.0, 6.0
# Ratio of the distance from the origin to the extent of the cameras from which on they
# are not around the origin.
FAR_FROM_ORIGIN = 100.0
_GUESSED = "near and far are estimated from the cameras"


@confines
def read(
    path: AnyPath,
    factor: int | None = None,
    max_side: int | None = None,
    heldout: int | str | None = None,
    missing: str = "refuse",
    background: tuple[float, float, float] = WHITE,
    near: float | None = None,
    far: float | None = None,
) -> Capture:
    """Read a capture from transforms*.json.

    Args:
      path: The folder with the files, or one of the files.
      factor: Read images at 1/`factor` of their full size.
      max_side: Longest side of the images in pixels. At most one of the two can be
        given.
      heldout: None for the first of these that exists: the test split, the validation
        split, every 8th frame. "val" or "test" for that split. n for every n-th frame
        of the file (of split files, the training one).
      missing: "refuse" or "skip" frames without an image.
      background: sRGB color in [0, 1] behind images with alpha.
      near: Near plane in scene units. By default 2 for Blender's cameras at distance 4
        from the origin, and derived from the points for nerfstudio.
      far: Far plane in scene units, 6 for Blender's cameras by default.

    Returns:
      The capture.

    Raises:
      CaptureError: If the capture cannot be used.
    """
    path = pathlib.Path(path)
    root = path if path.is_dir() else path.parent
    split = read_split(path, heldout, missing)
    entries = [*split.train, *split.heldout]
    where = str(split.file)
    moved_notes = _made_local(root, entries, split.transforms)
    files = [_image_file(root, entry, split.file) for entry in entries]
    names = [_name(entry.file_path) for entry in entries]
    rows, skip_notes = frames.keep_found(files, names, missing, where)
    entries, files = [entries[row] for row in rows], [files[row] for row in rows]
    is_train = rows < len(split.train)
    full = image_files.read_header(files[0]).size
    _, shrink_by = frames.choose_source({1: root}, full, factor, max_side, where)
    sequence = frames.read_frames(files, shrink_by, background)
    images, alpha = sequence.images, sequence.alpha
    if alpha is not None and not alpha.any():
        raise CaptureError(
            f"{where}: all pixels of all images are transparent (alpha 0); save them "
            "with their alpha, or as RGB without it"
        )
    cameras, notes = _cameras(entries, split.transforms, full, where)
    cameras = camera.resize(cameras, (shrink_by, shrink_by), (1, 1))
    points = None
    if split.transforms.ply_file_path is not None:
        points = read_ply(named_file(root, split.transforms.ply_file_path, split.file))
    size = images.shape[2:0:-1]
    placement, placement_notes = _place(cameras, points, split.transforms, size)
    offset = cameras.position - placement.center
    times, camera_ids, time_notes = _times(entries, split)
    if camera_ids is None:
        camera_ids = _camera_ids(entries, times, split, is_train)
    valid, mask_notes = _valid(root, entries, split.file, size, shrink_by)
    return Capture(
        name=root.resolve().name,
        source="blender",
        ids=tuple(names[row] for row in rows),
        images=images,
        cameras=cameras._replace(
            position=(offset * placement.scale).astype(np.float32)
        ),
        times=times,
        train=np.flatnonzero(is_train),
        heldout=np.flatnonzero(~is_train),
        near=placement.near if near is None else near,
        far=placement.far if far is None else far,
        warp_ids=splits.dense(times),
        appearance_ids=np.zeros(len(rows), np.int32),
        camera_ids=camera_ids,
        valid=frames.both(valid, sequence.observed),
        points=_in_scene_units(points, placement),
        background=background if alpha is not None else split.transforms.background,
        scale=placement.scale,
        center=placement.center,
        # z is up in Blender and nerfstudio. `up` is an extension of this library.
        up=world_points.unit(split.transforms.up) or (0.0, 0.0, 1.0),
        frames_per_second=split.transforms.fps,
        path=path,
        notes=(
            *split.notes,
            *moved_notes,
            *skip_notes,
            *notes,
            *placement_notes,
            *time_notes,
            *mask_notes,
            *sequence.notes,
            *_unread_depths(entries),
        ),
    )


def _made_local(root, entries, transforms):
    """Replace paths of another machine by those of the same files in this folder."""
    fields = [(entry, key) for entry in entries for key in ("file_path", "mask_path")]
    fields.append((transforms, "ply_file_path"))
    fields = [(owner, key) for owner, key in fields if getattr(owner, key)]
    names = [getattr(owner, key) for owner, key in fields]
    local = [frames.local_name(root, name) for name in names]
    for (owner, key), name in zip(fields, local, strict=True):
        setattr(owner, key, name)
    return frames.moved_note(names, local)


def _in_scene_units(points, placement):
    """Return the points in scene units, or None if there are none."""
    if points is None:
        return None
    position = (points.position - np.array(placement.center)) * placement.scale
    return points._replace(position=position.astype(np.float32))


def _name(file_path):
    """An id that is unique over the splits and can be a file name, as train_r_0."""
    plain = pathlib.PurePosixPath(text_files.forward_slashes(file_path))
    stem = plain.with_suffix("") if plain.suffix.lower() in frames.SUFFIXES else plain
    return "_".join(part for part in stem.parts if part not in (".", "/"))


def _image_file(root, entry, file):
    """The image of a frame. The suffix may differ, since copies are often converted."""
    name = entry.file_path
    inside(root, name, file)
    image = frames.find_image(root, name)
    suffix = pathlib.PurePosixPath(name).suffix
    if image is None and suffix.lower() in frames.SUFFIXES:
        image = frames.find_image(root, name.removesuffix(suffix))
    return image


def _cameras(entries, transforms, size, where):
    """Cameras in world units with float64 positions, and notes."""
    cameras, lenses = [], []
    for entry in entries:
        label = f"{where}: frame {entry.file_path!r}"
        lens = transforms_lens.resolve(entry, transforms, size, label)
        rotation, position = _pose(entry.transform_matrix, label)
        cameras.append(
            Camera(
                camera_from_world=rotation.astype(np.float32),
                position=position,
                focal_px=np.float32(lens.focal_px[0]),
                principal_point_px=np.float32(lens.principal_point_px),
                skew_px=np.float32(0),
                pixel_aspect=np.float32(lens.focal_px[1] / lens.focal_px[0]),
                radial=np.float32(lens.radial),
                tangential=np.float32(lens.tangential),
                fisheye=None if lens.fisheye is None else np.float32(lens.fisheye),
            )
        )
        lenses.append(lens)
    fisheyes = sum(one.fisheye is not None for one in cameras)
    if fisheyes not in (0, len(cameras)):
        raise CaptureError(
            f"{where}: {fisheyes} of {len(cameras)} frames are fisheyes; undistort "
            "the images of those"
        )
    return camera.stack(cameras), transforms_lens.notes(lenses, size)


def _pose(matrix, label):
    """Camera-from-world rotation and position from an OpenGL camera-to-world matrix."""
    rows = [len(row) for row in matrix]
    if rows not in ([4, 4, 4], [4, 4, 4, 4]):
        raise CaptureError(
            f"{label} has a transform_matrix of rows {rows}; expected 4x4 or 3x4"
        )
    last = matrix[3:]
    matrix = np.array(matrix[:3], np.float64)
    axes = matrix[:, :3].T  # rows: right, up, back
    length = np.linalg.norm(axes, axis=1)
    if not (length > 0).all() or np.ptp(length) > 1e-3 * length.mean():
        raise CaptureError(
            f"{label} has axes of lengths {length.round(4).tolist()} in "
            "transform_matrix; it must be a rotation"
        )
    if last and np.abs(np.subtract(last[0], (0, 0, 0, 1))).max() > 1e-3:
        raise CaptureError(
            f"{label} has a transform_matrix with the last row {last[0]}; expected "
            "0, 0, 0, 1, so transpose it if its last column is that"
        )
    # A uniform scale (of a parent object in Blender) does not affect the rotation.
    return axes / length[:, None] * [[1.0], [-1.0], [-1.0]], matrix[:, 3]


def _place(cameras, points, transforms, size):
    if points is not None and len(points.position) >= 3:
        depths = []
        local, position = world_points.near_origin(cameras, points.position)
        for row in range(len(cameras.focal_px)):
            _, depth, inside = world_points.pixels_of(local, row, position, size)
            depths.append(depth[inside])
        depths = np.concatenate(depths)
        if depths.size:
            return place_by_points(points.position, cameras.position, depths), ()
    if transforms.camera_angle_x is not None and transforms.fl_x is None:
        radius = float(np.median(np.linalg.norm(cameras.position, axis=1)))
        spread = float(np.linalg.norm(np.ptp(cameras.position, axis=0)))
        if 0 < spread < radius / FAR_FROM_ORIGIN:  # coordinates of a map
            return place_by_cameras(cameras), (f"no points: {_GUESSED}",)
        usual = 0.75 * USUAL_RADIUS < radius < 1.25 * USUAL_RADIUS or radius == 0
        ratio = 1.0 if usual else radius / USUAL_RADIUS
        near, far = USUAL_NEAR * ratio, USUAL_FAR * ratio
        note = (
            f"near {near:.3g} and far {far:.3g}, the defaults for cameras at distance "
            f"{radius:.3g}"
        )
        return Placement((0.0, 0.0, 0.0), 1.0, near, far), (note,)
    reason = "no points" if points is None else "no points in view"
    return place_by_cameras(cameras), (f"{reason}: {_GUESSED}",)


def _times(entries, split):
    """Stored times, or else times and cameras from the names, and notes."""
    entry_times = [entry.time for entry in entries]
    count = len(entries)
    if all(time is not None for time in entry_times):
        times = np.array(entry_times, np.float32)
        check_times(times, [entry.file_path for entry in entries], str(split.file))
        return times, None, ()
    if split.file.name == "transforms_train.json":
        note = "no times: taken as a static scene"
        return np.zeros(count, np.float32), None, (note,)
    clock = name_times.clock(stems(entries))
    note = "no times: taken from the names of the images"
    return splits.spread(clock.times), clock.cameras, (note, *clock.notes)


def _camera_ids(entries, times, split, is_train):
    """Ids of the folders if two of them have images of one time, else zeros."""
    paths = [text_files.forward_slashes(entry.file_path) for entry in entries]
    names = [pathlib.PurePosixPath(path).parent.as_posix() for path in paths]
    # In D-NeRF, train and test images of the one camera share times.
    several_files = split.file.name == "transforms_train.json"
    rows = np.flatnonzero(is_train) if several_files else range(len(entries))
    pairs = {(times[row], names[row]) for row in rows}
    if np.ptp(times) == 0 or len(pairs) == len({time for time, _ in pairs}):
        return np.zeros(len(entries), np.int32)
    return splits.dense(names)


def _unread_depths(entries):
    paths = [entry.depth_file_path for entry in entries if entry.depth_file_path]
    if not paths:
        return ()
    folder = pathlib.PurePosixPath(paths[0]).parent
    return (
        f"depth_file_path of {len(paths)} frames is not read; the depth maps in "
        f"{folder} can be used as external depths",
    )


def _valid(root, entries, file, size, shrink_by):
    if not any(entry.mask_path for entry in entries):
        return None, ()
    masks = [
        (entry.mask_path and named_file(root, entry.mask_path, file)) or None
        for entry in entries
    ]
    white, notes = frames.read_masks(masks, size, shrink_by, "not observed")
    return white == 1, notes
