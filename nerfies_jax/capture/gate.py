"""Consistency checks of every capture, independent of its format.

Each check measures one property of a capture and names the likely cause of a bad value:
another pose convention, another unit, intrinsics of images of another size, or inverted
masks. `checked` is called after every reader.
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
    """Run all checks on a capture.

    Args:
      capture: A capture of any format. `checked` may refuse it.

    Returns:
      One finding for each check that applies. Those with a `problem` need attention.
    """
    # Absurd values overflow and are then reported by the checks.
    with np.errstate(all="ignore"):
        return [
            *gate_poses.findings(capture),
            *gate_cameras.findings(capture),
            *gate_depths.findings(capture),
            *gate_frames.findings(capture),
        ]


def table(capture: Capture) -> list[str]:
    """Format the findings about a capture as text.

    Args:
      capture: The capture.

    Returns:
      Lines of text with the subject and value of each check, and any problem below it.
    """
    results = findings(capture)
    width = max(len(finding.subject) for finding in results)
    lines = []
    for finding in results:
        lines.append(f"{finding.subject:<{width}}  {finding.value}")
        if finding.problem:
            lines.append(f"{'':<{width}}  ! {finding.problem}")
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
            (capture.train, "training frames"),
            (capture.heldout, "held-out frames"),
        ):
            if rows.size and not capture.valid[rows].any():
                raise CaptureError(
                    f"{where}: no pixel of the {rows.size} {use} is observed; check "
                    "the masks (white is observed) and the alpha channel of the images "
                    "(255 is observed)"
                )
    external = None if capture.external is None else capture.external.moving
    for moving in (capture.moving, external):
        if moving is None:
            continue
        static = ~moving[capture.train]
        if not static.any():
            raise CaptureError(
                f"{where}: all pixels of the {capture.train.size} training frames are "
                "marked as moving, which leaves no static scene; the masks may be "
                "inverted"
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
