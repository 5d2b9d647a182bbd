"""Findings of an inspection: one for each effect, with a confidence."""

import dataclasses
import math
from collections.abc import Iterable, Mapping

CERTAIN, LIKELY, CANNOT_TELL = "certain", "likely", "cannot tell"
# Names of the effects in all findings.
MOTION, LIGHT, TRANSIENT = "motion", "appearance codes", "transient objects"
START, BACKGROUND = "start from points", "background points"
DEPTH, MASKS, LENS = "depth", "masks of what moves", "lens distortion"
TEXTURE = "more texture bands"
# Not an effect, but a kind of capture, which several findings together tell
# (`is_collection`).
COLLECTION = "photo collection"
# Photographs differ in light by this much (root mean square), or more.
COLLECTION_STOPS = 0.5
# Factors by which a value must differ from its threshold. The gain of an effect is
# known to a factor of two at best, so values within a quarter are undecided.
CERTAIN_FACTOR, LIKELY_FACTOR = 2.0, 1.25
DEVIATIONS = 2.0  # standard errors by which a value is first moved to its threshold


@dataclasses.dataclass(frozen=True)
class Finding:
    """Observations about one effect, as plain values for a JSON file."""

    effect: str
    evidence: str  # text about the measurements, with numbers and units
    threshold: str
    wanted: bool | None  # whether the effect is needed, None if undecided
    confidence: str
    # Measured quantities by name, with the unit in the name.
    numbers: dict[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        if (self.wanted is None) != (self.confidence == CANNOT_TELL):
            raise ValueError(
                f"{self.effect}: wanted={self.wanted} does not match confidence="
                f"{self.confidence!r}; it must be None if undecided, and only then"
            )

    @property
    def decision(self) -> str:
        """Decision as text: yes, no, or a dash if undecided."""
        return {True: "yes", False: "no", None: "-"}[self.wanted]


def judge(
    value: float | int, threshold: float | int, error: float | int
) -> tuple[bool | None, str]:
    """Decide whether a non-negative value exceeds its threshold, with a confidence.

    The value is first moved toward the threshold by two standard errors. It is
    undecided if it then reaches the threshold or is within a quarter of it. The
    decision is certain from a factor of two on.

    Args:
      value: The value.
      threshold: The threshold, positive.
      error: Standard error of the value.

    Returns:
      The decision or None, and its confidence.
    """
    if not (threshold > 0 and value >= 0 and error >= 0):
        return None, CANNOT_TELL  # also for NaN, which means not measured
    above = bool(value > threshold)
    if above:
        factor = (value - DEVIATIONS * error) / threshold
    else:
        nearer = value + DEVIATIONS * error
        factor = threshold / nearer if nearer > 0 else math.inf
    if factor < LIKELY_FACTOR:
        return None, CANNOT_TELL
    return above, CERTAIN if factor >= CERTAIN_FACTOR else LIKELY


def is_collection(findings: Iterable[Finding]) -> bool:
    """Test if frames are photographs of one scene in changing light, not a video.

    Nothing can be followed from one frame to the next, so transient objects are
    undecided and no track moves, and the light certainly differs.

    Args:
      findings: Findings about motion, transient objects and light.

    Returns:
      True for a photo collection.
    """
    by_effect = {one.effect: one for one in findings}
    if not {MOTION, TRANSIENT, LIGHT} <= by_effect.keys():
        return False
    motion, light = by_effect[MOTION], by_effect[LIGHT]
    # Outlines, which people and cars in front change as well, say nothing.
    if motion.wanted and "moving_share" in motion.numbers:
        return False
    if by_effect[TRANSIENT].wanted is not None:
        return False
    changes = light.wanted and light.confidence == CERTAIN
    return bool(changes) and light.numbers.get("drift_stops", 0) >= COLLECTION_STOPS


def cannot_tell(effect: str, reason: str, threshold: str = "") -> Finding:
    """Create an undecided finding.

    Args:
      effect: Name of the effect.
      reason: The reason.
      threshold: Description of the threshold.

    Returns:
      The finding.
    """
    return Finding(effect, reason, threshold, None, CANNOT_TELL)


def table(
    findings: tuple[Finding, ...], costs: Mapping[str, str], width: int = 110
) -> list[str]:
    """Format findings as a table for a terminal, with long texts wrapped.

    Args:
      findings: The findings.
      costs: Cost of each effect per step, as text.
      width: Width of the table in characters.

    Returns:
      Lines of text.
    """
    narrow_heads = ("effect", "decision", "confidence", "cost per step")
    heads = (*narrow_heads, "evidence", "threshold")
    rows = [
        (
            finding.effect,
            finding.decision,
            finding.confidence,
            costs[finding.effect],
            finding.evidence,
            finding.threshold,
        )
        for finding in findings
    ]
    narrow = [max(len(row[i]) for row in (heads, *rows)) for i in range(4)]
    remaining = max(width - sum(narrow) - 10, 40)
    columns = [*narrow, remaining * 3 // 5, remaining * 2 // 5]
    lines = []
    for row in (heads, tuple("-" * column for column in columns), *rows):
        cells = [_wrap(cell, size) for cell, size in zip(row, columns, strict=True)]
        for line in range(max(len(cell) for cell in cells)):
            parts = [cell[line] if line < len(cell) else "" for cell in cells]
            padded_parts = (
                part.ljust(size) for part, size in zip(parts, columns, strict=True)
            )
            lines.append("  ".join(padded_parts).rstrip())
    return lines


def _wrap(text, width):
    lines, line = [], ""
    for word in text.split():
        if line and len(line) + 1 + len(word) > width:
            lines.append(line)
            line = word
        else:
            line = f"{line} {word}".strip()
    return [*lines, line]
