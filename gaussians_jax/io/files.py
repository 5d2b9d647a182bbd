"""Gaussian files: 3DGS .ply, antimatter15 .splat and Niantic .spz.

Compressed PLY, SOG, OpenUSD and glTF files are written, and not read.

docs/formats.md lists what each format stores. Files are written to a temporary name
next to the target and renamed, so a crash leaves the old file or the new one.
"""

import os
import pathlib
import re
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from gaussians_jax.core import splats
from gaussians_jax.core.splats import SH_DC, Splats
from gaussians_jax.io import gltf, packed_ply, sog, spz, usd
from gaussians_jax.io.activated import opacity_of, unit_quaternion
from nerfies_jax.capture import ply_files, safe_files, text_files
from nerfies_jax.capture.errors import FileError
from nerfies_jax.capture.json_files import replaced_file

MOST_HEADER_BYTES = ply_files.MAX_HEADER  # 62 properties take 1.5 kB
MOST_BYTES = 4 * 2**30  # of a .splat or .spz file: 100 million Gaussians
SUFFIXES = (".ply", ".splat", ".spz")
WRITTEN = (*SUFFIXES, packed_ply.SUFFIX, sog.SUFFIX, usd.SUFFIX, gltf.SUFFIX)
MOST_ROUNDING = 0.1  # of float64 coordinates, relative to the median scale
_REQUIRED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
_SPLAT_ROW = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)]
)


class Loaded(NamedTuple):
    """The Gaussians of a file, and notes about data that was not loaded.

    Attributes:
      splats: Raw parameters, float32.
      dropped: Number of Gaussians with a value that is not finite.
      notes: Properties and elements of the file that were ignored.
    """

    splats: Splats
    dropped: int
    notes: tuple[str, ...]


def load(path: str | os.PathLike, *, drop_broken: bool = False) -> Loaded:
    """Load Gaussians from a .ply, .splat or .spz file.

    Args:
      path: The file, whose suffix selects the format.
      drop_broken: Leave out and count Gaussians with NaN or infinity, instead of
        refusing the file.

    Returns:
      Raw parameters and notes.

    Raises:
      FileError: If the file is damaged or of another format.
    """
    path = pathlib.Path(path)
    readers = dict(zip(SUFFIXES, (_read_ply, _read_splat, _read_spz), strict=True))
    if path.suffix.lower() not in readers:
        raise FileError(
            f"{path}: cannot read {path.suffix or 'a file without suffix'}; supported "
            f"formats are {', '.join(SUFFIXES)}"
        )
    if not path.is_file():
        raise FileError(f"{path}: no such file")
    try:
        rows, notes = readers[path.suffix.lower()](path)
        rows, dropped_count = _without_broken(rows, drop_broken)
    except FileError:  # it names the path already
        raise
    except (ValueError, OSError, MemoryError, OverflowError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{path}: {reason}") from error
    return Loaded(Splats(*map(jnp.asarray, rows)), dropped_count, notes)


def save(
    path: str | os.PathLike,
    rows: Splats,
    *,
    spz_version: int = 3,
    usd_up: Literal["Y", "Z"] = "Y",
) -> int:
    """Save the active Gaussians in the format of the suffix.

    Args:
      path: File to write, ending in .ply, .splat, .spz, .compressed.ply, .sog, .usda or
        .glb.
      rows: Raw parameters. Inactive Gaussians are left out.
      spz_version: Version of SPZ files.
      usd_up: Axis that OpenUSD files name as up.

    Returns:
      Number of Gaussians written.

    Raises:
      ValueError: If a Gaussian is not finite, or the format is unknown.
    """
    path = pathlib.Path(path)
    suffix = path.suffix.lower()
    if path.name.lower().endswith(packed_ply.SUFFIX):
        suffix = packed_ply.SUFFIX
    encoders: dict[str, Callable[[Splats], bytes]] = {
        ".ply": _ply_bytes,
        ".splat": _splat_bytes,
        ".spz": lambda rows: spz.encode(spz.Unpacked._make((*rows, ())), spz_version),
        packed_ply.SUFFIX: packed_ply.encode,
        sog.SUFFIX: sog.encode,
        usd.SUFFIX: lambda rows: usd.encode(rows, usd_up),
        gltf.SUFFIX: gltf.encode,
    }
    if suffix not in encoders:
        raise ValueError(
            f"{path}: cannot write {path.suffix or 'a file without suffix'}; supported "
            f"formats are {', '.join(WRITTEN)}"
        )
    active = splats.rows_to_write(rows, path)
    rows_to_write = Splats(*(np.asarray(leaf, np.float32)[active] for leaf in rows))
    try:
        rows_to_write, _ = _without_broken(rows_to_write, False)
        data = encoders[suffix](rows_to_write)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; not written") from error
    with replaced_file(path) as partial:
        partial.write_bytes(data)
    return int(active.sum())


def _without_broken(rows, drop):
    finite = np.ones(len(rows.mean), bool)
    for leaf in rows:
        finite &= np.isfinite(leaf.reshape(len(finite), -1)).all(axis=1)
    broken_count = int((~finite).sum())
    if broken_count and not drop:
        first = np.flatnonzero(~finite)[0]
        name = next(
            name
            for name, leaf in zip(rows._fields, rows, strict=True)
            if not np.isfinite(leaf[first]).all()
        )
        raise ValueError(
            f"row {first} has a {name} that is not finite, {broken_count} such rows in "
            "total; load with drop_broken=True to skip them"
        )
    if not finite.any():
        raise ValueError("every row has a value that is not finite")
    return Splats(*(leaf[finite] for leaf in rows)), broken_count


# The PLY of 3D Gaussian splatting ---------------------------------------------------


def _read_ply(path):
    header = _ply_header(path)
    text = b"\nformat ascii" in header
    try:
        ply = ply_files.read(path)
    except ValueError as error:
        raise ValueError(f"damaged PLY ({error})") from error
    if "vertex" not in ply:
        raise ValueError("it has no element 'vertex'")
    vertex = ply["vertex"].data
    _refuse_other_ply(ply, vertex)
    names = vertex.dtype.names
    rest = sorted(
        (name for name in names if re.fullmatch(r"f_rest_\d+", name)),
        key=lambda name: int(name.rsplit("_", 1)[1]),
    )
    if len(rest) not in (0, 9, 24, 45):
        raise ValueError(
            f"{len(rest)} properties f_rest_*; spherical harmonics of degree 0, 1, 2 "
            "and 3 have 0, 9, 24 and 45"
        )

    def columns(*which):
        if not which:
            return np.zeros((len(vertex), 0), np.float32)
        # float64 values beyond float32's range become inf, reported as not finite.
        with np.errstate(over="ignore", invalid="ignore"):
            return np.stack([vertex[name] for name in which], -1).astype(np.float32)

    _refuse_map_coordinates(vertex)
    channels = columns(*rest).reshape(len(vertex), 3, -1)  # all red, then green, blue
    rows = Splats(
        mean=columns("x", "y", "z"),
        log_scale=columns("scale_0", "scale_1", "scale_2"),
        quaternion=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        opacity_logit=columns("opacity")[:, 0],
        sh_dc=columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :],
        sh_rest=np.ascontiguousarray(channels.transpose(0, 2, 1)),
    )
    expected_names = {*_REQUIRED, *rest, "nx", "ny", "nz"}
    extra = [name for name in names if name not in expected_names]
    extra += [f"element {part.name}" for part in ply.elements if part.name != "vertex"]
    notes = (f"ignored: {', '.join(extra)}",) if extra else ()
    trailing = path.stat().st_size - len(header) - vertex.nbytes
    if trailing > 0 and not text and len(ply.elements) == 1:
        notes += (f"ignored: {trailing} bytes after the last row",)
    return rows, notes


def _refuse_map_coordinates(vertex):
    """Refuse float64 coordinates that float32 rounds by the size of Gaussians."""
    axes = [axis for axis in "xyz" if vertex[axis].dtype == np.float64]
    if not axes or not len(vertex):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        rounding = max(
            float(np.nanmax(np.abs(vertex[axis] - vertex[axis].astype(np.float32))))
            for axis in axes
        )
        scales = [np.float64(vertex[f"scale_{number}"]) for number in range(3)]
        size = float(np.exp(np.median(scales)))
    if np.isfinite(rounding) and rounding > MOST_ROUNDING * size:
        raise ValueError(
            f"float32 would round its float64 coordinates by up to {rounding:.2g}, but "
            f"the median scale of a Gaussian is {size:.2g}; subtract an origin from "
            "the coordinates and write the file again"
        )


def _ply_header(path):
    """Return the header after checking its length and counts."""
    with safe_files.open_file(path) as stream:
        head = text_files.utf8(stream.read(MOST_HEADER_BYTES))
    return ply_files.check_header(head, path.stat().st_size)


def _refuse_other_ply(ply, vertex):
    names = vertex.dtype.names
    if "chunk" in ply and "packed_position" in names:
        raise ValueError(
            "it is a compressed PLY of SuperSplat; convert it with `splat-transform "
            "in.ply out.spz`"
        )
    missing = [name for name in _REQUIRED if name not in names]
    if "x" in names and "f_dc_0" in missing:
        raise ValueError(
            "it holds points or a mesh, not Gaussians: property f_dc_0 is missing; "
            "initialize Gaussians from its points with splats.from_points"
        )
    if missing:
        raise ValueError(f"missing properties: {', '.join(missing)}")
    lists = [name for name in names if vertex.dtype[name].kind not in "fiu"]
    if lists:
        raise ValueError(f"properties that are not numbers: {', '.join(lists)}")
    if not len(vertex):
        raise ValueError("it holds no Gaussians: element vertex 0")


def _ply_bytes(rows):
    rest = rows.sh_rest.shape[1]
    blocks = {
        ("x", "y", "z"): rows.mean,
        ("nx", "ny", "nz"): np.zeros_like(rows.mean),  # unused, but viewers expect them
        ("f_dc_0", "f_dc_1", "f_dc_2"): rows.sh_dc[:, 0],
        tuple(f"f_rest_{i}" for i in range(3 * rest)): rows.sh_rest.transpose(
            0, 2, 1
        ).reshape(len(rows.mean), -1),
        ("opacity",): rows.opacity_logit[:, None],
        ("scale_0", "scale_1", "scale_2"): rows.log_scale,
        ("rot_0", "rot_1", "rot_2", "rot_3"): rows.quaternion,
    }
    names = [name for block in blocks for name in block]
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"element vertex {len(rows.mean)}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    table = np.concatenate(list(blocks.values()), axis=1).astype("<f4")
    return "\n".join(header).encode() + table.tobytes()


# .splat: 32 bytes a row, no harmonics -----------------------------------------------


def _read_splat(path):
    data = safe_files.read_bytes(path, MOST_BYTES)
    if not data:
        raise ValueError("it is empty and holds no Gaussians")
    if len(data) % _SPLAT_ROW.itemsize:
        raise ValueError(
            f"{len(data)} bytes is not a multiple of {_SPLAT_ROW.itemsize}: truncated, "
            "or not a .splat file"
        )
    table = np.frombuffer(data, _SPLAT_ROW)
    with np.errstate(invalid="ignore"):  # a signaling NaN, refused later
        scale = table["scale"].astype(np.float64)
    bounds = np.exp(splats.LOG_SCALE_RANGE)
    # A flat Gaussian of scale 0 gets the smallest scale. NaN stays NaN.
    log_scale = np.where(scale >= 0, np.log(np.clip(scale, *bounds)), np.nan)
    rows = Splats(
        mean=table["mean"].astype(np.float32),
        log_scale=log_scale.astype(np.float32),
        quaternion=(table["turn"].astype(np.float32) - 128) / 128,
        opacity_logit=spz.logit_of_byte(table["rgba"][:, 3]),
        sh_dc=((table["rgba"][:, None, :3] / 255 - 0.5) / SH_DC).astype(np.float32),
        sh_rest=np.zeros((len(table), 0, 3), np.float32),
    )
    return rows, ()


def _splat_bytes(rows):
    # Viewers render the file while it loads, so the largest Gaussians come first, by
    # opacity times volume. Logarithms cannot overflow.
    log_opacity = -np.logaddexp(0, -rows.opacity_logit.astype(np.float64))
    log_scale = np.clip(rows.log_scale.astype(np.float64), *splats.LOG_SCALE_RANGE)
    largest_first = np.argsort(-(log_opacity + log_scale.sum(axis=1)), kind="stable")
    rows = Splats(*(leaf[largest_first] for leaf in rows))
    log_scale = log_scale[largest_first]
    table = np.zeros(len(rows.mean), _SPLAT_ROW)
    table["mean"] = rows.mean
    table["scale"] = np.exp(log_scale)
    rgba = np.column_stack([0.5 + SH_DC * rows.sh_dc[:, 0], opacity_of(rows)])
    table["rgba"] = _nearest_byte(rgba * 255)
    table["turn"] = _nearest_byte(unit_quaternion(rows.quaternion) * 128 + 128)
    return table.tobytes()


def _nearest_byte(values):
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _read_spz(path):
    contents = spz.decode(safe_files.read_bytes(path, MOST_BYTES))
    return Splats(*contents[:-1]), contents.notes
