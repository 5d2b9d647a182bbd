"""One run of the benchmark, in a process of its own."""

import json
import pathlib
from typing import Any

from nerfies_jax.runs import platform, representations
from nerfies_jax.runs.config import RunConfig


def score(
    config: RunConfig, folder: pathlib.Path, seconds: float | None, alone: bool
) -> dict[str, Any]:
    """Preset, machine and metrics of one run, made in `folder` unless it is there.

    One that is `alone` on the machine takes the cores that its preset wants.
    """
    metrics = folder / "metrics.json"
    if not metrics.exists():
        wanted = representations.cores(config.preset, config.overrides)
        platform.start_jax("cpu", *(wanted if alone else ("one",)))
        from nerfies_jax import runs
        from nerfies_jax.capture.json_files import write_json
        from nerfies_jax.measure import clock

        outcome = runs.reconstruct(config, folder, seconds=seconds)
        if outcome.errors:
            raise RuntimeError(f"{folder}: {outcome.errors[0]}")
        about = {"preset": outcome.run.config.preset, "machine": clock.machine()}
        write_json(folder / "about.json", about)
    about = json.loads((folder / "about.json").read_text())
    return about | {"metrics": json.loads(metrics.read_text())}
