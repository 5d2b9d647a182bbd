"""From what was found to presets and overrides for splats and for fields."""

import dataclasses

from experiments.inspect_findings import Finding

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

    What cannot be told keeps the default of `experiments.reconstruct`, a model that
    moves: on a still scene it costs time, and the other way round all that moves.
    """
    wanted = {one.effect: one.wanted for one in findings}
    numbers = {one.effect: one.numbers for one in findings}
    notes = []
    for effect, choice in wanted.items():
        if choice is None:
            notes.append(f"{effect}: cannot tell, the preset's own setting stays")
    build = {SPLATS: _splats, FIELDS: _fields}[representation]
    preset, overrides, more = build(wanted, numbers)
    preset = preset if full else f"{preset}-small"
    return Advice(representation, preset, tuple(overrides), (*notes, *more))


def _splats(wanted, numbers):
    overrides, notes = [], []
    preset = "splats-static" if wanted.get("motion") is False else "splats-deformable"
    if wanted.get("appearance codes"):
        notes.append(
            "appearance codes: splats have none; the drift ends up in their colours, "
            "so prefer the field"
        )
    if wanted.get("transient"):
        notes.append("transient: splats have no medium for it; prefer the field")
    if wanted.get("start from points") is False:
        overrides.append("start.source=random")
    if wanted.get("depth") and wanted.get("motion") is not False:
        notes.append("depth: --preset sonata-small has a loss that uses it")
    if preset == "splats-deformable" and "time_bands" in numbers.get("motion", {}):
        overrides.append(f"motion.time.bands={numbers['motion']['time_bands']:.0f}")
    return preset, overrides, notes


def _fields(wanted, numbers):
    overrides, notes = [], []
    moves, passes = wanted.get("motion"), wanted.get("transient")
    drifts = wanted.get("appearance codes")
    if moves is False:
        preset = "nerf-w" if passes or drifts else "nerf"
        if preset == "nerf-w" and not passes:
            overrides.append("transient=none")
        if preset == "nerf-w" and drifts is False:
            overrides.append("appearance=none")
        return preset, overrides, notes
    preset = "nerfies"
    if drifts is False:
        overrides.append("appearance=none")
    if wanted.get("background points") is False:
        overrides.append("background=none")
    if passes:
        notes.append(
            "transient: nerfies-small has no medium for what comes and goes; its warp "
            "codes take what they can"
        )
    return preset, overrides, notes
