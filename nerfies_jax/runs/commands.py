"""Command lines for a shell to paste: what a run was, and how it goes on.

With a `base`, absolute paths become relative to it, for a page that is read elsewhere.
"""

import os
import pathlib
import shlex

from nerfies_jax.runs import relative_paths
from nerfies_jax.runs.config import RunConfig

_RECONSTRUCT = ("python", "-m", "experiments.reconstruct")


def resume(
    folder: pathlib.Path,
    effects: tuple[str, ...] = (),
    base: pathlib.Path | None = None,
) -> str:
    """Continue the run in a folder. Its settings are there, its `effects` repeated."""
    words = [*_RECONSTRUCT, "--out", str(folder), "--resume", *_trusting(effects)]
    return _line(words, base)


def reconstruct(config: RunConfig, base: pathlib.Path | None = None) -> str:
    """Start a run with everything that `config` says."""
    words = [*_RECONSTRUCT, *config.source.arguments, "--preset", config.preset]
    if config.steps is not None:
        words += ["--steps", str(config.steps)]
    if config.seed:
        words += ["--seed", str(config.seed)]
    if config.overrides:
        words += ["--set", *config.overrides]
    return _line([*words, *_trusting(config.effects)], base)


def render(
    folder: pathlib.Path,
    effects: tuple[str, ...] = (),
    base: pathlib.Path | None = None,
) -> str:
    """Render the run in a folder from a camera that moves in a circle."""
    words = ["python", "-m", "experiments.render", str(folder), "--path", "orbit"]
    return _line([*words, *_trusting(effects)], base)


def _trusting(effects):
    """The option that names the user's own effects: no folder is trusted with them."""
    return ["--effect", *effects] if effects else []


def _line(words, base):
    if base is not None:
        words = [
            relative_paths.relative(word, base) if os.path.isabs(word) else word
            for word in words
        ]
    return shlex.join(words)
