"""Checks of cameras against scene points, and the conventions that explain a mismatch.

Computations are in float64, since positions may be wrong by many orders of magnitude.
"""

from typing import NamedTuple

import jax
import numpy as np

from nerfies_jax.capture import gate_axes
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.gate_finding import Finding

# Share of the points in an image, averaged over cameras. Below `DOUBTFUL`, another
# convention is suggested if its share is at least `CONVINCING`.
DOUBTFUL, CONVINCING = 0.05, 0.3
NONE = 0.005  # shares below this count as none
# Above `DOUBTFUL`, another convention is suggested if its share is at least `BETTER`
# and at least `FAR_BETTER` times as large.
BETTER, FAR_BETTER = 0.6, 2.5
# Share of the points in any image. In a survey each image shows few points, but all
# images together show most.
SEEN = 0.5
# Focal lengths are suspected to be for larger images if less than this share of the
# points is in any image, scaled ones have at most this field of view in degrees, and
# the principal point is within this share of the image from the center.
MOST_UNSEEN, WIDE, CENTERED = 0.7, 90.0, 0.1
SMALL = 0.03  # share of the width and height that all points cover if units are wrong
MOST_FRAMES, MOST_POINTS, LEAST_POINTS = 1000, 1000, 10
MOST_BEYOND = 0.3  # largest share of the visible points outside near and far
NO_PARALLAX = 1e-4  # extent of the camera path over the depth of the points
_FLIP = np.diag([1.0, -1.0, -1.0])  # between OpenGL and OpenCV axes of a camera


class Pose(NamedTuple):
    """Poses of several cameras in world units, float64."""

    rotation: np.ndarray  # [frames, 3, 3] camera from world; right, down, forward
    position: np.ndarray  # [frames, 3]


class Projected(NamedTuple):
    """Projections of points into the images of several cameras."""

    pixel: np.ndarray  # [frames, points, 2]
    depth: np.ndarray  # [frames, points]
    inside: np.ndarray  # [frames, points] bool: in front, and in the image


def findings(capture: Capture) -> list[Finding]:
    """Compare the poses and intrinsics of a capture with its points.

    Args:
      capture: The capture.

    Returns:
      The findings, none if there are too few points.
    """
    if capture.points is None or len(capture.points.position) < LEAST_POINTS:
        return gate_axes.findings(capture)
    count = len(capture.ids)
    rows = np.unique(np.linspace(0, count - 1, min(count, MOST_FRAMES)).astype(int))
    cameras = jax.tree.map(lambda leaf: np.asarray(leaf, float)[rows], capture.cameras)
    points = capture.points.position
    sample = np.linspace(0, len(points) - 1, min(len(points), MOST_POINTS)).astype(int)
    points = np.float64(points[sample]) / capture.scale + np.array(capture.center)
    pose = Pose(
        np.asarray(cameras.camera_from_world),
        np.asarray(cameras.position) / capture.scale + np.array(capture.center),
    )
    projection = _project(cameras, pose, points, capture.size)
    share, front = projection.inside.mean(), (projection.depth > 0).mean()
    visible = projection.inside.any(0).mean()
    value = (
        f"{front:.0%} in front of a camera and {share:.0%} inside its image, on average"
    )
    subject = "points"
    if share < DOUBTFUL and visible < SEEN:
        problem, is_refused = _explain(capture, cameras, pose, points, share)
        return [Finding(subject, value, problem, is_refused)]
    problem = ""
    if share < CONVINCING:
        readings = _other_conventions(capture, cameras, pose)
        if visible < MOST_UNSEEN:
            readings |= _smaller_images(capture, cameras, pose)
        readings |= _other_units(cameras, pose)
        best, reason = _best_reading(readings, capture, points)
        if best >= max(BETTER, FAR_BETTER * share):
            problem = f"{share:.0%} of the points fall into the images, and " + reason
    return [
        Finding(subject, value, problem),
        *_spread(capture, projection),
        *_parallax(pose, projection),
        *_near_and_far(capture, projection),
        *_empty_frames(capture, rows, projection),
    ]


def _explain(capture, cameras, pose, points, share):
    """The problem if hardly any point is visible, and True if it must be refused."""
    readings = _other_conventions(capture, cameras, pose)
    if share < NONE:  # tiles and surveys show some points, and other units may show all
        readings |= _other_units(cameras, pose)
    best, reason = _best_reading(readings, capture, points)
    statement = f"{share:.0%} of the points fall into the images, and "
    if best >= CONVINCING:
        return statement + reason, True
    readings = _smaller_images(capture, cameras, pose)
    best, reason = _best_reading(readings, capture, points)
    if best >= BETTER:
        return statement + reason, False
    if share >= NONE:
        return "", False
    return (
        f"{share:.1%} of the points fall into an image: the points or the poses are "
        "probably in other coordinates or units; export both from one program, or "
        "remove the file of points",
        bool(share == 0),
    )


def _best_reading(readings, capture, points):
    """The largest share of points in the images of any reading, and its reason."""
    shares = {}
    for name, (cameras, pose) in readings.items():
        projection = _project(cameras, pose, points, capture.size)
        # From far enough away all points are visible as a dot.
        is_dot = max(_extent(capture, projection), default=0.0) < SMALL
        shares[name] = 0.0 if is_dot else float(projection.inside.mean())
    if not shares:
        return 0.0, ""
    best = max(shares, key=shares.get)
    return shares[best], f"{shares[best]:.0%} if {best}"


def _other_conventions(capture, cameras, pose):
    """Cameras and poses under other conventions, by reason."""
    rotation, position = pose
    back = rotation.swapaxes(1, 2)  # world from camera

    def rotate(matrix, vector):
        return np.einsum("nij,nj->ni", matrix, vector)

    remedy = "; convert the poses to camera to world with axes right, up, back (OpenGL)"
    readings = {}
    if capture.source == "blender":
        for name, other in gate_axes.transforms_conventions(rotation, position).items():
            readings[f"{name}{remedy}"] = Pose(*other)
    else:
        remedy = (
            "; convert the poses to rotations from world to camera with axes right, "
            "down, forward (OpenCV), and positions of the cameras"
        )
        readings |= {
            f"the camera's axes are right, up, back (OpenGL){remedy}": Pose(
                _FLIP @ rotation, position
            ),
            f"the rotations are from camera to world{remedy}": Pose(back, position),
            f"the positions are translations from world to camera{remedy}": Pose(
                rotation, -rotate(back, position)
            ),
            f"the poses are the inverse, world to camera{remedy}": Pose(
                back, -rotate(rotation, position)
            ),
        }
    readings = {name: (cameras, other) for name, other in readings.items()}
    ratio = 2 * cameras.principal_point_px / np.array(capture.size)
    times = float(np.median(ratio))
    if times >= 1.5:
        smaller = cameras._replace(
            focal_px=cameras.focal_px / times,
            principal_point_px=cameras.principal_point_px / times,
        )
        name = (
            f"the intrinsics are for images {times:.3g} times as large; state the size "
            "that they refer to, or scale them"
        )
        readings[name] = smaller, pose
    return readings


def _smaller_images(capture, cameras, pose):
    """Cameras if only the focal lengths are for larger images, by reason."""
    offset = np.abs(cameras.principal_point_px / np.array(capture.size) - 0.5).max()
    if offset > CENTERED:  # the principal point is wrong as well
        return {}
    readings = {}
    for times in (2, 4, 8):
        smaller = cameras._replace(focal_px=cameras.focal_px / times)
        angle = 2 * np.arctan2(capture.size[0] / 2, np.median(smaller.focal_px))
        if np.degrees(angle) > WIDE:
            break
        name = (
            f"the focal lengths are for images {times} times as large; state the size "
            "that they refer to, or scale them"
        )
        readings[name] = smaller, pose
    return readings


def _other_units(cameras, pose):
    """Cameras and poses with positions in another unit than the points, by reason."""
    readings = {}
    for factor, description in (
        (0.001, "camera positions in millimeters and points in meters"),
        (1000.0, "camera positions in meters and points in millimeters"),
        (0.01, "camera positions in centimeters and points in meters"),
        (100.0, "camera positions in meters and points in centimeters"),
    ):
        name = f"the units differ: {description}; export both in one unit"
        readings[name] = cameras, Pose(pose.rotation, pose.position * factor)
    return readings


def _extent(capture, projection):
    """Shares of width and height that 90 % of the points cover. () for few points."""
    extents = []
    for pixel, inside in zip(projection.pixel, projection.inside, strict=True):
        if inside.sum() >= LEAST_POINTS:
            low, high = np.quantile(pixel[inside], (0.05, 0.95), axis=0)
            extents.append((high - low) / np.array(capture.size))
    return np.median(extents, axis=0) if extents else ()


def _spread(capture, projection):
    """Check if all points lie in a small part of the images, as in a wrong unit."""
    extent = _extent(capture, projection)
    if not len(extent):
        return []
    x, y = extent
    value = f"{x:.0%} of the width and {y:.0%} of the height"
    problem = ""
    if max(x, y) < SMALL:
        problem = (
            f"the points cover {x:.1%} of the width and {y:.1%} of the height "
            "of an image: the focal length is too small (in millimeters, or of smaller "
            "images), or camera positions and points are in different units, such as "
            "millimeters and meters"
        )
    return [Finding("points cover", value, problem)]


def _parallax(pose, projection):
    """Check if the camera path is so short that its unit must be another one."""
    extent = float(np.linalg.norm(np.ptp(pose.position, axis=0)))
    depths = projection.depth[projection.inside]
    if extent == 0 or not depths.size:
        return []
    ratio = extent / float(np.median(depths))
    problem = ""
    if ratio < NO_PARALLAX:
        problem = (
            f"the cameras move by {ratio:.1g} of the depth of the points: camera "
            "positions and points seem to be in different units, such as meters and "
            "millimeters; export both in one unit"
        )
    return [Finding("cameras move by", f"{ratio:.2g} of the median depth", problem)]


def _near_and_far(capture, projection):
    """Check that the visible points lie between near and far."""
    depths = projection.depth[projection.inside] * capture.scale
    if not depths.size:
        return []
    near, far = capture.near, capture.far
    beyond = float(((depths < near) | (depths > far)).mean())
    value = f"{near:.3g} to {far:.3g}, {beyond:.1%} of the points outside"
    subject = "near and far"
    if beyond <= MOST_BEYOND:
        return [Finding(subject, value)]
    median = float(np.median(depths))
    reason = "set them so that they contain the scene"
    if near <= median / capture.scale <= far:
        reason = (
            f"they seem to be in world units, so multiply them by {capture.scale:g}"
        )
    problem = (
        f"{beyond:.0%} of the points lie outside near {near:.3g} and far {far:.3g}, at "
        f"a median depth of {median:.3g} scene units: {reason}"
    )
    return [Finding(subject, value, problem, beyond > 0.95)]


def _empty_frames(capture, rows, projection):
    """Frames that show hardly any points, compared with the other frames."""
    counts = projection.inside.sum(1)
    median = np.median(counts)
    is_few = median < 2 * LEAST_POINTS  # a frame may have none by chance
    empty = rows[:0] if is_few else rows[counts < DOUBTFUL * median]
    value = f"{len(empty)} of {len(rows)}"
    problem = ""
    if len(empty):
        names = ", ".join(capture.ids[row] for row in empty[:5])
        names += ", ..." if len(empty) > 5 else ""
        problem = (
            f"{len(empty)} frames show no points ({names}): their poses may be wrong; "
            "estimate them again or leave those frames out"
        )
    return [Finding("frames without points", value, problem)]


def _project(cameras, pose, points, size):
    """Project points [points, 3] of a world into all images."""
    origin = np.median(points, axis=0)
    offset = (points - origin)[None] - (pose.position - origin)[:, None]
    local = np.einsum("fij,fnj->fni", pose.rotation, offset)
    depth = local[..., 2]
    in_front = depth > 0
    plane = local[..., :2] / np.where(in_front, depth, 1.0)[..., None]
    x, y = plane[..., 0], plane[..., 1]
    distorted_x, distorted_y, is_unique = _distort(cameras, x, y)
    focal = cameras.focal_px[:, None]
    pixel = np.stack(
        [
            focal * distorted_x + cameras.skew_px[:, None] * distorted_y,
            focal * cameras.pixel_aspect[:, None] * distorted_y,
        ],
        axis=-1,
    )
    pixel = pixel + cameras.principal_point_px[:, None]
    within = ((pixel >= 0) & (pixel < np.array(size))).all(-1)
    return Projected(pixel, depth, in_front & within & is_unique)


def _distort(cameras, x, y):
    """Distorted positions [frames, points], and a mask where lenses are one-to-one."""
    radius_sq = np.minimum(x * x + y * y, 1e8)
    if cameras.fisheye is not None:
        angle = np.arctan(np.sqrt(radius_sq))
        powers = angle[..., None] ** np.arange(2, 9, 2)
        stretch = 1 + np.einsum("fpk,fk->fp", powers, cameras.fisheye)
        stretch = stretch * np.where(angle > 0, angle, 1)
        stretch = stretch / np.where(angle > 0, np.sqrt(radius_sq), 1)
        folds = np.tan(np.minimum(fold_radius(cameras.fisheye), np.pi / 2 - 1e-4))
        return x * stretch, y * stretch, radius_sq < folds[:, None] ** 2
    k1, k2, k3 = (cameras.radial[:, [i]] for i in range(3))
    p1, p2 = (cameras.tangential[:, [i]] for i in range(2))
    stretch = 1 + radius_sq * (k1 + radius_sq * (k2 + radius_sq * k3))
    bent_x = x * stretch + 2 * p1 * x * y + p2 * (radius_sq + 2 * x * x)
    bent_y = y * stretch + 2 * p2 * x * y + p1 * (radius_sq + 2 * y * y)
    return bent_x, bent_y, radius_sq < fold_radius(cameras.radial)[:, None] ** 2


def fold_radius(radial: np.ndarray) -> np.ndarray:
    """Compute the undistorted radius up to which each lens is one-to-one.

    Args:
      radial: Coefficients k1, k2, k3 of each lens, [lenses, 3], or those of a fisheye,
        [lenses, 4].

    Returns:
      Radii in the image plane, of a fisheye angles in radians, [lenses]. inf for lenses
      that never fold.
    """
    radii = {}
    for each in np.unique(radial, axis=0).tolist():
        # d/dr (r + k1 r^3 + k2 r^5 + k3 r^7), a polynomial in r^2
        powers = np.arange(len(each), 0, -1)
        slope = np.append((2 * powers + 1) * each[::-1], 1.0)
        roots = np.roots(np.trim_zeros(slope, "f"))
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        radii[tuple(each)] = float(np.sqrt(real.min())) if real.size else np.inf
    return np.array([radii[tuple(each)] for each in radial.tolist()])
