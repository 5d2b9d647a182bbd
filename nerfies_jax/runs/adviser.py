"""Recommended preset and overrides for a capture, for each representation."""

import dataclasses
from collections.abc import Callable

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation import method_curves
from nerfies_jax.evaluation.representation import Representation
from nerfies_jax.preprocessing.findings import (
    COLLECTION,
    MOTION,
    Finding,
    is_collection,
    table,
)
from nerfies_jax.runs import prices, representations
from nerfies_jax.runs.config import RunConfig
from nerfies_jax.runs.effect_choice import Trial
from nerfies_jax.runs.run import scene_spec


@dataclasses.dataclass(frozen=True)
class Advice:
    """A preset with overrides, and notes on undecided or unsupported effects."""

    representation: str
    preset: str
    overrides: tuple[str, ...]
    notes: tuple[str, ...]

    def arguments(self) -> str:
        """Return the arguments of `nerfies reconstruct` for this advice.

        Returns:
          Part of a command line.
        """
        words = f"--preset {self.preset}"
        return f"{words} --set {' '.join(self.overrides)}" if self.overrides else words


def advise(
    findings: tuple[Finding, ...],
    representation: Representation,
    full: bool = False,
    family: str | None = None,
    seconds: float | int | None = None,
) -> Advice:
    """Recommend a preset of a representation for the findings about a capture.

    Undecided effects keep the setting of the preset. If motion itself is undecided, a
    dynamic model is recommended: on a static scene it costs time, whereas a static
    model of a dynamic scene loses everything that moves.

    Args:
      findings: Findings about the capture.
      representation: The representation.
      full: True for models of the size in the papers, False for models that a CPU can
        train.
      family: Name of a preset without "-small", which is kept if it supports the
        required effects.
      seconds: Planned seconds of training, or None.

    Returns:
      The recommendation.

    Raises:
      ValueError: If the representation recommends no presets.
    """
    needs = {finding.effect: finding.wanted for finding in findings}
    notes = [
        f"{effect}: undecided, the setting of the preset is kept"
        for effect, choice in needs.items()
        if choice is None
    ]
    if representation.recommendation is None:
        raise ValueError(
            f"the {representation.name} representation recommends no presets"
        )
    needs[COLLECTION] = is_collection(findings)
    choice = representation.recommendation.advise(needs, full, family, seconds)
    if not full and family is None:
        moves = None if needs[COLLECTION] else needs.get(MOTION)
        notes += _report_curves(representation, moves, seconds)
    return Advice(
        representation.name,
        choice.preset if full else f"{choice.preset}-small",
        choice.overrides,
        (*notes, *choice.notes),
    )


def _report_curves(representation, moves, seconds):
    """Report the best curves of the presets, if the advice follows from them."""
    if moves is None:
        return []
    ranking = method_curves.ranking(representation.presets, moves, seconds)
    best = ", ".join(f"{curve.preset} {curve.psnr:.1f} dB" for curve in ranking[:3])
    budget = "complete runs" if seconds is None else f"{seconds:g} s of training"
    scenes = "with motion" if moves else "without motion"
    return [f"{budget} on built-in scenes {scenes}: {best}"] if ranking else []


def advise_all(
    findings: tuple[Finding, ...],
    full: bool = False,
    seconds: float | int | None = None,
) -> list[Advice]:
    """Recommend a preset of each installed representation.

    Args:
      findings: Findings about the capture.
      full: True for models of the size in the papers.
      seconds: Planned seconds of training, or None.

    Returns:
      One recommendation for each representation.
    """
    return [
        advise(findings, each, full, seconds=seconds)
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


def by_tracks(
    config: RunConfig,
    capture: Capture,
    seconds: float | int | None = None,
    try_out: Callable[[RunConfig, RunConfig, Capture, str], Trial] | None = None,
) -> tuple[RunConfig, list[str]]:
    """Choose a preset from the point tracks of a capture.

    If tracks cover little of what moves, the choice is compared with a static preset on
    frames left out of training, and the better one is kept.

    Args:
      config: Config without a preset.
      capture: The capture.
      seconds: Planned seconds of training, or None.
      try_out: Function that compares two configs. None trains nothing, and keeps the
        first choice.

    Returns:
      The config with preset and overrides, and lines of text with the reasons.

    Raises:
      ValueError: If no installed representation can choose a preset.
    """
    choosing = representations.choosing()
    if not choosing:
        raise ValueError(
            "preset=None: no installed representation can choose a preset; set one"
        )
    _, choose = choosing[0]
    choice = choose(capture, seconds)
    new_config, lines = _config_of_choice(config, choice), []
    other = choice.alternative
    if other is not None and try_out is not None and _is_accepted(config, other):
        trial = try_out(
            new_config, _config_of_choice(config, other), capture, other.preset
        )
        lines = [
            f"motion: after {trial.steps} steps {trial.without:.2f} dB with "
            f"{choice.preset} and {trial.with_effect:.2f} dB with {other.preset} on "
            f"{trial.frames} frames left out"
        ]
        if trial.pays:
            lines[0] += "; motion is worth less than nothing, so the scene is static"
            choice, new_config = other, _config_of_choice(config, other)
    words = [choice.preset, *(["--set"] if choice.overrides else []), *choice.overrides]
    line = f"preset: {' '.join(words)}" + "".join(f" ({n})" for n in choice.notes)
    return new_config, [*lines, line]


def _config_of_choice(config, choice):
    overrides = (*choice.overrides, *config.overrides)
    return dataclasses.replace(config, preset=choice.preset, overrides=overrides)


def _is_accepted(config, choice):
    """Test if a preset has all components that the user's overrides set."""
    try:
        scene_spec(_config_of_choice(config, choice))
    except ValueError:
        return False
    return True


def follow(
    config: RunConfig, user_overrides: tuple[str, ...], findings: tuple[Finding, ...]
) -> tuple[RunConfig, list[str]]:
    """Apply the recommendation to a config.

    The requested preset determines the representation, the family and the size. The
    other overrides of the config were chosen for that preset and are dropped if another
    preset is recommended.

    Args:
      config: The config.
      user_overrides: Overrides set by the user, which take precedence.
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
    same_preset = advice.preset == config.preset
    overrides = config.overrides if same_preset else user_overrides
    new_config = dataclasses.replace(
        config, preset=advice.preset, overrides=(*advice.overrides, *overrides)
    )
    return new_config, lines
