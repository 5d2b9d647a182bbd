"""Consistency checks of every capture, independent of its format."""

import dataclasses
import pathlib

import numpy as np

from nerfies_jax.capture.capture import Capture, CaptureError, point_depths

WRONG_UNITS = 20.0  # factor between stored depths and the scene that units explain
# Names of factors between the units of depths and of cameras.
UNITS = (
    (1000.0, "the depths are in millimeters and the cameras in meters"),
    (100.0, "the depths are in centimeters and the cameras in meters"),
    (0.001, "the depths are in meters and the cameras in millimeters"),
    (0.01, "the depths are in meters and the cameras in centimeters"),
)
MASKS = ("masks", "mask", "motion_masks", "dynamic_masks")
DEPTHS = ("depth", "depths", "depth_maps", "disp")
SAMPLES = 1_000_000  # of the pixels; more change no median


def checked(capture: Capture) -> Capture:
    """Check a capture that was just read.

    Args:
      capture: The capture.

    Returns:
      The capture, with a note for each finding.

    Raises:
      CaptureError: If nothing can be reconstructed from it, or its parts contradict
        each other.
    """
    check_observed(capture)
    notes = (*_depth_notes(capture), *_unread_notes(capture))
    if not notes:
        return capture
    return dataclasses.replace(capture, notes=(*capture.notes, *notes))


def check_observed(capture: Capture) -> None:
    """Refuse a capture without any static or observed pixel.

    Args:
      capture: The capture.

    Raises:
      CaptureError: If no pixel of the training frames, or of the held-out ones, is
        observed, or if all pixels of the training frames are marked as moving, by the
        capture or by external masks.
    """
    where = str(capture.path or capture.name)
    if capture.valid is not None:
        for rows, use in (
            (capture.train, "frames to learn from"),
            (capture.heldout, "held-out frames"),
        ):
            if rows.size and not capture.valid[rows].any():
                raise CaptureError(
                    f"{where}: no pixel of the {rows.size} {use} is observed; check "
                    "the masks (white is observed) and the alpha channel of the images "
                    "(255 is observed)"
                )
    given = None if capture.given is None else capture.given.moving
    for moving in (capture.moving, given):
        if moving is not None and moving[capture.train].all():
            raise CaptureError(
                f"{where}: every pixel of the {capture.train.size} frames to learn "
                "from is marked as moving, which leaves no static scene; the masks may "
                "be inverted"
            )


def _unread_notes(capture):
    """Folders next to the capture whose names promise what was not read."""
    if capture.path is None:
        return ()
    root = pathlib.Path(capture.path)
    root = root if root.is_dir() else root.parent
    notes = []
    for names, has, way_out in (
        (MASKS, capture.valid is not None or capture.moving is not None, "masks"),
        (DEPTHS, capture.depths is not None, "depths"),
    ):
        there = [name for name in names if _has_files(root / name)]
        if there and not has:
            notes.append(
                f"the folder {there[0]} is not read: nothing in the capture names its "
                f"files; they can be given as external {way_out}"
            )
    return tuple(notes)


def _has_files(folder):
    return folder.is_dir() and any(folder.iterdir())


def _depth_notes(capture):
    """Findings about the units of depths, against the points or near and far."""
    if capture.depths is None:
        return ()
    where = str(capture.path or capture.name)
    known = capture.depths.ravel()[:: max(1, capture.depths.size // SAMPLES)]
    known = known[known > 0]
    if not capture.depths.any():
        return ("depth is stored, but no pixel has one above 0",)
    if not known.size:
        return ()
    near, far = capture.near, capture.far
    median = float(np.median(known))
    beyond = float(((known < near) | (known > far)).mean())
    points = point_depths(capture)
    usual = float(np.median(points)) if points.size else float(np.sqrt(near * far))
    ratio = median / usual
    stated = (
        f"the median stored depth is {median:.3g} scene units, {ratio:.3g} times that "
        + ("of the points" if points.size else f"between near and far ({usual:.3g})")
        + f"; near is {near:.3g} and far {far:.3g}"
    )
    if 1 / WRONG_UNITS < ratio < WRONG_UNITS:
        return (f"{beyond:.0%} of depths: {stated}",) if beyond > 0.5 else ()
    factor, reason = min(UNITS, key=lambda one: abs(np.log(ratio / one[0])))
    way_out = "convert the depths to the unit of the cameras or remove them"
    if abs(np.log(ratio / capture.scale)) < abs(np.log(ratio / factor)):
        factor, reason = capture.scale, "the depths are in scene units already"
    if abs(np.log(ratio / factor)) < np.log(3):
        way_out = f"probably {reason}, so multiply the depths by {1 / factor:g}"
    raise CaptureError(f"{where}: {stated}; {way_out}")
