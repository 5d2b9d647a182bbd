"""Reader and writer of Nerfies, HyperNeRF, NeRF-DS and DyCheck directories.

All four use the layout of Park et al. 2021 (arXiv:2011.12948) with additions.
docs/formats.md lists the files and their meaning.
"""

import pathlib

import numpy as np

from nerfies_jax.capture import (
    flow_files,
    frames,
    nerfies_colmap,
    npz_files,
    text_files,
    world_points,
)
from nerfies_jax.capture import images as image_files
from nerfies_jax.capture.capture import (
    Capture,
    CaptureError,
    PointCloud,
    blocks,
    shrink,
    shrink_depth,
)
from nerfies_jax.capture.json_files import AnyPath, new_folder, write_json
from nerfies_jax.capture.nerfies_views import camera_entry, only, read_cameras
from nerfies_jax.capture.safe_files import confines
from nerfies_jax.capture.transforms_writer import check_names
from nerfies_jax.geometry import camera

MAX_POINTS = 50_000_000


@confines
def read(
    path: AnyPath,
    factor: int | None = None,
    max_side: int | None = None,
    heldout: int | str | None = None,
    missing: str = "refuse",
) -> Capture:
    """Read a capture from a Nerfies, HyperNeRF, NeRF-DS or DyCheck directory.

    Args:
      path: The directory.
      factor: Read images at 1/`factor` of their full size. If there is no folder
        `rgb/<factor>x`, larger images are downscaled. None for the largest stored
        images, or those that DyCheck's extra.json names.
      max_side: Longest side of the images in pixels. At most one of the two can be
        given.
      heldout: As in `nerfies_views.read_cameras`.
      missing: "refuse" or "skip" frames without an image.

    Returns:
      The capture.

    Raises:
      CaptureError: If the capture cannot be used.
    """
    path = pathlib.Path(path)
    views = read_cameras(path, heldout, missing)
    folder, source, shrink_by, notes = _stored_images(path, views, factor, max_side)
    paths = [frames.find_image(folder, name) for name in views.ids]
    rows, skip_notes = frames.keep_found(paths, views.ids, missing, str(folder))
    views = only(views, rows)
    sequence = frames.read_frames([paths[row] for row in rows], shrink_by)
    images, alpha = sequence.images, sequence.alpha
    total = source * shrink_by
    _check_image_size(paths[rows[0]], views.size, source)
    cameras = camera.resize(views.cameras, (total, total), (1, 1))
    size = (images.shape[2], images.shape[1])
    valid, valid_notes = _masks(path / "valid", views.ids, size, total, "not observed")
    static, mask_notes = _masks(path / "resized_mask", views.ids, size, total, "moving")
    notes += [*valid_notes, *mask_notes]
    if alpha is not None:  # in DyCheck, 255 marks observed pixels
        valid = (alpha == 255) & (True if valid is None else valid == 1)
        notes.append("images have alpha: pixels below 255 count as not observed")
    elif valid is not None:
        valid = valid == 1
    valid = frames.both(valid, sequence.observed)
    notes += sequence.notes
    moving = None if static is None else static < 1
    points, point_notes = _points(path, images, cameras, views, moving)
    depths, unread = _depths(path, views, size, total)
    return Capture(
        name=path.resolve().name,
        source="nerfies",
        ids=views.ids,
        images=images,
        cameras=cameras,
        times=views.times,
        train=views.train,
        heldout=views.heldout,
        near=views.scene.near,
        far=views.scene.far,
        warp_ids=views.warp_ids,
        appearance_ids=views.appearance_ids,
        camera_ids=views.camera_ids,
        valid=None if valid is None or valid.all() else valid,
        moving=moving,
        depths=depths,
        flow=_flow(path / "flow", views, size, total),
        points=points,
        background=views.scene.background,
        scale=views.scene.scale,
        center=views.scene.center,
        up=world_points.unit(views.extra.up) or world_points.up_direction(cameras),
        frames_per_second=views.extra.fps,
        path=path,
        notes=(*views.notes, *notes, *skip_notes, *point_notes, *unread),
    )


def _stored_images(path, views, factor, max_side):
    """The folder to read, its reduction, a further reduction to apply, and notes."""
    available = {
        int(folder.name[:-1]): folder
        for folder in (path / "rgb").glob("*x")
        if folder.name[:-1].isdecimal() and int(folder.name[:-1]) > 0
    }
    if not available:
        raise CaptureError(
            f"{path}: cameras but no images (looked for rgb/1x, rgb/2x, ...); add "
            "them, or load the cameras alone with nerfies_views.read_cameras"
        )
    notes = []
    if factor is None and max_side is None and views.extra.factor in available:
        factor = views.extra.factor
        notes.append(f"read at 1/{factor} of the full size, as in extra.json")
    source, shrink_by = frames.choose_source(
        available, views.size, factor, max_side, str(path)
    )
    return available[source], source, shrink_by, notes


def write(capture: Capture, path: AnyPath, factors: tuple[int, ...] = (1,)):
    """Write a capture as a Nerfies directory, completely or not at all.

    Images go to `rgb/<factor>x`, downscaled by averaging. In addition to the layout of
    Nerfies, exact times, depth (as in DyCheck), masks of moving pixels (as in NeRF-DS),
    masks of observed pixels, optical flow and colors of the points are stored in files
    and keys that other readers ignore. External results (`external`) are not stored.
    When the directory is read again, frames in neither split are missing, and every
    eighth frame is held out if none was.

    Args:
      capture: The capture.
      path: The directory, which may be absent or empty.
      factors: Integer reductions of the images.

    Raises:
      CaptureError: If the directory cannot be written.
    """
    check_names(capture, path)
    with new_folder(path) as folder:
        _write_tables(capture, folder)
        (folder / "camera").mkdir()
        for row, name in enumerate(capture.ids):
            frame_camera = camera.take(capture.cameras, row)
            entry = camera_entry(frame_camera, capture, capture.size)
            write_json(folder / "camera" / f"{name}.json", entry)
        for factor in factors:
            _write_images(capture, folder, factor)
            if capture.flow is not None:
                flow_files.write(capture.flow, capture.ids, folder / "flow", factor)
        if capture.points is not None:
            world = capture.points.position.astype(np.float64) / capture.scale
            np.save(folder / "points.npy", world + capture.center, allow_pickle=False)
            np.save(
                folder / "points_color.npy", capture.points.color, allow_pickle=False
            )


def _write_tables(capture, folder):
    scene = {
        "scale": float(capture.scale),
        "center": [float(x) for x in capture.center],
        "near": float(capture.near),
        "far": float(capture.far),
    }
    if capture.background is not None:
        scene["background"] = [float(x) for x in capture.background]
    write_json(folder / "scene.json", scene)
    train, val = (
        [capture.ids[row] for row in rows] for rows in (capture.train, capture.heldout)
    )
    write_json(
        folder / "dataset.json",
        {
            "count": len(capture.ids),
            "num_exemplars": len(train),
            "ids": list(capture.ids),
            "train_ids": train,
            "val_ids": val,
        },
    )
    write_json(
        folder / "metadata.json",
        {
            name: {
                "warp_id": int(capture.warp_ids[row]),
                "appearance_id": int(capture.appearance_ids[row]),
                "camera_id": int(capture.camera_ids[row]),
                "time": float(capture.times[row]),
            }
            for row, name in enumerate(capture.ids)
        },
    )
    extra = {"up": capture.up, "fps": capture.frames_per_second}
    if any(value is not None for value in extra.values()):
        write_json(
            folder / "extra.json", {k: v for k, v in extra.items() if v is not None}
        )


def _write_images(capture, folder, factor):
    """Write images, masks and depth at one reduction."""
    depths, moving, valid = capture.depths, capture.moving, capture.valid

    def subfolder(kind):
        target = folder / kind / f"{factor}x"
        target.mkdir(parents=True, exist_ok=True)
        return target

    for row, name in enumerate(capture.ids):
        image = shrink(capture.images[row], factor)
        image_files.write_png(subfolder("rgb") / f"{name}.png", image)
        if moving is not None:  # as in NeRF-DS: black moves, and the suffix is doubled
            static = ~blocks(moving[row], factor).any((-3, -1))
            image_files.write_png(subfolder("resized_mask") / f"{name}.png.png", static)
        if valid is not None:
            is_valid = blocks(valid[row], factor).all((-3, -1))
            image_files.write_png(subfolder("valid") / f"{name}.png", is_valid)
        if depths is not None:
            depth = shrink_depth(depths[row], factor) / np.float32(capture.scale)
            np.save(subfolder("depth") / f"{name}.npy", depth, allow_pickle=False)


def _check_image_size(file, full_size, source):
    """Compare the size of an image with its camera.

    Sizes may differ by less than a pixel, since incomplete blocks are cropped.
    """
    width, height = image_files.read_header(file).size
    if (
        abs(width - full_size[0] / source) >= 1
        or abs(height - full_size[1] / source) >= 1
    ):
        raise CaptureError(
            f"{file}: {width}x{height} pixels, but 1/{source} of the camera's "
            f"{full_size[0]}x{full_size[1]} is expected; correct image_size or move "
            "the images to the right rgb/<factor>x"
        )


def _stored_reduction(folder, total):
    """The smallest stored reduction that divides `total`, and the remaining factor."""
    for source in range(total, 0, -1):
        if total % source == 0 and (folder / f"{source}x").is_dir():
            return folder / f"{source}x", total // source
    return None, 1


def _masks(kind, ids, size, total, black):
    """Share of white per pixel, and notes. In NeRF-DS names end in .png.png."""
    folder, shrink_by = _stored_reduction(kind, total)
    if folder is None:
        return None, ()
    paths = [text_files.find(folder, name, (".png.png", ".png")) for name in ids]
    if not any(paths):
        note = f"no file in {kind.name}/{folder.name} is named as a frame: not read"
        return None, (note,) if any(folder.iterdir()) else ()
    return frames.read_masks(paths, size, shrink_by, black)


def _depths(path, views, size, total):
    """Read z-depth in scene units from files in world units, with 0 where unknown."""
    folder, shrink_by = _stored_reduction(path / "depth", total)
    if folder is None:
        return None, ()
    if not any(folder.glob("*.npy")):
        first_file = next(iter(folder.iterdir()), None)
        note = f"depth/{folder.name} holds no .npy file: its depth is not read"
        return None, () if first_file is None else (note,)
    width, height = size
    count, depths = 0, np.zeros((len(views.ids), height, width), np.float32)
    for row, name in enumerate(views.ids):
        file = text_files.find(folder, name, (".npy",))
        if file is None:
            continue  # DyCheck has depth for the moving camera only
        depth = npz_files.load_array(file, image_files.MAX_PIXELS)
        depth = depth[..., 0] if depth.ndim == 3 else depth
        if depth.ndim != 2 or (
            depth.shape[0] // shrink_by != height
            or depth.shape[1] // shrink_by != width
        ):
            raise CaptureError(
                f"{file}: depth of shape {depth.shape} for images of "
                f"{width * shrink_by}x{height * shrink_by}; the sizes must agree"
            )
        positive = np.isfinite(depth) & (depth > 0)
        depth = np.where(positive, depth * views.scene.scale, 0).astype(np.float32)
        depths[row] = shrink_depth(depth, shrink_by)
        count += 1
    if not count:
        return None, (
            f"no file in depth/{folder.name} is named as a frame: depth is not read",
        )
    return depths, ()


def _flow(path, views, size, total):
    folder, shrink_by = _stored_reduction(path, total)
    if folder is None:
        return None
    return flow_files.read(path, total // shrink_by, shrink_by, views.ids, size)


def _points(path, images, cameras, views, moving):
    file = path / "points.npy"
    if not file.exists():
        return nerfies_colmap.points_beside(path, views)
    world = npz_files.load_array(file, 3 * MAX_POINTS)
    if world.ndim != 2 or world.shape[1] != 3:
        raise CaptureError(f"{file}: shape {world.shape}; expected [points, 3]")
    finite = np.isfinite(world).all(1)
    notes = (
        () if finite.all() else (f"{(~finite).sum()} points are not finite: dropped",)
    )
    scene = views.scene
    position = ((world - np.array(scene.center)) * scene.scale).astype(np.float32)[
        finite
    ]
    # An extension of this library, which earlier versions spelled differently.
    colors = next(iter(sorted(path.glob("points_colo*r.npy"))), None)
    if colors is not None:
        color = npz_files.load_array(colors, 3 * MAX_POINTS)
        if color.shape != world.shape or color.dtype != np.uint8:
            raise CaptureError(
                f"{colors}: {color.dtype} of shape {color.shape}; expected uint8 of "
                f"{world.shape}, as points.npy"
            )
        return PointCloud(position, color[finite]), notes
    cloud = world_points.colored_points(position, images, cameras, views.train, moving)
    return cloud, (*notes, "points.npy has no colors: sampled from the images")
