"""What the experiments know of each representation: splats, and radiance fields."""

import functools
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

from experiments import evaluate, step_time, variants
from nerfies_jax.capture.capture import Capture
from nerfies_jax.training.model import Frames, Model, TrainState

Spec = Any
MODEL = "model.npz"  # in a run folder: all of a trained scene of Gaussians


class Saved(NamedTuple):
    """The files of a trained scene, beside its checkpoint."""

    model_bytes: int | None = None  # of the one file that holds all of it
    notes: tuple[str, ...] = ()  # what the reader should know of them


class Representation(NamedTuple):
    """How its scenes are named, built, timed and saved."""

    name: str
    spec_type: type
    presets: dict[str, Spec]
    with_steps: Callable[[Spec, int], Spec]  # schedules stretch with the steps
    facts_of: Callable[[Capture, Spec], Any]
    build: Callable[[Spec, Any], Model]  # (spec, facts) -> model
    estimate_memory_bytes: Callable[[Spec, Capture], int]  # of the first state and step
    memory_hint: str  # which settings make the first state smaller
    # (spec, facts, model, state, frames) -> milliseconds of each part of a step
    time_parts: Callable[[Spec, Any, Model, TrainState, Frames], dict[str, float]]
    # (spec, facts, effects left out, whether appearances are blended) -> model;
    # it draws a `variants.Between` instead of a view where they are.
    variant: Callable[[Spec, Any, tuple[str, ...], bool], Model]
    # (spec, facts, state, capture, rows) -> scores with codes fitted to half a frame;
    # None where the scene has no codes of its own for each frame.
    score_halves: Callable[..., evaluate.Halves | None]
    fitted_rays: int  # rendered to fit the codes of one frame
    # (folder, spec, facts, state) -> what it wrote beside the checkpoint
    save: Callable[[pathlib.Path, Spec, Any, TrainState], Saved]


@functools.cache
def gaussians() -> Representation:
    """Gaussian splats, static or moving."""
    from gaussians_jax import files, model_file, presets, scene

    def save(folder, spec, facts, state):
        about = {"spec": spec, "facts": facts, "step": int(state.step)}
        size = model_file.save(folder / MODEL, state.params, about)
        files.save(folder / "gaussians.ply", state.params.rows["splats"])
        effects = scene.effects_of(spec, facts)
        if all(effect.deform is None for effect in effects):
            return Saved(size)
        note = "gaussians.ply holds the canonical Gaussians, without their motion."
        return Saved(size, (note,))

    return Representation(
        name="gaussians",
        spec_type=scene.SplatScene,
        presets=presets.PRESETS,
        with_steps=presets.with_steps,
        facts_of=lambda capture, spec: scene.facts_of(capture),
        build=scene.build,
        estimate_memory_bytes=scene.estimate_memory_bytes,
        memory_hint="lower init.points, init.random or raster.capacity with --set",
        time_parts=step_time.of_splats,
        variant=variants.of_splats,
        score_halves=lambda *_: None,
        fitted_rays=0,
        save=save,
    )


@functools.cache
def radiance() -> Representation:
    """Radiance fields of the NeRF family."""
    from experiments import held_out_codes
    from nerfies_jax import presets, scene

    return Representation(
        name="radiance",
        spec_type=scene.RadianceScene,
        presets=presets.PRESETS,
        with_steps=presets.with_steps,
        facts_of=scene.facts_of,
        build=scene.build,
        estimate_memory_bytes=scene.estimate_memory_bytes,
        memory_hint="lower rays, sampling.coarse or sampling.fine with --set",
        time_parts=step_time.of_fields,
        variant=variants.of_fields,
        score_halves=held_out_codes.score,
        fitted_rays=held_out_codes.RAYS * held_out_codes.EVALUATIONS,
        save=lambda *_: Saved(),  # the checkpoint holds all there is
    )


# By the name that `config.json` stores. Makers: what is not used is not imported.
MAKERS = {"gaussians": gaussians, "radiance": radiance}


def named(name: str) -> Representation:
    """The representation of that name; ValueError where there is none."""
    if name not in MAKERS:
        raise ValueError(f"no representation {name!r}; there are {', '.join(MAKERS)}")
    return MAKERS[name]()


def of_preset(preset: str) -> Representation:
    """The representation that has a preset; ValueError names all there are."""
    known = []
    for make in MAKERS.values():
        if preset in make().presets:
            return make()
        known += make().presets
    raise ValueError(
        f"--preset {preset}: no such preset; there are {', '.join(sorted(known))}"
    )
