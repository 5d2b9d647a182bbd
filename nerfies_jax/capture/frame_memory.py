"""Memory of the frames of a capture, shared between NumPy and JAX on the CPU.

JAX on the CPU uses the memory of a NumPy array if it is aligned, and copies it
otherwise. Readers therefore decode into aligned arrays, and training indexes all frames
of a large capture instead of copying the training frames.
"""

import math
from typing import Any

import jax
import numpy as np

from nerfies_jax.capture.capture import Capture

ALIGNMENT = 64  # bytes, of arrays that XLA uses without a copy
# Images in memory while a capture is read: four threads, each with a decoded image and
# its array.
READING_IMAGES = 8
# Smaller captures are copied, so that their compiled programs depend on the training
# frames alone.
LEAST_SHARED_BYTES = 2**26


def aligned_empty(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Allocate an array that JAX on the CPU uses without a copy.

    Args:
      shape: Its shape.
      dtype: Its type.

    Returns:
      The array, not initialized.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.empty(size + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + size].view(dtype).reshape(shape)


def is_shared(capture: Capture) -> bool:
    """Test if training on this device indexes all images of a capture in place.

    Args:
      capture: The capture.

    Returns:
      True if no copy of the images is needed.
    """
    images = capture.images
    return (
        images.nbytes >= LEAST_SHARED_BYTES
        and images.flags.c_contiguous
        and images.ctypes.data % ALIGNMENT == 0
        and jax.default_backend() == "cpu"
        and jax.local_device_count() == 1
    )


def frame_bytes(capture: Capture, devices: int = 1) -> int:
    """Estimate the peak memory of the frames of a capture in reading and training.

    Args:
      capture: The capture.
      devices: Number of devices that train.

    Returns:
      Bytes of the capture on the host, plus the larger of two: the images that are
      decoded at a time, or the copies of the training frames on the host and on each
      device.
    """
    image = capture.images[:1].nbytes
    copies = 0
    if not is_shared(capture):
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
