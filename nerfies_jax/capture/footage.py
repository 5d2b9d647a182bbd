"""Images without cameras: sharp frames of a video, or photographs rotated upright.

Both are written as a folder of PNG files of one size, with a second folder for masks if
there are any.
"""

import collections
import os
import pathlib
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from nerfies_jax.capture import decoder, frames, photographs
from nerfies_jax.capture import masks as mask_files
from nerfies_jax.capture.capture import CaptureError, blocks, shrink
from nerfies_jax.capture.colmap_library import MIN_TRACK
from nerfies_jax.capture.formats import VIDEOS
from nerfies_jax.capture.images import MAX_PIXELS, write_png
from nerfies_jax.capture.photographs import HEIC
from nerfies_jax.capture.video import notes_of, read_video, transfer_of
from nerfies_jax.runtime import earlier_names, events

__getattr__ = earlier_names.attributes(__name__)

PLAIN = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
FRAMES = 100  # default number of frames to select from a video
OWN_TIMES = 0.9  # share of the frames of a video that must have distinct times
# Frames below this share of the median sharpness around them are blurred. In tests,
# blurred frames have less than 0.2.
BLURRED = 0.4
_BROKEN = "not readable, so copy them again"
_LARGE = f"of more than {MAX_PIXELS:,} pixels, so make them smaller first"


class SourceImages(NamedTuple):
    """Images taken from a video or from a folder of photographs."""

    names: tuple[str, ...]  # of the written files, in order
    notes: tuple[str, ...]  # on images that were left out
    seconds: float | None = None  # from the first to the last frame of a video
    # Focal length over the longest side of the image, if files state it.
    focal: float | None = None
    # Names of the images by camera model and focal length, with the focal length over
    # the longest side or None. Images without this information are one group.
    groups: tuple[tuple[tuple[str, ...], float | None], ...] = ()


def kind_of(path: pathlib.Path) -> str | None:
    """Distinguish videos and folders of images.

    Args:
      path: A file or folder.

    Returns:
      "video" for a video, "images" for a folder with at least two images, or None.
    """
    if path.is_file() and path.suffix.lower() in VIDEOS:
        return "video"
    if path.is_dir() and len(images_in(path)) >= 2:
        return "images"
    return None


def images_in(folder: pathlib.Path) -> list[pathlib.Path]:
    """List the image files of a folder, by their suffix.

    Args:
      folder: The folder.

    Returns:
      Paths in natural order.
    """
    files = frames.images_in(folder, (*PLAIN, *HEIC))
    return sorted(files, key=lambda file: frames.natural(file.name))


@decoder.session()
def from_video(
    video: pathlib.Path,
    out: pathlib.Path,
    count: int | None = None,
    per_second: float | None = None,
    max_side: int = 960,
    masks: pathlib.Path | None = None,
) -> SourceImages:
    """Write the sharpest frames of a video, evenly spread in time, into `out/images`.

    Names contain the time in milliseconds.

    Args:
      video: The video.
      out: The folder to write to.
      count: Number of frames.
      per_second: Frames per second of video. At most one of the two can be given.
      max_side: Longest side of the images in pixels.
      masks: Folder with one PNG for each frame of the video, black where something
        moves. Those of the selected frames go to `out/masks`.

    Returns:
      Names of the images, and notes.

    Raises:
      CaptureError: If the video cannot be used.
    """
    stored_times, sharpnesses = [], []
    with events.stage("decoding the video to find sharp frames") as stage:
        for seconds, gray in read_video(video, gray=True, damaged="skip"):
            stored_times.append(seconds)
            sharpnesses.append(sharpness(gray))
            stage.advance(text=f"{len(stored_times):,} frames")
    # Frames arrive in display order, but .avi files hold decoding times, and B-frames
    # are decoded in another order.
    times, scores = np.sort(stored_times), np.array(sharpnesses)
    milliseconds = np.round(1000 * times)  # in the names of the files
    # In a phone's video, one or two frames may share a time. In a video without times
    # all do.
    if len(np.unique(milliseconds)) < OWN_TIMES * len(milliseconds):
        raise CaptureError(f"{video}: its frames have no times; encode it again")
    count = _frame_count(video, times, count, per_second)
    selection, blur_count = sharp_rows(scores, times, count)
    selection = selection[np.unique(milliseconds[selection], return_index=True)[1]]
    sources = None if masks is None else _masks_of_video(masks, len(times))
    names, rows, white = [], selection.tolist(), []  # rows are in ascending order
    if sources is not None:
        sources = {row: sources[row] for row in rows}
        encoding = mask_files.find_encoding([*sources.values()], "upright")
    colors = read_video(video, rows=set(rows), damaged="skip")
    with events.stage("writing frames of the video", len(rows)) as stage:
        for row, (_, frame) in zip(rows, colors, strict=True):
            factor = _factor(frame.shape[1::-1], max_side)
            names.append(f"ms{round(times[row] * 1000):08d}.png")
            _write(out / "images" / names[-1], shrink(frame, factor))
            if sources is not None:
                mask = mask_files.read_mask(sources[row], encoding, "upright")
                white.append(mask.mean())
                _write_mask(out, names[-1], mask, frame.shape, factor, sources[row])
            stage.advance()
    notes = [
        f"{len(selection)} of {len(scores)} frames selected, {blur_count} too blurred"
    ]
    notes += notes_of(video, len(scores), float(times[-1]))
    transfer = transfer_of(video)
    if transfer is not None:
        notes.append(f"video in high dynamic range ({transfer}), tone-mapped to sRGB")
    if sources is not None:
        mask_paths = [*sources.values()]
        notes.append(
            mask_files.describe(
                mask_paths, len(mask_paths), encoding, np.mean(white), "moving"
            )
        )
    return SourceImages(tuple(names), tuple(notes), float(np.ptp(times[selection])))


def _frame_count(path, times, count, per_second):
    """Number of frames to select."""
    if per_second is not None:
        if count is not None:
            raise ValueError(
                f"count={count} and per_second={per_second}; pass only one of the two"
            )
        count = round(per_second * np.ptp(times)) + 1
    count = FRAMES if count is None else count
    if count < MIN_TRACK:
        raise ValueError(
            f"{path}: {count} frames to select; a reconstruction needs at least "
            f"{MIN_TRACK}"
        )
    return count


def _masks_of_video(folder, count):
    files = images_in(folder)
    if len(files) != count:
        raise CaptureError(
            f"{folder}: {len(files)} masks for a video of {count} frames; there must "
            "be one for each, in the order of their names"
        )
    return files


@decoder.session()
def from_images(
    folder: pathlib.Path,
    out: pathlib.Path,
    max_side: int = 960,
    masks: pathlib.Path | None = None,
) -> SourceImages:
    """Write the images of a folder, upright and of one size, into `out/images`.

    Images that cannot be read or differ in size from the majority are left out with a
    note.

    Args:
      folder: The folder.
      out: The folder to write to.
      max_side: Longest side of the images in pixels.
      masks: Folder with NAME.png (or NAME.jpg.png) for every image NAME.jpg, black
        where something moves.

    Returns:
      Names of the images, and notes.

    Raises:
      CaptureError: If the images cannot be used.
    """
    headers, notes = _readable(folder)
    sizes = collections.Counter(header.size for header in headers.values())
    size = sizes.most_common(1)[0][0]
    files = [file for file in headers if headers[file].size == size]
    other_names = [file.name for file in headers if headers[file].size != size]
    notes += _left_out_note(other_names, f"not of {size[0]}x{size[1]} pixels like most")
    stems = collections.Counter(_encodable(file.stem) for file in files)
    stem, count = stems.most_common(1)[0]
    if count > 1:
        raise CaptureError(f"{folder}: {count} images are named {stem}; keep one")
    factor, broken_files, mask_paths, white = _factor(size, max_side), [], [], []
    if masks is not None:
        sources = {file: _mask_of(masks, file) for file in files}
        encoding = mask_files.find_encoding([*sources.values()], "upright")
    with events.stage("reading images", len(files)) as stage:
        for file in files:
            stage.advance()
            try:
                color = photographs.read_upright(file)
            except photographs.Unreadable:  # damaged after its header
                broken_files.append(file)
                continue
            name = f"{_encodable(file.stem)}.png"
            _write(out / "images" / name, shrink(color, factor))
            if masks is not None:
                mask_paths.append(sources[file])
                mask = mask_files.read_mask(mask_paths[-1], encoding, "upright")
                white.append(mask.mean())
                _write_mask(out, name, mask, color.shape, factor, mask_paths[-1])
    notes += _left_out_note([file.name for file in broken_files], _BROKEN)
    files = [file for file in files if file not in broken_files]
    count = len(files)
    _check_enough(folder, count, notes)
    if masks is not None:
        note = mask_files.describe(
            mask_paths, count, encoding, np.mean(white), "moving"
        )
        notes += (note,)
    names = tuple(f"{_encodable(file.stem)}.png" for file in files)
    focals = [headers[file].focal for file in files]
    known_focals = [focal for focal in focals if focal is not None]
    by_camera = collections.defaultdict(list)
    for name, file in zip(names, files, strict=True):
        by_camera[headers[file].camera, headers[file].focal].append(name)
    groups = tuple((tuple(group), focal) for (_, focal), group in by_camera.items())
    focal = float(np.median(known_focals)) if known_focals else None
    return SourceImages(names, notes, focal=focal, groups=groups)


def _readable(folder):
    """Return the headers of readable images, and notes on the others."""
    files = images_in(folder)
    heic_names = [file.name for file in files if file.suffix.lower() in HEIC]
    notes = ()
    if heic_names and not photographs.heic_is_read():
        notes = _left_out_note(
            heic_names, "HEIC, which needs pip install 'nerfies-jax[heic]'"
        )
        files = [file for file in files if file.name not in heic_names]
    headers, broken_names, large_names = {}, [], []
    for file in files:
        try:
            headers[file] = photographs.read_header(file)
        except photographs.Unreadable:
            broken_names.append(file.name)
        except photographs.TooLarge:
            large_names.append(file.name)
    notes += _left_out_note(broken_names, _BROKEN) + _left_out_note(large_names, _LARGE)
    _check_enough(folder, len(headers), notes)
    return headers, notes


def _check_enough(folder, count, notes):
    if count < MIN_TRACK:
        raise CaptureError(
            f"{folder}: {count} images; a reconstruction needs at least {MIN_TRACK}"
            + "".join(f" ({note})" for note in notes)
        )


def _left_out_note(names, reason):
    if not names:
        return ()
    listing = ", ".join(map(_encodable, names[:5]))
    listing += ", ..." if len(names) > 5 else ""
    return (f"{len(names)} images left out, {reason}: {listing}",)


def _encodable(name):
    """The name in UTF-8, which COLMAP expects. Names in old archives may not be."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return os.fsencode(name).decode("latin-1")
    return name


def _mask_of(folder, image):
    for name in (f"{image.stem}.png", f"{image.name}.png"):
        if (folder / name).is_file():
            return folder / name
    raise CaptureError(f"{folder}: no mask {image.stem}.png; name each after its image")


def _factor(size, max_side):
    if max_side < 16:
        raise ValueError(f"max_side={max_side}; expected at least 16 pixels")
    return frames.least_factor(max(size), max_side)


def _write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.ascontiguousarray(image))


def _write_mask(out, name, mask, shape, factor, source):
    if mask.shape != shape[:2]:
        raise CaptureError(
            f"{source}: a mask of {mask.shape[1]}x{mask.shape[0]} pixels for images of "
            f"{shape[1]}x{shape[0]}; the sizes must agree"
        )
    _write(out / "masks" / f"{name}.png", blocks(mask, factor).all((-3, -1)))


def sharpness(gray: np.ndarray) -> float:
    """Compute the variance of the Laplacian of an image, large for sharp edges.

    Args:
      gray: Gray image, [height, width].

    Returns:
      The variance.
    """
    step = max(1, max(gray.shape) // 480)
    thumbnail = gray[::step, ::step].astype(np.float32)
    return float(scipy.ndimage.laplace(thumbnail).var())


def sharp_rows(
    scores: np.ndarray, seconds: np.ndarray, count: int
) -> tuple[np.ndarray, int]:
    """Select the sharpest frame of each of several intervals of time.

    The threshold for blur is local, since a video may be sharper where the scene has
    more texture. (The filter in Nerfies' notebook removes the sharpest frames instead.)

    Args:
      scores: Sharpness of each frame, [frames].
      seconds: Times in ascending order, [frames].
      count: Number of intervals.

    Returns:
      Indices of the selected frames, and the number of intervals without a sharp frame.
    """
    share = (seconds - seconds[0]) / max(np.ptp(seconds), np.finfo(float).tiny)
    # Each frame lasts until the next one, and so does the last.
    interval = np.floor(share * (1 - 1 / len(seconds)) * count + 1e-9).astype(int)
    best = np.array(
        [
            rows[np.argmax(scores[rows])]
            for rows in (np.flatnonzero(interval == k) for k in np.unique(interval))
        ]
    )
    best_scores = scores[best]
    is_sharp = np.array(
        [
            score >= BLURRED * _typical_score(best_scores, row)
            for row, score in enumerate(best_scores)
        ]
    )
    return best[is_sharp], int((~is_sharp).sum())


def _typical_score(scores, row):
    """Lower of the medians before and after, since texture may change abruptly."""
    sides = scores[max(0, row - 5) : row], scores[row + 1 : row + 6]
    return min((np.median(side) for side in sides if side.size), default=0.0)
