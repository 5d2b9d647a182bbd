"""Wrong input ends in one line; every command is listed and answers."""

import dataclasses
import subprocess
import sys
from typing import Literal

import pytest

from experiments import __main__ as every
from experiments import cli


def test_user_errors_are_one_line_and_exit_code_two(capsys):
    with pytest.raises(SystemExit) as stop, cli.user_errors():
        raise ValueError("first\nsecond")
    assert stop.value.code == 2
    assert capsys.readouterr().err == "error: first second\n"


def test_our_own_bugs_keep_their_traceback():
    with pytest.raises(KeyError), cli.user_errors():
        raise KeyError("bug")


def test_an_unknown_device_is_refused():
    with pytest.raises(SystemExit):
        cli.parse(_Device, ["--device", "abacus"])


@dataclasses.dataclass(frozen=True)
class _Device:
    """A device."""

    device: Literal["cpu", "gpu"] = "cpu"


def test_every_command_is_listed_with_a_line(capsys):
    every.main([])
    printed = capsys.readouterr().out
    for name in ("reconstruct", "render", "prepare", "ablate", "hard_cases"):
        assert f"\n{name} " in printed
    assert all(line.endswith((".", "?")) for line in every.commands().values())


# Their options are made of what they study.
NEED_JAX = {
    "frequency_gates",
    "hard_cases",
    "motion_rank",
    "raster_speed",
    "solver_table",
    "spectral_bias",
}
ASK_FOR_HELP = """
import contextlib, io, sys
from experiments import __main__ as every
for name in sys.argv[1:]:
    try:
        with contextlib.redirect_stdout(io.StringIO()) as page:
            every.main([name, "--help"])
    except SystemExit as stop:
        if stop.code or "usage: nerfies" not in page.getvalue():
            sys.exit(f"{name} --help does not help")
    if "jax" in sys.modules:
        sys.exit(f"{name} --help imports JAX")
"""


def test_help_is_quick():
    names = sorted(every.commands().keys() - NEED_JAX)
    words = [sys.executable, "-c", ASK_FOR_HELP, *names]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_unknown_command_names_those_there_are(capsys):
    with pytest.raises(SystemExit) as stop:
        every.main(["reconstrct"])
    assert stop.value.code == 2
    assert "there are ablate, " in capsys.readouterr().err
