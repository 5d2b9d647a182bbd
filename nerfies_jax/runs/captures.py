"""Captures of runs: read from a folder, or rendered from a built-in scene."""

import dataclasses
import os
import pathlib

from nerfies_jax import capture as formats
from nerfies_jax.capture import gate, pinholes, synthetic
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.preprocessing import external_files
from nerfies_jax.runs.config import CaptureSource


def load_capture(
    folder: str | os.PathLike,
    *,
    factor: int | None = None,
    max_side: int | None = None,
    heldout: int | str | None = None,
) -> Capture:
    """Read a capture of any supported format, with its lens distortion.

    Args:
      folder: Folder of the capture.
      factor: Read images at 1/`factor` of their full size.
      max_side: Longest side of the images in pixels. Mutually exclusive with `factor`.
      heldout: Frames to evaluate: n for every n-th, or the name of a split. None for
        the split stored with the capture.

    Returns:
      The capture, on the host.

    Raises:
      ValueError: If it cannot be read.
    """
    return read_capture(
        CaptureSource(
            capture=pathlib.Path(folder),
            factor=factor,
            max_side=max_side,
            heldout=None if heldout is None else str(heldout),
        )
    )


def built_in_scene(name: str = "default", seed: int = 0) -> Capture:
    """Render the capture of a built-in synthetic scene.

    Args:
      name: Name of the scene, a key of `nerfies_jax.capture.synthetic.PRESETS`.
      seed: Seed of the hand-held camera motion.

    Returns:
      The capture.

    Raises:
      ValueError: If there is no scene with that name.
    """
    return read_capture(CaptureSource(scene=name), seed)


def read_capture(source: CaptureSource, seed: int = 0) -> Capture:
    """Read a capture, and mark the pixels for which its lens model has no ray.

    Args:
      source: The capture and the way to read it.
      seed: Seed of a built-in scene.

    Returns:
      The capture.
    """
    return pinholes.scorable(stored_capture(source, seed))


def stored_capture(source: CaptureSource, seed: int = 0) -> Capture:
    """Read a capture with its lens distortion.

    Args:
      source: The capture and the way to read it.
      seed: Seed of a built-in scene.

    Returns:
      The capture, on the host.

    Raises:
      ValueError: If it cannot be read as requested.
    """
    capture = external_files.attached(_load(source, seed), source.files)
    gate.check_observed(capture)
    if source.preprocessing is None:
        return capture
    return dataclasses.replace(capture, preprocessing=source.preprocessing)


def _load(source, seed):
    if source.capture is None:
        return _built_in_capture(source, seed)
    heldout = source.heldout
    if heldout is not None and heldout.isdigit():
        heldout = int(heldout)
    return formats.load(
        source.capture,
        factor=source.factor,
        max_side=source.max_side,
        heldout=heldout,
        missing=source.missing,
        times=source.files.times,
    )


def _built_in_capture(source, seed):
    if source.scene not in synthetic.PRESETS:
        raise ValueError(
            f"scene={source.scene}: no such built-in scene; "
            + known_names(source.scene, synthetic.PRESETS)
        )
    if source.files.times is not None:
        raise ValueError(
            f"times={source.files.times}: timestamps can only be set for a capture; "
            "a built-in scene defines its own"
        )
    for name in ("factor", "max_side", "heldout"):
        value = getattr(source, name)
        if value is not None:
            raise ValueError(
                f"{name}={value} applies to captures only; render the built-in scene "
                "to a folder with experiments.make_scene, and use that as the capture"
            )
    return synthetic.cached(synthetic.PRESETS[source.scene], CACHE / "scenes", seed)[0]
