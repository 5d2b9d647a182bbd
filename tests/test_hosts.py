"""Training on several processes, which are connected by `jax.distributed`."""

import contextlib
import dataclasses
import os
import pathlib
import pickle
import signal
import socket
import subprocess
import sys
import time
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import multihost_utils

from nerfies_jax.runs import multiple_hosts
from nerfies_jax.runtime import data_parallel, hosts
from nerfies_jax.training import follower
from nerfies_jax.training.model import Event
from tests import scenes
from tests.gaussians.test_bands import stretched
from tests.test_devices import model_of
from tests.training import toy

STEPS = 4
SPECS = (
    scenes.TINY_SPLATS,  # one view, in bands
    dataclasses.replace(scenes.TINY_FIELD, micro_batches=2),
)


def shrunk(state, _frames):
    """The state as an event changes it, which only process 0 does."""
    return state._replace(params=jax.tree.map(lambda leaf: 0.9 * leaf, state.params))


EVENT = Event("shrink", (2,), shrunk)


def free_port(first=0, last=0):
    """Return a port that nothing listens on, between two numbers or any."""
    for port in range(first, last + 1):
        with socket.socket() as free, contextlib.suppress(OSError):
            free.bind(("localhost", port))
            return free.getsockname()[1]
    raise OSError("all ports are used")


def started(code, *more, processes=2, launched=None):
    """Start processes that run `code` with the arguments of `hosts.join`.

    `launched` is a function that returns the variables of a launcher for the number of
    a process.
    """
    port = free_port()
    env = dict(os.environ, JAX_PLATFORMS="cpu", JAX_NUM_CPU_DEVICES="1")
    env["XLA_FLAGS"] = "--xla_backend_optimization_level=0"  # compiles sooner
    return [
        subprocess.Popen(
            [sys.executable, "-c", code, f"localhost:{port}", str(processes), str(i)]
            + [str(argument) for argument in more],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=env if launched is None else env | launched(i),
        )
        for i in range(processes)
    ]


def ended(process):
    """Return the exit code of a process and the end of its output."""
    output = process.communicate(timeout=300)[0]
    return process.returncode, output[-3000:]


def connected():
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    address, count, number = sys.argv[1:4]
    hosts.join(address, int(count), int(number))


def train_each():
    """Train each scene on all processes, in process 0 also alone."""
    connected()
    capture = pickle.loads(pathlib.Path(sys.argv[4]).read_bytes())
    assert hosts.joined()
    with hosts.dismissing() if hosts.leads() else data_parallel.spanning_hosts():
        for spec in SPECS:
            if hosts.leads():
                compare(spec, capture)
            else:
                model, state, frames = scene_of(spec, capture)

                assert follower.follow(model, state, frames) == ""


def scene_of(spec, capture):
    model, state, frames = model_of(spec, capture)
    return model, stretched(state) if spec is SPECS[0] else state, frames


def compare(spec, capture):
    model, state, frames = scene_of(spec, capture)
    one = toy.fit(frames, state, model, steps=STEPS, events=(EVENT,))
    with data_parallel.spanning_hosts():
        model, state, frames = scene_of(spec, capture)
        assert model.devices == 2
        several = toy.fit(frames, state, model, steps=STEPS, events=(EVENT,))
    hosts.send(hosts.END, error="")
    assert several.stopped_by == "steps"
    ours, plain = jax.tree.leaves(several.state), jax.tree.leaves(one.state)
    for new, old in zip(ours, plain, strict=True):
        if not jnp.issubdtype(old.dtype, jax.dtypes.prng_key):
            # Adam amplifies the rounding of gradients close to zero.
            new, old = np.asarray(new, float), np.asarray(old, float)
            assert np.linalg.norm(new - old) <= 1e-4 * np.linalg.norm(old)


def lose_the_other():
    """End process 1 while process 0 trains, whose steps then fail."""
    connected()
    both = multihost_utils.broadcast_one_to_all
    both(np.ones(3))  # connects the devices
    hosts.meet()
    if not hosts.leads():
        os.kill(os.getpid(), signal.SIGKILL)
    run = types.SimpleNamespace(code=(), model=types.SimpleNamespace(devices=2))
    multiple_hosts.rebuilt = lambda run: run
    try:
        with hosts.dismissing(), multiple_hosts.sharing(pathlib.Path("RUN"), run):
            while True:
                np.asarray(both(np.ones(3)))
    except hosts.Lost as error:
        sys.exit(f"error: {error}")


def wait_for_the_other():
    """End one process outside of a step. The other one waits, as for an evaluation."""
    hosts.HEARTBEAT_SECONDS = 3
    connected()
    hosts.meet()
    if jax.process_index() == int(sys.argv[4]):
        os.kill(os.getpid(), signal.SIGKILL)
    if hosts.leads():
        time.sleep(60)
    else:
        hosts.receive()


@pytest.mark.full
@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
@pytest.mark.parametrize("lost", [0, 1])
def test_a_host_that_dies_in_silence_ends_the_other_with_an_error(lost):
    """JAX would abort with a stack trace of C++."""
    code = "from tests import test_hosts as t; t.wait_for_the_other()"
    processes = started(code, lost)
    exit_code, output = ended(processes[1 - lost])
    assert exit_code == hosts.LOST_CODE, output
    assert output.splitlines()[-1].startswith("error: another process has died or ")
    assert "stack trace" not in output
    assert "Traceback" not in output
    assert ended(processes[lost])[0] == -signal.SIGKILL


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
def test_the_death_of_a_host_ends_process_0_with_its_error():
    """JAX would wait for the dead process, and abort."""
    first, second = started("from tests import test_hosts as t; t.lose_the_other()")
    code, output = ended(first)
    assert code == hosts.LOST_CODE, output
    assert "error: RUN: training on 2 processes failed (" in output
    assert ended(second)[0] == -signal.SIGKILL


def by_slurm(job, number):
    """Variables of `srun`: the job, and the hosts and the numbers of its processes."""
    names = {"JOB_ID": job, "STEP_NODELIST": "localhost,node[2-4]", "NTASKS": 2}
    names |= {"PROCID": number, "LOCALID": number}
    return {f"SLURM_{name}": str(value) for name, value in names.items()}


def by_open_mpi(job, number):
    """Numbers of a process that all versions of `mpirun` set."""
    numbers = {"SIZE": 2, "RANK": number, "LOCAL_RANK": number}
    return {f"OMPI_COMM_WORLD_{name}": str(value) for name, value in numbers.items()}


def by_open_mpi_4(job, number):
    uri = f"{job * 2**12}.0;tcp://127.0.0.1,10.148.0.1:34911"
    return {**by_open_mpi(job, number), "OMPI_MCA_orte_hnp_uri": uri}


def by_open_mpi_5(job, number):
    """Of 5.0.11. The name of the job ends with the process id of `mpirun`."""
    name = f"prterun-localhost-{job}@1"
    return {**by_open_mpi(job, number), "PMIX_NAMESPACE": name}


def join_by_launcher():
    hosts.join(None)
    leader = multihost_utils.broadcast_one_to_all(np.int32(jax.process_index() + 5))
    print("process", jax.process_index(), "of", jax.process_count(), "hears", leader)


@pytest.mark.full
@pytest.mark.parametrize("launcher", [by_slurm, by_open_mpi_4, by_open_mpi_5])
def test_processes_are_connected_by_the_variables_of_a_launcher(launcher):
    job = free_port(61440 + 7, 65535) - 61440  # the port follows from it
    processes = started(
        "from tests import test_hosts as t; t.join_by_launcher()",
        launched=lambda number: launcher(job, number),
    )
    for number, process in enumerate(processes):
        code, output = ended(process)
        assert code == 0, output
        assert f"process {number} of 2 hears 5" in output


def test_open_mpi_5_names_the_host_of_mpirun_in_the_job():
    name = {"PMIX_NAMESPACE": "prterun-node-01.lab-70000@2"}
    assert hosts.open_mpi_address(name) is None  # another program of PMIx
    variables = by_open_mpi(0, 1) | name
    address = f"node-01.lab:{61440 + 70000 % 4096}"
    assert hosts.open_mpi_address(variables) == (address, 2, 1, [1])
    variables |= {"JAX_COORDINATOR_PORT": "9876", "JAX_LOCAL_DEVICE_IDS": "0,1"}
    assert hosts.open_mpi_address(variables) == ("node-01.lab:9876", 2, 1, None)
    variables["PMIX_NAMESPACE"] = "slurm.pmix.12.0"
    assert hosts.open_mpi_address(variables) is None


@pytest.mark.full
def test_two_processes_train_what_one_does(tmp_path):
    """Splats and a field, with an event that process 0 alone applies."""
    file = tmp_path / "capture"
    file.write_bytes(pickle.dumps(scenes.tiny_capture()))
    processes = started("from tests import test_hosts as t; t.train_each()", file)
    for code, output in [ended(process) for process in processes]:
        assert code == 0, output
