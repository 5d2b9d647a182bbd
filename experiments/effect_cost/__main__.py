"""Cost of each effect of a scene, by itself and together with the others.

    python -m experiments.effect_cost
    python -m experiments.effect_cost --presets sonata-small --repeats 9
    python -m experiments.effect_cost --check runs/effect_cost/effect_cost.json

For every preset: the bare scene, the bare scene with each effect alone (and its
requirements), the whole preset, and the whole preset without each effect, or without a
part that is priced separately (ADC-GS' bits, EDGS' mask, SC-GS' rigidity). For the loss
and the training step it tabulates the compiler's counts (flops, bytes accessed,
temporary memory), the matrix products with every iteration of every loop, the
parameters, the compilation time and the processor time of warm calls, with all scenes
of a preset in turn. Steps are scanned in tens, as a run does for all but expensive
ones. A run is priced at `--at` of its steps, after every warm-up.

The price of an effect alone is a difference from the scene without it. Prices do not
add up exactly, because the compiler fuses neighboring operations. Prints the table,
saves effect_cost.json, effect_cost.md and effect_cost.png.
"""

import dataclasses
import pathlib
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

from experiments import cli
from nerfies_jax.runs import platform, run_folder
from nerfies_jax.runtime import console

PRESETS = (
    "nerf-w-small",
    "nerfies-small",
    "hypernerf-small",
    "nsff-small",
    "tineuvox-small",
    "nerf-ds-small",
    "splats-deformable-small",
    "sonata-small",
    "moba-small",
    "splats-static-small",
    "splats-tracked-small",
    "dynmf-small",
    "spacetime-small",
    "spline-small",
    "4dgs-small",
    "e-d3dgs-small",
    "sc-gs-small",
    "edgs-small",
    "d-miso-small",
    "adc-gs-small",
    "motion-gs-small",
)
# Effects that no preset has, as paths of --set, and the preset they are priced beside.
BESIDE = {
    "splats-static-small": ("exposure.learning_rate=0.01", "poses=PoseRefinementSpec"),
    "motion-gs-small": ("poses=PoseRefinementSpec",),
}
# Parts of effects by the names of their rows, and how --set leaves them out.
PARTS = {
    "adc-gs-small": {"bits": "motion.rate=none"},
    "edgs-small": {"mask": "motion.mask=none"},
    "sc-gs-small": {"rigidity": "motion.rigidity=none"},
}
# Without these the effect on the left cannot be there, or does nothing.
NEEDS = {
    "elastic": ("warp",),
    "background": ("warp",),
    "temporal_opacity": ("motion",),
    "mask": ("warp",),
    "alternation": ("motion",),
    "acceleration": ("motion",),
    "neighbors": ("motion",),
    "motion_growth": ("motion",),
    "flow": ("motion",),
}
PROGRAMS = ("loss", "step")


@dataclasses.dataclass(frozen=True)
class EffectCost:
    """Tabulate what the effects of presets cost."""

    presets: tuple[str, ...] = PRESETS
    """Presets to measure on the built-in scene."""
    at: float = 0.4
    """Share of a run's steps that is behind the step that is priced."""
    rows: int | None = None
    """Gaussians that a scene of splats starts from (default: the preset's)."""
    rays: int | None = None
    """Rays of a step of a radiance field (default: the preset's)."""
    repeats: int = 5
    """Timed calls of every program, in turn. The table has the medians."""
    out: pathlib.Path | None = None
    """Folder for effect_cost.json, .md and .png (default: runs/effect_cost)."""
    check: pathlib.Path | None = None
    """An earlier effect_cost.json: says what got worse since, exit code 1 if any."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Device to compute on."""

    def __post_init__(self):
        if not self.presets:
            raise ValueError("--presets: name at least one")
        if not 0 <= self.at < 1:
            raise ValueError(f"--at {self.at}: a share of the steps, from 0 to below 1")
        for name in ("rows", "rays", "repeats"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name} {value} must be at least 1")


class PricedScene(NamedTuple):
    """One scene of a preset's table."""

    name: str  # "bare", "only warp", "warp + elastic", "all", "without warp"
    effect: str | None  # that is priced
    base: str | None  # the arm that its price is a difference from
    spec: Any


class Priced(NamedTuple):
    """Cost of one program of one scene."""

    flops: float
    bytes_accessed: float
    temporary_bytes: int
    matrix_flops: float
    at_least: bool  # of the matrix products: some loops run longer than is known
    compile_seconds: float  # of the processor
    seconds: float  # of the processor, median
    wall_seconds: float


class SceneCost(NamedTuple):
    """All that was measured of one scene."""

    arm: PricedScene
    parameters: int
    programs: dict[str, Priced]  # by the names in PROGRAMS


@cli.command(EffectCost)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    with cli.user_errors():
        platform.start_jax(args.device, "one")
        import jax

        # Compiling is one of the prices; JAX asks once, when it first compiles.
        jax.config.update("jax_enable_compilation_cache", False)
        from experiments.effect_cost import report
        from nerfies_jax.metrics import baselines

        before = None
        if args.check is not None:
            before = baselines.read(args.check, "effect_cost.json")
        tables = {name: _arms(name, args) for name in args.presets}
        folder = run_folder.new_run_folder(args.out, "effect_cost")
    console.say(report.heading())
    rows = {}
    for name, scenes in tables.items():
        rows[name] = measure(name, scenes, args.at, args.repeats)
        console.say(report.table(name, rows[name]))
    metrics = report.write(folder, rows, args)
    console.say(f"saved in {folder}")
    worse = [] if before is None else baselines.changes(metrics, before)
    if before is not None:
        console.say("\n".join(worse) or f"nothing is worse than in {args.check}")
    return cli.Ended(cli.stored(folder / "effect_cost.json"), 1 if worse else 0)


def _arms(name, args):
    from nerfies_jax.training import specs

    spec = _spec(name, args)
    parts = PARTS.get(name, {})
    return arms(
        spec, {part: specs.override(spec, [off]) for part, off in parts.items()}
    )


def _spec(name, args):
    from gaussians_jax.init import points as initialization
    from nerfies_jax.runs import representations
    from nerfies_jax.training import specs

    preset = representations.of_preset(name).presets[name]
    spec = specs.override(preset, BESIDE.get(name, ()))
    if hasattr(spec, "start"):  # of no step; and tracks take a minute to be found
        spec = dataclasses.replace(
            spec, start=dataclasses.replace(spec.start, motion="none")
        )
    if hasattr(spec, "init"):  # and of no more Gaussians than beside tracks
        init = initialization.of_start(spec.init, tracked=True)
        spec = dataclasses.replace(spec, init=init)
    if args.rays is not None and hasattr(spec, "rays"):
        spec = dataclasses.replace(spec, rays=args.rays)
    if args.rows is not None and hasattr(spec, "init"):
        init = dataclasses.replace(spec.init, source="random", random=args.rows)
        most = max(spec.strategy.cap_max or args.rows, args.rows)
        densification = dataclasses.replace(spec.strategy, cap_max=most)
        spec = dataclasses.replace(spec, init=init, strategy=densification)
    return spec


def effects_in(spec: Any) -> list[str]:
    """The names of the effects that a scene has, in the order of its settings."""
    return [
        field.name
        for field in dataclasses.fields(spec)
        if field.name != "coarse"  # a network's size, and no effect
        and field.default is None
        and dataclasses.is_dataclass(getattr(spec, field.name))
    ]


def without(spec: Any, names: tuple[str, ...]) -> Any:
    """The scene without these effects and without what needs them."""
    gone = set(names)
    gone |= {name for name, needed in NEEDS.items() if gone & {*needed}}
    return dataclasses.replace(spec, **dict.fromkeys(gone & {*effects_in(spec)}))


def arms(spec: Any, parts: Mapping[str, Any]) -> list[PricedScene]:
    """Assemble the scenes of a preset's table.

    Args:
      spec: Settings of the preset.
      parts: Settings without each separately priced part.

    Returns:
      Scenes by name.

    Raises:
      ValueError: If the preset has no effect.
    """
    names = effects_in(spec)
    if not names:
        raise ValueError(
            "--presets: one of them has no effect to be priced; choose from "
            + ", ".join(PRESETS)
        )

    def only(*kept):
        return without(spec, tuple(name for name in names if name not in kept))

    priced = [PricedScene("bare", None, None, only())]
    for name in names:
        needed = tuple(x for x in NEEDS.get(name, ()) if x in names)
        base = f"only {needed[0]}" if needed else "bare"
        title = f"{needed[0]} + {name}" if needed else f"only {name}"
        priced.append(PricedScene(title, name, base, only(name, *needed)))
    whole = "all"
    if len(names) == 1:
        whole = priced[-1].name  # the only one is all there is
    else:
        priced.append(PricedScene(whole, None, "bare", spec))
        parts = {name: without(spec, (name,)) for name in names} | dict(parts)
    for name, rest in parts.items():
        priced.append(PricedScene(f"without {name}", name, whole, rest))
    return priced


def measure(
    preset: str, scenes: list[PricedScene], at: float, repeats: int
) -> list[SceneCost]:
    """Compile the programs of every scene once and time all of them in turn."""
    from nerfies_jax import runs
    from nerfies_jax.metrics import clock
    from nerfies_jax.runs import representations
    from nerfies_jax.runs.config import CaptureSource
    from nerfies_jax.training import chunk

    representation = representations.of_preset(preset)
    capture = runs.read_capture(CaptureSource())
    # The same scene may stand under several names: "without" the one effect is "bare".
    first = {arm.spec: arm.name for arm in reversed(scenes)}
    calls: dict[str, Callable[[], Any]] = {}
    counted = {}
    for spec, arm_name in first.items():
        programs, counted[spec] = _compile(representation, capture, spec, at)
        calls |= {f"{arm_name} {name}": call for name, call in programs.items()}
    timings = clock.compare(calls, repeats=repeats, warm_up=1)
    rows = []
    for arm in scenes:
        parameters, costs = counted[arm.spec]
        programs = {}
        for name in PROGRAMS:
            cost, products = costs[name]
            timing = timings[f"{first[arm.spec]} {name}"]
            at_once = chunk.LENGTH if name == "step" else 1
            programs[name] = Priced(
                flops=cost.flops,
                bytes_accessed=cost.bytes_accessed,
                temporary_bytes=cost.temporary_bytes,
                matrix_flops=products.flops,
                at_least=products.at_least,
                compile_seconds=cost.compile_seconds,
                seconds=timing.median_cpu / at_once,
                wall_seconds=timing.median / at_once,
            )
        rows.append(SceneCost(arm, parameters, programs))
    return rows


def _compile(representation, capture, spec, at):
    """Warm calls of a scene's programs, and (parameters, costs of each program)."""
    import jax
    import jax.numpy as jnp

    from nerfies_jax import evaluation
    from nerfies_jax.metrics import clock
    from nerfies_jax.training import chunk, matrix_flops

    metadata = representation.metadata_of(capture, spec)
    model = representation.build(spec, metadata)
    state = model.init(capture, jax.random.key(0))
    state = state._replace(step=jnp.asarray(round(at * spec.steps), jnp.int32))
    frames = evaluation.frames_of(capture, model.required_data)

    def loss(state, frames):
        # The compiler drops the slopes and the update, which nothing reads.
        return model.step(state, frames)[1]["loss"]

    def steps(state, frames):
        # Alone, a step would ask the system for its memory anew: 24 of 110 ms.
        return chunk.scan_steps(model.step, state, frames, chunk.LENGTH)

    calls, costs = {}, {}
    for name, once, called in (("loss", loss, loss), ("step", model.step, steps)):
        began = time.process_time()
        program = jax.jit(called).lower(state, frames).compile()
        cost = clock.cost_of(program, time.process_time() - began)
        costs[name] = cost, matrix_flops.count(once, state, frames)
        calls[name] = lambda program=program: program(state, frames)
    return calls, (model.counts(state)["parameters"], costs)


if __name__ == "__main__":
    main()
