"""Detail of the texture, as a number of bands of a positional encoding."""

import math

import numpy as np

from nerfies_jax.capture import scene_metadata
from nerfies_jax.capture.capture import Capture
from nerfies_jax.preprocessing import view_set
from nerfies_jax.preprocessing.findings import CERTAIN, LIKELY, Finding, cannot_tell
from nerfies_jax.preprocessing.findings import TEXTURE as EFFECT
from nerfies_jax.preprocessing.view_set import Views

SMALL = 8  # bands of the small presets of radiance fields
ENERGY = 0.95  # share of the gradient energy below the highest relevant frequency
SHOWN = 8  # frames whose spectra are computed


def bands_for(cycles_per_unit: float) -> int:
    """Return the number of bands sin 2^k x whose last one reaches a frequency.

    Args:
      cycles_per_unit: Frequency in cycles per unit of the coordinates.

    Returns:
      The number of bands, at least 1.
    """
    return max(1, 1 + math.ceil(math.log2(max(2 * math.pi * cycles_per_unit, 1))))


def texture(capture: Capture, views: Views, factor: int) -> Finding:
    """Estimate the number of bands that the texture needs in a field of extent 1.

    It is derived from the spectrum of the images at the median depth.

    Args:
      capture: The capture.
      views: Its frames.
      factor: Reduction of the frames, compared with the capture's images, which may
        hold finer detail.

    Returns:
      The finding.
    """
    threshold = f"{SMALL} bands, as in the small presets of radiance fields"
    frames = [frame for frame in _sample(views) if views.valid[frame].mean() > 0.5]
    if not frames:
        return cannot_tell(
            EFFECT, "plain background fills most of the views", threshold
        )
    cycles = float(np.median([_finest(views.gray[frame]) for frame in frames]))
    near, far = view_set.depth_span(capture, views)
    depth = math.sqrt(near * far)
    scale = scene_metadata.metadata_of(capture, 1.0).scale
    per_unit = cycles * views.intrinsics[0, 0, 0] / depth / scale
    bands = bands_for(per_unit)
    evidence = (
        f"{ENERGY:.0%} of the detail is coarser than {1 / cycles:.1f} px at 1/{factor} "
        f"of the size, which is {1 / per_unit:.3g} of the half-side of a field: "
        f"{bands} bands"
    )
    numbers = {"finest_px": 1 / cycles * factor, "bands": float(bands)}
    sure = CERTAIN if abs(bands - SMALL) > 1 else LIKELY
    return Finding(EFFECT, evidence, threshold, bands > SMALL, sure, numbers)


def _sample(views):
    return np.unique(np.linspace(0, len(views.row) - 1, SHOWN).round().astype(int))


def _finest(gray):
    """Return the cycles per pixel below which `ENERGY` of the gradients lie.

    Noise, which is assumed to be white, is estimated at the highest frequencies.
    """
    height, width = gray.shape
    window = np.hanning(height)[:, None] * np.hanning(width)
    power = np.abs(np.fft.fft2((gray - gray.mean()) * window)) ** 2
    across, down = np.fft.fftfreq(width), np.fft.fftfreq(height)
    frequency = np.hypot(*np.meshgrid(across, down))
    noise = np.median(power[frequency > 0.45])
    slope = np.maximum(power - noise, 0) * frequency**2
    order = np.argsort(frequency.ravel())
    total = np.cumsum(slope.ravel()[order])
    if not total[-1] > 0:
        return 1 / max(width, height)
    at = min(int(np.searchsorted(total, ENERGY * total[-1])), len(order) - 1)
    return float(np.clip(frequency.ravel()[order][at], 1 / width, 0.5))
