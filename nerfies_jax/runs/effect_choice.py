"""Effects of a new run, chosen by an inspection and by short training runs."""

import dataclasses
import io
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import rich.console

from nerfies_jax import evaluation
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation import Renderer
from nerfies_jax.preprocessing import inspection
from nerfies_jax.preprocessing.findings import CERTAIN, DEPTH, LIGHT, Finding
from nerfies_jax.runs import representations, validation
from nerfies_jax.runs.config import RunConfig
from nerfies_jax.runs.run import Run, initial_state, new_run, scene_spec, with_steps
from nerfies_jax.runtime import events, stopping
from nerfies_jax.training import loop

# Motion is chosen with the preset. The other effects of an inspection change no preset
# of Gaussian splats.
CHOSEN = (LIGHT, DEPTH)
STEPS = 300  # of a trial, for images of up to `PIXELS`. Larger ones have fewer.
MIN_STEPS = 100
PIXELS = 176 * 132
LEFT_OUT = 6  # A trial leaves out one in six training frames, at most `MAX_LEFT_OUT`.
MAX_LEFT_OUT = 8
MIN_GAIN = 0.1  # dB. Differences between seeds are about as large.


class Trial(NamedTuple):
    """Result of two short training runs that differ in one effect."""

    steps: int
    frames: int  # training frames that were left out and scored
    without: float  # PSNR in dB
    with_effect: float  # PSNR in dB

    @property
    def pays(self) -> bool:
        """True if the effect improves frames left out of training."""
        return self.with_effect - self.without >= MIN_GAIN


def choose(
    config: RunConfig,
    capture: Capture,
    user_overrides: tuple[str, ...] = (),
    try_out: Callable[[RunConfig, RunConfig, Capture, str], Trial] | None = None,
) -> tuple[RunConfig, list[str]]:
    """Enable the effects that a capture needs.

    Effects that the inspection calls certain are enabled. Those that it calls likely
    are tried in two short training runs, and enabled if they improve frames that were
    left out. A component that the user has set is not changed.

    Args:
      config: Config with a preset.
      capture: The capture, as `stored_capture` returns it.
      user_overrides: Overrides set by the user.
      try_out: Function that compares the configs without and with overrides. None for
        `compare_configs`.

    Returns:
      The config with further overrides before those of the user, and lines of text
      with the reasons.
    """
    findings = inspection.find(capture, CHOSEN, CACHE / "evidence")
    lines = []
    for finding in findings:
        overrides = _overrides(config, finding, user_overrides)
        if not overrides:
            continue
        text = f"{finding.effect} ({finding.confidence}: {finding.evidence})"
        if finding.confidence != CERTAIN:
            changed = dataclasses.replace(
                config, overrides=(*config.overrides, *overrides)
            )
            trial = (try_out or compare_configs)(
                config, changed, capture, " ".join(overrides)
            )
            text += (
                f"; after {trial.steps} steps {trial.without:.2f} dB without and "
                f"{trial.with_effect:.2f} dB with on {trial.frames} frames left out"
            )
            if not trial.pays:
                lines.append(f"effects: not {' '.join(overrides)}, for {text}")
                continue
        lines.append(f"effects: {' '.join(overrides)}, for {text}")
        config = _with(config, overrides, user_overrides)
    return config, lines


def _overrides(config: RunConfig, finding: Finding, user_overrides) -> tuple[str, ...]:
    """Return the overrides of a finding for components that the user has not set."""
    representation = representations.of_preset(config.preset_name)
    recommendation = representation.recommendation
    if recommendation is None:
        return ()
    needs = {finding.effect: finding.wanted}
    overrides = recommendation.effect_overrides(needs, scene_spec(config))
    user_set = {_component(text) for text in user_overrides}
    return tuple(text for text in overrides if _component(text) not in user_set)


def _component(override):
    """Return the first name of the path of an override."""
    return override.partition("=")[0].partition(".")[0]


def _with(config, overrides, user_overrides):
    """Insert overrides before those of the user, which come last."""
    before = config.overrides[: len(config.overrides) - len(user_overrides)]
    return dataclasses.replace(config, overrides=(*before, *overrides, *user_overrides))


def compare_configs(
    config: RunConfig, changed: RunConfig, capture: Capture, name: str
) -> Trial:
    """Train two configs for a few steps, and score both.

    Every 6th training frame is left out of both, and the two models are scored on these
    frames, by the protocol of the changed model: if it has a code for each frame, codes
    are fitted to the left half and the right half is scored.

    Args:
      config: Config with a preset.
      changed: Another config with a preset.
      capture: The capture, as `stored_capture` returns it.
      name: Name of the change, for messages about progress.

    Returns:
      The scores.

    Raises:
      KeyboardInterrupt: If the process was asked to stop.
    """
    with events.stage(f"trying {name}"):
        short = [_short_run(each, capture) for each in (config, changed)]
        train, times = short[0].capture.train, short[0].capture.times
        count = min(max(len(train) // LEFT_OUT, 1), MAX_LEFT_OUT)
        rows = validation.spread_over_time(train, times, count)
        without, with_effect = (
            _score(run, short[1], _train(run, rows), rows) for run in short
        )
    return Trial(short[0].spec.steps, len(rows), without, with_effect)


def _short_run(config: RunConfig, capture: Capture) -> Run:
    """Return a run with the steps of a trial, fewer for large images."""
    run = new_run(config, capture)
    width, height = run.capture.size
    steps = round(STEPS * min(PIXELS / (width * height), 1))
    return with_steps(run, min(max(steps, MIN_STEPS), run.spec.steps))


def _train(run: Run, rows: np.ndarray):
    capture = dataclasses.replace(
        run.capture, train=np.setdiff1d(run.capture.train, rows), heldout=rows
    )
    frames = validation.frames_for(run, capture)
    silent = rich.console.Console(file=io.StringIO())
    result = loop.fit(
        run.model, initial_state(run), frames, steps=run.spec.steps, console=silent
    )
    if result.stopped_by in stopping.NAMES:
        raise KeyboardInterrupt(f"{result.stopped_by} while an effect was tried")
    return result.state


def _score(run: Run, fitted_as: Run, state, rows: np.ndarray) -> float:
    """Return the PSNR of frames, by the protocol of another run of the capture."""
    size = run.capture.size
    scorer = run.representation.scoring.half_scorer(
        fitted_as.spec, fitted_as.metadata, size
    )
    if scorer is not None:
        return evaluation.known_mean(scorer(state, run.capture, rows).psnr)
    renderer = Renderer(run.model, size)
    scores = evaluation.score(renderer, state, run.capture, rows)
    return evaluation.known_mean(scores.psnr)
