"""`.splatv`: a dynamic scene in one file for antimatter15's viewer of this format.

Each Gaussian moves on a cubic in time, rotates by a quaternion linear in time, and has
an opacity that is a Gaussian in time, as in SpacetimeGaussians (Li et al. 2024,
arXiv:2312.16812, equations 7 to 9). Its color does not depend on the direction and its
size is constant. The trained motion is fitted by these curves, and the error is
reported.
"""

import json
import pathlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gaussians_jax.core.splats import Gaussians
from gaussians_jax.io.keyframes import Keyframes
from gaussians_jax.splatting import rendering
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.metrics.image_quality import psnr, quantize
from nerfies_jax.training.model import TrainState

MAGIC = 0x674B
TEXELS_ACROSS = 4096  # width of the viewer's texture, four texels per Gaussian
ALWAYS = 1e4  # width of a constant opacity, in units of the video: 1 - 3e-9 at its ends
FARTHEST_CENTER = 10.0  # largest distance of a temporal center, in units of the video
FAINTEST = 1e-3  # weight of invisible Gaussians in the fit
FAINTEST_SEEN = 0.05  # Gaussians with a lower opacity are not measured
MEASURED = 12  # views
MOST = 6e4  # largest number in the file, below 65504 of half floats
NEAREST = 0.2  # near plane of the viewer, scene units
_ROW = np.dtype(
    [
        ("position", "<f4", 3),
        ("quaternion", "<f2", 4),
        ("scale", "<f2", 3),
        ("_", "<f2"),
        ("rgba", "u1", 4),
        ("motion", "<f2", (3, 3)),
        ("__", "<f2"),
        ("turning", "<f2", 4),
        ("bell", "<f2", 2),
    ]
)


class Curves(NamedTuple):
    """Curves of the file, as float64 in scene units.

    With u the time since `center`, in units of the video: a mean is `position +
    motion[0] u + motion[1] u² + motion[2] u³`, a rotation `quaternion + turning u`,
    normalized, and an opacity `opacity exp(-(u / width)²)`.
    """

    position: np.ndarray  # [gaussians, 3]
    motion: np.ndarray  # [gaussians, 3 powers, 3]
    quaternion: np.ndarray  # [gaussians, 4] wxyz
    turning: np.ndarray  # [gaussians, 4]
    scale: np.ndarray  # [gaussians, 3]
    color: np.ndarray  # [gaussians, 3] in [0, 1]
    opacity: np.ndarray  # [gaussians]
    center: np.ndarray  # [gaussians]
    width: np.ndarray  # [gaussians]


class Fit(NamedTuple):
    """Error of the curves with respect to the trained motion."""

    rms: float  # of the visible means at all times, scene units
    most: float  # 99th percentile of the largest error over time, scene units
    psnr: float  # dB, renders of the curves against those of the trained motion
    views: int


def fit(keyframes: Keyframes) -> Curves:
    """Fit curves to Gaussians at evenly spaced times by least squares.

    Args:
      keyframes: Gaussians at evenly spaced times. Faint ones have less weight.

    Returns:
      The curves.
    """
    times = np.linspace(0, 1, len(keyframes.mean))
    opacity, center, width = _bells(times, keyframes.opacity.astype(np.float64))
    time_offset = times - 0.5
    weight = keyframes.opacity.astype(np.float64) + FAINTEST
    means = keyframes.mean.astype(np.float64)
    position = _polynomials(time_offset, weight, means, 4)
    turn = _polynomials(time_offset, weight, keyframes.quaternion.astype(np.float64), 2)
    # Change of variables from the time since the middle to the time since the center.
    shift = (center - 0.5)[:, None]
    a, b, c, d = np.moveaxis(position, 1, 0)
    motion = np.stack([b + shift * (2 * c + 3 * d * shift), c + 3 * d * shift, d], 1)
    return Curves(
        position=a + shift * (b + shift * (c + shift * d)),
        motion=motion,
        quaternion=turn[:, 0] + shift * turn[:, 1],
        turning=turn[:, 1],
        scale=np.exp(keyframes.log_scale.astype(np.float64).mean(axis=0)),
        color=np.clip(keyframes.color, 0, 1).astype(np.float64),
        opacity=opacity,
        center=center,
        width=width,
    )


def _polynomials(time_offset, weight, values, terms):
    """Fit coefficients [gaussians, terms, parts] to [times, gaussians, parts]."""
    powers = time_offset[:, None] ** np.arange(terms)
    squares = np.einsum("tn,ti,tj->nij", weight, powers, powers, optimize=True)
    moments = np.einsum("tn,ti,tnd->nid", weight, powers, values, optimize=True)
    return np.linalg.solve(squares, moments)


def _bells(times, opacity):
    """Fit height, center and width of a bell curve to opacities [times, gaussians].

    A parabola is fitted to the logarithm. It is used if it opens downward and has a
    smaller error than a constant opacity.
    """
    constant = opacity.mean(axis=0)
    logarithm = np.log(np.maximum(opacity, 1e-4))[..., None]
    # The error of the opacity is its logarithm's error times the opacity.
    weight = np.maximum(opacity, 1e-4) ** 2
    time_offset = times - 0.5
    parabola = _polynomials(time_offset, weight, logarithm, 3)[..., 0]
    opens_down = parabola[:, 2] < -((1 / ALWAYS) ** 2)
    curvature = np.where(opens_down, -parabola[:, 2], 1.0)
    offset = parabola[:, 1] / (2 * curvature)
    opens_down &= np.abs(offset) < FARTHEST_CENTER
    offset = np.where(opens_down, offset, 0.0)
    height = np.exp(np.minimum(parabola[:, 0] + curvature * offset**2, 0))
    bell = height * np.exp(-curvature * (time_offset[:, None] - offset) ** 2)
    is_better = ((bell - opacity) ** 2).sum(0) < ((constant - opacity) ** 2).sum(0)
    use_bell = opens_down & is_better
    return (
        np.where(use_bell, height, constant),
        0.5 + np.where(use_bell, offset, 0.0),
        np.where(use_bell, curvature**-0.5, ALWAYS),
    )


def at(curves: Curves, time: float) -> Gaussians:
    """Evaluate the curves as the viewer does.

    Args:
      curves: The curves.
      time: Normalized time in [0, 1].

    Returns:
      The Gaussians.
    """
    time_offset = (time - curves.center)[:, None]
    first, second, third = np.moveaxis(curves.motion, 1, 0)
    mean = curves.position + time_offset * (
        first + time_offset * (second + time_offset * third)
    )
    turn = curves.quaternion + curves.turning * time_offset
    bell = np.exp(-((time_offset[:, 0] / curves.width) ** 2))
    parts = mean, turn, curves.scale, curves.opacity * bell
    return Gaussians(*(jnp.asarray(part, jnp.float32) for part in parts))


def encode(curves: Curves, capture: Capture) -> bytes:
    """Encode the file.

    Args:
      curves: The curves.
      capture: The capture, whose training cameras are stored.

    Returns:
      Bytes of the file.

    Raises:
      ValueError: If a number exceeds the range of the format.
    """
    for name, values in curves._asdict().items():
        if not np.abs(values).max(initial=0) < MOST:
            raise ValueError(
                f"{name} of {np.abs(values).max():.3g} exceeds {MOST:g}, the largest "
                "number of .splatv; scale the capture down"
            )
    count = len(curves.position)
    rows = np.zeros(-(-count // 1024) * 1024, _ROW)
    for name in ("position", "quaternion", "scale", "motion", "turning"):
        rows[name][:count] = getattr(curves, name)
    rgba = np.concatenate([curves.color, curves.opacity[:, None]], axis=1)
    rows["rgba"][:count] = np.round(255 * rgba)
    rows["bell"][:count] = np.stack([curves.center, curves.width], axis=1)
    about = {
        "type": "splat",
        "size": rows.nbytes,
        "texwidth": TEXELS_ACROSS,
        "texheight": len(rows) * 4 // TEXELS_ACROSS,
        "cameras": [_camera(capture, row) for row in capture.train],
    }
    header = json.dumps([about]).encode()
    sizes = np.array([MAGIC, len(header)], "<u4")
    return sizes.tobytes() + header + rows.tobytes()


def _camera(capture, row):
    camera = cameras.take(capture.cameras, row)
    focal = float(camera.focal_px)
    return {
        "id": int(row),
        "img_name": capture.ids[row],
        "width": capture.size[0],
        "height": capture.size[1],
        "position": camera.position.tolist(),
        "rotation": camera.camera_from_world.T.tolist(),  # world from camera
        "fx": focal,
        "fy": focal * float(camera.pixel_aspect),
    }


def decode(data: bytes) -> Curves:
    """Decode the curves from the bytes of a file, as a viewer does.

    Args:
      data: Bytes of the file.

    Returns:
      The curves.
    """
    magic, length = np.frombuffer(data[:8], "<u4")
    if magic != MAGIC:
        raise ValueError(
            f"it begins with {magic:#x}, not {MAGIC:#x}: not a .splatv file"
        )
    rows = np.frombuffer(data[8 + int(length) :], _ROW)
    rows = rows[rows["bell"][:, 1] > 0]  # without padding of the texture
    rgba = rows["rgba"] / 255
    bell = rows["bell"].astype(np.float64)
    names = ("position", "motion", "quaternion", "turning", "scale")
    parts = (rows[name].astype(np.float64) for name in names)
    return Curves._make((*parts, rgba[:, :3], rgba[:, 3], bell[:, 0], bell[:, 1]))


def write(path: pathlib.Path, keyframes: Keyframes, capture: Capture) -> Curves:
    """Fit curves and write the file.

    Args:
      path: File to write.
      keyframes: Gaussians at evenly spaced times.
      capture: The capture.

    Returns:
      The curves as they are read from the file.
    """
    data = encode(fit(keyframes), capture)
    with replaced_file(path) as partial:
        partial.write_bytes(data)
    return decode(data)


def measured(
    curves: Curves,
    keyframes: Keyframes,
    draw: Draw,
    state: TrainState,
    raster: RasterSpec,
    capture: Capture,
) -> Fit:
    """Measure the error of the curves at their times and in captured views.

    Args:
      curves: The curves.
      keyframes: Gaussians at evenly spaced times.
      draw: Renderer of the run.
      state: Trained state.
      raster: Settings of the rasterizer.
      capture: The capture, of which at most `MEASURED` views are used, held-out ones
        first.

    Returns:
      The errors.
    """
    times = np.linspace(0, 1, len(keyframes.mean))
    fitted_means = np.stack([np.asarray(at(curves, time).mean) for time in times])
    error = np.linalg.norm(fitted_means - keyframes.mean, axis=-1)
    error = np.where(keyframes.opacity > FAINTEST_SEEN, error, 0)
    background = jnp.asarray(capture.background or (0.0, 0.0, 0.0), jnp.float32)
    colors = jnp.asarray(curves.color, jnp.float32)
    render = jax.jit(
        lambda gaussians, camera: (
            rendering.render(
                gaussians,
                colors,
                camera,
                capture.size,
                raster,
                background,
                depth=False,
            ).rendering.color
        )
    )
    rows = capture.heldout if len(capture.heldout) else capture.train
    rows, scores = evaluation.spread(rows, MEASURED), []
    for row in rows:
        view = evaluation.view_of(capture, row)
        camera = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), view.camera)
        image = render(at(curves, float(view.time)), camera)
        reference = jnp.clip(draw(state, view).color, 0, 1)
        scores.append(float(psnr(quantize(image), quantize(reference))))
    return Fit(
        rms=float(np.sqrt(np.mean(error**2))),
        most=float(np.quantile(error.max(axis=0), 0.99)),
        psnr=float(np.mean(scores)),
        views=len(rows),
    )
