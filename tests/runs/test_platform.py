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
program = jax.jit(jnp.exp).lower(jnp.zeros((2048, 2048))).compile()
print("outer_dimension_partitions" in program.as_text())
"""


@pytest.mark.full
@pytest.mark.skipif(platform.cores() < 2, reason="there is one core to divide among")
def test_devices_that_see_a_core_each_do_not_divide_loops():
    assert is_divided("all") == "True"
    assert is_divided("one") == "False"


def is_divided(threads):
    own = ("XLA_FLAGS", "PJRT_NPROC", "NPROC", "JAX_NUM_CPU_DEVICES")
    environment = {name: x for name, x in os.environ.items() if name not in own}
    command = [sys.executable, "-c", DIVIDED, threads]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()
