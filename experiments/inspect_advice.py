"""From what was found to presets and overrides for splats and for fields; no JAX."""

import dataclasses
from typing import Any

from experiments import settings as run_settings
from experiments.inspect_findings import (
    BACKGROUND,
    DEPTH,
    LIGHT,
    MOTION,
    START,
    TRANSIENT,
    Finding,
    table,
)

SPLATS, FIELDS = "splats", "fields"


@dataclasses.dataclass(frozen=True)
class Advice:
    """A preset, the fields to change in it, and what could not be decided or done."""

    representation: str
    preset: str
    overrides: tuple[str, ...]
    notes: tuple[str, ...]

    def arguments(self) -> str:
        """As on the command line of `experiments.reconstruct`."""
        words = f"--preset {self.preset}"
        return f"{words} --set {' '.join(self.overrides)}" if self.overrides else words


def advise(
    findings: tuple[Finding, ...], representation: str, full: bool = False
) -> Advice:
    """What to reconstruct with; `full` takes the papers' sizes, not those for a CPU.

    What cannot be told keeps what the preset has. Where motion itself cannot be told,
    that is a model that moves: on a still scene it costs time, on a moving one a model
    at rest loses whatever moves.
    """
    wanted = {one.effect: one.wanted for one in findings}
    notes = [
        f"{effect}: cannot tell, the preset's own setting stays"
        for effect, choice in wanted.items()
        if choice is None
    ]
    build = {SPLATS: _splats, FIELDS: _fields}[representation]
    preset, overrides, more = build(wanted, full)
    return Advice(
        representation,
        preset if full else f"{preset}-small",
        tuple(overrides),
        (*notes, *more),
    )


def representation_of(preset: str) -> str:
    """Whose preset it is, by its name alone."""
    return SPLATS if preset.startswith(run_settings.SPLATS) else FIELDS


def follow(choices: Any, findings: tuple[Finding, ...]) -> tuple[Any, list[str]]:
    """`runs.Choices` as advised, and what to tell; the user's own settings come last.

    The preset asked for says which representation and which size.
    """
    from experiments import inspect_prices

    full = not choices.preset.endswith("-small")
    advice = advise(findings, representation_of(choices.preset), full)
    costs = inspect_prices.told(findings)
    lines = [*table(findings, costs), f"effects: {advice.arguments()}"]
    lines += [f"note: {note}" for note in advice.notes]
    overrides = (*advice.overrides, *choices.overrides)
    changed = dataclasses.replace(choices, preset=advice.preset, overrides=overrides)
    return changed, lines


def _splats(wanted, full):
    overrides, notes = [], []
    preset = "splats-static" if wanted.get(MOTION) is False else "splats-deformable"
    if wanted.get(LIGHT):
        notes.append(f"{LIGHT}: splats have none; prefer the field")
    if wanted.get(TRANSIENT) and preset == "splats-static":
        notes.append(f"{TRANSIENT}: splats have no medium for it; prefer the field")
    if wanted.get(START) is False:
        overrides.append("init.source=random")
    if wanted.get(DEPTH):
        overrides.append("depth.weight=0.1")
    return preset, overrides, notes


def _fields(wanted, full):
    overrides, notes = [], []
    drifts, passes = wanted.get(LIGHT), wanted.get(TRANSIENT)
    preset = "nerf" if wanted.get(MOTION) is False else "nerfies"
    has_codes = preset == "nerfies" and full
    if drifts and not has_codes:
        overrides.append(f"appearance.width={48 if full else 4}")
    if drifts is False and has_codes:
        overrides.append("appearance=none")
    if passes and preset == "nerfies":
        # The medium takes over what moves: on the built-in scene of this name it costs
        # 1.7 dB after 1000 steps, and without a warp it brings 0.9 dB after 700.
        notes.append(
            f"{TRANSIENT}: a medium for it beside a warp was not measured to pay; "
            "what passes is left to the warp"
        )
    elif passes:
        size = (16, 4, 128) if full else (8, 2, 48)  # of NeRF-W and of its small preset
        names = ("code_width", "depth", "width")
        overrides += [f"transient.{n}={v}" for n, v in zip(names, size, strict=True)]
    if preset == "nerfies" and wanted.get(BACKGROUND) is False:
        overrides.append("background=none")
    return preset, overrides, notes
