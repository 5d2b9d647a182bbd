"""One measurement of `experiments.on_device`, in a process of its own."""

import pathlib
import sys
import time
import typing
from typing import Any

from nerfies_jax.runs import platform
from nerfies_jax.runtime import children


def measure(part: str, name: str, device: platform.Device) -> dict[str, Any]:
    """Measure one case, preset or command.

    Args:
      part: "raster", "steps" or "job".
      name: The case or the preset.
      device: Platform, or "auto".

    Returns:
      Measurements by name, with the machine.
    """
    from experiments.speed import raster, steps

    if part == "job":
        return steps.default_command(device=device)
    if part == "steps":
        return steps.measure(name, True, device)
    platform.start_jax(device, "one")
    from nerfies_jax.metrics import clock

    forward, with_gradient = raster.compile_case(
        name, raster.make_scene(*raster.parse_case(name))
    )
    # Wall-clock time: the processor only waits for an accelerator.
    record: dict[str, Any] = {
        "forward_ms": raster.median_ms(forward, time.perf_counter),
        "forward_backward_ms": raster.median_ms(with_gradient, time.perf_counter),
    }
    if (peak := clock.device_peak_bytes()) is not None:
        record["device_peak_mb"] = peak / 1e6
    return record | {"machine": clock.machine()}


def main() -> None:
    """Measure and write the result."""
    children.end_with_parent()
    part, name, device, path = sys.argv[1:]
    record = measure(part, name, typing.cast(platform.Device, device))
    from nerfies_jax.capture.json_files import write_json

    write_json(pathlib.Path(path), record)


if __name__ == "__main__":
    main()
