"""One run of the benchmark, in a process of its own."""

import pathlib
from typing import Any

from experiments import kept
from nerfies_jax.runs import platform, representations, run_folder
from nerfies_jax.runs.config import RunConfig

# What must be in the files of a finished run.
SCORED, MADE = {"heldout.psnr": object}, {"preset": str, "machine": dict}


def score(
    config: RunConfig, folder: pathlib.Path, seconds: float | None, alone: bool
) -> dict[str, Any]:
    """Preset, machine and metrics of one run, made in `folder` unless it is there.

    One that was interrupted goes on. One that is `alone` on the machine takes the cores
    that its preset wants. ValueError where the folder holds a run of another capture.
    """
    metrics, about = folder / "metrics.json", folder / "about.json"
    begun = (folder / run_folder.CONFIG).exists()
    if begun:
        _check_capture(config, folder)
    if None in (kept.one(metrics, SCORED), kept.one(about, MADE)):
        wanted = representations.cores(config.preset, config.overrides)
        platform.start_jax("cpu", *(wanted if alone else ("one",)))
        from nerfies_jax import runs
        from nerfies_jax.capture.json_files import write_json
        from nerfies_jax.metrics import clock

        if begun:
            outcome = runs.resume(folder)
        else:
            outcome = runs.reconstruct(config, folder, seconds=seconds)
        if outcome.errors:
            raise RuntimeError(f"{folder}: {outcome.errors[0]}")
        if not metrics.exists():
            stopped = outcome.result.stopped_by
            raise RuntimeError(
                f"{folder}: stopped ({stopped}); the same command goes on"
            )
        preset = outcome.run.config.preset
        write_json(about, {"preset": preset, "machine": clock.machine()})
    made = kept.one(about, MADE)
    assert made is not None, about
    return made | {"metrics": kept.one(metrics, SCORED)}


def _check_capture(config, folder):
    """Refuse the numbers of another capture whose folder has the same name."""
    from nerfies_jax.runs.reconstruction import Refused
    from nerfies_jax.runs.run import read_config

    there = read_config(folder).source.capture
    wanted = config.source.capture
    if there == wanted or (there and wanted and run_folder.is_of(there, wanted)):
        return
    raise Refused(
        f"{folder}: holds a run of {there}, and {wanted} is asked for; name another "
        "--out"
    )
