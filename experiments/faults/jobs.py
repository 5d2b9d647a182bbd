"""Tiny jobs of each kind: their commands, and what tells two results apart."""

import hashlib
import json
import os
import pathlib
import subprocess
import sys
from collections.abc import Callable
from typing import NamedTuple

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Programs are compiled in half the time.
ROUGH = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
COMMON = ("--evaluate-every", "2", "--checkpoint-every", "0", "--set")
SPLATS = ("strategy=none", "sh_degree=0", "init.extra_random=0")
MOTION = ("motion.width=8", "motion.depth=2", "motion.skips=")
FIELD = (
    *("rays=32", "sampling.coarse=4", "sampling.fine=4", "background=none"),
    *("template.skips=", "template.depth=1", "template.width=8"),
    "template.color_width=8",
)
SWEEP = (
    *("--suite", "presets", "--methods", "splats-static-small", "splats-mcmc-small"),
    *("--steps", "20", "--seeds", "1", "--jobs", "2"),
    *("--set", "sh_degree=0", "init.extra_random=0"),
)
LITTER = ("*.partial*", "*.earlier", "*.unfinished*")


class Bench:
    """The folder of a campaign, with what its jobs read."""

    def __init__(self, folder: pathlib.Path):
        self.folder = folder
        self.work = folder / "work"
        self.work.mkdir(exist_ok=True)
        cache = folder / "cache"
        self.environment = {
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "XDG_CACHE_HOME": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PLATFORMS": "cpu",
            "PJRT_NPROC": "1",
            "XLA_FLAGS": ROUGH,
        }
        self.filmed = folder / "filmed"
        if not self.filmed.exists():
            scene = ("--frames", "6", "--size", "40", "30", "--set")
            tiny = ("supersampling=1", "points=200", "tracks=8")
            self.call("make_scene", self.filmed, *scene, *tiny)
        self.clip = folder / "clip"
        if not self.clip.exists():
            from experiments.faults import clip

            clip.write(self.clip)

    def command(self, *words: object) -> list[str]:
        """A command of this package."""
        return [sys.executable, "-m", "experiments", *map(str, words)]

    def call(self, *words: object, cwd: pathlib.Path | None = None) -> None:
        """Run a command that must succeed."""
        done = subprocess.run(
            self.command(*words),
            cwd=cwd or self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise ValueError(f"{words}: exit code {done.returncode}: {done.stderr}")

    def run_of(self, name: str) -> pathlib.Path:
        """The run that was never disturbed."""
        return self.folder / "references" / name / "out"


class Job(NamedTuple):
    """A job that works in a folder and writes its result to `out` in it."""

    command: Callable[[Bench, pathlib.Path], list[str] | None]  # None: it is complete
    result: Callable[[pathlib.Path], dict[str, str]]  # digests by name
    whole: Callable[[pathlib.Path], dict[str, str]]  # of what is finished already
    before: Callable[[Bench, pathlib.Path], None] = lambda bench, work: None
    needs: str | None = None  # the job whose run it reads


def _digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _files(folder):
    if not folder.is_dir():
        return {"out": _digest(folder)} if folder.is_file() else {}
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): _digest(path) for path in paths}


def _state(work):
    return _state_of(work / "out")


def _state_of(run):
    """The bits of the last checkpoint, the score and the names of the products."""
    last = max((run / "checkpoints").iterdir(), key=lambda path: int(path.name))
    about = json.loads((last / "about.json").read_text())
    bits = {name: str(note["crc32"]) for name, note in about["leaves"].items()}
    metrics = json.loads((run / "metrics.json").read_text())
    products = sorted(path.name for path in run.iterdir() if path.name[0] != ".")
    score = {"step": last.name, "psnr": repr(metrics["heldout.psnr"])}
    return bits | score | dict.fromkeys(products, "there")


def _saved(work):
    """Whole checkpoints: later ones replace them, but one at least must stay."""
    folder = work / "out/checkpoints"
    names = [path.name for path in folder.glob("*") if path.name.isdigit()]
    return {"a checkpoint": "there"} if names else {}


def _trains(preset, steps, *changes):
    def command(bench, work):
        out = work / "out"
        if (out / "config.json").exists():
            return bench.command("reconstruct", "--out", out, "--resume")
        words = ("--preset", preset, "--steps", steps, "--out", out, *COMMON, *changes)
        return bench.command("reconstruct", bench.filmed, *words)

    return Job(command, _state, _saved)


def _prepare(bench, work):
    if (work / "out").exists():
        return None
    words = ("pictures", bench.clip, work / "out", "--passes", "1", "--threads", "1")
    return bench.command("prepare", *words)


def _export(bench, work, frames=5):
    words = (bench.run_of("moving"), "ply", "--frames", frames, "--overwrite")
    return bench.command("export", *words, "--out", work / "out")


def _render(bench, work, frames=5):
    words = ("--path", "sway", "--frames", frames, "--overwrite")
    out = ("--out", work / "out")
    return bench.command("render", bench.run_of("moving"), *words, *out)


def _earlier(command):
    """Write an earlier result, of other frames, into the folder."""

    def write(bench, work):
        done = subprocess.run(
            command(bench, work, frames=4),
            env=bench.environment,
            cwd=work,
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise ValueError(f"the earlier result: {done.stderr}")

    return write


def _whole_folder(work):
    """The earlier result, which a process killed in the middle of a replacement leaves
    under another name.
    """
    moved = next(work.glob(".out.*.earlier"), work / "out")
    return _files(work / "out" if (work / "out").exists() else moved)


def _sweep(bench, work):
    words = (bench.filmed, *SWEEP, "--out", work / "out")
    return bench.command("benchmark", *words)


def _finished_runs(work):
    """The state of each finished run, which other runs must not touch."""
    runs = {path.parent for path in (work / "out").rglob("metrics.json")}
    return {run.name: json.dumps(_state_of(run)) for run in sorted(runs)}


def _everything(work):
    return _files(work / "out")


JOBS = {
    "splats": _trains("splats-static-small", 40, *SPLATS),
    "moving": _trains("splats-deformable-small", 40, *SPLATS, *MOTION),
    "field": _trains("nerf-small", 40, *FIELD),
    "prepare": Job(_prepare, _everything, _everything),
    "export": Job(_export, _everything, _whole_folder, _earlier(_export), "moving"),
    "render": Job(_render, _everything, _whole_folder, _earlier(_render), "moving"),
    "sweep": Job(_sweep, _finished_runs, _finished_runs),
}
# A sweep takes six times as long as an export.
ORDER = (
    *("splats", "export", "prepare", "render", "moving", "export"),
    *("field", "render", "prepare", "export", "sweep", "render"),
)


def litter(work: pathlib.Path) -> list[str]:
    """Partial files and folders that are left."""
    found = [path for pattern in LITTER for path in work.rglob(pattern)]
    return sorted(str(path.relative_to(work)) for path in found)
