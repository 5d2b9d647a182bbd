"""Settings that the runs of a benchmark were made with, and whether they still apply.

A preset may change after it was measured. A stored method keeps a digest of all of its
settings, and its page marks it if the same preset has other settings today.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any, Literal

from nerfies_jax.runs import run
from nerfies_jax.runs.config import RunConfig
from nerfies_jax.training import specs

Age = Literal["current", "old", "unknown"]
DIGITS = 16


def of_run(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Select what is stored of the settings of a run.

    Args:
      settings: Contents of its `config.json`.

    Returns:
      The preset, its steps and changes, and a digest of the complete spec.
    """
    config = settings["config"]
    return {
        "preset": config["preset"],
        "steps": config.get("steps"),
        "overrides": list(config.get("overrides", ())),
        "digest": _digest(settings["spec"]),
    }


def age(made_with: Mapping[str, Any] | None) -> Age:
    """Compare stored settings with those that the preset has today.

    Args:
      made_with: Result of `of_run`, None if the settings were not stored.

    Returns:
      "current" if they are equal, "old" if they differ or the preset no longer
      accepts the changes, and "unknown" if they were not stored.
    """
    if made_with is None:
        return "unknown"
    config = RunConfig(
        preset=made_with["preset"],
        steps=made_with["steps"],
        overrides=tuple(made_with["overrides"]),
    )
    try:
        today = specs.as_json(run.scene_spec(config))
    except ValueError:
        return "old"
    return "current" if _digest(today) == made_with["digest"] else "old"


def _digest(spec):
    text = json.dumps(_without_disabled(spec), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]


def _without_disabled(spec):
    """Remove disabled effects, so that a new one, which is None, changes nothing."""
    if isinstance(spec, dict):
        return {key: _without_disabled(x) for key, x in spec.items() if x is not None}
    return [_without_disabled(x) for x in spec] if isinstance(spec, list) else spec
