"""Looks at a capture and decides which effects it calls for; host side, no training."""

import dataclasses
import time

import numpy as np

from nerfies_jax.capture import pinholes
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evidence import (
    contact_sheet,
    exposure,
    motion,
    outlines,
    scene_points,
    stored,
    texture,
    transient,
    view_set,
)
from nerfies_jax.evidence.findings import CERTAIN, MOTION, Finding
from nerfies_jax.evidence.motion import Film
from nerfies_jax.evidence.view_set import Views


@dataclasses.dataclass(frozen=True)
class Inspection:
    """What was found, the contact sheet, and how long it took."""

    findings: tuple[Finding, ...]
    sheet: np.ndarray  # [height, width, 3] uint8
    factor: int  # pictures were looked at this many times smaller
    seconds: float
    views: Views
    films: list[Film]

    def finding(self, effect: str) -> Finding:
        """The one of an effect."""
        return next(one for one in self.findings if one.effect == effect)


def inspect(capture: Capture) -> Inspection:
    """Everything that can be told of a capture; about half a minute for 70 frames."""
    began = time.perf_counter()
    small = view_set.shrunk(pinholes.as_pinholes(capture))
    looked = small.capture
    views = view_set.look(looked)
    points = scene_points.own_points(looked)
    spans = view_set.depth_span(looked, views, points)
    films = motion.films(views, spans)
    rest = points
    if not len(points) and motion.unusable(views, films) is None:
        rest = scene_points.followed_points(views, films)
    findings = (
        _motion(views, films, spans),
        exposure.exposure(views, rest),
        transient.transient(views, films),
        scene_points.start(looked, views, films, points),
        scene_points.background(looked, views, films, points),
        stored.depth(looked, views, films),
        stored.masks(looked, views, films),
        stored.lens(capture),
        texture.texture(looked, views, small.factor),
    )
    sheet = contact_sheet.sheet(views, films)
    seconds = time.perf_counter() - began
    return Inspection(findings, sheet, small.factor, seconds, views, films)


def _motion(views, films, spans):
    """By paths of pixels, or by outlines where views are too far apart to follow."""
    if np.ptp(views.time) == 0:
        return Finding(
            MOTION,
            "all frames have the same time: a motion has nothing to depend on",
            "two times",
            False,
            CERTAIN,
        )
    finding = motion.motion(views, films, spans)
    if finding.wanted is None:
        shapes = outlines.outlines(views)
        if shapes is not None:
            return outlines.motion(views, shapes)
    return finding
