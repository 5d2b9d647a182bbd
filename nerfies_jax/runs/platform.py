"""Where a process computes, and what it keeps between runs.

JAX is imported only when it is started: which platform, and how many cores XLA:CPU
sees, is decided before its first array.
"""

import contextlib
import os
from typing import Literal

import psutil

from nerfies_jax import events
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.compiler import UNDIVIDED

Device = Literal["auto", "cpu", "gpu", "tpu"]
# Whether XLA:CPU sees one core or all of them; each representation says which suits it.
Threads = Literal["one", "all"]
_AFFINITY = hasattr(psutil.Process, "cpu_affinity")  # not on macOS
VECTOR_WIDTH = "--xla_cpu_prefer_vector_width"  # XLA:CPU's own is 256 bits


@events.stage("starting JAX")
def start_jax(
    device: Device = "auto", threads: Threads = "one", shares: int = 1
) -> None:
    """Choose the platform, how many cores XLA:CPU sees, and the compilation cache.

    Steps that fall into equal `shares` get as many CPU devices, where there are so many
    cores (`data_parallel`). Call it before the first array is made; it is too late
    afterwards. `PJRT_NPROC` and `JAX_NUM_CPU_DEVICES` in the environment have the last
    word, as has `XLA_FLAGS` on the width of vectors, 512 bits where the processor has
    them, and on the passes that are left out: where each device sees one core, that
    which divides loops. Raises ValueError where the device is not there.
    """
    if threads == "one" and os.environ.setdefault("PJRT_NPROC", "1") == "1":
        # XLA sees a thread for each device, and would divide the loops of each among
        # all: a step of `splats-tracked-small` on two takes 21 ms for 24.
        for name, value in UNDIVIDED.items():
            _set_flag(f"--{name}", value)
    if "avx512f" in _processor_flags():
        # Splats train in 0.88 of the time (10,000 Gaussians, 256x192, side by side).
        _set_flag(VECTOR_WIDTH, "512")
    import jax

    if shares > 1 and "JAX_NUM_CPU_DEVICES" not in os.environ:
        with contextlib.suppress(RuntimeError):  # where JAX has begun, as it is
            jax.config.update("jax_num_cpu_devices", min(shares, cores()))
    if device != "auto":
        name = {"gpu": "cuda"}.get(device, device)
        os.environ["JAX_PLATFORMS"] = name  # of the processes that this one starts
        jax.config.update("jax_platforms", name)
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        reason = (str(error).splitlines() or ["JAX finds none"])[0]
        raise ValueError(
            f"--device {device} cannot be used here ({reason}); choose --device cpu, "
            "or install a JAX built for that device"
        ) from error
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        folder = CACHE / "compiled"
        with contextlib.suppress(OSError):  # a cache that cannot be kept is no error
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))


def cores() -> int:
    """How many cores this process may use."""
    return len(psutil.Process().cpu_affinity()) if _AFFINITY else os.cpu_count() or 1


def _set_flag(name, value):
    flags = os.environ.get("XLA_FLAGS", "")
    if name not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {name}={value}".strip()


def _processor_flags():
    """What the processor can do, as Linux says it; empty elsewhere."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith("flags"):
                return frozenset(line.split())
    return frozenset()
