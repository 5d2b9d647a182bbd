"""What a process is told of its cores before JAX begins."""

import os
import pathlib
import re
import subprocess
import sys

import pytest

import gaussians_jax
import nerfies_jax
from nerfies_jax.runs import platform

DIVIDED = """
import sys
from nerfies_jax.runs import platform
platform.start_jax("cpu", sys.argv[1], 2)
import jax, jax.numpy as jnp
from nerfies_jax.runtime.compiler import UNDIVIDED
lowered = jax.jit(jnp.exp).lower(jnp.zeros((2048, 2048)))
for options in (None, UNDIVIDED):
    print("outer_dimension_partitions" in lowered.compile(options).as_text())
"""


@pytest.mark.full
@pytest.mark.skipif(platform.cores() < 2, reason="there is one core to divide among")
def test_devices_that_see_a_core_each_and_what_asks_for_it_do_not_divide_loops():
    assert printed_by(DIVIDED, "all") == ["True", "False"]
    assert printed_by(DIVIDED, "one") == ["False", "False"]


def printed_by(code, *arguments):
    """The words that a process prints which finds no settings of its cores."""
    own = ("XLA_FLAGS", "PJRT_NPROC", "NPROC", "JAX_NUM_CPU_DEVICES")
    environment = {name: x for name, x in os.environ.items() if name not in own}
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.split()


WIDE = """
from nerfies_jax.runs import platform
platform.start_jax("cpu")
import jax, jax.numpy as jnp, numpy as np
from nerfies_jax.geometry import so3

rng = np.random.default_rng(0)
vectors = rng.normal(size=(5000, 3)).astype(np.float32)
rotated = jax.jit(jax.vmap(lambda v: so3.log(so3.exp(v))))(vectors)
angle = np.linalg.norm(vectors, axis=1, keepdims=True).astype(np.float64)
near = (angle + np.pi) % (2 * np.pi) - np.pi
print(np.abs(rotated - vectors / angle * near)[angle[:, 0] < 3].max() < 1e-5)
"""


@pytest.mark.full
def test_rotations_are_right_in_wide_vectors():
    """XLA's arctan is wrong there for long arrays."""
    assert printed_by(WIDE) == ["True"]


@pytest.mark.parametrize("wide", [False, True])
def test_code_of_other_packages_is_not_compiled_in_wide_vectors(wide, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(platform, "_processor_flags", lambda: {"avx512f"})
    platform.start_jax("cpu", "all", wide=wide)
    assert (platform.VECTOR_WIDTH in os.environ["XLA_FLAGS"]) == wide


def test_no_function_uses_what_is_wrong_with_wide_vectors():
    """Commands compile for vectors of 512 bits, and tests do not."""
    wrong = re.compile(r"(?<!`)(jnp|lax)\.(arctan|atan)\(")
    for package in (nerfies_jax, gaussians_jax):
        for path in pathlib.Path(package.__file__).parent.rglob("*.py"):
            assert not wrong.search(path.read_text()), path
