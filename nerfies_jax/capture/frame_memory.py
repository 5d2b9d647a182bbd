"""Memory of the frames of a capture, shared between NumPy and JAX on the CPU.

JAX on the CPU uses the memory of a NumPy array if it is aligned, and copies it
otherwise. Readers therefore decode into aligned arrays, and training indexes all frames
of a large capture instead of copying the training frames.

Arrays above `MOST_IN_MEMORY` are mapped from a temporary file: the system reads the
frames that are used from the disk, and drops them again if memory is short.
"""

import contextlib
import errno
import math
import mmap
import os
import pathlib
import shutil
import tempfile
import threading
import time
import weakref
from typing import Any

import jax
import numpy as np

from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture

ALIGNMENT = 64  # bytes, of arrays that XLA uses without a copy
MOST_IN_MEMORY = 2 * 2**30  # bytes of an array; larger ones are mapped from a file
FOLDER = CACHE / "frames"  # of these files, which have no names
UNMAP_SECONDS = 0.25
# Images in memory while a capture is read: four threads, each with a decoded image and
# its array.
READING_IMAGES = 8
# Smaller captures are copied, so that their compiled programs depend on the training
# frames alone.
LEAST_SHARED_BYTES = 2**26

_device_limit = math.inf  # bytes, of `limit_device`


def allocate(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Allocate an array of frames that JAX on the CPU uses without a copy.

    Args:
      shape: Its shape.
      dtype: Its type.

    Returns:
      The array, filled with zeros. It is mapped from a file if it is large.

    Raises:
      OSError: If the disk has no space for the file.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size > MOST_IN_MEMORY:
        return np.ndarray(shape, dtype, _mapping(size, FOLDER))
    memory = np.zeros(size + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + size].view(dtype).reshape(shape)


def is_mapped(array: np.ndarray) -> bool:
    """Test if an array is mapped from a file.

    Args:
      array: An array or a view of it.

    Returns:
      True if it is.
    """
    owner: Any = array
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return isinstance(owner, mmap.mmap)


def _mapping(size: int, folder: pathlib.Path) -> mmap.mmap:
    """Map a temporary file, which the system deletes with the mapping."""
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if free < size:
        reason = f"{size / 2**30:.1f} GiB are needed and {free / 2**30:.1f} are free"
        raise OSError(errno.ENOSPC, reason, str(folder))
    with tempfile.TemporaryFile(dir=folder) as file:
        # Writing to a page for which the disk has no space would end the process.
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            file.truncate(size)
        mapping = mmap.mmap(file.fileno(), size)
    if hasattr(mapping, "madvise"):
        unmapping = threading.Thread(
            target=_unmap_pages, args=(weakref.ref(mapping),), daemon=True
        )
        unmapping.start()
    return mapping


def _unmap_pages(mapping: weakref.ref) -> None:
    """Return pages of a mapping to the system, while the mapping exists.

    They stay in the system's cache as long as memory is free, and do not count as
    memory of this process.
    """
    while (pages := mapping()) is not None:
        with contextlib.suppress(OSError, ValueError):  # closed
            pages.madvise(mmap.MADV_DONTNEED)
        del pages
        time.sleep(UNMAP_SECONDS)


def is_shared(capture: Capture) -> bool:
    """Test if training indexes all images of a capture, without a copy on the host.

    Args:
      capture: The capture.

    Returns:
      True for large captures on a CPU device, and for those mapped from a file.
    """
    images = capture.images
    return (
        images.nbytes >= LEAST_SHARED_BYTES
        and images.flags.c_contiguous
        and images.ctypes.data % ALIGNMENT == 0
        and (jax.default_backend() == "cpu" or is_mapped(images))
    )


def limit_device(gibibytes: float | int | None) -> None:
    """Limit the memory of each device for training frames.

    Args:
      gibibytes: Memory in GiB. None for what the device has.

    Raises:
      ValueError: If it is not positive and finite.
    """
    global _device_limit
    if gibibytes is not None and not 0 < gibibytes < math.inf:
        raise ValueError(
            f"frame_memory={gibibytes} must be a positive, finite number of GiB"
        )
    _device_limit = math.inf if gibibytes is None else gibibytes * 2**30


def device_limit(training: int = 0) -> float | int:
    """Return the memory of a device that is available for training frames.

    Args:
      training: Bytes that training needs in addition to the frames.

    Returns:
      Bytes: the limit of `limit_device`, or what training leaves of the memory of the
      device if it is less. The memory of a CPU device is not bounded.
    """
    statistics = jax.local_devices()[0].memory_stats() or {}
    limit = statistics.get("bytes_limit", math.inf)
    return min(_device_limit, max(limit - training, 0))


def check_device(needed: int) -> None:
    """Check that training frames fit in the memory of the device.

    Args:
      needed: Bytes of their images, masks and depths.

    Raises:
      ValueError: If they do not fit in `device_limit`.
    """
    limit = device_limit()
    if needed > limit:
        raise ValueError(
            f"the training frames need {needed / 2**30:.1f} GiB of memory on the "
            f"device, which has {limit / 2**30:.1f} GiB for them; read smaller images "
            "with max_side=..., or select fewer frames"
        )


def frame_bytes(capture: Capture, devices: int = 1) -> int:
    """Estimate the peak memory of the frames of a capture in reading and training.

    Args:
      capture: The capture.
      devices: Number of devices that train.

    Returns:
      Bytes of the capture on the host, plus the larger of two: the images that are
      decoded at a time, or the copies of the training frames on the host and on each
      device. CPU devices share one copy, and frames above `device_limit` have none.
    """
    image = capture.images[:1].nbytes
    copies = 0
    if not is_shared(capture) and len(capture.train) * image <= device_limit():
        devices = 1 if jax.default_backend() == "cpu" else devices
        copies = len(capture.train) * (devices + 1)
    return capture_bytes(capture) + image * max(copies, READING_IMAGES)


def capture_bytes(capture: Capture) -> int:
    """Return the memory of the images, masks and depths of a capture on the host.

    Args:
      capture: The capture.

    Returns:
      Bytes.
    """
    arrays = (capture.images, capture.valid, capture.moving, capture.depths)
    return sum(array.nbytes for array in arrays if array is not None)
