"""Recognition of capture formats, and `load`, which reads any of them."""

import importlib
import pathlib
import re
import shlex
from collections.abc import Callable
from typing import NamedTuple

from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.json_files import AnyPath

VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".3gp")


class Format(NamedTuple):
    """A capture format and the test that recognizes it."""

    name: str
    looks_for: str
    recognize: Callable[[pathlib.Path], bool]
    module: str  # imported only when needed: decoders and pycolmap are slow to load


def _is_nerfies(path):
    return (path / "scene.json").is_file() and (path / "camera").is_dir()


def _is_blender(path):
    return path.is_file() or any(path.glob("transforms*.json"))


# Folders that may hold COLMAP models, either directly or in numbered subfolders.
MODELS = ("sparse", "colmap/sparse", "distorted/sparse", "colmap", "")


def sparse_models(path: pathlib.Path, part: str = "images") -> list[pathlib.Path]:
    """Find the COLMAP models of a capture.

    Folders deeper down are not searched, since captures made from the images may lie
    below them.

    Args:
      path: Folder of the capture.
      part: File of a model, without suffix, that must exist.

    Returns:
      Model folders in the first of `MODELS` that has any, in ascending order of their
      numbers.
    """
    for name in MODELS:
        parent = path / name
        subfolders = [p for p in parent.glob("*") if p.is_dir() and p.name.isdecimal()]
        folders = (*sorted(subfolders, key=lambda p: int(p.name)), parent)
        models = [
            folder
            for folder in folders
            if any((folder / f"{part}.{suffix}").is_file() for suffix in ("bin", "txt"))
        ]
        if models:
            return models
    return []


def _is_colmap(path):
    # Incomplete models are recognized too, so that the reader can report what is
    # missing.
    return any(sparse_models(path, part) for part in ("images", "cameras"))


def _is_llff(path):
    return (path / "poses_bounds.npy").is_file()


def videos_in(path: pathlib.Path) -> list[pathlib.Path]:
    """List the videos of a folder by their suffix.

    Args:
      path: The folder.

    Returns:
      Paths in lexicographic order.
    """
    files = path.glob("*") if path.is_dir() else ()
    return sorted(
        file
        for file in files
        if file.suffix.lower() in VIDEOS
        and not file.name.startswith(".")
        and file.is_file()
    )


def camera_folders(path: pathlib.Path) -> list[pathlib.Path]:
    """List folders that each hold the images of one camera.

    Args:
      path: Folder of the capture. The folder itself, `images` and `frames` are
        searched.

    Returns:
      Folders whose names end in a number, with images or with a folder `images`, in
      lexicographic order.
    """
    for parent in ("", "images", "frames"):
        folders = [
            folder
            for folder in sorted((path / parent).glob("*"))
            if re.fullmatch(r"(?!images).*\d", folder.name)
            and folder.is_dir()
            and (_has_images(folder) or _has_images(folder / "images"))
        ]
        if len(folders) > 1:
            return folders
    return []


def _has_images(folder):
    suffixes = (".png", ".jpg", ".jpeg")
    return any(file.suffix.lower() in suffixes for file in folder.glob("*"))


def _is_rig(path):
    return _is_llff(path) and bool(
        len(videos_in(path)) > 1 or len(camera_folders(path)) > 1
    )


FORMATS = (
    Format(
        "nerfies",
        "scene.json and camera/*.json (Nerfies, HyperNeRF, NeRF-DS, DyCheck)",
        _is_nerfies,
        "nerfies_jax.capture.nerfies_format",
    ),
    Format(
        "blender",
        "transforms*.json (Blender, D-NeRF, nerfstudio)",
        _is_blender,
        "nerfies_jax.capture.blender_format",
    ),
    Format(
        "rig",
        "poses_bounds.npy with cam00.mp4, cam01.mp4, ... or folders cam00, cam01, ... "
        "(Neural 3D Video)",
        _is_rig,
        "nerfies_jax.capture.rig_format",
    ),
    Format(
        "colmap",
        "sparse/0/cameras.bin or .txt (COLMAP)",
        _is_colmap,
        "nerfies_jax.capture.colmap",
    ),
    # After COLMAP, since LLFF folders often hold the COLMAP model that the poses came
    # from, which also has points.
    Format(
        "llff",
        "poses_bounds.npy (LLFF, NSFF)",
        _is_llff,
        "nerfies_jax.capture.llff_format",
    ),
)


def _count_images(path):
    from nerfies_jax.capture import footage  # imports decoders, which are slow to load

    return len(footage.images_in(path)) if path.is_dir() else 0


def recognize(path: AnyPath) -> Format:
    """Recognize the format of a capture.

    Args:
      path: Folder or file of the capture.

    Returns:
      The format.

    Raises:
      CaptureError: If there is no capture, with a list of the formats.
    """
    path = pathlib.Path(path)
    if not path.exists():
        raise CaptureError(f"{path}: no such file or folder; check the path")
    if path.is_file() and path.suffix != ".json":
        verb = "npz" if path.suffix == ".npz" else "video"
        raise CaptureError(
            f"{path}: a file, not a capture; pass a capture's folder, or make one with "
            f"nerfies prepare {verb} {shlex.quote(str(path))} OUT"
        )
    for each in FORMATS:
        if each.recognize(path):
            return each
    images = _count_images(path)
    if images >= 2:
        raise CaptureError(
            f"{path}: {images} images without cameras; estimate those with "
            f"nerfies prepare images {shlex.quote(str(path))} OUT"
        )
    videos = videos_in(path)
    if len(videos) > 1:
        raise CaptureError(
            f"{path}: {len(videos)} videos ({videos[0].name}, ...) without cameras; "
            "for synchronized cameras, put poses_bounds.npy as in Neural 3D Video next "
            "to them; prepare a single video with nerfies prepare "
            f"video {shlex.quote(str(videos[0]))} OUT"
        )
    expected_files = "; ".join(each.looks_for for each in FORMATS)
    raise CaptureError(f"{path}: no capture here; looked for {expected_files}")


def load(
    path: AnyPath,
    factor: int | None = None,
    max_side: int | None = None,
    heldout: int | str | None = None,
    missing: str = "refuse",
    times: AnyPath | None = None,
    **options,
) -> Capture:
    """Read a capture of any format.

    Args:
      path: Folder or file of the capture.
      factor: Read images at 1/`factor` of their full size.
      max_side: Longest side of the images in pixels. At most one of the two can be
        given.
      heldout: None for the split in the files (every 8th frame if they have none), n
        for every n-th frame, or the name of a split.
      missing: "refuse" or "skip" frames without an image, a camera file or a pose.
      times: File of frame times (`times_file.with_times`) that replace those of the
        capture.
      **options: Further arguments of the format's reader, such as `background` of
        `blender_format.read`.

    Returns:
      The capture. Its `notes` say what was assumed, repaired or left out.

    Raises:
      CaptureError: If the capture cannot be used.
    """
    path = pathlib.Path(path)
    reader = importlib.import_module(recognize(path).module)
    capture = reader.read(
        path,
        factor=factor,
        max_side=max_side,
        heldout=heldout,
        missing=missing,
        **options,
    )
    from nerfies_jax.capture import gate, times_file  # both load decoders

    if times is not None:
        capture = times_file.with_times(capture, times)
    return gate.checked(capture)
