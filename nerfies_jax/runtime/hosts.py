"""Several processes, one for each host, that train together by `jax.distributed`.

Process 0 leads. It does all that a single process does, and sends every chunk of
training steps to the others, which compute their shares of it (`training.follower`).
Only process 0 reads the clock, applies events and writes files, so the processes
cannot disagree. Messages go through the coordination service of JAX, and arrays through
its collectives. If a process dies, the others end with an error of one line.
"""

import atexit
import contextlib
import ctypes
import functools
import json
import os
import re
import signal
import sys
import threading
import weakref
from collections.abc import Iterator, Mapping
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.runtime import console, stopping

PyTree = Any

HEARTBEAT_SECONDS = 30  # without a sign of life, after which a process is dead
SHUTDOWN_SECONDS = 15  # that processes which have ended wait for each other
POLL_SECONDS = 1
BARRIER_SECONDS = 3600  # one process may still be compiling
LEAST_PORT, PORTS = 61440, 4096  # from which JAX chooses the port under a launcher
END, RUN, COMPILE, STEPS = "end", "run", "compile", "steps"  # kinds of messages

_messages = 0  # sent or received by this process
_barriers = 0
# Leaves of the state that the last chunk returned, which all processes have.
_sent_leaves: list[weakref.ref] = []
_ending = threading.Lock()  # of `end_without_others`

LOST_CODE = 2  # exit code, that of other errors which are not bugs


class Lost(ValueError):
    """A program that several processes run together failed."""


def join(
    coordinator: str | None, processes: int | None = None, process: int | None = None
) -> None:
    """Connect this process to the others, before the first array is created.

    Args:
      coordinator: ADDRESS:PORT at which process 0 listens. None to take all three from
        the variables of Slurm, Open MPI or another launcher that JAX recognizes.
      processes: Number of processes.
      process: Number of this process, from 0.

    Raises:
      ValueError: If the launcher is not recognized, or the others cannot be reached.
    """
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    address = open_mpi_address(os.environ) if coordinator is None else None
    coordinator, processes, process, devices = address or (
        *(coordinator, processes, process),
        None,
    )
    try:
        with stopping.keeps_handlers(), _ending_with_others():
            jax.distributed.initialize(
                coordinator,
                processes,
                process,
                devices,
                heartbeat_timeout_seconds=HEARTBEAT_SECONDS,
                shutdown_timeout_seconds=SHUTDOWN_SECONDS,
            )
    except (RuntimeError, ValueError, TypeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(
            f"coordinator={coordinator or 'auto'}: the processes cannot be connected "
            f"({reason}); start them by Slurm or Open MPI, or give the coordinator as "
            "HOST:PORT of process 0, the number of processes and that of each"
        ) from error
    counts = [0] * jax.process_count()
    for device in jax.devices():
        counts[device.process_index] += 1
    if len(set(counts)) > 1:
        raise ValueError(
            f"the processes have {counts} devices, but each needs the same number; "
            "limit them with the variables of the platform, such as "
            "CUDA_VISIBLE_DEVICES or JAX_NUM_CPU_DEVICES"
        )


def open_mpi_address(
    environment: Mapping[str, str],
) -> tuple[str, int, int, list[int] | None] | None:
    """Read the variables of `mpirun` of Open MPI 5, which JAX 0.10 does not recognize.

    The name of a job has the host and the process id of `mpirun`. JAX also takes this
    host for that of process 0, under earlier versions of Open MPI.

    Args:
      environment: Environment variables.

    Returns:
      HOST:PORT of process 0, the number of processes, that of this process, and the
      numbers of its local devices, or None for those that JAX reads. None if Open MPI 5
      has not started this process.
    """
    namespace = environment.get("PMIX_NAMESPACE", "")
    job = re.fullmatch(r"prterun-(?P<host>.+)-(?P<pid>\d+)@\d+", namespace)
    if job is None or "OMPI_COMM_WORLD_RANK" not in environment:
        return None
    port = LEAST_PORT + int(job["pid"]) % PORTS
    port = int(environment.get("JAX_COORDINATOR_PORT", port))
    count, number, local = (
        int(environment[f"OMPI_COMM_WORLD_{name}"])
        for name in ("SIZE", "RANK", "LOCAL_RANK")
    )
    devices = None if "JAX_LOCAL_DEVICE_IDS" in environment else [local]
    return f"{job['host']}:{port}", count, number, devices


def joined() -> bool:
    """Test if this process was connected to others.

    Returns:
      True after `join`, if there is more than one process.
    """
    return jax.distributed.is_initialized() and jax.process_count() > 1


def leads() -> bool:
    """Test if this process leads others.

    Returns:
      True for process 0 of several.
    """
    return joined() and jax.process_index() == 0


@contextlib.contextmanager
def dismissing() -> Iterator[None]:
    """Tell the other processes to end when the block ends, if this process leads.

    Yields:
      None.
    """
    error = ""
    try:
        yield
    except BaseException as cause:
        error = (str(cause).splitlines() or [type(cause).__name__])[0]
        raise
    finally:
        if leads():
            send(END, error=error)


def is_loss(error: Exception) -> bool:
    """Test if an error of a program can come from the death of another process.

    Args:
      error: The error.

    Returns:
      True for errors of the runtime. JAX raises those of collectives on CPUs as a
      ValueError if they occur before a program returns.
    """
    return isinstance(error, jax.errors.JaxRuntimeError) or (
        isinstance(error, ValueError) and "Gloo" in str(error)
    )


def abandon() -> None:
    """Let this process end with `LOST_CODE`, because another process has died.

    At exit, JAX would wait for the dead process, and abort after `SHUTDOWN_SECONDS`.
    """
    atexit.register(_end_at_once)  # called before the functions that JAX has registered


def _end_at_once() -> NoReturn:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # closed
            stream.flush()
    os._exit(LOST_CODE)


def end_without_others(reason: object) -> NoReturn:
    """End this process with `LOST_CODE` and one line, because another one has died.

    Args:
      reason: The error of JAX.
    """
    _ending.acquire()  # never released, so only one thread prints the line
    line = (str(reason).splitlines() or [""])[0]
    console.error(
        f"another process has died or cannot be reached ({line}); start all again, "
        "fewer if need be, and resume the run"
    )
    _end_at_once()


@contextlib.contextmanager
def _ending_with_others():
    """Let the client that `jax.distributed` creates in the block end without a trace.

    By default it aborts with a stack trace of C++ when another process has sent no
    heartbeat. JAX does not pass the argument for another function. jaxlib 0.10 fails to
    convert the argument of that function, and aborts, which a signal handler in C must
    catch: those of Python are called by the main thread, later.
    """
    from jax._src import distributed

    module, name = distributed._jax, "get_distributed_runtime_client"
    create = getattr(module, name)
    ending = functools.partial(create, missed_heartbeat_callback=end_without_others)
    setattr(module, name, ending)
    try:
        yield
    finally:
        setattr(module, name, create)
    if os.name == "posix":
        ctypes.CDLL(None).signal(int(signal.SIGABRT), _on_abort)


@ctypes.CFUNCTYPE(None, ctypes.c_int)
def _on_abort(_):
    end_without_others("see the messages of JAX above")


def send(kind: str, **content: Any) -> None:
    """Send a message to all other processes.

    Args:
      kind: END, RUN, COMPILE or STEPS.
      **content: JSON values.
    """
    global _messages
    _client().key_value_set(_key(_messages), json.dumps({"kind": kind, **content}))
    _messages += 1


def receive() -> dict[str, Any]:
    """Wait for the next message of process 0.

    Returns:
      Its content.
    """
    global _messages
    while True:
        stopping.check()
        try:
            text = _client().blocking_key_value_get(
                _key(_messages), 1000 * POLL_SECONDS
            )
        except jax.errors.JaxRuntimeError as error:
            if "DEADLINE_EXCEEDED" not in str(error):
                end_without_others(error)
            continue
        _messages += 1
        return json.loads(text)


def meet() -> None:
    """Wait until all processes have called this function as often.

    Collectives fail after a time, which compilation on one host may exceed.
    """
    global _barriers
    _client().wait_at_barrier(f"nerfies-{_barriers}", 1000 * BARRIER_SECONDS)
    _barriers += 1


def send_steps(
    kind: str, state: PyTree, frames: PyTree, steps: int, count: int
) -> None:
    """Send a chunk of steps to the other processes.

    Args:
      kind: COMPILE or STEPS.
      state: Training state, or its shapes to COMPILE. The arrays are sent unless they
        are those that the last chunk returned.
      frames: Training frames, or their shapes.
      steps: Number of steps of the whole run.
      count: Number of steps of the chunk.
    """
    leaves = jax.tree.leaves(state)
    is_same_tree = len(leaves) == len(_sent_leaves) and all(
        last() is leaf for last, leaf in zip(_sent_leaves, leaves, strict=True)
    )
    arrays = kind == STEPS and not is_same_tree
    send(
        kind,
        steps=steps,
        count=count,
        state=[_note(leaf) for leaf in leaves],
        frames=[_note(leaf) for leaf in jax.tree.leaves(frames)],
        arrays=arrays,
    )
    if arrays:
        _broadcast(b"".join(_to_host(leaf).tobytes() for leaf in leaves))


def remember(state: PyTree) -> None:
    """Note the state that a chunk returned, the same in all processes.

    Args:
      state: Training state.
    """
    _sent_leaves[:] = [weakref.ref(leaf) for leaf in jax.tree.leaves(state)]


def received_state(message: dict[str, Any], example: PyTree) -> PyTree:
    """Return the state of a message of `send_steps`.

    Args:
      message: The message.
      example: A state of the same structure.

    Returns:
      The state on the first local device, zeros if the message has no arrays.
    """
    notes = message["state"]
    sizes = [jnp.dtype(n["dtype"]).itemsize * int(np.prod(n["shape"])) for n in notes]
    data = bytes(sum(sizes))
    if message["arrays"]:
        data = _broadcast(data)
    examples, structure = jax.tree.flatten(example)
    leaves, start = [], 0
    for note, size, template in zip(notes, sizes, examples, strict=True):
        array = np.frombuffer(data[start : start + size], jnp.dtype(note["dtype"]))
        leaf = jnp.array(array.reshape(note["shape"]))
        if _is_key(template):
            leaf = jax.random.wrap_key_data(leaf, impl=jax.random.key_impl(template))
        leaves.append(leaf)
        start += size
    return jax.tree.unflatten(structure, leaves)


def check_frames(message: dict[str, Any], frames: PyTree) -> None:
    """Check that the frames of this process have the shapes of those of process 0.

    Args:
      message: A message of `send_steps`.
      frames: Training frames.

    Raises:
      ValueError: If an array has another shape or type.
    """
    notes = [_note(leaf) for leaf in jax.tree.leaves(frames)]
    if notes != message["frames"]:
        raise ValueError(
            f"process {jax.process_index()} read training frames of "
            f"{[n['shape'] for n in notes]}, and process 0 of "
            f"{[n['shape'] for n in message['frames']]}; give all processes the same "
            "capture and the same cache (XDG_CACHE_HOME)"
        )


def _note(leaf):
    """Describe an array, or the data of PRNG keys, as JSON values."""
    if _is_key(leaf):
        shape = jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)
        leaf = jax.eval_shape(jax.random.key_data, shape)
    return {"dtype": str(leaf.dtype), "shape": list(leaf.shape)}


def _to_host(leaf):
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _is_key(leaf):
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _broadcast(data: bytes) -> bytes:
    """Return the bytes that process 0 passes, of which others pass the number."""
    from jax.experimental import multihost_utils

    meet()
    array = np.frombuffer(data, np.uint8)
    return np.asarray(multihost_utils.broadcast_one_to_all(array)).tobytes()


def _key(number):
    return f"nerfies/{number}"


def _client():
    # JAX has no public access to the service, without which a process could wait for
    # another only inside of a collective, which fails after 30 s. Orbax does the same.
    from jax._src import distributed

    return distributed.global_state.client
