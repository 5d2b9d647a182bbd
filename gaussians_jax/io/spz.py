"""SPZ, the packed format of Niantic: versions 2 and 3 (gzip) and 4 (zstd).

Layout and quantization follow the README and headers of github.com/nianticlabs/spz.
Fields follow one another for all Gaussians: 24-bit fixed-point means, opacities,
colors, logarithms of scales, rotations, harmonics. SPZ axes are right, up, back. Ours,
like those of 3DGS PLY files, are right, down, front.
"""

import gzip
import math
import struct
import zlib
from typing import NamedTuple

import numpy as np

from gaussians_jax.core.splats import LOG_SCALE_RANGE
from gaussians_jax.io.activated import unit_quaternion
from nerfies_jax.capture import extras

MAGIC = b"NGSP"
COLOR_SCALE = 0.15  # from the coefficient of the constant harmonic to [0, 1]
FRACTION_BITS = 12  # of a mean: steps of 1/4096 scene unit, range ±2048
# Largest compression ratio of deflate, also enforced by the reference reader. A header
# that claims more Gaussians is refused before anything is allocated.
MOST_EXPANSION = 1032
MOST_WINDOW = 1 << 27  # bytes allocated for decompression, zstd's default
SMALLEST_THREE_STEPS = 511 * math.sqrt(2)  # nine bits over 1/sqrt(2)

# Signs under the change between the two systems of axes, which flips y and z.
_MEAN_SIGN = np.array([1, -1, -1], np.float32)
_TURN_SIGN = np.array([1, 1, -1, -1], np.float32)  # wxyz, of F R F
# Parity of each spherical harmonic of degrees 1 to 3 under that change.
_SH_SIGN = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


class Unpacked(NamedTuple):
    """Raw parameters in our axes, as NumPy float32."""

    mean: np.ndarray  # [n, 3]
    log_scale: np.ndarray  # [n, 3]
    quaternion: np.ndarray  # [n, 4] wxyz
    opacity_logit: np.ndarray  # [n]
    sh_dc: np.ndarray  # [n, 1, 3]
    sh_rest: np.ndarray  # [n, rest, 3]
    notes: tuple[str, ...]


def decode(data: bytes) -> Unpacked:
    """Decode an SPZ file.

    Args:
      data: Bytes of the file.

    Returns:
      Raw parameters.

    Raises:
      ValueError: If the file is damaged.
    """
    if (
        data[:4] == MAGIC
        and len(data) >= 8
        and struct.unpack_from("<I", data, 4)[0] > 3
    ):
        header, parts = _open_zstd(data)
    else:
        header, parts = _open_gzip(data)
    version, count, degree, fraction_bits, flags = header
    mean, opacity, color, log_scale, turn, harmonics = parts
    steps = mean.reshape(count, 3, 3).astype(np.int32) @ np.array(
        [1, 1 << 8, 1 << 16], np.int32
    )
    steps -= (steps >= 1 << 23) * np.int32(1 << 24)
    unpack = _first_three if version == 2 else _smallest_three
    rest = (degree + 1) ** 2 - 1
    sh = harmonics.reshape(count, rest, 3).astype(np.float32)
    return Unpacked(
        mean=(steps / 2.0**fraction_bits).astype(np.float32) * _MEAN_SIGN,
        log_scale=log_scale.reshape(count, 3).astype(np.float32) / 16 - 10,
        quaternion=unpack(turn.reshape(count, -1)) * _TURN_SIGN,
        opacity_logit=logit_of_byte(opacity),
        sh_dc=(
            (color.reshape(count, 1, 3).astype(np.float32) / 255 - 0.5) / COLOR_SCALE
        ).astype(np.float32),
        sh_rest=(sh - 128) / 128 * _SH_SIGN[:rest, None],
        notes=_notes(flags),
    )


def encode(rows: Unpacked, version: int = 3) -> bytes:
    """Encode an SPZ file.

    Args:
      rows: Raw parameters.
      version: Version 2 or 3, or 4 if zstandard is installed.

    Returns:
      Bytes of the file.

    Raises:
      ValueError: If a mean exceeds the fixed-point range of 2048 scene units.
    """
    if version not in (2, 3, 4):
        raise ValueError(f"version={version}: SPZ versions 2, 3 and 4 can be written")
    count, rest = len(rows.mean), rows.sh_rest.shape[1]
    steps = np.rint(rows.mean.astype(np.float64) * 2**FRACTION_BITS * _MEAN_SIGN)
    if np.abs(steps).max() >= 1 << 23:
        raise ValueError(
            f"a mean is {np.abs(rows.mean).max():g} scene units from the origin, but "
            "SPZ ends at 2048; write a .ply file, or scale the scene down"
        )
    mean = np.ascontiguousarray(steps.astype("<i4")[..., None]).view(np.uint8)[..., :3]
    quaternion = unit_quaternion(rows.quaternion) * _TURN_SIGN
    pack = _pack_first_three if version == 2 else _pack_smallest_three
    # Clamped before scaling, because coefficients above 2e36 would overflow float32.
    # Their largest bytes stand for 1 and 10 / 3.
    sh = np.rint(np.clip(rows.sh_rest, -1, 1) * _SH_SIGN[:rest, None] * 128) + 128
    color = np.clip(rows.sh_dc, -4, 4) * (COLOR_SCALE * 255) + 127.5
    # The reference keeps 5 bits of degree 1 and 4 of the others; zeros compress well.
    step = np.where(np.arange(rest) < 3, 8, 16)[:, None]
    logit = rows.opacity_logit.astype(np.float64)
    parts = [
        mean,
        _byte(255 / (1 + np.exp(-np.clip(logit, -700, 700)))),
        _byte(color),
        _byte((np.clip(rows.log_scale, *LOG_SCALE_RANGE) + 10) * 16),
        pack(quaternion),
        _byte((sh + step // 2) // step * step),
    ]
    degree = math.isqrt(rest + 1) - 1
    parts = [np.ascontiguousarray(part).tobytes() for part in parts]
    head = struct.pack("<4sIIBBB", MAGIC, version, count, degree, FRACTION_BITS, 0)
    if version < 4:
        return gzip.compress(head + b"\0" + b"".join(parts), mtime=0)
    zstd = _zstandard()
    parts = [part for part in parts if part]
    streams = [zstd.ZstdCompressor().compress(part) for part in parts]
    sizes = [(len(p), len(part)) for p, part in zip(streams, parts, strict=True)]
    table = b"".join(struct.pack("<QQ", *size) for size in sizes)
    return head + struct.pack("<BI12x", len(parts), 32) + table + b"".join(streams)


def logit_of_byte(opacity: np.ndarray) -> np.ndarray:
    """Convert an opacity byte to a logit that is finite at 0 and at 255.

    Args:
      opacity: Opacities as bytes.

    Returns:
      Logits, whose opacity rounds to the byte.
    """
    # A quarter of a step inside the range, so that it rounds back to the same byte.
    opacity_value = np.clip(opacity.astype(np.float64), 0.25, 254.75) / 255
    return (np.log(opacity_value) - np.log1p(-opacity_value)).astype(np.float32)


def _open_gzip(data):
    if data[:4] != MAGIC and data[:2] != b"\x1f\x8b":
        raise ValueError("it begins with neither gzip nor NGSP: not an SPZ file")
    inflate = zlib.decompressobj(31)
    raw = data[:4] == MAGIC  # some tools write the contents uncompressed
    try:
        head = data[:16] if raw else inflate.decompress(data, 16)
        if len(head) < 16 or head[:4] != MAGIC:
            raise ValueError("truncated, or not an SPZ file: no NGSP header inside")
        version, count, degree, bits, flags, _ = struct.unpack("<IIBBBB", head[4:])
        sizes = _sizes(version, count, degree, bits, len(data))
        total = sum(sizes)
        if raw:
            body = data[16 : 16 + total]
        else:
            body = inflate.decompress(inflate.unconsumed_tail, total)
    except zlib.error as error:
        raise ValueError(f"the gzip stream is damaged ({error})") from error
    if len(body) < total:
        raise ValueError(
            f"truncated: {count} Gaussians need {total} bytes, but there are "
            f"{len(body)}"
        )
    values = np.frombuffer(body, np.uint8)
    return (version, count, degree, bits, flags), np.split(
        values, np.cumsum(sizes)[:-1]
    )


def _open_zstd(data):
    if len(data) < 32:
        raise ValueError(
            f"truncated: an SPZ header has 32 bytes, but there are {len(data)}"
        )
    version, count, degree, bits, flags, streams, table = struct.unpack_from(
        "<IIBBBBI", data, 4
    )
    if version != 4:
        raise ValueError(f"SPZ version {version}; versions 2, 3 and 4 can be read")
    sizes = _sizes(version, count, degree, bits, len(data))
    nonempty = [size for size in sizes if size]
    start = table + 16 * streams
    if table < 32 or start > len(data) or streams != len(nonempty):
        raise ValueError(
            f"its table of {streams} streams at byte {table} does not fit the file"
        )
    decompressor = _zstandard().ZstdDecompressor(max_window_size=MOST_WINDOW)
    parts = []
    for index, size in enumerate(nonempty):
        packed_size, unpacked_size = struct.unpack_from("<QQ", data, table + 16 * index)
        piece = data[start : start + packed_size]
        if unpacked_size != size or len(piece) < packed_size:
            raise ValueError(
                f"stream {index} has {len(piece)} of {packed_size} bytes and "
                f"decompresses to {unpacked_size}; {count} Gaussians need {size}"
            )
        try:
            # One byte more reveals a longer stream. Frames need not store their size.
            with decompressor.stream_reader(piece, read_across_frames=True) as reader:
                part = reader.read(size + 1)
        except Exception as error:
            raise ValueError(f"stream {index} is damaged ({error})") from error
        if len(part) != size:
            raise ValueError(f"stream {index} holds {len(part)} bytes, not {size}")
        parts.append(np.frombuffer(part, np.uint8))
        start += packed_size
    if len(parts) < len(sizes):
        parts.append(np.zeros(0, np.uint8))
    return (version, count, degree, bits, flags), parts


def _sizes(version, count, degree, bits, file_bytes):
    """Return the bytes of each field, after checking the header."""
    if version not in (2, 3, 4):
        raise ValueError(f"SPZ version {version}; versions 2, 3 and 4 can be read")
    if degree > 3 or bits > 23:
        raise ValueError(
            f"spherical harmonics of degree {degree} and {bits} fraction bits; at most "
            "3 and 23 can be read"
        )
    if count == 0:
        raise ValueError("it holds no Gaussians")
    rest = (degree + 1) ** 2 - 1
    sizes = [9 * count, count, 3 * count, 3 * count]
    sizes += [(3 if version == 2 else 4) * count, 3 * rest * count]
    if sum(sizes) > MOST_EXPANSION * file_bytes:
        raise ValueError(
            f"its header claims {count} Gaussians, more than {file_bytes} bytes can "
            "hold"
        )
    return sizes


def _notes(flags):
    notes = []
    if flags & 1:
        notes.append("it was made for antialiased rendering (opacity compensation)")
    if flags & 2:
        notes.append("ignored: vendor extensions")
    return tuple(notes)


def _byte(values):
    # Half away from zero as in the C++ reference, because numpy rounds half to even.
    return np.clip(np.floor(np.asarray(values, np.float64) + 0.5), 0, 255).astype(
        np.uint8
    )


def _first_three(bytes_):
    xyz = bytes_.astype(np.float32) / 127.5 - 1
    remainder = 1 - np.sum(xyz.astype(np.float64) ** 2, axis=1, keepdims=True)
    w = np.sqrt(np.maximum(remainder, 0)).astype(np.float32)
    return np.concatenate([w, xyz], axis=1)


def _pack_first_three(quaternion):
    canonical_quaternion = quaternion * np.where(quaternion[:, :1] < 0, -1, 1)
    return _byte(canonical_quaternion[:, 1:] * 127.5 + 127.5)


def _smallest_three(bytes_):
    """Decode the index of the largest component (xyzw) and the others in ten bits."""
    word = np.ascontiguousarray(bytes_).view("<u4")[:, 0]
    largest = (word >> 30).astype(int)
    xyzw = np.zeros((len(word), 4))
    remainder = np.ones(len(word))
    for axis in (3, 2, 1, 0):  # the last component has the lowest bits
        is_stored = largest != axis
        value = (word & 511) / SMALLEST_THREE_STEPS
        value = np.where(word & 512, -value, value)
        xyzw[:, axis] = np.where(is_stored, value, 0)
        remainder -= xyzw[:, axis] ** 2
        word = np.where(is_stored, word >> np.uint32(10), word)
    xyzw[np.arange(len(word)), largest] = np.sqrt(np.maximum(remainder, 0))
    return xyzw[:, [3, 0, 1, 2]].astype(np.float32)


def _pack_smallest_three(quaternion):
    xyzw = quaternion[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(axis=1)
    canonical_xyzw = xyzw * np.sign(xyzw[np.arange(len(xyzw)), largest])[:, None]
    word = largest.astype(np.uint32)
    for axis in range(4):
        size = np.floor(np.abs(canonical_xyzw[:, axis]) * SMALLEST_THREE_STEPS + 0.5)
        bits = np.minimum(size, 511).astype(np.uint32)
        bits |= (canonical_xyzw[:, axis] < 0).astype(np.uint32) << np.uint32(9)
        word = np.where(largest == axis, word, (word << np.uint32(10)) | bits)
    return word.astype("<u4")[:, None].view(np.uint8)


def _zstandard():
    return extras.library("zstandard", "spz")  # versions 2 and 3 need none
