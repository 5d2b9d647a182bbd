"""OpenEXR files as plain arrays. It runs in `decoder_child`, so it imports no JAX."""

from typing import Any

import numpy as np
import OpenEXR

from nerfies_jax.capture.errors import FileError

MAX_SHOWN = 64_000_000  # pixels of the display window
MAX_FLOATS = 512_000_000  # of all channels; a 4K frame with 20 has 166 million


def read(path: str, header_only: bool) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the data window of the first part.

    Args:
      path: The file.
      header_only: True to leave out the pixels.

    Returns:
      Origin of the data window, size of the display window and number of values as a
      dict; and the channels [height, width].

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
        # Copies, since the arrays belong to the file and vanish when it closes.
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
        header = file.header()  # is emptied when the file closes
        data, display = (
            np.asarray(header[name], int) for name in ("dataWindow", "displayWindow")
        )
        channels = header["channels"]
        width, height = (data[1] - data[0] + 1).tolist()
        display_size = tuple((display[1] - display[0] + 1).tolist())
        if not 0 < width * height * len(channels) <= MAX_FLOATS:
            raise FileError(
                f"{width}x{height} pixels of {len(channels)} channels, more "
                f"than {MAX_FLOATS} values; crop it or keep fewer channels"
            )
        if not (
            min(display_size) > 0 and display_size[0] * display_size[1] <= MAX_SHOWN
        ):
            raise FileError(
                f"a display window of {display_size[0]}x{display_size[1]} pixels; "
                f"expected 1 to {MAX_SHOWN} pixels, so write it again"
            )
        if any(
            channel.xSampling != 1 or channel.ySampling != 1 for channel in channels
        ):
            raise FileError(
                "channels of different resolution (luminance-chroma); save it as RGB"
            )
    left, top = (data[0] - display[0]).tolist()
    return (left, top), (width, height), display_size, len(channels)
