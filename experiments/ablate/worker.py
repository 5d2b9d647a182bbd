"""One arm and seed of an ablation, in a process of its own.

python -m experiments.ablate.worker SETTINGS.json
"""

import dataclasses
import json
import pathlib
import sys

from experiments import cli
from experiments.ablate import suites
from experiments.ablate.settings import Ablate
from nerfies_jax.runs import platform, representations
from nerfies_jax.training import specs


def main(path: str) -> None:
    """Train the run that a file describes. Wrong settings end with exit code 2."""
    with cli.user_errors():
        text = pathlib.Path(path).read_text()
        stored = specs.from_json(json.loads(text), Ablate)
        # Paths were stored as text.
        args: Ablate = dataclasses.replace(stored, out=pathlib.Path(stored.out))
        (name,) = args.arms
        preset = suites.named(args.suite).arms[name].preset
        threads = representations.of_preset(preset).threads
        platform.start_jax(args.device, threads)
        from experiments.ablate.job import Job

        job = Job(args)
    raise SystemExit(1 if job.run() else 0)


if __name__ == "__main__":
    main(sys.argv[1])
