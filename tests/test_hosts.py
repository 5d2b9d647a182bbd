"""Training on several processes, which are connected by `jax.distributed`."""

import dataclasses
import os
import pathlib
import pickle
import signal
import socket
import subprocess
import sys
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


def started(code, *more, processes=2):
    """Start processes that run `code` with the arguments of `hosts.join`."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    env = dict(os.environ, JAX_PLATFORMS="cpu", JAX_NUM_CPU_DEVICES="1")
    env["XLA_FLAGS"] = "--xla_backend_optimization_level=0"  # compiles sooner
    return [
        subprocess.Popen(
            [sys.executable, "-c", code, f"localhost:{port}", str(processes), str(i)]
            + [str(argument) for argument in more],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=env,
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


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
def test_the_death_of_a_host_ends_process_0_with_its_error():
    """JAX would wait for the dead process, and abort."""
    first, second = started("from tests import test_hosts as t; t.lose_the_other()")
    code, output = ended(first)
    assert code == hosts.LOST_CODE, output
    assert "error: RUN: training on 2 processes failed (" in output
    assert ended(second)[0] == -signal.SIGKILL


@pytest.mark.full
def test_two_processes_train_what_one_does(tmp_path):
    """Splats and a field, with an event that process 0 alone applies."""
    file = tmp_path / "capture"
    file.write_bytes(pickle.dumps(scenes.tiny_capture()))
    processes = started("from tests import test_hosts as t; t.train_each()", file)
    for code, output in [ended(process) for process in processes]:
        assert code == 0, output
