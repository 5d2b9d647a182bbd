"""Masks of moving pixels in a video without known cameras.

Structure from motion needs static points and fails with large moving objects. The
motion of most tracks over some frames is due to the camera, and is described by one
epipolar geometry, or by one homography if there is no parallax. Other tracks are on
moving objects. Motion along epipolar lines is not detected, nor is motion in front of a
single plane, where it looks like a smaller depth. With the cameras estimated by use of
these masks, `record.gather` detects more.
"""

import pathlib

import cv2
import numpy as np

from nerfies_jax.capture import frames
from nerfies_jax.capture import images as image_files
from nerfies_jax.preprocessing import dense_flow, moving, view_set
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.static_points import StaticPoints
from nerfies_jax.runtime import events

LATER = (6, 10, 15)  # distances in frames over which tracks are compared
WITHIN_SHARE = 0.004  # maximum error relative to the width: 0.7 px of 176
FEWEST = 30  # tracks of a pair of frames for estimating a geometry
# A homography, which has fewer degrees of freedom, is used if it explains at least this
# share of the tracks that the fundamental matrix explains.
AS_GOOD = 0.9
RIM_SHARE = 0.02  # margin of masks relative to the width, because features have a size


def _moving_masks(images: np.ndarray) -> np.ndarray:
    """Segment moving pixels of a video.

    In built-in scenes of 60 frames, 68 % (`default`) to 100 % (`rigid`) of moving
    pixels are masked, and 81 to 94 % of static pixels are not.
    """
    whole = view_set.without_cameras(images)
    views = view_set.smaller(whole, view_set.times_smaller(whole))
    gray_images = dense_flow.leveled(views)
    flow = dense_flow.between_neighbors(views, gray_images)
    tracks = tracking.from_flow(views, flow, gray_images)
    off = _off_the_camera_motion(tracks, WITHIN_SHARE * views.size[0])
    valid = np.isfinite(off).any(1)
    tracks, off = tracks.take(valid), off[valid]
    point_fields = np.zeros((len(off), 3)), off, np.zeros_like(off)
    score = moving.track_scores(tracks, StaticPoints(*point_fields))
    share = moving.votes(views, tracks, score)
    moves = moving.mask(views, share, np.zeros_like(share))
    width, height = whole.size
    side = 2 * round(RIM_SHARE * width) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    full_masks = (
        cv2.resize(mask.astype(np.float32), (width, height)) > 0.5 for mask in moves
    )
    return np.stack(
        [cv2.dilate(mask.astype(np.uint8), disc) > 0 for mask in full_masks]
    )


@events.stage("detecting moving objects")
def moving_in(folder: pathlib.Path) -> dict[str, np.ndarray]:
    """Segment moving pixels of the images in a folder.

    Args:
      folder: Folder of images whose names are in order of time.

    Returns:
      Booleans [height, width] by the name of each image.

    Raises:
      ValueError: If there are too few images, or they differ in size.
    """
    names = [file.name for file in frames.images_in(folder)]
    if len(names) <= min(LATER):
        raise ValueError(
            f"{folder}: {len(names)} images are too few to detect moving objects; "
            f"use more than {min(LATER)}"
        )
    images = [image_files.read_image(folder / name)[0] for name in names]
    sizes = {image.shape for image in images}
    if len(sizes) > 1:
        raise ValueError(
            f"{folder}: images of {len(sizes)} sizes; frames of a video must have "
            "one size: resize them"
        )
    return dict(zip(names, _moving_masks(np.stack(images)), strict=True))


def _off_the_camera_motion(tracks, within):
    """Return distances [tracks, frames] in px from the motion of most other tracks.

    They are NaN if the track is not visible, or too few tracks are.
    """
    frames = tracks.visible.shape[1]
    off = np.zeros(tracks.visible.shape)
    count = np.zeros(tracks.visible.shape, int)
    for later in LATER:
        for frame in range(frames - later):
            rows = np.flatnonzero(
                tracks.visible[:, frame] & tracks.visible[:, frame + later]
            )
            if len(rows) < FEWEST:
                continue
            start, end = (tracks.pixel[rows, at] for at in (frame, frame + later))
            miss = _pair_misses(start, end, within)
            for at in (frame, frame + later):
                off[rows, at] = np.maximum(off[rows, at], miss)
                count[rows, at] += 1
    return np.where(count > 0, off, np.nan)


def _pair_misses(start, end, within):
    """Return distances in px of tracks in a pair of frames from the camera motion."""
    settings = {"ransacReprojThreshold": within, "confidence": 0.999}
    plane, _ = cv2.findHomography(start, end, cv2.USAC_MAGSAC, within, confidence=0.999)
    lines, _ = cv2.findFundamentalMat(start, end, cv2.USAC_MAGSAC, **settings)
    by_plane = np.full(len(start), np.inf)
    if plane is not None:
        by_plane = _homography_misses(plane, start, end)
    if lines is None or lines.shape != (3, 3):
        return by_plane
    by_lines = _sampson(lines, start, end)
    inlier_counts = [(miss < within).sum() for miss in (by_plane, by_lines)]
    return by_plane if inlier_counts[0] > AS_GOOD * inlier_counts[1] else by_lines


def _homography_misses(plane, start, end):
    homogeneous = np.c_[start, np.ones(len(start))] @ plane.T
    with np.errstate(divide="ignore", invalid="ignore"):
        miss = np.linalg.norm(homogeneous[:, :2] / homogeneous[:, 2:] - end, axis=-1)
    return np.nan_to_num(miss, nan=np.inf)


def _sampson(lines, start, end):
    """Return Sampson distances in px (Hartley and Zisserman, 11.4.3)."""
    one, other = (np.c_[points, np.ones(len(points))] for points in (start, end))
    second, first = one @ lines.T, other @ lines
    slope_sq = (second[:, :2] ** 2).sum(1) + (first[:, :2] ** 2).sum(1)
    return np.abs((other * second).sum(1)) / np.sqrt(np.maximum(slope_sq, 1e-30))
