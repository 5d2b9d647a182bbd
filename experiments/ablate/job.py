"""Train and measure the arms of an ablation, one after the other."""

import gc
import hashlib
import os
import pathlib
import time
from typing import Any, NamedTuple

import jax
import rich.console

from experiments import cli
from experiments.ablate import measures, results, suites
from experiments.ablate.budget import Budget, affordable
from experiments.ablate.log import line, log
from experiments.ablate.results import ArmResult
from experiments.ablate.settings import Ablate
from nerfies_jax import evaluation, runs
from nerfies_jax.capture import pinholes, synthetic
from nerfies_jax.capture.json_files import scratch_folder
from nerfies_jax.capture.synthetic import truth as truths
from nerfies_jax.evaluation import heldout, moving_masks, protocol
from nerfies_jax.evaluation.lens import ThroughLens
from nerfies_jax.metrics import clock
from nerfies_jax.runs import platform, representations
from nerfies_jax.runs.config import CaptureSource
from nerfies_jax.runtime import console
from nerfies_jax.training import loop, specs

# Arms with their programs, which hold 4,000 mappings of memory and more. Linux lets a
# process have 65,530: the eighth model of one long --jobs 1 was the end of it.
KEPT_ARMS = 4
PILOT_STEPS = 150  # of a whole, short schedule, to see what a step costs
NEAR_ENOUGH = 0.1  # share of --seconds by which a first seed may miss them
# JAX's event for a program that was read from the compilation cache.
SAVED = "/jax/compilation_cache/compile_time_saved_sec"


class CompiledArm(NamedTuple):
    """A compiled method, reused for all of its seeds."""

    representation: Any
    spec: Any
    metadata: Any
    model: Any
    renderer: Any
    compile_seconds: float


class Job:
    """A capture, what is known of it, and the folder that holds what was finished."""

    def __init__(self, args: Ablate):
        self.args, self.suite = args, suites.named(args.suite)
        if args.jobs > 1 and jax.default_backend() != "cpu":
            raise ValueError(
                f"--jobs {args.jobs}: several processes would fight for one "
                f"{jax.default_backend()}; leave it out, or use --device cpu"
            )
        self._open()
        self.names = args.arms or tuple(
            name
            for name, arm in self.suite.arms.items()
            if arm.needs is None or getattr(self.capture, arm.needs) is not None
            if self.told is not None or not arm.told
        )
        untold = [name for name in self.names if self.suite.arms[name].told]
        if self.told is None and untold:
            raise ValueError(
                f"--arms {untold[0]}: starts from the truth, which "
                f"{self.capture.name} has none of; leave it out, or give a --scene"
            )
        self.seeds = args.all_seeds if args.seed is None else (args.seed,)
        for name in self.names:  # refuses wrong settings before any training
            self.spec(name, args.steps)
        stem = f"ablation-{args.suite}-{'-'.join(self.capture.name.split())}"
        if args.suite == "fields" and args.source.capture is None:
            stem = f"ablation-{args.source.scene}"
        self.out = args.out or pathlib.Path("runs", stem)
        self.budgets = []
        if args.seconds is None or args.steps is not None:
            self.budgets.append(Budget(args.steps, None, self.out))
        if args.seconds is not None:
            kind = "processor-seconds" if args.clock == "processor" else "seconds"
            folder = self.out / f"{kind}-{args.seconds:g}"
            self.budgets.append(Budget(None, args.seconds, folder, clock=args.clock))
        for budget in self.budgets:
            budget.folder.mkdir(parents=True, exist_ok=True)
        self._built: dict[tuple[str, int], CompiledArm] = {}
        self._cache_saved = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _open(self):
        """Load the capture, with ground truth if it is a built-in scene."""
        args, source = self.args, self.args.source
        if source == CaptureSource(scene=source.scene) and (
            source.scene in synthetic.PRESETS
        ):
            film = synthetic.PRESETS[source.scene]
            self.capture_digest = synthetic.digest(film)
            self.capture, truth = synthetic.cached(film, platform.CACHE / "scenes")
            self.filmed = self.capture
            self.known = protocol.ground_truth(
                self.capture, truth, args.frames, args.tracks
            )
            self.told = truths.with_truth(self.capture, truth)
            return
        self.told = None
        stored = runs.stored_capture(source)
        # All arms learn from pinholes' pictures, and are scored as it was filmed.
        self.capture = pinholes.as_pinholes(stored)
        filmed = pinholes.scorable(stored, traced=False)
        images = filmed.images.tobytes()
        self.capture_digest = hashlib.sha256(images).hexdigest()[:16]
        self.known = protocol.held_out_only(self.capture, args.frames)
        self.filmed, note = moving_masks.with_masks(filmed, platform.CACHE / "evidence")
        if note:
            log(note)

    def _listen(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event == SAVED:
            self._cache_saved += duration_secs

    def spec(self, name: str, steps: int | None) -> Any:
        """The preset of an arm over so many steps, with what is changed in it."""
        arm = self.suite.arms[name]
        representation = representations.of_preset(arm.preset)
        spec = representation.presets[arm.preset]
        if steps is not None:
            spec = representation.with_steps(spec, steps)
        return specs.override(spec, (*arm.changes, *self.args.set))

    def tasks(self) -> list[tuple[str, int]]:
        """All arms of the first seed, then of the next."""
        return [(name, seed) for seed in self.seeds for name in self.names]

    def run(self) -> list[tuple[str, int]]:
        """Train what is not finished yet.

        Returns:
          Methods and seeds that failed.
        """
        if self.args.jobs > 1:
            from experiments.ablate import pool

            cores = len(os.sched_getaffinity(0))
            if self.args.jobs > cores:
                log(f"{cores} cores for {self.args.jobs} jobs: their times will tell")
            return pool.run(self)
        began, longest = time.monotonic(), 0.0
        tasks = self.tasks()
        for number, (name, seed) in enumerate(tasks, 1):
            if self.is_finished(name, seed):
                continue
            spent = time.monotonic() - began
            if self.is_over(spent, longest):
                break
            log(f"[{number}/{len(tasks)}] {name}, seed {seed}, after {spent:.0f} s")
            for budget in self.budgets:
                self.make(name, seed, budget)
            longest = max(longest, time.monotonic() - began - spent)
        return []

    def is_over(self, spent: float, longest: float) -> bool:
        """Predict if another run would exceed the --budget.

        Args:
          spent: Seconds so far.
          longest: Seconds of the longest run.

        Returns:
          True if no further run should start.
        """
        minutes = self.args.budget
        longest = max(longest, self.args.seconds or 0)
        return minutes is not None and spent + longest > 60 * minutes

    def make(self, name: str, seed: int, budget: Budget) -> None:
        """Train an arm and write down where it ends, unless that is there already."""
        path = self.path(name, seed, budget)
        with results.claimed(path) as ours:
            if not ours:
                log(f"    {path}: another process is making it; left to that one")
                return
            if self.kept(name, seed, budget) is not None:
                return
            if budget.seconds is not None and seed == 0:
                steps, kept = self._train_for(name, budget)
            else:
                with cli.user_errors():
                    steps = self.planned_steps(name, budget)
                kept = self._train(name, seed, steps)
            identity = self.identity(name, seed, steps, budget)
            results.write(path, identity, kept)
        log("    " + line(kept.numbers))

    def _train_for(self, name, budget) -> tuple[int, ArmResult]:
        """Train the first seed for as many steps as fit into the given time.

        The cost of a step is taken from the run over --steps, or from a short pilot. It
        depends on the number of steps, because Gaussians grow. If the first try misses
        the time by too much, there is a second one, and a try that takes too long is
        stopped for it.
        """
        # Other seeds may be finished: this one stands next to them.
        found = results.steps_of(budget.folder, name)
        if found is not None:
            return found, self._train(name, 0, found)
        other = None
        if self.budgets[0] is not budget:
            other = self.kept(name, 0, self.budgets[0])
        pilot = other or self._train(name, 0, PILOT_STEPS)
        steps = affordable(pilot, budget)
        kept = self._train(name, 0, steps, (1 + NEAR_ENOUGH) * budget.seconds)
        done, took = kept.notes["steps"], kept.numbers[budget.measure]
        missed = done < steps or abs(took / budget.seconds - 1) > NEAR_ENOUGH
        if missed and kept.notes["stopped_by"] in ("steps", "seconds"):
            log(f"    {done} steps took {took:.1f} s: once more, with a better guess")
            steps = affordable(kept, budget, pilot)
            kept = self._train(name, 0, steps)
        return steps, kept

    def _train(self, name, seed, steps, at_most=None) -> ArmResult:
        """Train one arm from the start, and measure where it ends.

        `at_most` so many seconds by the clock on the wall.
        """
        compiled_before = (name, steps) in self._built
        arm = self._build(name, steps)
        told = self.suite.arms[name].told
        capture = self.told if told else self.capture
        state = arm.model.init(capture, jax.random.key(seed))
        frames = evaluation.frames_of(self.capture, arm.model.required_data)
        began, self._cache_saved = time.process_time(), 0.0
        result = loop.fit(arm.model, state, frames, steps=steps, seconds=at_most)
        cpu_seconds = result.training_share * (time.process_time() - began)
        compile_seconds = result.compile_seconds + self._cache_saved
        if result.stopped_by.startswith("SIG"):
            console.say(f"stopped; go on with the same command and --out {self.out}")
            raise SystemExit(130 if result.stopped_by == "SIGINT" else 143)
        draw = ThroughLens(arm.renderer, self.filmed.size)
        filmed = evaluation.as_found(arm.model, result.state, self.filmed)
        scored = evaluation.score(draw, result.state, filmed, self.known.rows)
        followed = arm.representation.follow(
            arm.spec, arm.metadata, result.state, self.capture, self.known
        )
        scores = heldout.heldout_metrics(
            scored, self.filmed, known=self.known, followed=followed
        )
        counts = arm.model.counts(result.state)
        numbers = {
            **measures.quality(scores, self.known.exact),
            "gaussians": float(counts.get("gaussians", float("nan"))),
            "parameters": float(counts["parameters"]),
            "steps": float(result.steps),
            "train_seconds": result.seconds,
            "train_cpu_seconds": cpu_seconds,
            "compile_seconds": arm.compile_seconds + compile_seconds,
            # Jobs side by side double what the wall clock says.
            "render_ms": arm.renderer.ms_per_frame(
                len(self.known.rows), cpu=jax.default_backend() == "cpu"
            ),
            "peak_mb": clock.peak_bytes() / 1e6,
            **_model_sizes(self.out / f"{name}-{seed}", arm, result.state),
        }
        if compiled_before:  # most of it in this very process
            numbers["compile_seconds"] = float("nan")
        if len(self._built) > 1:  # what came before it counts, too
            numbers["peak_mb"] = float("nan")
        arrays = {"color": evaluation.as_picture(scored.color), "depth": scored.depth}
        notes = {"steps": result.steps, "stopped_by": result.stopped_by}
        if followed is not None:
            arrays |= {"path": followed.path, "found": followed.found}
            notes["points"] = len(followed.found)
            notes["points_ever_lost"] = int((~followed.found.all(axis=1)).sum())
        return ArmResult(numbers, arrays, notes)

    def _build(self, name, steps) -> CompiledArm:
        """The arm, its step compiled by one step that is thrown away."""
        if (name, steps) not in self._built:
            if len(self._built) == KEPT_ARMS:
                self._built.pop(next(iter(self._built)))
                jax.clear_caches()
                gc.collect()
            spec = self.spec(name, steps)
            preset = self.suite.arms[name].preset
            representation = representations.of_preset(preset)
            metadata = representation.metadata_of(self.capture, spec)
            model = representation.build(spec, metadata)
            self._cache_saved = 0.0
            # As from a start at rest: a fit to tracks takes longer than compiling.
            begin = model.example or model.init
            first = loop.fit(
                model,
                begin(self.capture, jax.random.key(0)),
                evaluation.frames_of(self.capture, model.required_data),
                steps=1,
                console=rich.console.Console(quiet=True),
            )
            seconds = first.compile_seconds + self._cache_saved
            renderer = evaluation.Renderer(model, self.capture.size)
            self._built[name, steps] = CompiledArm(
                representation, spec, metadata, model, renderer, seconds
            )
        return self._built[name, steps]

    def planned_steps(self, name: str, budget: Budget) -> int:
        """Look up the number of steps of every seed of a method.

        Args:
          name: Name of the method.
          budget: The budget. For one in seconds, seed 0 determines the steps.

        Returns:
          Number of steps.

        Raises:
          ValueError: If no seed is finished.
        """
        if budget.seconds is None:
            return self.spec(name, budget.steps).steps
        steps = results.steps_of(budget.folder, name)
        if steps is None:
            raise ValueError(
                f"{self.path(name, 0, budget)} is not there: seed 0 of {name} finds "
                "how many steps fit into --seconds, train it first"
            )
        return steps

    def identity(self, name, seed, steps, budget) -> dict[str, Any]:
        """Settings that a stored run must share to be reused."""
        return {
            "scene": self.capture_digest,
            "arm": name,
            "seed": seed,
            "steps": steps,
            "seconds": budget.seconds,
            # As those that were kept before there was a choice.
            **({"clock": budget.clock} if budget.clock != "wall" else {}),
            "spec": specs.as_json(self.spec(name, steps)),
            **{k: x for k, x in self.measured_on().items() if k != "scene"},
        }

    def measured_on(self) -> dict[str, Any]:
        """Identity of the capture, the held-out frames and the tracked points."""
        return {
            "scene": self.capture_digest,
            "rows": self.known.rows.tolist(),
            "tracks": len(self.known.path),
            "start": self.known.start,
            # As those that were kept before what moves was scored there, too.
            **({} if self.known.exact else {"moving": "masked"}),
        }

    def path(self, name: str, seed: int, budget: Budget) -> pathlib.Path:
        """Path of a run's numbers, with its images next to them."""
        return budget.folder / f"{name}-{seed}.json"

    def kept(self, name: str, seed: int, budget: Budget) -> ArmResult | None:
        """Load a finished run. One of another experiment ends the command with exit
        code 2.
        """
        path = self.path(name, seed, budget)
        with cli.user_errors():
            if not os.path.lexists(path):
                return None
            by_time = budget.seconds is not None
            if by_time and results.steps_of(budget.folder, name) is None:
                return None
            steps = self.planned_steps(name, budget)
            return results.read(path, self.identity(name, seed, steps, budget))

    def is_finished(self, name: str, seed: int) -> bool:
        """Test if a run is finished for every budget."""
        return all(self.kept(name, seed, b) is not None for b in self.budgets)

    def finished(self, budget: Budget) -> dict[tuple[str, int], ArmResult]:
        """Return the finished results by arm and seed."""
        stored = {task: self.kept(*task, budget) for task in self.tasks()}
        return {task: kept for task, kept in stored.items() if kept is not None}

    def missing(self) -> list[tuple[str, int]]:
        """Arms and seeds that are not finished."""
        return [task for task in self.tasks() if not self.is_finished(*task)]


def _model_sizes(place, arm, state):
    """Return the size of the model file, or of the parameters if there is none, in MB.

    The second number is the entropy-coded size, NaN if the model has none.
    """
    with scratch_folder(place) as folder:
        saved = arm.representation.save(folder, arm.spec, arm.metadata, state)
    held, coded = saved.model_bytes, saved.coded_bytes
    if held is None:
        held = sum(leaf.nbytes for leaf in jax.tree.leaves(state.params))
    coded_mb = float("nan") if coded is None else coded / 1e6
    return {"model_mb": held / 1e6, "coded_mb": coded_mb}
