"""Inspection of a capture without training, to recommend effects."""

import dataclasses
import pathlib
import time
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.preprocessing import (
    contact_sheet,
    exposure,
    motion,
    record,
    scene_points,
    stored,
    texture,
    transient,
    view_set,
)
from nerfies_jax.preprocessing.findings import (
    BACKGROUND,
    DEPTH,
    LENS,
    LIGHT,
    MASKS,
    MOTION,
    START,
    TEXTURE,
    TRANSIENT,
    Finding,
)
from nerfies_jax.preprocessing.record import Evidence
from nerfies_jax.preprocessing.view_set import Views
from nerfies_jax.runtime import events


@dataclasses.dataclass(frozen=True)
class Inspection:
    """Findings about a capture, with a contact sheet and the time taken."""

    findings: tuple[Finding, ...]
    sheet: np.ndarray  # [height, width, 3] uint8
    factor: int  # by which images were downsampled
    seconds: float
    views: Views
    evidence: Evidence

    def finding(self, effect: str) -> Finding:
        """Return the finding of an effect.

        Args:
          effect: Name of the effect.

        Returns:
          The finding.
        """
        return next(one for one in self.findings if one.effect == effect)


def inspect(capture: Capture, folder: pathlib.Path | None = None) -> Inspection:
    """Inspect a capture, in about 20 s for 60 frames of 176x132.

    Args:
      capture: The capture.
      folder: Cache folder of preprocessing. None for no cache.

    Returns:
      The findings.
    """
    began = time.perf_counter()
    read = _read(capture, folder)
    findings = _findings(read, EFFECTS)
    with events.stage("drawing the contact sheet"):
        sheet = contact_sheet.followed(read.views, read.evidence)
    seconds = time.perf_counter() - began
    factor = read.evidence.factor
    return Inspection(findings, sheet, factor, seconds, read.views, read.evidence)


def find(
    capture: Capture, effects: Collection[str], folder: pathlib.Path | None = None
) -> tuple[Finding, ...]:
    """Inspect a capture for some effects only.

    Args:
      capture: The capture.
      effects: Names of the effects, of `EFFECTS`.
      folder: Cache folder of preprocessing. None for no cache.

    Returns:
      Their findings.

    Raises:
      ValueError: If there is no effect with such a name.
    """
    unknown = set(effects) - set(EFFECTS)
    if unknown:
        raise ValueError(
            f"{min(unknown)!r} is no effect of an inspection; there are "
            f"{', '.join(EFFECTS)}"
        )
    return _findings(_read(capture, folder), effects)


class _Read(NamedTuple):
    """Data of an inspection."""

    capture: Capture
    small: Capture  # at the size of preprocessing
    views: Views
    evidence: Evidence
    points: np.ndarray  # of the capture, [points, 3]
    static: np.ndarray  # the same, or of preprocessing where the capture has none


def _read(capture, folder):
    if folder is None:
        evidence = record.gather(capture)
    else:
        evidence = record.cached(capture, folder)
    small = record.downscale(capture, evidence.factor)
    points = view_set.own_points(small)
    static = points
    if not len(points) and not evidence.unusable:
        static = view_set.some(evidence.static_cloud.position)
    views = view_set.in_time_order(small)
    return _Read(capture, small, views, evidence, points, static)


EFFECTS: Mapping[str, Callable[[_Read], Finding]] = MappingProxyType(
    {
        MOTION: lambda x: motion.motion(x.views, x.evidence),
        LIGHT: lambda x: exposure.exposure(x.views, x.static),
        TRANSIENT: lambda x: transient.transient(x.views, x.evidence),
        START: lambda x: scene_points.start(x.small, x.views, x.evidence, x.points),
        BACKGROUND: lambda x: scene_points.background(x.views, x.evidence, x.points),
        DEPTH: lambda x: stored.depth(x.small, x.views, x.evidence),
        MASKS: lambda x: stored.masks(x.small, x.evidence),
        LENS: lambda x: stored.lens(x.capture),
        TEXTURE: lambda x: texture.texture(x.small, x.views, x.evidence.factor),
    }
)


@events.stage("deciding on effects")
def _findings(read, effects):
    return tuple(find(read) for name, find in EFFECTS.items() if name in effects)
