"""SOG version 2 of PlayCanvas: a ZIP archive of meta.json and lossless WebP images.

Each Gaussian is a pixel, in the order of a Morton curve. Positions have 16 bits a
coordinate after a symmetric logarithm, in two images. Rotations have three components
of 8 bits and the number of the fourth, largest one. Scales and colors are entries of
codebooks with 256 values, and harmonics are entries of a palette whose values are
entries of a codebook. Format: the user manual of PlayCanvas, "The SOG Format".
"""

import io
import json
import math
import zipfile
from typing import Any

import numpy as np
from PIL import Image

from gaussians_jax.core.splats import Splats
from gaussians_jax.io import packed_ply
from gaussians_jax.io.activated import opacity_of

SUFFIX = ".sog"
CODEBOOK = 256
# Entries of the palette of harmonics, and columns of its image.
MOST_PALETTE, PALETTE_COLUMNS = 65536, 64
LLOYD_STEPS = 20
_FIRST_TAG = 252  # of alpha, if the real part of a rotation is the largest


def encode(rows: Splats) -> bytes:
    """Encode Gaussians.

    Args:
      rows: Raw parameters of active Gaussians, finite, in NumPy.

    Returns:
      The file.
    """
    rows = packed_ply.along_curve(rows)
    low, high, bounds = _positions(rows.mean)
    scale_codes, scale_book = _in_codebook(
        np.clip(rows.log_scale, *packed_ply.SCALE_RANGE)
    )
    color_codes, color_book = _in_codebook(rows.sh_dc[:, 0])
    opacity = opacity_of(rows)
    files = {
        "means_l": _image(low),
        "means_u": _image(high),
        "scales": _image(scale_codes),
        "quats": _image(_rotations(rows.quaternion)),
        "sh0": _image(np.column_stack([color_codes, np.rint(255 * opacity)])),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "nerfies_jax"},
        "count": len(rows.mean),
        "means": {**bounds, "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book, "files": ["sh0.webp"]},
    }
    if rows.sh_rest.shape[1]:
        about, images = _harmonics(rows.sh_rest)
        files |= images
        meta["shN"] = {**about, "files": [f"{name}.webp" for name in images]}
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            # Without the time of writing, so that equal scenes make equal files.
            archive.writestr(zipfile.ZipInfo(f"{name}.webp"), data)
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta))
    return content.getvalue()


def _positions(mean):
    """Bytes of the symmetric logarithm of coordinates, low and high, and its bounds."""
    log_mean = np.sign(mean) * np.log1p(np.abs(mean))
    # Bounds as a reader has them, in float32.
    low = log_mean.min(axis=0).astype(np.float32).astype(np.float64)
    high = log_mean.max(axis=0).astype(np.float32).astype(np.float64)
    share = (log_mean - low) / np.where(high > low, high - low, 1)
    level = np.clip(np.rint(65535 * share), 0, 65535).astype(np.uint16)
    return level & 255, level >> 8, {"mins": low.tolist(), "maxs": high.tolist()}


def _rotations(quaternion):
    """Bytes of the three smaller components, and the tag of the largest one."""
    largest, share = packed_ply.smallest_three(quaternion)
    level = np.clip(np.rint(255 * share), 0, 255)
    return np.column_stack([level, _FIRST_TAG + largest])


def _in_codebook(values):
    """Numbers of entries of a codebook for values of any shape, and the codebook.

    Half of the entries start at quantiles, and half evenly spaced, because few values
    in the tails attract no entries. Lloyd's algorithm improves both.
    """
    sorted_values = np.sort(values, axis=None)
    sums = np.concatenate([[0.0], np.cumsum(sorted_values)])
    ranks = np.linspace(0, len(sorted_values) - 1, CODEBOOK // 2).round().astype(int)
    grid = np.linspace(sorted_values[0], sorted_values[-1], CODEBOOK // 2)
    book = np.sort(np.concatenate([sorted_values[ranks], grid]))
    for _ in range(LLOYD_STEPS):
        ends = np.searchsorted(sorted_values, (book[1:] + book[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(sorted_values)]])
        count = np.diff(ends)
        mean = np.diff(sums[ends]) / np.maximum(count, 1)
        # Rounding of sums must not unsort the entries.
        book = np.maximum.accumulate(np.where(count > 0, mean, book))
    book = np.float32(book).astype(np.float64)  # as a reader has it
    return np.searchsorted((book[1:] + book[:-1]) / 2, values), book.tolist()


def _harmonics(rest):
    """The description of the palette of harmonics, and its two images."""
    count, size = rest.shape[:2]
    labels, palette = _palette(rest.reshape(count, -1))
    codes, book = _in_codebook(palette)
    lines = math.ceil(len(palette) / PALETTE_COLUMNS)
    pixels = np.zeros((lines * PALETTE_COLUMNS, size, 3), np.uint8)
    pixels[: len(palette)] = codes.reshape(len(palette), size, 3)
    pixels = pixels.reshape(lines, PALETTE_COLUMNS * size, 3)
    split = np.column_stack([labels & 255, labels >> 8, np.zeros(count, int)])
    about = {
        "count": len(palette),
        "bands": math.isqrt(size + 1) - 1,
        "codebook": book,
    }
    return about, {"shN_centroids": _webp(pixels), "shN_labels": _image(split)}


def _palette(vectors):
    """Numbers of entries of a palette for vectors, and the palette.

    All different vectors are entries if there are few enough. Otherwise groups are
    halved at the median of the coordinate of largest variance, and an entry is the mean
    of a group.
    """
    different, labels = np.unique(vectors, axis=0, return_inverse=True)
    labels = labels.reshape(-1)
    if len(different) <= MOST_PALETTE:
        return labels, different
    group = np.zeros(len(different), int)
    for _ in range(int(math.log2(MOST_PALETTE))):
        order = np.argsort(group, kind="stable")
        starts = np.flatnonzero(np.diff(group[order], prepend=-1))
        size = np.diff(starts, append=len(order))
        number = np.repeat(np.arange(len(starts)), size)  # of sorted rows
        sorted_vectors = different[order]
        mean = np.add.reduceat(sorted_vectors, starts) / size[:, None]
        variance = np.add.reduceat((sorted_vectors - mean[number]) ** 2, starts)
        widest = np.argmax(variance, axis=1)[number]
        value = sorted_vectors[np.arange(len(order)), widest]
        inner = np.lexsort((value, number))
        rank = np.arange(len(order)) - starts[number]  # of rows sorted by value
        group[order[inner]] = 2 * number + (rank >= (size[number] + 1) // 2)
    group_ids, group = np.unique(group, return_inverse=True)
    sums = np.zeros((len(group_ids), vectors.shape[1]))
    labels = group[labels]
    np.add.at(sums, labels, vectors)
    return labels, sums / np.bincount(labels, minlength=len(group_ids))[:, None]


def _image(pixels):
    """Encode one pixel for each Gaussian, in lines from the top left."""
    count, channels = pixels.shape
    width = math.ceil(math.sqrt(count))
    height = math.ceil(count / width)
    padded_pixels = np.zeros((height * width, channels), np.uint8)
    padded_pixels[:count] = pixels
    return _webp(padded_pixels.reshape(height, width, channels))


def _webp(pixels):
    content = io.BytesIO()
    # Exact, because otherwise colors of transparent pixels are changed.
    Image.fromarray(pixels).save(content, "webp", lossless=True, exact=True)
    return content.getvalue()
