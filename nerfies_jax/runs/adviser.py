"""From what was found to presets and overrides, one for each representation."""

import dataclasses

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.representation import Representation
from nerfies_jax.evidence.findings import Finding, table
from nerfies_jax.runs import prices, representations
from nerfies_jax.runs.config import RunConfig


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
    findings: tuple[Finding, ...],
    representation: Representation,
    full: bool = False,
    family: str | None = None,
) -> Advice:
    """What to reconstruct with; `full` takes the papers' sizes, not those for a CPU.

    `family`, a preset without "-small", is kept where it can do what is called for.

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
    choice = representation.advise(wanted, full, family)
    return Advice(
        representation.name,
        choice.preset if full else f"{choice.preset}-small",
        choice.overrides,
        (*notes, *choice.notes),
    )


def advise_all(findings: tuple[Finding, ...], full: bool = False) -> list[Advice]:
    """One for each representation that is installed."""
    return [
        advise(findings, each, full) for each in representations.installed().values()
    ]


def advise_for(findings: tuple[Finding, ...], preset: str) -> Advice:
    """In the family and size of a preset."""
    family = preset.removesuffix("-small")
    kind = representations.of_preset(preset)
    return advise(findings, kind, full=family == preset, family=family)


def by_tracks(config: RunConfig, capture: Capture) -> tuple[RunConfig, list[str]]:
    """A config that names no preset with the one its capture calls for, and why."""
    chooses = [
        each.default_preset
        for each in representations.installed().values()
        if each.default_preset is not None
    ]
    if not chooses:
        raise ValueError("name a preset: nothing that is installed has a default one")
    choice = chooses[0](capture)
    words = [choice.preset, *(["--set"] if choice.overrides else []), *choice.overrides]
    lines = [f"preset: {' '.join(words)}" + "".join(f" ({n})" for n in choice.notes)]
    overrides = (*choice.overrides, *config.overrides)
    changed = dataclasses.replace(config, preset=choice.preset, overrides=overrides)
    return changed, lines


def follow(
    config: RunConfig, own: tuple[str, ...], findings: tuple[Finding, ...]
) -> tuple[RunConfig, list[str]]:
    """A config as advised, and what to tell; the user's `own` overrides come last.

    The preset asked for says which representation, which family and which size. Other
    overrides of the config belong to that preset, and stay only with it.
    """
    advice = advise_for(findings, config.preset)
    lines = [
        *table(findings, prices.format_prices(findings)),
        f"effects: {advice.arguments()}",
    ]
    lines += [f"note: {note}" for note in advice.notes]
    kept = config.overrides if advice.preset == config.preset else own
    changed = dataclasses.replace(
        config, preset=advice.preset, overrides=(*advice.overrides, *kept)
    )
    return changed, lines
