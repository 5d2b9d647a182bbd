"""Command lines for a shell to paste: what a run was, and how it goes on."""

import pathlib
import shlex

from nerfies_jax.runs.config import RunConfig

_RECONSTRUCT = ("python", "-m", "experiments.reconstruct")


def resume(folder: pathlib.Path, effects: tuple[str, ...] = ()) -> str:
    """Continue the run in a folder. Its settings are there, its `effects` repeated."""
    words = [*_RECONSTRUCT, "--out", str(folder), "--resume", *_trusting(effects)]
    return shlex.join(words)


def reconstruct(config: RunConfig) -> str:
    """Start a run with everything that `config` says."""
    words = [*_RECONSTRUCT, *config.source.arguments, "--preset", config.preset]
    if config.steps is not None:
        words += ["--steps", str(config.steps)]
    if config.seed:
        words += ["--seed", str(config.seed)]
    if config.overrides:
        words += ["--set", *config.overrides]
    return shlex.join([*words, *_trusting(config.effects)])


def render(folder: pathlib.Path, effects: tuple[str, ...] = ()) -> str:
    """Render the run in a folder from a camera that moves in a circle."""
    words = ["python", "-m", "experiments.render", str(folder), "--path", "orbit"]
    return shlex.join([*words, *_trusting(effects)])


def _trusting(effects):
    """The option that names the user's own effects: no folder is trusted with them."""
    return ["--effect", *effects] if effects else []
