"""Device, number of cores and caches of a process.

JAX is imported only in `start_jax`, because the platform and the number of cores that
XLA:CPU sees must be set before the first array is created.
"""

import contextlib
import os
from typing import Literal, NamedTuple

import psutil

from nerfies_jax.capture import cache
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.runtime import events
from nerfies_jax.runtime.compiler import UNDIVIDED

Device = Literal["auto", "cpu", "gpu", "tpu"]
# Number of cores that XLA:CPU sees. Each representation chooses it.
Threads = Literal["one", "all"]
_AFFINITY = hasattr(psutil.Process, "cpu_affinity")  # not on macOS
# Programs that compile faster are not kept. A run has 40 between this and the 1 s of
# JAX, and reads each in milliseconds.
CACHED_SECONDS = 0.05
VECTOR_WIDTH = "--xla_cpu_prefer_vector_width"  # 256 bits by default


class Cluster(NamedTuple):
    """The processes that train one run together (`nerfies_jax.runtime.hosts`)."""

    coordinator: str | None  # None to take all from the variables of the launcher
    processes: int | None = None
    process: int | None = None  # number of this process


@events.stage("starting JAX")
def start_jax(
    device: Device = "auto",
    threads: Threads = "one",
    shares: int = 1,
    *,
    devices: int | None = None,
    frame_memory: float | int | None = None,
    cluster: Cluster | None = None,
    wide: bool = True,
) -> None:
    """Choose the platform, the number of cores that XLA:CPU sees, and the cache.

    Call it before the first array is created. If each CPU device sees one core, the
    compiler pass that parallelizes loops is disabled. The vector width is 512 bits if
    the processor supports it and `wide` is true. The environment variables
    `PJRT_NPROC`, `JAX_NUM_CPU_DEVICES` and `XLA_FLAGS`, with the number of devices of
    `--xla_force_host_platform_device_count`, take precedence over these choices.

    Args:
      device: Platform, or "auto" for the default of JAX.
      threads: "one" or "all" cores for XLA:CPU.
      shares: Number of equal parts that a step is divided into, each with a CPU device
        of its own if there are enough cores (`data_parallel`).
      devices: Number of devices to compute on. None for all, and on a CPU for as many
        as there are shares and cores.
      frame_memory: GiB of device memory for training frames. None for what the device
        has.
      cluster: Other processes to train with. None for this process alone. Each uses
        as many devices as `devices` says.
      wide: False for processes that compile code of other packages. With vectors of 512
        bits, `jnp.arctan(x)` and `jnp.arctan2(x, 1)` are wrong for long arrays (JAX
        0.10.2, errors of 1 rad). The functions of this package do not use them.

    Raises:
      ValueError: If the devices are not available, the processes cannot be connected,
        or a limit of memory or of the cache is wrong.
    """
    if threads == "one" and os.environ.setdefault("PJRT_NPROC", "1") == "1":
        # XLA has a thread for each device and would divide the loops of every device
        # among all threads. Without that, a step of `splats-tracked-small` on two
        # devices takes 21 ms instead of 24 ms.
        for name, value in UNDIVIDED.items():
            _set_flag(f"--{name}", value)
    if wide and "avx512f" in _processor_flags():
        # Training takes 0.88 of the time (10,000 Gaussians, 256x192).
        _set_flag(VECTOR_WIDTH, "512")
    import jax

    # These load JAX.
    from nerfies_jax.capture import cache_files
    from nerfies_jax.capture.frame_memory import limit_device
    from nerfies_jax.runtime import data_parallel, hosts

    count = min(shares, cores()) if devices is None else devices
    is_set = "--xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if count > 1 and not is_set and "JAX_NUM_CPU_DEVICES" not in os.environ:
        # The number of devices cannot change if JAX has already been initialized.
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", count)
    if device != "auto":
        name = {"gpu": "cuda"}.get(device, device)
        os.environ["JAX_PLATFORMS"] = name  # for child processes
        jax.config.update("jax_platforms", name)
    if cluster is not None:
        hosts.join(*cluster)
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        reason = (str(error).splitlines() or ["JAX finds no such device"])[0]
        raise ValueError(
            f"device={device} is not available ({reason}); choose device=cpu, or "
            "install a version of JAX for that device"
        ) from error
    data_parallel.limit_devices(devices)
    limit_device(frame_memory)
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        folder = CACHE / "compiled"
        with contextlib.suppress(OSError):  # JAX also works without a cache
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))
            if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
                seconds = CACHED_SECONDS
                jax.config.update("jax_persistent_cache_min_compile_time_secs", seconds)
            # Not `jax_compilation_cache_max_size`: a process that is killed between the
            # two files of an entry would make all later writes fail (JAX 0.10).
            cache_files.evict(folder, cache.limit_bytes())


def cores() -> int:
    """Return the number of cores that this process may use.

    Returns:
      The number of cores.
    """
    return len(psutil.Process().cpu_affinity()) if _AFFINITY else os.cpu_count() or 1


def _set_flag(name, value):
    flags = os.environ.get("XLA_FLAGS", "")
    if name not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {name}={value}".strip()


def _processor_flags():
    """Features of the processor as Linux reports them. Empty elsewhere."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith("flags"):
                return frozenset(line.split())
    return frozenset()
