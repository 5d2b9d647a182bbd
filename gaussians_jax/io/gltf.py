"""Binary glTF files with the ratified extension KHR_gaussian_splatting (Khronos, 2026).

github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

import json
import struct

import numpy as np

from gaussians_jax.core.splats import SH_DC, Splats
from gaussians_jax.io.activated import activate

EXTENSION = "KHR_gaussian_splatting"
SUFFIX = ".glb"
MOST_BYTES = 2**32 - 1  # the file's length is a uint32
_FLOAT, _UNSIGNED_BYTE = 5126, 5121
_ARRAY_BUFFER, _POINTS = 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def encode(rows: Splats) -> bytes:
    """Encode Gaussians as one primitive of points.

    Args:
      rows: Raw parameters of active Gaussians, finite, in NumPy. The y axis is up.

    Returns:
      The file, with all values in float32. Viewers without the extension draw points
      with the colors of degree 0.

    Raises:
      ValueError: If the file would be larger than the format allows.
    """
    attributes = _attributes(rows)
    accessors, views, parts, size = [], [], [], 0
    for name, values in attributes.items():
        data = values.tobytes()
        views.append(
            {
                "buffer": 0,
                "byteOffset": size,
                "byteLength": len(data),
                "target": _ARRAY_BUFFER,
            }
        )
        accessors.append(_accessor(len(views) - 1, name, values))
        parts.append(data)
        size += len(data)
    primitive = {
        "attributes": {name: number for number, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "sortingMethod": "cameraDistance",
                "projection": "perspective",
            }
        },
    }
    document = {
        "asset": {"version": "2.0", "generator": "gaussians_jax"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "Gaussians", "mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + size
    if total > MOST_BYTES:
        raise ValueError(
            f"{len(rows.mean)} Gaussians take {total} bytes, and a .glb file has at "
            f"most {MOST_BYTES}: write fewer, or a .ply"
        )
    header = struct.pack("<4sII", b"glTF", 2, total)
    chunk = struct.pack("<I4s", len(text), b"JSON") + text
    return b"".join([header, chunk, struct.pack("<I4s", size, b"BIN\0"), *parts])


def _attributes(rows: Splats) -> dict[str, np.ndarray]:
    """Return the vertex attributes, each with elements of a multiple of four bytes."""
    values = activate(rows)
    color = np.column_stack([0.5 + SH_DC * values.harmonics[:, 0], values.opacity])
    attributes = {
        "POSITION": values.mean,
        f"{EXTENSION}:ROTATION": values.quaternion[:, [1, 2, 3, 0]],  # xyzw
        f"{EXTENSION}:SCALE": values.scale,
        f"{EXTENSION}:OPACITY": values.opacity[:, None],
    }
    degrees = round(values.harmonics.shape[1] ** 0.5)
    for degree in range(degrees):
        for order in range(2 * degree + 1):
            name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"
            attributes[name] = values.harmonics[:, degree**2 + order]
    attributes = {name: leaf.astype("<f4") for name, leaf in attributes.items()}
    attributes["COLOR_0"] = np.rint(255 * np.clip(color, 0, 1)).astype(np.uint8)
    return attributes


def _accessor(view: int, name: str, values: np.ndarray) -> dict:
    floats = values.dtype != np.uint8
    accessor = {
        "bufferView": view,
        "componentType": _FLOAT if floats else _UNSIGNED_BYTE,
        "count": len(values),
        "type": _TYPES[values.shape[1]],
    }
    if not floats:
        accessor["normalized"] = True
    if name == "POSITION":  # the format requires its bounds, exactly
        accessor["min"] = values.min(axis=0).tolist()
        accessor["max"] = values.max(axis=0).tolist()
    return accessor
