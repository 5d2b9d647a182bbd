"""Inspect a capture, then train presets on it as they are and as advised."""

import math
import pathlib
from typing import Any, NamedTuple

import numpy as np

from experiments import cli, inspect_scene
from experiments.ablate import pool
from experiments.ablate.job import Job, log
from experiments.ablate.settings import Ablate
from experiments.inspect_pays import arms
from nerfies_jax import runs
from nerfies_jax.capture import cache_files
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation import pictures
from nerfies_jax.evidence import inspection
from nerfies_jax.evidence.findings import Finding
from nerfies_jax.runs import adviser, representations
from nerfies_jax.runs.config import CaptureSource
from nerfies_jax.training import specs

FOUND, LOOKED = "inspected.json", "findings 1"  # the file, and what it holds


class ArmMeans(NamedTuple):
    """One way to train, over all seeds: means; NaN where not known."""

    psnr: float  # dB, held-out frames
    depth: float  # median error, scene units
    seconds: float  # of the processor, training alone
    runs: int


class Comparison(NamedTuple):
    """A preset on a capture against what was advised for it."""

    capture: str
    preset: str
    advised: str  # the preset and what is changed in it
    notes: tuple[str, ...]
    same: bool  # the advice is the preset as it is
    refused: str  # why the preset cannot be built on the capture; empty if it can
    before: ArmMeans | None  # None where not trained
    after: ArmMeans | None


def read(
    args: Any, capture: pathlib.Path | None, scene: str = "default"
) -> tuple[str, CaptureSource, Capture]:
    """A capture's name, how it is read, and itself; ValueError where it cannot be."""
    own = capture is not None
    source = CaptureSource(
        capture=capture,
        scene=scene,
        factor=args.factor if own else None,
        max_side=args.max_side if own else None,
        heldout=args.heldout if own else None,
    )
    stored = runs.stored_capture(source)
    if not len(stored.heldout):
        raise ValueError(
            f"{capture}: no held-out frames to judge by; choose some with --heldout, "
            "as --heldout 8 for every eighth"
        )
    return capture.absolute().name if own else scene, source, stored


class Trial:
    """A capture, what was found in it, and the runs that tell what it was worth."""

    def __init__(self, args: Any, name: str, source: CaptureSource, stored: Capture):
        self.args, self.name, self._source = args, name, source
        self._stored = stored
        self.folder = args.out / name
        self.folder.mkdir(parents=True, exist_ok=True)
        self._findings: tuple[Finding, ...] | None = None
        self._job: Job | None = None
        self._refused: dict[str, str] = {}  # arms that cannot be built, and why

    def findings(self) -> tuple[Finding, ...]:
        """As kept, or looked for now; ValueError where another capture's are kept."""
        if self._findings is not None:
            return self._findings
        path = self.folder / FOUND
        args = specs.as_json(self._source)
        kept = cache_files.read(path, _findings_at)
        if kept is not None:
            read_as, self._findings = kept
            if read_as != args:
                raise ValueError(
                    f"{path}: the capture was read otherwise; name another --out"
                )
            return self._findings
        log(f"{self.name}: looking at it")
        inspected = inspection.inspect(self._stored, CACHE / "evidence")
        pictures.save(inspected.sheet, self.folder / "inspected.png")
        advice = adviser.advise_all(inspected.findings)
        findings = inspect_scene.as_json(self._stored, inspected, advice)
        cache_files.write_json(path, {"read as": args, **findings}, LOOKED)
        self._findings = inspected.findings
        return self._findings

    def advice(self, preset: str) -> adviser.Advice:
        """In the representation and size of a preset."""
        return adviser.advise_for(self.findings(), preset)

    def pairs(self) -> dict[str, str]:
        """By preset, the arm that is advised in its place."""
        return {
            preset: arms.name_of(self.advice(preset)) for preset in self.args.presets
        }

    def run(self) -> list[tuple[str, int]]:
        """Train what is not there yet; returns the arms and seeds that failed."""
        with cli.user_errors():
            differ = [pair for pair in self.pairs().items() if len({*pair}) > 1]
            names = dict.fromkeys(name for pair in differ for name in pair)
            if not names:
                return []
            args = self.args
            self._job = Job(
                Ablate(
                    suite="advice",
                    arms=tuple(names),
                    source=self._source,
                    steps=args.steps,
                    seeds=args.seeds,
                    jobs=args.jobs,
                    out=self.folder,
                    frames=args.frames,
                    set=args.set,
                    device="cpu",
                )
            )
        self._refused = dict(filter(None, map(self._reason, names)))
        self._job.names = tuple(name for name in names if name not in self._refused)
        for name, reason in self._refused.items():
            log(f"{self.name}: {name} cannot be built: {reason}")
        log(f"{self.name}: {', '.join(self._job.names)}")
        return pool.run(self._job)

    def _reason(self, name):
        """Why an arm cannot be built on the capture, with its name; None if it can."""
        spec = self._job.spec(name, self.args.steps)
        representation = representations.of_preset(self._job.suite.arms[name].preset)
        try:
            metadata = representation.metadata_of(self._job.capture, spec)
            representation.build(spec, metadata)
        except ValueError as error:
            return name, str(error)
        return None

    def rows(self) -> list[Comparison]:
        """One for each preset, with what has been trained by now."""
        finished = {}
        if self._job is not None:
            (budget,) = self._job.budgets
            finished = self._job.finished(budget)
        rows = []
        for preset, advised in self.pairs().items():
            before, after = (_side(finished, name) for name in (preset, advised))
            rows.append(
                Comparison(
                    capture=self.name,
                    preset=preset,
                    advised=advised,
                    notes=self.advice(preset).notes,
                    same=preset == advised,
                    refused=self._refused.get(preset, ""),
                    before=before,
                    after=after,
                )
            )
        return rows


def _findings_at(path):
    """How the capture was read, and what was found in it."""
    stored = cache_files.read_json(path, LOOKED)
    return stored["read as"], tuple(Finding(**one) for one in stored["findings"])


def _side(finished, name):
    kept = [one.numbers for (arm, _), one in finished.items() if arm == name]
    if not kept:
        return None
    psnr, depth, seconds = (
        float(np.mean([one.get(key, math.nan) for one in kept]))
        for key in ("psnr", "depth_median", "train_cpu_seconds")
    )
    return ArmMeans(psnr, depth, seconds, len(kept))
