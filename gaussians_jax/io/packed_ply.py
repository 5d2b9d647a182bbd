"""The compressed PLY of PlayCanvas and SuperSplat, 16 bytes a Gaussian and harmonics.

256 neighboring Gaussians are a chunk. Values are quantized between the minimum and the
maximum of their chunk: positions and logarithms of scales to 11, 10 and 11 bits, colors
and opacities to 8. Rotations have three components of 10 bits and the number of the
fourth, largest one. Harmonics are bytes between -4 and 4.
"""

from typing import Any

import numpy as np

from gaussians_jax.core.splats import SH_DC, Splats
from gaussians_jax.io.activated import opacity_of, unit_quaternion

CHUNK = 256
SUFFIX = ".compressed.ply"
# Of logarithms of scales, as the readers clip them.
SCALE_RANGE = (-20.0, 20.0)
_BITS = (11, 10, 11)


def encode(rows: Splats) -> bytes:
    """Encode Gaussians.

    Args:
      rows: Raw parameters of active Gaussians, finite, in NumPy.

    Returns:
      The file.
    """
    rows = along_curve(rows)
    color = 0.5 + SH_DC * rows.sh_dc[:, 0]
    log_scale = np.clip(rows.log_scale, *SCALE_RANGE)
    position, position_bounds = _in_chunks(rows.mean)
    scale, scale_bounds = _in_chunks(log_scale)
    shade, color_bounds = _in_chunks(color)
    opacity = opacity_of(rows)
    words = np.stack(
        [
            _pack(position, _BITS),
            _pack_rotations(rows.quaternion),
            _pack(scale, _BITS),
            _pack(np.column_stack([shade, opacity]), (8, 8, 8, 8)),
        ],
        axis=-1,
    )
    count, rest = len(words), rows.sh_rest.shape[1]
    bounds = np.concatenate([position_bounds, scale_bounds, color_bounds], axis=1)
    names = [
        f"{bound}_{kind}{axis}"
        for kind, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
        for bound in ("min", "max")
        for axis in axes
    ]
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"element chunk {len(bounds)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element vertex {count}"]
    fields = ("position", "rotation", "scale", "color")
    header += [f"property uint packed_{field}" for field in fields]
    parts = [bounds.astype("<f4").tobytes(), words.astype("<u4").tobytes()]
    if rest:
        header += [f"element sh {count}"]
        header += [f"property uchar f_rest_{index}" for index in range(3 * rest)]
        channels = rows.sh_rest.transpose(0, 2, 1).reshape(count, -1)
        bytes_of = np.clip(np.floor((channels / 8 + 0.5) * 256), 0, 255)
        parts.append(bytes_of.astype("u1").tobytes())
    return ("\n".join([*header, "end_header\n"])).encode() + b"".join(parts)


def along_curve(rows: Splats) -> Splats:
    """Sort Gaussians along a Morton curve.

    Args:
      rows: Raw parameters in NumPy.

    Returns:
      The parameters in float64, in the order of `_curve_order`.
    """
    order = _curve_order(np.asarray(rows.mean, np.float64))
    leaves: Any = (np.asarray(leaf, np.float64)[order] for leaf in rows)
    return Splats(*leaves)


def smallest_three(quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split rotations into the index of the largest component and the three others.

    Args:
      quaternion: Quaternions of any length, [gaussians, 4]. Zero is the identity.

    Returns:
      Indices [gaussians], and the other components [gaussians, 3] of the unit
      quaternion whose largest one is positive, mapped from [-1/sqrt(2), 1/sqrt(2)] to
      [0, 1].
    """
    unit = unit_quaternion(quaternion)
    largest = np.argmax(np.abs(unit), axis=1)
    row = np.arange(len(unit))
    unit = unit * np.where(unit[row, largest] < 0, -1, 1)[:, None]
    others = np.argsort(np.arange(4) == largest[:, None], axis=1, kind="stable")[:, :3]
    return largest, np.take_along_axis(unit, others, axis=1) / 2**0.5 + 0.5


def _curve_order(mean: np.ndarray) -> np.ndarray:
    """Sort points along a Morton curve, so that chunks are small."""
    low, high = mean.min(axis=0), mean.max(axis=0)
    cells = (mean - low) / np.where(high > low, high - low, 1) * 1023
    code = np.zeros(len(mean), np.uint32)
    for axis, values in enumerate(cells.astype(np.uint32).T):
        for bit in range(10):
            code |= ((values >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _in_chunks(values):
    """Values in [0, 1] between the bounds of their chunk, and these bounds."""
    starts = np.arange(0, len(values), CHUNK)
    # Bounds as a reader has them, in float32.
    low = np.minimum.reduceat(values, starts).astype(np.float32)
    high = np.maximum.reduceat(values, starts).astype(np.float32)
    chunk = np.arange(len(values)) // CHUNK
    extent = np.where(high > low, high.astype(np.float64) - low, 1)
    return (values - low[chunk]) / extent[chunk], np.concatenate([low, high], axis=1)


def _pack(values, bits):
    """Quantize columns in [0, 1] and join them, the first in the highest bits."""
    word = np.zeros(len(values), np.uint32)
    for column, size in zip(values.T, bits, strict=True):
        most = 2**size - 1
        level = np.clip(np.floor(column * most + 0.5), 0, most).astype(np.uint32)
        word = (word << np.uint32(size)) | level
    return word


def _pack_rotations(quaternion):
    """Join the number of the largest component and the three others."""
    largest, level = smallest_three(quaternion)
    return (largest.astype(np.uint32) << np.uint32(30)) | _pack(level, (10, 10, 10))
