"""Looks at a capture and decides which effects it calls for; host side, no training."""

import dataclasses
import time

import numpy as np

from experiments import (
    inspect_bands,
    inspect_light,
    inspect_motion,
    inspect_outlines,
    inspect_picture,
    inspect_points,
    inspect_stored,
    inspect_transient,
    inspect_views,
)
from experiments.inspect_findings import CERTAIN, MOTION, Finding
from experiments.inspect_motion import Film
from experiments.inspect_views import Views
from nerfies_jax.capture import pinholes
from nerfies_jax.capture.capture import Capture


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
    small = inspect_views.shrunk(pinholes.as_pinholes(capture))
    looked = small.capture
    views = inspect_views.look(looked)
    points = inspect_points.own_points(looked)
    spans = inspect_views.depth_span(looked, views, points)
    films = inspect_motion.films(views, spans)
    rest = points
    if not len(points) and inspect_motion.unusable(views, films) is None:
        rest = inspect_points.followed_points(views, films)
    findings = (
        _motion(views, films, spans),
        inspect_light.exposure(views, rest),
        inspect_transient.transient(views, films),
        inspect_points.start(looked, views, films, points),
        inspect_points.background(looked, views, films, points),
        inspect_stored.depth(looked, views, films),
        inspect_stored.masks(looked, views, films),
        inspect_stored.lens(capture),
        inspect_bands.texture(looked, views, small.factor),
    )
    sheet = inspect_picture.sheet(views, films)
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
    found = inspect_motion.motion(views, films, spans)
    if found.wanted is None:
        shapes = inspect_outlines.outlines(views)
        if shapes is not None:
            return inspect_outlines.motion(views, shapes)
    return found
