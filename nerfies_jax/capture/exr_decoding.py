"""OpenEXR files as plain arrays. `decoder_child` runs this, so it imports no JAX."""

from typing import Any

import numpy as np
import OpenEXR

from nerfies_jax.capture.errors import FileError

MAX_SHOWN = 64_000_000  # pixels of the display window
MAX_FLOATS = 512_000_000  # in all channels. A 4K frame with 20 channels has 166 million


def read(path: str, header_only: bool) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the data window of the first part.

    Args:
      path: The file.
      header_only: True to leave out the pixels.

    Returns:
      Origin of the data window, size of the display window, and how many numbers there
      are; and the channels [height, width].

    Raises:
      FileError: If the file cannot be used, with the remedy but without the path.
    """
    origin, (width, height), display_size, count = _windows(path)
    about = {
        "origin": origin,
        "display_size": display_size,
        "numbers": width * height * count,
    }
    if header_only:
        return about, {}
    with OpenEXR.File(path, separate_channels=True) as file:
        # Copied: the arrays belong to the file, and `channels()` is empty once it
        # closes.
        channels = {k: np.array(v.pixels) for k, v in file.channels().items()}
    if not channels or any(c.shape != (height, width) for c in channels.values()):
        raise FileError("its pixels do not fill its window; write it again")
    return about, channels


def _windows(path):
    """Origin and size of the data window, and the size of the display window.

    The origin is relative to the display window. Both sizes are bounded before any
    pixel is decoded.
    """
    with OpenEXR.File(str(path), header_only=True) as file:
        header = file.header()  # it empties when the file closes
        data, display = (
            np.asarray(header[name], int) for name in ("dataWindow", "displayWindow")
        )
        channels = header["channels"]
        width, height = (data[1] - data[0] + 1).tolist()
        shown = tuple((display[1] - display[0] + 1).tolist())
        if not 0 < width * height * len(channels) <= MAX_FLOATS:
            raise FileError(
                f"{width}x{height} pixels of {len(channels)} channels, more "
                f"than {MAX_FLOATS} numbers; crop it or keep fewer channels"
            )
        if not (min(shown) > 0 and shown[0] * shown[1] <= MAX_SHOWN):
            raise FileError(
                f"a display window of {shown[0]}x{shown[1]} pixels; expected "
                f"1 to {MAX_SHOWN}: write it again"
            )
        if any(
            channel.xSampling != 1 or channel.ySampling != 1 for channel in channels
        ):
            raise FileError(
                "channels of different resolution (luminance-chroma); save it as RGB"
            )
    left, top = (data[0] - display[0]).tolist()
    return (left, top), (width, height), shown, len(channels)
