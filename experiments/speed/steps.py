"""One preset, or the default command, timed in a process of its own."""

import json
import pathlib
import subprocess
import sys
import tempfile
import time
from typing import Any

from nerfies_jax.runs import platform, representations
from nerfies_jax.runtime import children

FRAMES = 5  # rendered, after one that compiles
# Metrics of the default command to store.
METRICS = (
    *("train.seconds", "train.compile_seconds"),
    *("heldout.psnr", "heldout.moving_psnr"),
)


def prepare() -> None:
    """Render the built-in scene and preprocess it, so that no run measures that."""
    platform.start_jax("cpu")
    from nerfies_jax import runs
    from nerfies_jax.preprocessing import record

    record.cached(runs.built_in_scene("default"), platform.CACHE / "evidence")


def measure(
    preset: str, all_cores: bool, device: platform.Device = "cpu"
) -> dict[str, Any]:
    """Measure seconds and bytes of a preset on the built-in scene.

    Motions are initialized as in the preset: tracks bring Gaussians of their own, and
    longer steps.

    Args:
      preset: Name of the preset.
      all_cores: Use the cores that the preset wants, and time the step alone. Otherwise
        use one core.
      device: Platform, or "auto".

    Returns:
      Measurements by name.
    """
    count = representations.cores(preset)
    platform.start_jax(device, *(count if all_cores else ("one",)))
    import jax

    # Compilation is measured, too.
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
    if (peak := clock.device_peak_bytes()) is not None:
        record["device_peak_mb"] = peak / 1e6
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


def default_command(
    checkout: pathlib.Path | None = None, device: str = "auto"
) -> dict[str, Any]:
    """Time the README's first command with empty caches.

    Args:
      checkout: Another checkout of the library, whose code is run. None for this one.
      device: Platform, or "auto".

    Returns:
      Seconds, revision, metrics and machine.
    """
    with tempfile.TemporaryDirectory() as folder:
        run = pathlib.Path(folder) / "run"
        environment = dict(children.environment(), XDG_CACHE_HOME=f"{folder}/cache")
        for name in ("JAX_COMPILATION_CACHE_DIR", "PJRT_NPROC", "NPROC"):
            environment.pop(name, None)
        if checkout is not None:
            environment["PYTHONPATH"] = str(checkout.resolve())
        command = [sys.executable, "-m", "experiments.reconstruct", "--out", str(run)]
        command += [] if device == "auto" else ["--device", device]
        began = time.perf_counter()
        subprocess.run(
            command, check=True, env=environment, cwd=checkout, capture_output=True
        )
        seconds = time.perf_counter() - began
        metrics = json.loads((run / "metrics.json").read_text())
    from nerfies_jax.metrics import clock
    from nerfies_jax.training.provenance import revision

    return {
        "seconds": seconds,
        "revision": revision(checkout),
        **{name: metrics.get(name) for name in METRICS},
        "machine": clock.machine(),
    }
