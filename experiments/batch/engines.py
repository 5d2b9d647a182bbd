"""Engines that execute tasks: threads of this process, Dask, and Slurm by submitit.

An engine is a function of tasks that yields each with its ending. When it is closed or
a signal arrives, it ends the tasks that it has started.
"""

import collections
import concurrent.futures
import contextlib
import itertools
import math
import os
import pathlib
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from experiments.batch.task import POLL_SECONDS, ROOT, Ending, Task
from nerfies_jax.capture import extras
from nerfies_jax.runtime import stopping

Engine = Callable[[Iterable[Task]], Iterator[tuple[Task, Ending]]]

EXTRA = "batch"  # with submitit and Dask
CLUSTER_POLL_SECONDS = 1.0
A_DAY_MINUTES = 24 * 60  # time slot of a job without a limit, requeued at its end
SPARE_MINUTES = 5  # for the supervisor to end a run at its limit
SPARE_GB = 1  # for the supervisor next to the run


def execute(
    tasks: Iterable[Task], engine: Engine, retries: int = 0
) -> Iterator[tuple[Task, Ending]]:
    """Execute tasks, and continue those that a signal from outside has ended.

    Args:
      tasks: The tasks.
      engine: The engine.
      retries: How often an interrupted task is continued.

    Yields:
      Each task with its last ending.
    """
    waiting, attempts = list(tasks), collections.Counter[Task]()
    while waiting:
        again = []
        for task, ending in engine(waiting):
            attempts[task] += 1
            if ending.interrupted and attempts[task] <= retries:
                again.append(task)
            else:
                yield task, ending
        waiting = again


def local(tasks: Iterable[Task], jobs: int = 1) -> Iterator[tuple[Task, Ending]]:
    """Execute tasks on this machine.

    Args:
      tasks: The tasks.
      jobs: Number of tasks at a time.

    Yields:
      Each task with its ending, as they end.
    """
    stop, waiting = threading.Event(), iter(tasks)
    pool = concurrent.futures.ThreadPoolExecutor(jobs)
    running: dict[concurrent.futures.Future[Ending], Task] = {}
    try:
        while True:
            # Not all at once: none may begin after the caller has given up.
            for task in itertools.islice(waiting, jobs - len(running)):
                running[pool.submit(task, stop)] = task
            if not running:
                return
            completed_futures, _ = concurrent.futures.wait(
                running, POLL_SECONDS, concurrent.futures.FIRST_COMPLETED
            )
            for future in completed_futures:
                yield running.pop(future), future.result()
            stopping.check()
    finally:
        stop.set()
        with stopping.protected():
            pool.shutdown()


def dask(
    tasks: Iterable[Task], jobs: int = 1, address: str | None = None
) -> Iterator[tuple[Task, Ending]]:
    """Execute tasks on the workers of a Dask cluster.

    A task whose worker dies is continued by another worker.

    Args:
      tasks: The tasks.
      jobs: Number of workers to start on this machine, without an address.
      address: Address of the scheduler of a running cluster, such as tcp://HOST:8786.

    Yields:
      Each task with its ending, as they end.
    """
    distributed = extras.library("distributed", EXTRA)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_importable())
        cluster: Any = address
        if address is None:
            cluster = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=jobs, threads_per_worker=1, dashboard_address=None
                )
            )
        client = stack.enter_context(distributed.Client(cluster))
        # A task that is continued needs another key.
        running = {client.submit(task, key=uuid.uuid4().hex): task for task in tasks}
        while running:
            for future in [future for future in running if future.done()]:
                error = future.exception() if future.status != "finished" else None
                yield running.pop(future), _failure(error) if error else future.result()
            time.sleep(POLL_SECONDS)
            stopping.check()


def slurm(
    tasks: Iterable[Task],
    folder: pathlib.Path,
    jobs: int = 1,
    options: Mapping[str, Any] = {},
    cluster: str = "slurm",
) -> Iterator[tuple[Task, Ending]]:
    """Execute tasks as an array of Slurm jobs.

    Args:
      tasks: The tasks.
      folder: Folder of the logs of Slurm, which all nodes can write.
      jobs: Number of jobs at a time.
      options: Options of `sbatch`, such as `partition`.
      cluster: Executor of submitit. "local" starts all tasks on this machine at once.

    Yields:
      Each task with its ending, as they end.
    """
    submitit = extras.library("submitit", EXTRA)
    tasks = list(tasks)
    executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
    executor.update_parameters(
        name="nerfies",
        slurm_array_parallelism=jobs,
        slurm_additional_parameters=dict(options),
        **_slot(tasks),
    )
    with _importable(), executor.batch():
        submitted_jobs = [executor.submit(task) for task in tasks]
    running = dict(zip(submitted_jobs, tasks, strict=True))
    try:
        while running:
            for job in [job for job in running if job.done()]:
                try:
                    ending = job.result()
                except Exception as error:  # of a job that could not report anything
                    ending = _failure(error)
                yield running.pop(job), ending
            time.sleep(CLUSTER_POLL_SECONDS)
            stopping.check()
    finally:
        for job in running:
            job.cancel()


def _slot(tasks):
    """Time and memory that Slurm reserves for each of some tasks."""
    seconds = max(task.limits.seconds for task in tasks)
    memory = max(task.limits.memory_bytes for task in tasks)
    slot: dict[str, Any] = {"timeout_min": A_DAY_MINUTES}
    if math.isfinite(seconds):
        slot["timeout_min"] = math.ceil(seconds / 60) + SPARE_MINUTES
    if math.isfinite(memory):
        slot["mem_gb"] = math.ceil(memory / 1e9) + SPARE_GB
    return slot


def _failure(error):
    """Ending of a task whose supervisor died, so that the run can be continued."""
    lines = str(error).strip().splitlines() or [""]
    return Ending(1, f"{type(error).__name__}: {lines[0]}", interrupted=True)


@contextlib.contextmanager
def _importable():
    """Let the processes of an engine import this package from a checkout."""
    earlier = os.environ.get("PYTHONPATH")
    path = filter(None, [str(ROOT), earlier])
    os.environ["PYTHONPATH"] = os.pathsep.join(path)
    try:
        yield
    finally:
        if earlier is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = earlier
