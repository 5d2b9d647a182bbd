"""What a process is told of its cores before JAX begins."""

import os
import subprocess
import sys

import pytest

from nerfies_jax.runs import platform

DIVIDED = """
import sys
from nerfies_jax.runs import platform
platform.start_jax("cpu", sys.argv[1], 2)
import jax, jax.numpy as jnp
from nerfies_jax.compiler import UNDIVIDED
lowered = jax.jit(jnp.exp).lower(jnp.zeros((2048, 2048)))
for options in (None, UNDIVIDED):
    print("outer_dimension_partitions" in lowered.compile(options).as_text())
"""


@pytest.mark.full
@pytest.mark.skipif(platform.cores() < 2, reason="there is one core to divide among")
def test_devices_that_see_a_core_each_and_what_asks_for_it_do_not_divide_loops():
    assert are_divided("all") == ["True", "False"]
    assert are_divided("one") == ["False", "False"]


def are_divided(threads):
    own = ("XLA_FLAGS", "PJRT_NPROC", "NPROC", "JAX_NUM_CPU_DEVICES")
    environment = {name: x for name, x in os.environ.items() if name not in own}
    command = [sys.executable, "-c", DIVIDED, threads]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.split()
