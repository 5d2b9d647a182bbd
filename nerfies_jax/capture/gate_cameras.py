"""Checks of intrinsics against the image size, and of positions against float32."""

import jax
import numpy as np

from nerfies_jax.capture import units
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.gate_finding import Finding
from nerfies_jax.capture.gate_poses import fold_radius
from nerfies_jax.geometry.camera import unproject

# Ranges of the horizontal field of view in degrees: valid ones, and usual ones.
POSSIBLE, USUAL = (0.01, 165.0), (0.5, 140.0)
# Relative difference of two ratios that count as equal. Distance of the principal point
# from the center, as a share of the image.
ALIKE, OFF_CENTER = 0.03, 0.25
ZOOM = 2.0  # largest ratio of the focal lengths of one camera
# Spacing of float32 in pixels that is noted, and that is refused.
DOUBTFUL_PX, WRONG_PX = 0.1, 2.0
# Share of the image in which a lens is not one-to-one: noted, and refused.
FOLDED, MOST_FOLDED = 1e-3, 0.5
MOST_BENT = 0.6  # largest relative displacement of image corners by a lens
# Share of coordinates that are multiples of the float32 spacing if they were rounded.
ON_STEPS = 0.99
MOST_ROUNDED = 10_000  # points that are tested for rounding


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
        *_is_rounded(capture),
    ]


def _field_of_view(capture):
    width = capture.size[0]
    focal = np.float64(capture.cameras.focal_px)
    degrees = np.degrees(2 * np.arctan2(width / 2, focal))
    low, high = float(degrees.min()), float(degrees.max())
    value = f"{low:.3g} to {high:.3g} degrees" if high > low else f"{low:.3g} degrees"
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
        focal[rows].max() > ZOOM * focal[rows].min() for rows in _by_camera(capture)
    ):
        return Finding(
            subject,
            value,
            f"focal lengths of one camera range from {focal.min():.4g} to "
            f"{focal.max():.4g} px: unless it zooms, some are for images of another "
            "size; state them for these images",
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


def _by_camera(capture):
    """Indices of the frames of each camera."""
    ids = capture.camera_ids
    return [np.flatnonzero(ids == each) for each in np.unique(ids)]


def _aspect(capture):
    aspect = np.float64(capture.cameras.pixel_aspect)
    not_square = aspect[np.abs(aspect - 1) > 0.01]
    value = f"{aspect.min():.4g} to {aspect.max():.4g}"
    if not not_square.size:
        return Finding("pixel aspect", value)
    problem = (
        f"{not_square.size} frames have pixels that are not square: vertical over "
        f"horizontal focal length {not_square.min():.3g} to {not_square.max():.3g}; "
        "check that both are for images of one size"
    )
    return Finding("pixel aspect", value, problem)


def _principal_point(capture):
    share = np.float64(capture.cameras.principal_point_px) / np.array(capture.size)
    median = np.median(share, axis=0)
    value = f"at {median[0]:.0%} of the width and {median[1]:.0%} of the height"
    subject = "principal point"
    distance = np.abs(share - 0.5).max(1)
    row = int(distance.argmax())
    ratio = 2 * share[row]
    larger = ratio.min() > 1.5 and np.ptp(ratio) <= ALIKE * ratio.max()
    smaller = 0.05 < ratio.max() < 0.67 and np.ptp(ratio) <= ALIKE * ratio.max()
    # Points that project into the images confirm that images are tiles of a larger one,
    # but the principal point of a tile seldom has equal ratios in x and y.
    if distance.max() <= OFF_CENTER or (
        capture.points is not None and not larger and not smaller
    ):
        return Finding(subject, value)
    position = ", ".join(
        f"{each:.4g}" for each in capture.cameras.principal_point_px[row]
    )
    reason = "unless the images are tiles, check the units of the principal point"
    if larger or smaller:
        reason = (
            f"the intrinsics seem to be for images {ratio.mean():.3g} times as large; "
            "scale them, unless the images are tiles"
        )
    return Finding(
        subject,
        value,
        f"frame {capture.ids[row]!r} has its principal point at {position} in an image "
        f"of {capture.size[0]}x{capture.size[1]}: {reason}",
    )


def _lens(capture):
    """Check that lens models are one-to-one and do not move corners too far."""
    cameras = capture.cameras
    if cameras.fisheye is not None:
        return _fisheye(capture)
    if not np.any(cameras.radial):
        return Finding("lens distortion", "none")
    width, height = capture.size
    y, x = (np.indices((17, 17)) / 16 * np.array([height, width])[:, None, None]) * 1.0
    folded_shares, shifts = [], []
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
        folded_shares.append(float((radius >= reach).mean()))
        corner = min(float(radius.max()), fold)
        stretch = corner**2 * (k1 + corner**2 * (k2 + corner**2 * k3))
        shifts.append(abs(stretch))
    share, shift = max(folded_shares), max(shifts)
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
        camera = jax.tree.map(lambda leaf, row=row: leaf[row], cameras)
        rays = unproject(camera, corners.reshape(2, -1).T.astype(np.float32))[1]
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
    positions = [capture.cameras.position]
    if capture.points is not None:
        positions.append(capture.points.position)
    step = max(units.float32_step(each) for each in positions)
    step_px = units.in_pixels(capture, step)
    value = f"{step_px:.1g} px"
    problem = ""
    if step_px > DOUBTFUL_PX:
        largest = max(np.abs(each).max() for each in positions)
        problem = (
            f"positions reach {largest:.3g} scene units, where the spacing of float32 "
            f"is {step_px:.2g} px: map coordinates are not centered; set the center of "
            "the scene to that of the cameras"
        )
    return Finding("float32 step", value, problem, step_px > WRONG_PX)


def _is_rounded(capture):
    """Check if positions in the files were rounded to float32."""
    results = _find_rounding(capture, capture.cameras.position, "camera positions")
    if capture.points is not None and len(capture.points.position):
        points = capture.points.position
        points = points[:: max(1, len(points) // MOST_ROUNDED)]
        # Not refused, since points only initialize the scene.
        results += [
            finding._replace(refused=False)
            for finding in _find_rounding(capture, points, "points")
        ]
    return results


def _find_rounding(capture, position, name):
    world = np.float64(position) / capture.scale + np.array(capture.center)
    steps = np.spacing(np.abs(world).max(0).astype(np.float32)).astype(float)
    # Positions in scene units are float32, which hides any finer rounding.
    resolution = units.float32_step(position) / capture.scale
    rounded_axes = []
    for axis in range(3):
        step = steps[axis] / 2  # spacing at half of the largest coordinate
        multiples = world[:, axis] / step
        on_steps = (np.abs(multiples - np.round(multiples)) < 0.1).mean() >= ON_STEPS
        if step > 20 * resolution and on_steps:
            rounded_axes.append(axis)
    step = max(steps[rounded_axes], default=0.0) / 2
    step_px = units.in_pixels(capture, step * capture.scale)
    # A constant coordinate may be such a multiple by chance.
    if step_px < DOUBTFUL_PX or not np.ptp(world[:, rounded_axes], axis=0).any():
        return []
    problem = (
        f"{name} are multiples of {step:.3g} world units, {step_px:.2g} px: "
        f"coordinates of up to {np.abs(world).max():.4g} were rounded to float32; "
        "subtract an origin before exporting them"
    )
    return [Finding(f"rounded {name}", f"{step:.3g}", problem, step_px > WRONG_PX)]
