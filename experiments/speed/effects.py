"""Cost of each effect of a scene, by itself and together with the others.

    nerfies study speed effects
    nerfies study speed effects --presets sonata-small --repeats 9
    nerfies study speed effects --check BEFORE/effect_cost.json

For every preset: the bare scene, the bare scene with each effect alone (and its
requirements), the whole preset, and the whole preset without each effect, or without a
part that is measured separately (ADC-GS' bits, EDGS' mask, SC-GS' rigidity). For the
loss and the training step: the compiler's counts (flops, bytes accessed, temporary
memory), the matrix products with every iteration of every loop, the parameters, the
compilation time and the processor time of warm calls, with all scenes of a preset in
turn. Steps are scanned in tens, as a run does for all but expensive ones. A step is
measured at `--at` of a run's steps, after every warm-up.

The cost of an effect alone is a difference from the scene without it. Costs do not add
up exactly, because the compiler fuses neighboring operations.
"""

import dataclasses
import math
import pathlib
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from experiments.speed import effects_page
from nerfies_jax import evaluation, runs
from nerfies_jax.metrics import clock
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.runs import platform, representations
from nerfies_jax.runs.config import CaptureSource
from nerfies_jax.runtime import console
from nerfies_jax.training import chunk, matrix_flops, specs

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
# Effects that no preset has, as paths of --set, and the preset they are measured with.
ADDED = {
    "splats-static-small": ("exposure.learning_rate=0.01", "poses=PoseRefinementSpec"),
    "motion-gs-small": ("poses=PoseRefinementSpec",),
}
# Parts of effects by the names of their rows, and how --set removes them.
PARTS = {
    "adc-gs-small": {"bits": "motion.rate=none"},
    "edgs-small": {"mask": "motion.mask=none"},
    "sc-gs-small": {"rigidity": "motion.rigidity=none"},
}
# Effects that the effect on the left requires.
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

# Number of a program, unit, and the share of its value by which it may grow. Counts
# repeat exactly under one version of XLA, and times are those of one machine.
NUMBERS = (
    ("flops", "flop", 0.005),
    ("bytes_accessed", "bytes", 0.005),
    ("temporary_bytes", "bytes", 0.02),
    ("matrix_flops", "flop", 0.001),
    ("compile_seconds", "s", 0.5),
    ("seconds", "s", 0.5),
)
RATIO_TOLERANCE = 0.25  # of a time over that of the bare scene of the same run
COUNTS = "XLA's, a loop's body once; matrix_flops with every known round"


class Variant(NamedTuple):
    """One scene of a preset's table."""

    name: str  # "bare", "only warp", "warp + elastic", "all", "without warp"
    spec: Any


def measure_all(args: Any, path: pathlib.Path) -> pathlib.Path:
    """Measure presets, print their tables and write all numbers.

    Args:
      args: Options.
      path: File of the results.

    Returns:
      The file.
    """
    platform.start_jax(args.device, "one")
    # Compilation is measured; JAX asks once, when it first compiles.
    jax.config.update("jax_enable_compilation_cache", False)
    presets = args.presets or PRESETS
    tables = {name: variants_of(name, args) for name in presets}
    metrics: list[Metric] = []
    for name, variants in tables.items():
        preset_metrics = measure(name, variants, args.at, args.repeats)
        console.say("\n".join(effects_page.tables({x.key: x for x in preset_metrics})))
        metrics += preset_metrics
    about = {
        "presets": list(presets),
        "at": args.at,
        "rows": args.rows,
        "rays": args.rays,
        "repeats": args.repeats,
        "counts": COUNTS,
        **clock.machine(),
    }
    clock.write_metrics(path, metrics, about)
    return path


def variants_of(preset: str, args: Any) -> list[Variant]:
    """Assemble the scenes of a preset's table.

    Args:
      preset: Name of the preset.
      args: Options.

    Returns:
      The scenes.
    """
    spec = spec_of(preset, args)
    parts = PARTS.get(preset, {})
    return variants(
        spec, {part: specs.override(spec, [off]) for part, off in parts.items()}
    )


def spec_of(preset: str, args: Any) -> Any:
    """Return the settings of a preset, with the effects added to it.

    Args:
      preset: Name of the preset.
      args: Options.

    Returns:
      The settings.
    """
    from gaussians_jax.init import points

    spec = representations.of_preset(preset).presets[preset]
    spec = specs.override(spec, ADDED.get(preset, ()))
    if hasattr(spec, "start"):  # no part of a step, and finding tracks takes a minute
        spec = dataclasses.replace(
            spec, start=dataclasses.replace(spec.start, motion="none")
        )
    if hasattr(spec, "init"):  # as many Gaussians as with tracks
        init = points.of_start(spec.init, tracked=True)
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
    """List the effects of a scene.

    Args:
      spec: Settings of the scene.

    Returns:
      Names in the order of the settings.
    """
    return [
        field.name
        for field in dataclasses.fields(spec)
        if field.name != "coarse"  # the size of a network
        and field.default is None
        and dataclasses.is_dataclass(getattr(spec, field.name))
    ]


def without(spec: Any, names: tuple[str, ...]) -> Any:
    """Remove effects, and the effects that require them.

    Args:
      spec: Settings of the scene.
      names: Names of the effects.

    Returns:
      The other settings.
    """
    removed_names = set(names)
    removed_names |= {
        name
        for name, required_names in NEEDS.items()
        if removed_names & {*required_names}
    }
    return dataclasses.replace(
        spec, **dict.fromkeys(removed_names & {*effects_in(spec)})
    )


def variants(spec: Any, parts: Mapping[str, Any]) -> list[Variant]:
    """Remove the effects of a scene in turn.

    Args:
      spec: Settings of the scene.
      parts: Settings without each separately measured part.

    Returns:
      The bare scene, then those with one effect, with all and without one.

    Raises:
      ValueError: If the scene has no effect.
    """
    names = effects_in(spec)
    if not names:
        raise ValueError(
            "--presets: one of them has no effect to be measured; choose from "
            + ", ".join(PRESETS)
        )

    def only(*present):
        return without(spec, tuple(name for name in names if name not in present))

    scenes = [Variant("bare", only())]
    for name in names:
        required_names = tuple(x for x in NEEDS.get(name, ()) if x in names)
        title = f"{required_names[0]} + {name}" if required_names else f"only {name}"
        scenes.append(Variant(title, only(name, *required_names)))
    if len(names) > 1:  # the only one is the whole scene
        scenes.append(Variant("all", spec))
        parts = {name: without(spec, (name,)) for name in names} | dict(parts)
    return scenes + [Variant(f"without {name}", scene) for name, scene in parts.items()]


def measure(
    preset: str, scenes: list[Variant], at: float, repeats: int
) -> list[Metric]:
    """Compile the programs of every scene once and time all of them in turn.

    Args:
      preset: Name of the preset.
      scenes: The scenes.
      at: Share of a run's steps before the measured one.
      repeats: Number of timed calls.

    Returns:
      Numbers of each program of each scene.
    """
    representation = representations.of_preset(preset)
    capture = runs.read_capture(CaptureSource())
    # "without" the only effect is "bare": the same scene under several names.
    first = {scene.spec: scene.name for scene in reversed(scenes)}
    scene_programs = {
        spec: _compile(representation, capture, spec, at) for spec in first
    }
    calls = {
        f"{first[spec]} {name}": program.call
        for spec, (_, programs) in scene_programs.items()
        for name, program in programs.items()
    }
    timings = clock.compare(calls, repeats=repeats, warm_up=1)

    def seconds(spec, name):
        timing = timings[f"{first[spec]} {name}"]
        return timing.median_cpu / scene_programs[spec][1][name].steps

    metrics = []
    for scene in scenes:
        parameters, programs = scene_programs[scene.spec]
        stem = f"{preset}.{scene.name.replace(' + ', '_and_').replace(' ', '_')}"
        metrics.append(Metric(f"{stem}.parameters", parameters, "numbers", "lower"))
        for name, program in programs.items():
            numbers = program.numbers | {"seconds": seconds(scene.spec, name)}
            for key, unit, share in NUMBERS:
                value = numbers[key]
                tolerance = share * value if math.isfinite(value) else 0.0
                metrics.append(
                    Metric(f"{stem}.{name}.{key}", value, unit, "lower", tolerance)
                )
            ratio = numbers["seconds"] / seconds(scenes[0].spec, name)
            tolerance = RATIO_TOLERANCE * ratio
            key = f"{stem}.{name}.over_bare"
            metrics.append(Metric(key, ratio, "", "lower", tolerance))
    return metrics


class _Program(NamedTuple):
    """A compiled program of a scene."""

    call: Any  # with warm inputs
    steps: int  # of one call
    numbers: dict[str, float]  # as counted by the compiler


def _compile(representation, capture, spec, at):
    """Return the number of parameters of a scene, and its programs."""
    metadata = representation.metadata_of(capture, spec)
    model = representation.build(spec, metadata)
    state = model.init(capture, jax.random.key(0))
    state = state._replace(step=jnp.asarray(round(at * spec.steps), jnp.int32))
    frames = evaluation.frames_of(capture, model.required_data)

    def loss(state, frames):
        # The compiler drops the gradients and the update, which nothing reads.
        return model.step(state, frames)[1]["loss"]

    def steps(state, frames):
        # A single step would allocate its memory anew: 24 of 110 ms.
        return chunk.scan_steps(model.step, state, frames, chunk.LENGTH)

    programs = {}
    for name, once, function, count in (
        ("loss", loss, loss, 1),
        ("step", model.step, steps, chunk.LENGTH),
    ):
        began = time.process_time()
        program = jax.jit(function).lower(state, frames).compile()
        cost = clock.cost_of(program, time.process_time() - began)._asdict()
        products = matrix_flops.count(once, state, frames)
        numbers = cost | {"matrix_flops": products.flops}
        programs[name] = _Program(
            lambda program=program: program(state, frames), count, numbers
        )
    return model.counts(state)["parameters"], programs
