"""Code in a process of its own: what JAX fixes when it starts cannot be tried here."""

import os
import subprocess
import sys


def run(code: str) -> None:
    """Run Python code on CPU devices; fail with the end of what it says."""
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env=dict(os.environ, JAX_PLATFORMS="cpu"),
    )
    assert result.returncode == 0, result.stderr[-2000:]
