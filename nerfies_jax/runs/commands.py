"""Shell commands that start, continue or render a run.

With a `base`, absolute paths become relative to it, so that a report can be read on
another machine.
"""

import os
import pathlib
import shlex

from nerfies_jax.runs import relative_paths
from nerfies_jax.runs.config import RunConfig

_RECONSTRUCT = ("nerfies", "reconstruct")


def resume(
    folder: pathlib.Path,
    code: tuple[str, ...] = (),
    base: pathlib.Path | None = None,
) -> str:
    """Return the command that continues a run.

    Args:
      folder: Folder of the run, which holds its settings.
      code: Names MODULE:NAME of code from other packages that the run needs.
      base: Folder that paths are relative to, or None.

    Returns:
      The command line.
    """
    words = [*_RECONSTRUCT, "--out", str(folder), "--resume", *_trust(code)]
    return _line(words, base)


def reconstruct(config: RunConfig, base: pathlib.Path | None = None) -> str:
    """Return the command that starts a run.

    Args:
      config: Config of the run.
      base: Folder that paths are relative to, or None.

    Returns:
      The command line.
    """
    words = [*_RECONSTRUCT, *config.source.arguments, "--preset", config.preset]
    if config.steps is not None:
        words += ["--steps", str(config.steps)]
    if config.seed:
        words += ["--seed", str(config.seed)]
    if config.overrides:
        words += ["--set", *config.overrides]
    return _line(words, base)


def render(
    folder: pathlib.Path,
    code: tuple[str, ...] = (),
    base: pathlib.Path | None = None,
) -> str:
    """Return the command that renders a run from a camera that moves in a circle.

    Args:
      folder: Folder of the run.
      code: Names MODULE:NAME of code from other packages that the run needs.
      base: Folder that paths are relative to, or None.

    Returns:
      The command line.
    """
    words = ["nerfies", "render", str(folder), "--path", "orbit"]
    return _line([*words, *_trust(code)], base)


def _trust(code):
    """Return the option that allows code of other packages to be loaded."""
    return ["--trust", *code] if code else []


def _line(words, base):
    if base is not None:
        words = [
            relative_paths.relative(word, base) if os.path.isabs(word) else word
            for word in words
        ]
    return shlex.join(words)
