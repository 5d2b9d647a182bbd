"""Measurements of time, memory and operations, and records of metrics."""

import dataclasses
import importlib.metadata
import math
import os
import pathlib
import platform
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import psutil

from nerfies_jax.capture.errors import UNEXPECTED_CONTENT, FileError
from nerfies_jax.capture.json_files import read_json, write_json

DIRECTIONS = ("lower", "higher", "equal")


@dataclasses.dataclass(frozen=True)
class Metric:
    """A measured value that can be compared with the value of another run."""

    key: str  # such as "heldout.psnr"
    value: float | int
    unit: str  # "dB", "ms", "bytes", "" for a share
    direction: str  # better values: "lower", "higher", "equal" for none
    tolerance: float = 0.0  # accepted decline, in the unit of the metric

    def __post_init__(self):
        if not self.key or self.key != self.key.strip():
            raise ValueError(
                f"a metric needs a key like 'heldout.psnr', got {self.key!r}"
            )
        if self.direction not in DIRECTIONS:
            raise ValueError(
                f"metric {self.key}: direction must be one of {', '.join(DIRECTIONS)}, "
                f"got {self.direction!r}"
            )
        if not (math.isfinite(self.tolerance) and self.tolerance >= 0):
            raise ValueError(
                f"metric {self.key}: tolerance must be finite and not negative, got "
                f"{self.tolerance}"
            )

    def holds(self, before: float) -> bool:
        """Test if the value is no worse than an earlier one, within the tolerance.

        Args:
          before: The earlier value.

        Returns:
          True if it is no worse. False for NaN.
        """
        change = self.value - before
        if self.direction == "lower":
            return change <= self.tolerance
        if self.direction == "higher":
            return -change <= self.tolerance
        return abs(change) <= self.tolerance


def write_metrics(
    path, metrics: Iterable[Metric], about: Mapping[str, Any] = {}
) -> None:
    """Write metrics as `{"about": ..., "metrics": {key: {value, unit, ...}}}`.

    Values that are not finite are written as null, because JSON cannot represent them.

    Args:
      path: The file.
      metrics: The metrics.
      about: JSON values about the measurement.
    """
    write_json(path, {"about": dict(about), "metrics": metric_rows(metrics)})


def metric_rows(metrics: Iterable[Metric]) -> dict[str, dict[str, Any]]:
    """Convert metrics to JSON values by key.

    Args:
      metrics: The metrics.

    Returns:
      The rows that `read_metrics` reads under "metrics".

    Raises:
      ValueError: If a key occurs twice.
    """
    rows: dict[str, Any] = {}
    for metric in metrics:
        if metric.key in rows:
            raise ValueError(
                f"metric {metric.key} occurs twice; each key must have one value"
            )
        row = dataclasses.asdict(metric)
        del row["key"]
        row["value"] = float(metric.value) if math.isfinite(metric.value) else None
        rows[metric.key] = row
    return rows


def read_metrics(path) -> dict[str, Metric]:
    """Read a file written by `write_metrics`.

    Args:
      path: The file.

    Returns:
      Metrics by key, with NaN for null.

    Raises:
      FileError: If it is not such a file.
    """
    try:
        rows = read_json(path, dict[str, Any])["metrics"]
        return {
            key: Metric(key, **{**row, "value": _number(row["value"])})
            for key, row in rows.items()
        }
    except FileError:  # it names the path already
        raise
    except UNEXPECTED_CONTENT as error:
        raise FileError(
            f"{path}: not a file of metrics ({error!r}); create it with write_metrics"
        ) from error


def _number(value):
    return math.nan if value is None else float(value)


class Timing(NamedTuple):
    """Times of repeated calls of a compiled function, in seconds."""

    wall: np.ndarray  # [repeats] wall time
    cpu: np.ndarray  # [repeats] processor time of all threads of this process

    @property
    def median(self) -> float:
        """Median wall time."""
        return float(np.median(self.wall))

    @property
    def median_cpu(self) -> float:
        """Median processor time, for comparisons on a shared machine."""
        return float(np.median(self.cpu))

    @property
    def spread(self) -> float:
        """Half of the interquartile range of the wall time."""
        low, high = np.percentile(self.wall, (25, 75))
        return float(high - low) / 2


def measure(
    function: Callable[[], Any], *, repeats: int = 10, warm_up: int = 2
) -> Timing:
    """Time calls of a function, each until its results are ready.

    Args:
      function: The function.
      repeats: Number of timed calls.
      warm_up: Number of preceding calls that are not timed.

    Returns:
      The times.
    """
    return compare({"it": function}, repeats=repeats, warm_up=warm_up)["it"]


def compare(
    functions: Mapping[str, Callable[[], Any]], *, repeats: int = 10, warm_up: int = 2
) -> dict[str, Timing]:
    """Time several functions in turn, so that other load affects all of them equally.

    On a shared machine, compare `median_cpu`. Compare ratios within one run rather than
    times of two runs, because absolute times vary by a quarter.

    Args:
      functions: Functions by name.
      repeats: Number of timed calls of each function.
      warm_up: Number of preceding calls of each function that are not timed.

    Returns:
      Times by name.

    Raises:
      ValueError: If there are no repeats or a negative warm-up.
    """
    if repeats < 1 or warm_up < 0:
        raise ValueError(
            f"timing needs repeats >= 1 and warm_up >= 0, got repeats={repeats}, "
            f"warm_up={warm_up}; the first call compiles and should not be timed"
        )
    for function in functions.values():
        for _ in range(warm_up):
            jax.block_until_ready(function())
    wall: dict[str, list[float]] = {name: [] for name in functions}
    cpu: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            wall_start, cpu_start = time.perf_counter(), time.process_time()
            jax.block_until_ready(function())
            cpu[name].append(time.process_time() - cpu_start)
            wall[name].append(time.perf_counter() - wall_start)
    return {
        name: Timing(np.array(wall[name]), np.array(cpu[name])) for name in functions
    }


class Cost(NamedTuple):
    """Cost of one call of a program, as reported by the compiler."""

    flops: float  # NaN if the backend does not report it
    bytes_accessed: float  # read and written, NaN if the backend does not report it
    temporary_bytes: int  # without arguments and results
    argument_bytes: int
    output_bytes: int
    compile_seconds: float


def cost(function: Callable, *args, **kwargs) -> Cost:
    """Compile a function for some arguments and return the cost of a call.

    The body of a loop is counted once, because XLA does not know the number of
    iterations.

    Args:
      function: The function, jitted or not.
      *args: Its arguments.
      **kwargs: Its keyword arguments.

    Returns:
      The cost.
    """
    start = time.perf_counter()
    lower = function.lower if hasattr(function, "lower") else jax.jit(function).lower
    program = lower(*args, **kwargs).compile()
    return cost_of(program, time.perf_counter() - start)


def cost_of(program: jax.stages.Compiled, compile_seconds: float) -> Cost:
    """Return the cost of a call of a compiled program.

    Args:
      program: The compiled program.
      compile_seconds: Time of its compilation.

    Returns:
      The cost.
    """
    analysis = program.cost_analysis() or {}
    if isinstance(analysis, list):  # one per computation on some backends
        analysis = analysis[0] if analysis else {}
    memory = program.memory_analysis()
    if memory is None:
        raise ValueError("this backend does not report the memory of its programs")
    return Cost(
        float(analysis.get("flops", math.nan)),
        float(analysis.get("bytes accessed", math.nan)),
        int(memory.temp_size_in_bytes),
        int(memory.argument_size_in_bytes),
        int(memory.output_size_in_bytes),
        compile_seconds,
    )


def peak_bytes() -> int:
    """Return the largest resident memory of this process so far.

    Returns:
      Number of bytes.
    """
    # psutil reports the peak only on Windows. On Linux getrusage is not used, because
    # its peak includes the memory of the process that started this one.
    peak = getattr(psutil.Process().memory_info(), "peak_wset", None)
    if peak is not None:
        return peak
    try:
        for line in pathlib.Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    import resource  # does not exist on Windows

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak  # macOS counts bytes


def device_peak_bytes() -> int | None:
    """Return the largest memory use of the first device so far.

    Returns:
      Number of bytes, None if the backend does not report it.
    """
    stats = jax.devices()[0].memory_stats() or {}
    return stats.get("peak_bytes_in_use")


def machine() -> dict[str, Any]:
    """Describe the machine and environment that a timing depends on.

    Returns:
      JSON values.
    """
    device = jax.devices()[0]
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "xla_cores": os.environ.get("PJRT_NPROC") or os.environ.get("NPROC"),
        "memory_bytes": psutil.virtual_memory().total,
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxlib": importlib.metadata.version("jaxlib"),
        "backend": device.platform,
        "device": device.device_kind,
        "x64": jnp.result_type(float) == jnp.float64,
    }


def beside(now: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """Add the processors of an earlier description, for a file with timings of both.

    Args:
      now: Description of this machine.
      before: Earlier description, which may be empty.

    Returns:
      `now` with the names of all different processors.
    """
    names = [*filter(None, before.get("cpu", "").split("; ")), now["cpu"]]
    return now | {"cpu": "; ".join(dict.fromkeys(names))}


def _cpu_model():
    try:
        for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
