"""Checks of intrinsics against the image size, and of positions against float32."""

import jax
import numpy as np

from nerfies_jax.capture import units
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.gate_finding import Finding
from nerfies_jax.capture.gate_poses import fold_radius
from nerfies_jax.geometry.camera import unproject

# Degrees across the image that a pinhole may have, and those that are usual.
POSSIBLE, USUAL = (0.01, 165.0), (0.5, 140.0)
ALIKE, OFF_CENTER = 0.03, 0.25
ZOOM = 2.0
# Float32 steps in pixels: what is worth a note, and what makes a capture useless.
DOUBTFUL_PX, WRONG_PX = 0.1, 2.0
FOLDED, MOST_FOLDED = 1e-3, 0.5
MOST_BENT = 0.6  # share by which a lens may move the corner of an image
ON_STEPS = 0.99  # of the coordinates: they were float32 once
MOST_ROUNDED = 10_000  # points; more say the same


def findings(capture: Capture) -> list[Finding]:
    """Check intrinsics and the precision of positions.

    Args:
      capture: The capture.

    Returns:
      The findings.
    """
    return [
        _field_of_view(capture),
        _aspect(capture),
        _principal_point(capture),
        _lens(capture),
        _precision(capture),
        *_rounded(capture),
    ]


def _field_of_view(capture):
    width = capture.size[0]
    focal = np.float64(capture.cameras.focal_px)
    degrees = np.degrees(2 * np.arctan2(width / 2, focal))
    low, high = float(degrees.min()), float(degrees.max())
    value = f"{low:.3g} to {high:.3g} degrees across" if high > low else f"{low:.3g}"
    value += f"; focal length {focal.min():.4g} to {focal.max():.4g} px"
    subject = "field of view"
    if high > USUAL[1]:
        reason = (
            "the focal length seems to be in millimeters, a share of the image, or of "
            "smaller images; state it in pixels of these images"
        )
    elif low < USUAL[0]:
        reason = (
            "the focal length seems to be of larger images or in another unit; state "
            "it in pixels of these images"
        )
    elif any(
        focal[rows].max() > ZOOM * focal[rows].min() for rows in _of_cameras(capture)
    ):
        return Finding(
            subject,
            value,
            f"focal lengths of one camera run from {focal.min():.4g} to "
            f"{focal.max():.4g} px: unless it zooms, some are of images of another "
            "size",
        )
    else:
        return Finding(subject, value)
    impossible = high > POSSIBLE[1] or low < POSSIBLE[0]
    extreme = focal[np.argmax(degrees) if high > USUAL[1] else np.argmin(degrees)]
    problem = (
        f"a focal length of {extreme:.4g} px in images {width} px wide is a field of "
        f"view of {high if high > USUAL[1] else low:.3g} degrees: {reason}"
    )
    return Finding(subject, value, problem, impossible)


def _of_cameras(capture):
    ids = capture.camera_ids
    return [np.flatnonzero(ids == each) for each in np.unique(ids)]


def _aspect(capture):
    aspect = np.float64(capture.cameras.pixel_aspect)
    odd = aspect[np.abs(aspect - 1) > 0.01]
    value = f"{aspect.min():.4g} to {aspect.max():.4g}"
    if not odd.size:
        return Finding("pixel aspect", value)
    problem = (
        f"{odd.size} frames have pixels that are not square: vertical over horizontal "
        f"focal length {odd.min():.3g} to {odd.max():.3g}; check that both are of "
        "images of one size"
    )
    return Finding("pixel aspect", value, problem)


def _principal_point(capture):
    share = np.float64(capture.cameras.principal_point_px) / np.array(capture.size)
    median = np.median(share, axis=0)
    value = f"at {median[0]:.0%} of the width and {median[1]:.0%} of the height"
    subject = "principal point"
    off = np.abs(share - 0.5).max(1)
    row = int(off.argmax())
    ratio = 2 * share[row]
    larger = ratio.min() > 1.5 and np.ptp(ratio) <= ALIKE * ratio.max()
    smaller = 0.05 < ratio.max() < 0.67 and np.ptp(ratio) <= ALIKE * ratio.max()
    # Points that fall into the images confirm a tile of a larger image, whose principal
    # point seldom lies as far out across as down.
    if off.max() <= OFF_CENTER or (
        capture.points is not None and not larger and not smaller
    ):
        return Finding(subject, value)
    where = ", ".join(f"{each:.4g}" for each in capture.cameras.principal_point_px[row])
    reason = "unless the images are tiles, check the units of the principal point"
    if larger or smaller:
        reason = (
            f"the intrinsics seem to be of images {ratio.mean():.3g} times as large; "
            "scale them, unless the images are tiles"
        )
    return Finding(
        subject,
        value,
        f"frame {capture.ids[row]!r} has its principal point at {where} in an image of "
        f"{capture.size[0]}x{capture.size[1]}: {reason}",
    )


def _lens(capture):
    """Check that lens models do not fold back or move corners too far."""
    cameras = capture.cameras
    if cameras.fisheye is not None:
        return _fisheye(capture)
    if not np.any(cameras.radial):
        return Finding("lens distortion", "none")
    width, height = capture.size
    y, x = (np.indices((17, 17)) / 16 * np.array([height, width])[:, None, None]) * 1.0
    folded, bent = [], []
    columns = (
        cameras.radial,
        cameras.focal_px[:, None],
        cameras.pixel_aspect[:, None],
        cameras.principal_point_px,
    )
    lenses = np.unique(np.concatenate(columns, axis=1).astype(np.float64), axis=0)
    for k1, k2, k3, focal, aspect, cx, cy in lenses:
        radius = np.hypot((x - cx) / focal, (y - cy) / (focal * aspect))
        fold = float(fold_radius(np.array([[k1, k2, k3]]))[0])
        reach = np.inf
        if np.isfinite(fold):
            reach = fold * (1 + fold**2 * (k1 + fold**2 * (k2 + fold**2 * k3)))
        folded.append(float((radius >= reach).mean()))
        far = min(float(radius.max()), fold)
        bent.append(abs(far**2 * (k1 + far**2 * (k2 + far**2 * k3))))
    share, shift = max(folded), max(bent)
    value = f"moves corners by {shift:.1%}, folds in {share:.1%} of the image"
    reason = (
        "the coefficients may be of another model (fisheye), in another order, or of "
        "another focal length; undistort the images with the program that made them"
    )
    subject = "lens distortion"
    if share > FOLDED:
        problem = f"the lens distortion folds back in {share:.1%} of the image: "
        return Finding(subject, value, problem + reason, share > MOST_FOLDED)
    if shift > MOST_BENT:
        problem = f"the lens distortion moves the corners by {shift:.0%}: "
        return Finding(subject, value, problem + reason)
    return Finding(subject, value)


def _fisheye(capture):
    """Check that a fisheye shows rays in most of its image."""
    cameras = capture.cameras
    corners = np.indices((17, 17))[::-1] / 16 * np.array(capture.size)[:, None, None]
    shares = []
    for row in np.unique(cameras.fisheye, axis=0, return_index=True)[1]:
        one = jax.tree.map(lambda leaf, row=row: leaf[row], cameras)
        rays = unproject(one, corners.reshape(2, -1).T.astype(np.float32))[1]
        shares.append(1 - float(np.mean(rays)))
    share = max(shares)
    value = f"fisheye, without rays in {share:.1%} of the image"
    problem = ""
    if share > MOST_FOLDED:
        problem = (
            f"the fisheye has no rays in {share:.1%} of the image: the coefficients "
            "may be of another model, or of another focal length"
        )
    return Finding("lens distortion", value, problem, share > MOST_FOLDED)


def _precision(capture):
    """Check that float32 resolves positions in scene units to a fraction of a pixel."""
    places = [capture.cameras.position]
    if capture.points is not None:
        places.append(capture.points.position)
    step = max(units.float32_step(each) for each in places)
    step_px = units.in_pixels(capture, step)
    value = f"{step_px:.1g} px"
    problem = ""
    if step_px > DOUBTFUL_PX:
        largest = max(np.abs(each).max() for each in places)
        problem = (
            f"positions reach {largest:.3g} scene units, where float32 has steps of "
            f"{step_px:.2g} px: coordinates of a map are not centered; set the center "
            "of the scene to that of the cameras"
        )
    return Finding("float32 step", value, problem, step_px > WRONG_PX)


def _rounded(capture):
    """Check if positions in the files were rounded to float32."""
    found = _rounded_positions(capture, capture.cameras.position, "camera positions")
    if capture.points is not None and len(capture.points.position):
        points = capture.points.position
        points = points[:: max(1, len(points) // MOST_ROUNDED)]
        # Points are where training begins, and cameras are what it is held against.
        found += [
            one._replace(refused=False)
            for one in _rounded_positions(capture, points, "points")
        ]
    return found


def _rounded_positions(capture, position, what):
    world = np.float64(position) / capture.scale + np.array(capture.center)
    steps = np.spacing(np.abs(world).max(0).astype(np.float32)).astype(float)
    # Scene units are float32 themselves, which blurs what was rounded more finely.
    own = units.float32_step(position) / capture.scale
    rounded = []
    for axis in range(3):
        step = steps[axis] / 2  # of coordinates down to half of the largest
        parts = world[:, axis] / step
        on_steps = (np.abs(parts - np.round(parts)) < 0.1).mean() >= ON_STEPS
        if step > 20 * own and on_steps:
            rounded.append(axis)
    step = max(steps[rounded], default=0.0) / 2
    step_px = units.in_pixels(capture, step * capture.scale)
    # A coordinate that never changes may be such a number by itself.
    if step_px < DOUBTFUL_PX or not np.ptp(world[:, rounded], axis=0).any():
        return []
    problem = (
        f"{what} are multiples of {step:.3g} world units, {step_px:.2g} px: "
        f"coordinates of up to {np.abs(world).max():.4g} were rounded to float32; "
        "subtract an origin before exporting them"
    )
    return [Finding(f"rounded {what}", f"{step:.3g}", problem, step_px > WRONG_PX)]
