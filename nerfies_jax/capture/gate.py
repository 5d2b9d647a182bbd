"""Consistency checks of every capture, independent of its format.

Each check measures one thing in the numbers of a capture and knows what makes it wrong:
another convention of poses, another unit, intrinsics of other images, masks of other
values. `checked` is called after every reader.
"""

import dataclasses

import numpy as np

from nerfies_jax.capture import gate_cameras, gate_depths, gate_frames, gate_poses
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.gate_finding import Finding


def checked(capture: Capture) -> Capture:
    """Check a capture that was just read.

    Args:
      capture: The capture.

    Returns:
      The capture, with a note for each problem.

    Raises:
      CaptureError: If nothing can be reconstructed from it, or its parts contradict
        each other.
    """
    check_observed(capture)
    problems = []
    for finding in findings(capture):
        if finding.refused:
            raise CaptureError(f"{capture.path or capture.name}: {finding.problem}")
        if finding.problem and finding.problem not in capture.notes:
            problems.append(finding.problem)
    if not problems:
        return capture
    return dataclasses.replace(capture, notes=(*capture.notes, *problems))


def findings(capture: Capture) -> list[Finding]:
    """Measure everything that can be checked in the numbers of a capture.

    Args:
      capture: A capture of any format, also one that `checked` refuses.

    Returns:
      One finding for each check that applies. Those with a `problem` need attention.
    """
    # Absurd numbers overflow here, and are then found to be wrong.
    with np.errstate(all="ignore"):
        return [
            *gate_poses.findings(capture),
            *gate_cameras.findings(capture),
            *gate_depths.findings(capture),
            *gate_frames.findings(capture),
        ]


def table(capture: Capture) -> list[str]:
    """Format the findings about a capture: each check, its value, and any problem.

    Args:
      capture: The capture.

    Returns:
      Lines of text.
    """
    found = findings(capture)
    wide = max(len(one.subject) for one in found)
    lines = []
    for one in found:
        lines.append(f"{one.subject:<{wide}}  {one.value}")
        if one.problem:
            lines.append(f"{'':<{wide}}  ! {one.problem}")
    return lines


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
        if moving is None:
            continue
        static = ~moving[capture.train]
        if not static.any():
            raise CaptureError(
                f"{where}: every pixel of the {capture.train.size} frames to learn "
                "from is marked as moving, which leaves no static scene; the masks may "
                "be inverted"
            )
        valid = capture.valid
        if valid is None or moving.shape != capture.images.shape[:3]:
            continue
        if not (static & valid[capture.train]).any():
            raise CaptureError(
                f"{where}: no observed pixel of the {capture.train.size} training "
                "frames is static; the masks of observed or of moving pixels may be "
                "inverted"
            )
