"""One preset timed in a process of its own."""

from typing import Any

from nerfies_jax.runs import platform, representations

FRAMES = 5  # rendered, after one that compiles


def prepare() -> None:
    """Film the built-in scene and follow what moves in it, as the first of many runs.

    What is kept of both does not count as memory of a run then.
    """
    platform.start_jax("cpu")
    from nerfies_jax import runs
    from nerfies_jax.preprocessing import record

    record.cached(runs.built_in_scene("default"), platform.CACHE / "evidence")


def measure(preset: str, all_cores: bool) -> dict[str, Any]:
    """Measure seconds and bytes of a preset on the built-in scene, from its first
    state.

    Motions are initialized as in the preset: tracks bring Gaussians of their own, and
    longer steps.

    Args:
      preset: Name of the preset.
      all_cores: Use the cores that the preset wants, and time the step alone. Otherwise
        use one core.

    Returns:
      Measurements by name.
    """
    wanted = representations.cores(preset)
    platform.start_jax("cpu", *(wanted if all_cores else ("one",)))
    import jax

    # As it is the first time.
    jax.config.update("jax_enable_compilation_cache", False)

    from nerfies_jax import evaluation, runs
    from nerfies_jax.evaluation import Renderer
    from nerfies_jax.metrics import clock
    from nerfies_jax.training.rate import step_time

    representation = representations.of_preset(preset)
    spec = representation.presets[preset]
    capture = runs.built_in_scene("default")
    metadata = representation.metadata_of(capture, spec)
    model = representation.build(spec, metadata)
    state = model.init(capture, jax.random.key(0))
    frames = evaluation.frames_of(capture, model.required_data)
    step = step_time(model, state, frames, spec.steps)
    record: dict[str, Any] = {
        "step_ms": 1e3 * step.seconds,
        "compile_seconds": step.compile_seconds,
        "devices": model.devices,
    }
    step_parts = representation.resources.step_parts
    if not all_cores and step_parts is not None:
        parts = step_parts(spec, metadata, model, state, frames).ms()
        renderer = Renderer(model, capture.size)
        for row in capture.heldout[: FRAMES + 1]:
            renderer(state, evaluation.view_of(capture, row))
        record["parts"] = parts
        record["frame_ms"] = renderer.ms_per_frame(FRAMES)
        record["peak_mb"] = clock.peak_bytes() / 1e6
    record["machine"] = clock.machine()
    return record
