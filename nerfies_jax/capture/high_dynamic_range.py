"""Tone mapping of HDR video (HLG, PQ) to 8-bit sRGB, with one curve for all frames.

Nothing adapts to single frames, so equal brightness in two frames gives equal color.
Diffuse white is at 203 nits (ITU-R BT.2408) and maps to white in sRGB. Values below
half of that keep their brightness, and brighter ones are compressed, up to 1000 nits.
FFmpeg's filter for this (zscale) is not part of PyAV.
"""

import functools
from typing import Literal

import numpy as np

from nerfies_jax.capture.srgb import srgb_from_linear

Transfer = Literal["HLG", "PQ"]
# Keys are FFmpeg's numbers of the transfer characteristics (ITU-T H.273, table 3).
TRANSFERS: dict[int, Transfer] = {16: "PQ", 18: "HLG"}
BRIGHTEST_NITS, WHITE_NITS = 1000.0, 203.0
CODES = 2**16
# ITU-R BT.2087-0: linear BT.2020 to linear BT.709, which sRGB shares.
_TO_SRGB = np.array(
    [
        [1.6605, -0.5876, -0.0728],
        [-0.1246, 1.1329, -0.0083],
        [-0.0182, -0.1006, 1.1187],
    ],
    np.float32,
)
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)  # of BT.2020
# SMPTE ST 2084 (PQ), and ITU-R BT.2100-2, table 5 (HLG).
_M1, _M2 = 2610 / 16384, 2523 / 4096 * 128
_C1, _C2, _C3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
_A = 0.17883277
_B, _C = 1 - 4 * _A, 0.5 - _A * np.log(4 * _A)
HLG_GAMMA = 1.2  # system gamma for a display of `BRIGHTEST_NITS`


def tone_mapped(code: np.ndarray, transfer: Transfer) -> np.ndarray:
    """Convert BT.2020 code values to sRGB.

    Args:
      code: uint16 code values, [..., 3].
      transfer: "PQ" or "HLG".

    Returns:
      uint8 sRGB, [..., 3].
    """
    if transfer == "PQ":
        nits = _nits_of_pq()[code]
    else:
        scene = _scene_of_hlg()[code]
        luminance = np.maximum(scene @ _LUMINANCE, np.finfo(np.float32).tiny)
        gain = BRIGHTEST_NITS * luminance ** (HLG_GAMMA - 1)
        nits = scene * gain[..., None].astype(np.float32)
    # The brightest channel sets the gain of all three, which preserves the hue.
    brightest = nits.max(axis=-1)
    display_peak = _roll_off()[_table_index(brightest, BRIGHTEST_NITS)]
    display = nits * (display_peak / np.maximum(brightest, 1e-3))[..., None]
    linear = display @ _TO_SRGB.T / WHITE_NITS
    return _srgb_bytes()[_table_index(linear, 1.0)]


def _table_index(values, largest):
    """Indices into tables of `CODES` entries over 0 to `largest`."""
    share = np.clip(values / np.float32(largest), 0, 1)
    return (share * (CODES - 1) + 0.5).astype(np.uint16)


@functools.cache
def _nits_of_pq():
    root = np.linspace(0, 1, CODES) ** (1 / _M2)
    return _from_root(root).astype(np.float32)


def _from_root(root):
    """Nits of PQ code values to the power of 1 / m2."""
    return 1e4 * (np.maximum(root - _C1, 0) / (_C2 - _C3 * root)) ** (1 / _M1)


def _pq_of_nits(nits):
    power = (nits / 1e4) ** _M1
    return ((_C1 + _C2 * power) / (1 + _C3 * power)) ** _M2


@functools.cache
def _scene_of_hlg():
    code = np.linspace(0, 1, CODES)
    bright = (np.exp((code - _C) / _A) + _B) / 12
    return np.where(code <= 0.5, code**2 / 3, bright).astype(np.float32)


@functools.cache
def _roll_off():
    """Displayed nits by recorded nits: the EETF of ITU-R BT.2390-11, section 5.4.1."""
    peak = _pq_of_nits(BRIGHTEST_NITS)
    source = _pq_of_nits(np.linspace(0, BRIGHTEST_NITS, CODES)) / peak
    top = _pq_of_nits(WHITE_NITS) / peak
    knee = 1.5 * top - 0.5
    t = (source - knee) / (1 - knee)
    spline = (
        (2 * t**3 - 3 * t**2 + 1) * knee
        + (t**3 - 2 * t**2 + t) * (1 - knee)
        + (3 * t**2 - 2 * t**3) * top
    )
    target = np.where(source < knee, source, spline)
    return _from_root((target * peak) ** (1 / _M2)).astype(np.float32)


@functools.cache
def _srgb_bytes():
    srgb = srgb_from_linear(np.linspace(0, 1, CODES))
    return np.round(255 * srgb).astype(np.uint8)
