"""Choice between reconstructions of the same images with different camera models.

Bundle adjustment of a video whose camera mostly turns may drive a free focal length far
from the truth, after which images are lost. Other camera models are therefore tried
while the result is implausible, and the best result is kept. These are pure functions
of summaries of the results.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

# Limits of reliable results. Real videos of 87 and 86 frames have errors of 0.4 px and
# triangulation angles of 6 and 9 degrees.
MOST_ERROR_PX, LEAST_ANGLE_DEG, LEAST_PLACED = 1.5, 1.5, 0.9
# Below this triangulation angle in degrees, a result is doubted, although no other
# camera model may improve it: the built-in scene `pan` has 1.7 with a path that is
# 1.2 % off.
DOUBTED_ANGLE_DEG = 2.5
# Plausible focal lengths as multiples of the longest image side: an angle of view of 19
# to 103 degrees along it.
LEAST_FOCAL, MOST_FOCAL = 0.4, 3.0
MOST_ASPECT = 1.1  # of the two focal lengths of a camera. Pixels are nearly square.
# A smaller error by less than this share does not decide between two results.
SAME_ERROR = 0.1
# Share of the images by which two results must differ to decide between them.
SAME_PLACED = 0.03
# Relative spread of focal lengths of single images that may show a zoom, and the share
# of the error of a common focal length that must remain. With a common focal length,
# 14 images of a zoom by 1.5 all register at 0.45 px, with a camera path that is 27 %
# off, and fitted one by one their focal lengths spread by 32 %. With a camera for each
# image, the error is 0.04 px and the path 0.1 % off.
ZOOM_SPREAD, ZOOM_ERROR = 0.05, 0.8


class Rung(NamedTuple):
    """A camera model, and how its parameters are found."""

    text: str  # for messages
    model: str | None  # COLMAP camera model; None for the requested one
    hold: bool  # focal length and distortion are held until all images are registered
    each: bool = False  # each image has a camera of its own


FREE = Rung("lens refined while registering", None, hold=False)
RADIAL = Rung("one distortion coefficient", "SIMPLE_RADIAL", hold=False)
HELD = Rung(
    "focal length held while registering, refined afterwards",
    "SIMPLE_RADIAL",
    hold=True,
)
EACH = Rung("a focal length for each image", "SIMPLE_PINHOLE", hold=False, each=True)


class Summary(NamedTuple):
    """Properties of one reconstruction."""

    rung: Rung
    images: int  # number of images
    placed: int  # number of registered images
    points: int  # observed in at least `MIN_TRACK` images
    error_px: float  # median over the points of their mean reprojection errors
    angle_deg: float  # median over the points of their largest triangulation angles
    focal: tuple[float, float]  # smallest and largest, in longest image sides
    aspect: float  # largest ratio of the two focal lengths of a camera
    folds: bool  # the distortion folds back inside an image
    # Relative spread of the focal lengths that fit single images best, with the points
    # of a reconstruction with a common focal length.
    spread: float = 0.0


def faults(result: Summary) -> list[str]:
    """List the properties of a reconstruction that make it implausible.

    Args:
      result: The reconstruction.

    Returns:
      One short text for each, empty if there are none.
    """
    reasons = [*implausible_lens(result)]
    if result.placed < LEAST_PLACED * result.images:
        reasons.append(f"{result.placed} of {result.images} images registered")
    if result.error_px > MOST_ERROR_PX:
        reasons.append(f"reprojection error of {result.error_px:.2f} px")
    if result.angle_deg < LEAST_ANGLE_DEG:
        reasons.append(f"triangulation angle of {result.angle_deg:.1f} degrees")
    return reasons


def implausible_lens(result: Summary) -> list[str]:
    """List implausible intrinsics of a reconstruction.

    Args:
      result: The reconstruction.

    Returns:
      One short text for each, empty if all are plausible.
    """
    reasons = []
    low, high = result.focal
    # Also true for NaN.
    if not (low >= LEAST_FOCAL and high <= MOST_FOCAL):
        reasons.append(
            f"focal length of {low:.2f} to {high:.2f} image sides"
            if high > 1.001 * low
            else f"focal length of {low:.2f} image sides"
        )
    if not result.aspect <= MOST_ASPECT:
        reasons.append(
            f"focal lengths of both axes differ by a factor {result.aspect:.2f}"
        )
    if result.folds:
        reasons.append("distortion that folds back inside the image")
    return reasons


def next_rung(results: Sequence[Summary], cameras: str = "auto") -> Rung | None:
    """Choose the camera model to try next.

    Args:
      results: Reconstructions so far, in the order of the attempts.
      cameras: "one", "each", or "auto" to give each image its own camera only if no
        common camera succeeds.

    Returns:
      The model, or None if no further attempt is needed.
    """
    if cameras == "each":
        rungs = [EACH, HELD]
    else:
        rungs = [FREE, RADIAL, HELD] + ([EACH] if cameras == "auto" else [])
    earlier_rungs = [result.rung for result in results]
    sound = [result for result in results if not faults(result)]
    if sound:
        may_zoom = cameras == "auto" and sound[-1].spread > ZOOM_SPREAD
        return EACH if may_zoom and EACH not in earlier_rungs else None
    return next((rung for rung in rungs if rung not in earlier_rungs), None)


def best(results: Sequence[Summary]) -> int:
    """Choose the best of several reconstructions.

    Plausible intrinsics count most, then the number of registered images, then the
    reprojection error, then the number of points. A camera for each image must show a
    zoom, because its additional parameters reduce the error of any video.

    Args:
      results: The reconstructions, at least one.

    Returns:
      Index of the best. Of equal ones, the first.
    """
    choice = 0
    for row in range(1, len(results)):
        if _better(results[row], results[choice]):
            choice = row
    return choice


def notes(
    result: Summary, tried: Sequence[Summary], pieces: Sequence[int]
) -> list[str]:
    """Explain the choice of a reconstruction, and say the doubts about it.

    Args:
      result: The chosen reconstruction.
      tried: All reconstructions, in the order of the attempts.
      pieces: Numbers of images of the chosen model and of those that do not fit to it.

    Returns:
      Lines of text, none if the first attempt succeeded.
    """
    lines = []
    others = [other for other in tried if other.rung != result.rung]
    if others:
        listing = "; ".join(f"{o.rung.text}: {_briefly(o)}" for o in others)
        lines.append(
            f"camera model: {result.rung.text} ({_briefly(result)}), {listing}"
        )
    lens = implausible_lens(result)
    if lens:
        lines.append(f"doubtful: {' and '.join(lens)}, so shapes may be distorted")
    elif not result.rung.each and any(faults(other) for other in others):
        low, high = result.focal
        lines.append(
            "doubtful: the images hardly determine the focal length, which is "
            f"{(low + high) / 2:.2f} image sides here; walk while recording, instead "
            "of turning the camera"
        )
    elif result.rung.each:
        # The built-in scene `zoom`: the path is 1.4 % off, focal lengths 2 to 6 %.
        lines.append(
            "doubtful: the focal length and the distance of a single image are hard to "
            "tell apart, so positions may be off by some percent of the path; record "
            "without zooming"
        )
    if len(pieces) > 1:
        listing = ", ".join(map(str, pieces[1:6]))
        lines.append(f"pieces of {listing} images did not fit and are left out")
    return lines


def _briefly(result):
    text = f"{result.placed} of {result.images} images, {result.error_px:.2f} px"
    return ", ".join((text, *implausible_lens(result)))


def _better(new: Summary, old: Summary) -> bool:
    if new.placed < 2 or old.placed < 2:
        return new.placed > old.placed
    if new.rung.each and not old.rung.each and not _is_zoom(new, old):
        return False
    plausible = bool(implausible_lens(old)) - bool(implausible_lens(new))
    if plausible:
        return plausible > 0
    if abs(new.placed - old.placed) > SAME_PLACED * new.images:
        return new.placed > old.placed
    ratio = math.log((new.error_px + 1e-3) / (old.error_px + 1e-3))
    if abs(ratio) > SAME_ERROR:
        return ratio < 0
    return new.points > old.points


def _is_zoom(per_image, common):
    low, high = per_image.focal
    spread = high / low - 1 if low > 0 else math.inf
    lower_error = per_image.error_px < ZOOM_ERROR * common.error_px
    more_images = per_image.placed > common.placed + SAME_PLACED * common.images
    return spread > ZOOM_SPREAD and (lower_error or more_images)


def folds_inside(distortion: Sequence[float], corner: float) -> bool:
    """Test if a radial distortion folds back inside the image.

    Args:
      distortion: Coefficients k1, k2, ... of r (1 + k1 r² + k2 r⁴ + ...).
      corner: Distance of the farthest corner from the principal point as observed, in
        focal lengths.

    Returns:
      True if some observed radius up to `corner` is never reached.
    """
    # Beyond 80 degrees off the axis a perspective model ends in any case.
    radius = np.linspace(0, max(2 * corner, math.tan(math.radians(80))), 4000)
    factor = 1 + sum(k * radius ** (2 * n + 2) for n, k in enumerate(distortion))
    distorted_radius = radius * factor
    falls = np.flatnonzero(np.diff(distorted_radius) <= 0)
    max_radius = distorted_radius[falls[0]] if falls.size else distorted_radius[-1]
    return bool(max_radius < corner)
