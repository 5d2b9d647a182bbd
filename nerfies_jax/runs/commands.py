"""Command lines for a shell to paste: what a run was, and how it goes on."""

import pathlib
import shlex

from nerfies_jax.runs.config import RunConfig

_RECONSTRUCT = ("python", "-m", "experiments.reconstruct")


def resume(folder: pathlib.Path) -> str:
    """Go on with the run in a folder; its settings are in there."""
    return shlex.join([*_RECONSTRUCT, "--out", str(folder), "--resume"])


def reconstruct(config: RunConfig) -> str:
    """Start a run with everything that `config` says."""
    words = [*_RECONSTRUCT, *config.source.arguments, "--preset", config.preset]
    if config.steps is not None:
        words += ["--steps", str(config.steps)]
    if config.seed:
        words += ["--seed", str(config.seed)]
    if config.overrides:
        words += ["--set", *config.overrides]
    if config.effects:
        words += ["--effect", *config.effects]
    return shlex.join(words)


def render(folder: pathlib.Path) -> str:
    """Draw the run in a folder from a camera that moves in a circle."""
    words = ["python", "-m", "experiments.render", str(folder), "--path", "orbit"]
    return shlex.join(words)
