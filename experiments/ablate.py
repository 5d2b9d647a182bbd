"""What each part of a deforming radiance field is worth, where the truth is known.

    python -m experiments.ablate
    python -m experiments.ablate --seeds 3 --steps 3000 --out runs/ablation
    python -m experiments.ablate --arms static nerfies --scene fast --budget 30

Static NeRF, T-NeRF, D-NeRF, Nerfies, and Nerfies without one of its parts learn the
same frames of a built-in scene over the same steps; the last iterate counts. Prints a
table and what it says of the claims, writes ablation.json and ablation.png. Finished
arms are kept in --out: the same command goes on where it was stopped.
"""

import dataclasses
import json
import pathlib
import sys
import time
from typing import Any, Literal, NamedTuple

from experiments import ablate_arms
from experiments import settings as run_settings
from experiments.ablate_arms import ARMS, MEASURES, Arm


@dataclasses.dataclass(frozen=True)
class Ablate:
    """Compare radiance fields with and without their parts, on a scene with a truth."""

    scene: str = "default"
    """Which built-in scene."""
    steps: int | None = None
    """Steps of training of every arm (default: the presets' own)."""
    seeds: int = 1
    """How many seeds; from two on, differences are held against their spread."""
    arms: tuple[str, ...] = ()
    """Which arms (default: all)."""
    out: pathlib.Path | None = None
    """Folder of results (default: runs/ablation-SCENE). It may hold finished arms."""
    budget: float | None = None
    """Minutes after which no arm is begun that may not end in time."""
    frames: int = 6
    """Held-out frames to render, evenly over the time."""
    tracks: int = 200
    """Points to follow, at most."""
    set: tuple[str, ...] = ()
    """Fields that are changed in every arm, as rays=256 template.width=64."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Where to compute."""


class Built(NamedTuple):
    """An arm ready to train; kept over its seeds, so that it is compiled once."""

    representation: Any
    spec: Any
    facts: Any
    model: Any
    renderer: Any
    compile_seconds: float


class Kept(NamedTuple):
    """What is left of one arm and seed when it is finished."""

    numbers: dict[str, float]
    arrays: dict[str, Any]  # colour, depth, and path where points were followed
    notes: dict[str, Any]  # steps, what stopped it, points that were ever lost


def main(arguments=None):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with run_settings.user_errors():
        asked = run_settings.parse(Ablate, arguments)
        _check(asked)
        names = asked.arms or tuple(ARMS)
        threads = {run_settings.threads_for(ARMS[name].preset) for name in names}
        run_settings.start_jax(asked.device, "all" if "all" in threads else "one")
        job = Job(asked)
    _measure_compiling()
    finished = job.run(names)
    if finished:
        from experiments import ablate_report

        ablate_report.write(job, finished)
    if len(finished) < asked.seeds * len(names):
        missing = asked.seeds * len(names) - len(finished)
        print(f"{missing} arms are left; the same command with --out {job.out} goes on")


def _check(asked):
    least = min(asked.seeds, asked.frames, asked.tracks)
    if least < 1 or not (asked.budget is None or asked.budget > 0):
        raise ValueError(
            "--seeds, --frames, --tracks and --budget are positive, got "
            f"{asked.seeds}, {asked.frames}, {asked.tracks} and {asked.budget}"
        )
    for name in asked.arms:
        if name not in ARMS:
            raise ValueError(f"--arms {name}: there are {', '.join(ARMS)}")


def _measure_compiling():
    """A program from the cache would not show what compiling it takes."""
    import jax

    jax.config.update("jax_enable_compilation_cache", False)


class Job:
    """A scene, its truth, and the folder that holds what was finished."""

    def __init__(self, asked: Ablate):
        from experiments import ablate_protocol
        from nerfies_jax.capture import synthetic

        if asked.scene not in synthetic.PRESETS:
            raise ValueError(
                f"--scene {asked.scene}: no such built-in scene; there are "
                + ", ".join(synthetic.PRESETS)
            )
        self.asked = asked
        self.out = asked.out or pathlib.Path("runs", f"ablation-{asked.scene}")
        self.out.mkdir(parents=True, exist_ok=True)
        film = synthetic.PRESETS[asked.scene]
        self.film = synthetic.digest(film)
        self.capture, truth = synthetic.cached(film, run_settings.CACHE / "scenes")
        self.known = ablate_protocol.known(
            self.capture, truth, asked.frames, asked.tracks
        )
        for name in asked.arms or ARMS:  # refuses wrong settings before any training
            self.spec(ARMS[name])
        self.built: dict[str, Built] = {}

    def spec(self, arm: Arm) -> Any:
        """The preset of an arm over the steps asked for, with what is changed in it."""
        from experiments import representations

        representation = representations.of_preset(arm.preset)
        spec = representation.presets[arm.preset]
        if self.asked.steps is not None:
            spec = representation.with_steps(spec, self.asked.steps)
        return run_settings.override(spec, (*arm.changes, *self.asked.set))

    def run(self, names) -> dict[tuple[str, int], Kept]:
        """All arms of the first seed, then of the next; read where they are kept."""
        began, longest, finished = time.monotonic(), 0.0, {}
        every = [(name, seed) for seed in range(self.asked.seeds) for name in names]
        for number, (name, seed) in enumerate(every, 1):
            kept = self._read(name, seed)
            if kept is None:
                spent = time.monotonic() - began
                if self._over(spent, longest):
                    continue
                print(
                    f"[{number}/{len(every)}] {name}, seed {seed}, after {spent:.0f} s",
                    file=sys.stderr,
                )
                kept = self._train(name, seed)
                self._write(name, seed, kept)
                longest = max(longest, time.monotonic() - began - spent)
                print("    " + _line(kept.numbers), file=sys.stderr, flush=True)
            finished[name, seed] = kept
        return finished

    def _over(self, spent, longest):
        budget = self.asked.budget
        return budget is not None and spent + longest > 60 * budget

    def _train(self, name, seed) -> Kept:
        """Train one arm from the start, and measure where it ends."""
        import jax

        from experiments import ablate_protocol, evaluate
        from nerfies_jax.training import loop

        arm = self._build(name)
        state = arm.model.init(self.capture, jax.random.key(seed))
        frames = evaluate.frames_of(self.capture, arm.model.wants)
        began = time.process_time()
        result = loop.fit(arm.model, state, frames, steps=arm.spec.steps)
        cpu_seconds = time.process_time() - began
        if result.stopped_by.startswith("SIG"):
            print(f"stopped; go on with the same command and --out {self.out}")
            raise SystemExit(130 if result.stopped_by == "SIGINT" else 143)
        scored, pictures = ablate_protocol.score_pictures(
            arm.renderer, result.state, self.capture, self.known
        )
        follow = ablate_protocol.FOLLOW.get(arm.representation.name)
        followed = None
        if follow is not None:
            followed = follow(
                arm.spec, arm.facts, result.state, self.capture, self.known
            )
        numbers = {
            **pictures,
            **ablate_protocol.score_tracks(self.known, followed),
            "train_seconds": result.seconds,
            "train_cpu_seconds": cpu_seconds,
            "compile_seconds": arm.compile_seconds,
            "render_ms": arm.renderer.ms_per_frame(len(self.known.rows)),
        }
        arrays = {"colour": evaluate.as_picture(scored.colour), "depth": scored.depth}
        notes = {"steps": result.steps, "stopped_by": result.stopped_by}
        if followed is not None:
            arrays |= {"path": followed.path, "found": followed.found}
            notes["points"] = len(followed.found)
            notes["points_ever_lost"] = int((~followed.found.all(axis=1)).sum())
        return Kept(numbers, arrays, notes)

    def _build(self, name) -> Built:
        """The arm, its step compiled by one step that is thrown away."""
        if name not in self.built:
            import jax
            import rich.console

            from experiments import evaluate, representations
            from nerfies_jax.training import loop

            spec = self.spec(ARMS[name])
            representation = representations.of_preset(ARMS[name].preset)
            facts = representation.facts_of(self.capture, spec)
            model = representation.build(spec, facts)
            first = loop.fit(
                model,
                model.init(self.capture, jax.random.key(0)),
                evaluate.frames_of(self.capture, model.wants),
                steps=1,
                console=rich.console.Console(quiet=True),
            )
            renderer = evaluate.Renderer(model, self.capture.size)
            self.built[name] = Built(
                representation, spec, facts, model, renderer, first.compile_seconds
            )
        return self.built[name]

    def _identity(self, name, seed) -> dict[str, Any]:
        """What a kept arm must have been made with to be taken over."""
        identity = {
            "scene": self.film,
            "arm": name,
            "seed": seed,
            "spec": run_settings.as_json(self.spec(ARMS[name])),
            "rows": self.known.rows.tolist(),
            "tracks": len(self.known.path),
            "start": self.known.start,
        }
        return json.loads(json.dumps(identity))  # tuples come back as lists

    def _path(self, name, seed) -> pathlib.Path:
        return self.out / f"{name}-{seed}.json"

    def _write(self, name, seed, kept):
        """Numbers last: an arm counts as finished when they are there."""
        import math

        import numpy as np

        from nerfies_jax.capture.json_files import replaced_file, write_json
        from nerfies_jax.training import checkpoint

        path = self._path(name, seed)
        with replaced_file(path.with_suffix(".npz")) as partial:
            np.savez_compressed(partial, **kept.arrays)
        numbers = {k: x if math.isfinite(x) else None for k, x in kept.numbers.items()}
        write_json(
            path,
            {
                "identity": self._identity(name, seed),
                "numbers": numbers,
                "notes": kept.notes,
                "made by": checkpoint.provenance(),
            },
        )

    def _read(self, name, seed) -> Kept | None:
        """A finished arm; ValueError where it is one of another experiment."""
        import math

        import numpy as np

        path = self._path(name, seed)
        if not path.is_file():
            return None
        with run_settings.user_errors():
            try:
                stored = json.loads(path.read_text())
                numbers = {name: stored["numbers"][name] for name in MEASURES}
                with np.load(path.with_suffix(".npz"), allow_pickle=False) as file:
                    arrays = dict(file)
                identity, notes = stored["identity"], stored["notes"]
            except (KeyError, TypeError, ValueError, OSError) as error:
                raise ValueError(
                    f"{path}: not a finished arm ({error}); remove it to run it again"
                ) from error
            if identity != self._identity(name, seed):
                raise ValueError(
                    f"{path} was made with other settings; name another --out, or "
                    "remove it to run it again"
                )
        numbers = {k: math.nan if x is None else x for k, x in numbers.items()}
        return Kept(numbers, arrays, notes)


def _line(numbers):
    shown = ("psnr", "moving_psnr", "depth_median", "track_error", "train_seconds")
    parts = (
        f"{name} {numbers[name]:.{ablate_arms.MEASURES[name].digits}f}"
        for name in shown
    )
    return ", ".join(parts)


if __name__ == "__main__":
    main()
