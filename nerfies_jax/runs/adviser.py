"""Presets and overrides recommended for a capture, one for each representation."""

import dataclasses

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.representation import Representation
from nerfies_jax.preprocessing.findings import Finding, table
from nerfies_jax.runs import prices, representations
from nerfies_jax.runs.config import RunConfig


@dataclasses.dataclass(frozen=True)
class Advice:
    """A preset with overrides, and notes on undecided or impossible requests."""

    representation: str
    preset: str
    overrides: tuple[str, ...]
    notes: tuple[str, ...]

    def arguments(self) -> str:
        """Return the arguments of `experiments.reconstruct` for this advice.

        Returns:
          Words of a command line.
        """
        words = f"--preset {self.preset}"
        return f"{words} --set {' '.join(self.overrides)}" if self.overrides else words


def advise(
    findings: tuple[Finding, ...],
    representation: Representation,
    full: bool = False,
    family: str | None = None,
) -> Advice:
    """Recommend a preset of a representation for the findings about a capture.

    Undecided effects keep the setting of the preset. If motion itself is undecided, a
    dynamic model is recommended: on a static scene it costs time, whereas a static
    model of a dynamic scene loses everything that moves.

    Args:
      findings: Findings about the capture.
      representation: The representation.
      full: True for the sizes of the papers, False for sizes that a CPU can train.
      family: A preset without "-small", kept if it supports the required effects.

    Returns:
      The recommendation.

    Raises:
      ValueError: If the representation recommends no presets.
    """
    wanted = {one.effect: one.wanted for one in findings}
    notes = [
        f"{effect}: cannot tell, the preset's own setting stays"
        for effect, choice in wanted.items()
        if choice is None
    ]
    if representation.recommendation is None:
        raise ValueError(
            f"the {representation.name} representation recommends no presets"
        )
    choice = representation.recommendation.advise(wanted, full, family)
    return Advice(
        representation.name,
        choice.preset if full else f"{choice.preset}-small",
        choice.overrides,
        (*notes, *choice.notes),
    )


def advise_all(findings: tuple[Finding, ...], full: bool = False) -> list[Advice]:
    """Recommend a preset of each installed representation.

    Args:
      findings: Findings about the capture.
      full: True for the sizes of the papers.

    Returns:
      One recommendation for each representation.
    """
    return [
        advise(findings, each, full)
        for each in representations.installed().values()
        if each.recommendation is not None
    ]


def advise_for(findings: tuple[Finding, ...], preset: str) -> Advice:
    """Recommend a preset in the family and size of another preset.

    Args:
      findings: Findings about the capture.
      preset: Name of the preset.

    Returns:
      The recommendation.
    """
    family = preset.removesuffix("-small")
    kind = representations.of_preset(preset)
    return advise(findings, kind, full=family == preset, family=family)


def by_tracks(config: RunConfig, capture: Capture) -> tuple[RunConfig, list[str]]:
    """Choose the preset of a config that names none, by tracks in the capture.

    Args:
      config: Config without a preset.
      capture: The capture.

    Returns:
      The config with preset and overrides, and lines of text with the reasons.

    Raises:
      ValueError: If no installed representation chooses presets.
    """
    choosing = representations.choosing()
    if not choosing:
        raise ValueError("name a preset: nothing that is installed has a default one")
    _, choose = choosing[0]
    choice = choose(capture)
    words = [choice.preset, *(["--set"] if choice.overrides else []), *choice.overrides]
    lines = [f"preset: {' '.join(words)}" + "".join(f" ({n})" for n in choice.notes)]
    overrides = (*choice.overrides, *config.overrides)
    changed = dataclasses.replace(config, preset=choice.preset, overrides=overrides)
    return changed, lines


def follow(
    config: RunConfig, own: tuple[str, ...], findings: tuple[Finding, ...]
) -> tuple[RunConfig, list[str]]:
    """Apply the recommendation to a config.

    The requested preset determines the representation, the family and the size. Other
    overrides of the config belong to that preset, and stay only with it.

    Args:
      config: The config.
      own: The user's own overrides, which come last.
      findings: Findings about the capture.

    Returns:
      The changed config, and lines of text.
    """
    advice = advise_for(findings, config.preset_name)
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
