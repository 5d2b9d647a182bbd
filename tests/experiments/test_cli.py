"""Wrong input ends in one line; every command is listed and answers."""

import dataclasses
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
    told = capsys.readouterr().out
    for name in ("reconstruct", "render", "prepare", "ablate", "hard_cases"):
        assert f"\n{name} " in told
    assert all(line.endswith((".", "?")) for line in every.commands().values())


def test_an_unknown_command_names_those_there_are(capsys):
    with pytest.raises(SystemExit) as stop:
        every.main(["reconstrct"])
    assert stop.value.code == 2
    assert "there are ablate, " in capsys.readouterr().err
