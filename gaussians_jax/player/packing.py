"""Compact encoding of Gaussians at a few times: integers, and offsets of moving ones.

A field (mean, quaternion, ...) is stored once at its reference value. Gaussians that
change also have an offset for each time, in steps of their own size. The reference is
the middle of the range, so that no offset is longer than half of it.
"""

from typing import Any, NamedTuple

import numpy as np

from gaussians_jax.core import splats
from gaussians_jax.io.keyframes import Keyframes

# Smaller offsets are left out: a tenth of a pixel in the nearest training view for
# means, and changes of an image by less than 1/255 for the others.
STILL_PX = 0.1
STILL = {"quaternion": 5e-3, "log_scale": 1e-2, "opacity": 4e-3}
BRIGHTEST = 4.0  # largest color, where white is 1
OFFSET_TYPES: dict[str, type[np.signedinteger]] = {
    "mean": np.int16,
    "quaternion": np.int8,  # 1/254 of the range: 0.2 degrees of 60
    "log_scale": np.int8,
    "opacity": np.int8,
}


class Packed(NamedTuple):
    """Concatenated arrays, and the location of each."""

    entries: dict[str, dict[str, Any]]  # value = shift + scale * stored number
    data: bytes


def pack(keyframes: Keyframes, still_distance: np.ndarray) -> Packed:
    """Encode Gaussians at several times.

    Reference means are float32, so that a distant Gaussian does not reduce the
    precision of near ones. Rotations, scales and colors have 16 bits, opacity has 8.

    Args:
      keyframes: The Gaussians at these times, scene units.
      still_distance: [gaussians] displacement that counts as static, scene units.

    Returns:
      The bytes and their description.
    """
    low, high = splats.LOG_SCALE_RANGE
    quantizers = {
        "mean": (np.float32, 1.0, 0.0),
        "quaternion": (np.int16, 1 / 32767, 0.0),
        "log_scale": (np.uint16, (high - low) / 65535, low),
        "opacity": (np.uint8, 1 / 255, 0.0),
    }
    arrays = _Arrays()
    # A Gaussian may be brighter than white if others occlude it.
    color = np.round(np.minimum(keyframes.color / BRIGHTEST, 1) * 65535)
    arrays.add("color", color.astype(np.uint16), BRIGHTEST / 65535)
    for name, (dtype, scale, shift) in quantizers.items():
        values = getattr(keyframes, name).astype(np.float64)
        values = values.reshape(*values.shape[:2], -1)
        reference = (values.min(axis=0) + values.max(axis=0)) / 2
        reference_codes = (reference - shift) / scale
        reference_codes = (
            reference_codes if dtype is np.float32 else np.round(reference_codes)
        )
        reference_codes = reference_codes.astype(dtype)
        # Relative to the rounded reference, so that offsets also correct its rounding.
        offset = values - (shift + scale * reference_codes.astype(np.float64))
        threshold = still_distance if name == "mean" else STILL[name]
        (rows,) = np.nonzero(np.abs(values - reference).max(axis=(0, 2)) > threshold)
        largest = np.iinfo(OFFSET_TYPES[name]).max
        step = (np.abs(offset[:, rows]).max(axis=(0, 2)) / largest).astype(np.float32)
        steps = np.maximum(step, np.finfo(np.float32).tiny)[None, :, None]
        offset_codes = np.clip(np.round(offset[:, rows] / steps), -largest, largest)
        arrays.add(name, reference_codes, scale, shift)
        arrays.add(f"{name}.rows", rows.astype(np.uint32))
        arrays.add(f"{name}.step", step)
        arrays.add(f"{name}.change", offset_codes.astype(OFFSET_TYPES[name]))
    return arrays.build()


class _Arrays:
    """Bytes of arrays, each aligned to four bytes."""

    def __init__(self):
        self._entries, self._parts, self._size = {}, [], 0

    def add(self, name, array, scale=1.0, shift=0.0):
        """Append an array; a value is `shift + scale * array`."""
        content = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"))
        content = content.tobytes()
        self._entries[name] = {
            "type": array.dtype.name,
            "shape": list(array.shape),
            "offset": self._size,
            "scale": scale,
            "shift": shift,
        }
        content += bytes(-len(content) % 4)
        self._parts.append(content)
        self._size += len(content)

    def build(self):
        """Return all arrays."""
        return Packed(self._entries, b"".join(self._parts))


def moving_rows(packed: Packed) -> int:
    """Count the Gaussians that change over time: the largest number in any field.

    Args:
      packed: The encoded Gaussians.

    Returns:
      Largest number of Gaussians with offsets in any field.
    """
    names = [name for name in packed.entries if name.endswith(".rows")]
    return max(packed.entries[name]["shape"][0] for name in names)
