"""Training of one run by several processes (`nerfies_jax.runtime.hosts`).

All processes must see the run folder and the capture under the same paths.
"""

import contextlib
import pathlib
from collections.abc import Collection, Iterator

import jax

from nerfies_jax.runs import commands, validation
from nerfies_jax.runs.run import Run, rebuilt, saved_run
from nerfies_jax.runtime import console, data_parallel, hosts
from nerfies_jax.training import follower


def check(run: Run) -> None:
    """Check that a step of a run can be divided among all processes.

    Args:
      run: The run.

    Raises:
      ValueError: If it cannot.
    """
    if hosts.leads():
        resources = run.representation.resources
        data_parallel.check_hosts(
            resources.shares(run.spec),
            resources.share_setting,
            divisible=resources.divisible,
        )


@contextlib.contextmanager
def sharing(folder: pathlib.Path, run: Run) -> Iterator[Run]:
    """Share the training of a run with the other processes, if this one leads.

    Args:
      folder: The run folder, which holds its settings.
      run: The run.

    Yields:
      The run whose steps use the devices of all processes, `run` if there is only one.

    Raises:
      Lost: If a step fails in the block, because another process has died.
    """
    if not hosts.leads():
        yield run
        return
    hosts.send(hosts.RUN, folder=str(folder.absolute()))
    with data_parallel.spanning_hosts():
        shared_run = rebuilt(run)
        console.say(
            f"{jax.process_count()} processes train, with {shared_run.model.devices} "
            "devices in all"
        )
        try:
            yield shared_run
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            if not hosts.is_loss(error):
                raise
            hosts.abandon()
            reason = str(error).splitlines()[0]
            raise hosts.Lost(
                f"{folder}: training on {jax.process_count()} processes failed "
                f"({reason}); if one of them has died, start the others again, fewer "
                f"if need be, and continue with {commands.resume(folder, run.code)}"
            ) from error


def follow(trusted: Collection[str] = ()) -> None:
    """Take part in the training of process 0 until it has ended.

    Args:
      trusted: Names MODULE:NAME of code from other packages that may be loaded if the
        run needs it.

    Raises:
      ValueError: If process 0 ended with an error, or this process cannot read the run
        or its capture.
    """
    message = hosts.receive()
    error = message.get("error", "")
    if message["kind"] == hosts.RUN:
        with data_parallel.spanning_hosts():
            run = saved_run(pathlib.Path(message["folder"]), trusted=trusted)
            build = run.model.example or run.model.init
            state = build(run.capture, jax.random.key(0))
            frames = validation.training_frames(run)
            try:
                error = follower.follow(run.model, state, frames)
            except (jax.errors.JaxRuntimeError, ValueError) as cause:
                if hosts.is_loss(cause):
                    hosts.end_without_others(cause)
                raise
    if error:
        raise ValueError(f"process 0 ended with an error: {error}")
