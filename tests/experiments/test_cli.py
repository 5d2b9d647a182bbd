"""Wrong input ends in one line; every command is listed and answers."""

import dataclasses
import json
import pathlib
import re
import signal
import subprocess
import sys
from typing import ClassVar, Literal

import pytest

import gaussians_jax
import nerfies_jax
from experiments import __main__ as every
from experiments import cli, names
from nerfies_jax.capture import json_files
from nerfies_jax.runs import representations, run_folder
from nerfies_jax.runs.config import CaptureNotFound
from nerfies_jax.training import specs


@dataclasses.dataclass(frozen=True)
class Nothing:
    """Do nothing."""


def test_user_errors_are_one_line_and_exit_code_two(capsys):
    with pytest.raises(SystemExit) as stop, cli.user_errors():
        raise ValueError("first\nsecond")
    assert stop.value.code == 2
    assert capsys.readouterr().err == "error: first second\n"


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ('leave them out with missing="skip"', "leave them out with --missing skip"),
        ("max_side=0; expected more", "--max-side 0; expected more"),
        ("choose a folder with out=..., or", "choose a folder with --out, or"),
        ("or set overwrite=True", "or set --overwrite"),
        ("a timeout=5 is no option", "a timeout=5 is no option"),
        ("or go on with runs.resume", "or go on with --resume"),
        ("use runs.resume('a b')", "use --out a b --resume"),
    ],
)
def test_options_stand_where_the_library_names_arguments(said, shown, capsys):
    with pytest.raises(SystemExit), cli.user_errors():
        raise ValueError(said)
    assert capsys.readouterr().err == f"error: {shown}\n"


def test_errors_of_some_kinds_are_shown_with_their_option(tmp_path, capsys):
    refusals = [
        (lambda: specs.override(Nothing(), ["a=1"]), "error: --set a: Nothing has no"),
        (lambda: run_folder.check_free(tmp_path), "or continue the run in it with --"),
    ]
    (tmp_path / "kept").touch()
    for refuse, words in refusals:
        with pytest.raises(SystemExit), cli.user_errors():
            refuse()
        assert words in capsys.readouterr().err
    with pytest.raises(SystemExit), cli.user_errors():
        raise CaptureNotFound(tmp_path, "capture")
    assert f"CAPTURE --out {tmp_path} --resume" in capsys.readouterr().err


def test_an_interrupted_command_ends_in_one_line(capsys):
    @cli.command(Nothing)
    def main(args):
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as stop:
        main([])
    assert stop.value.code == 130
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_is_ended_clears_away_what_it_began(number, tmp_path):
    @cli.command(Nothing)
    def main(args):
        with json_files.new_folder(tmp_path / "new") as folder:
            (folder / "half").touch()
            signal.raise_signal(number)

    before = signal.getsignal(number)
    with pytest.raises(SystemExit) as stop:
        main([])
    assert stop.value.code == 128 + number
    assert not list(tmp_path.iterdir())
    assert signal.getsignal(number) is before


def test_our_own_bugs_keep_their_traceback():
    with pytest.raises(KeyError), cli.user_errors():
        raise KeyError("bug")


@dataclasses.dataclass(frozen=True)
class _Inner:
    """What lies within."""

    masks: pathlib.Path | str | None = None
    """Where they are
    (default: beside it)."""


@dataclasses.dataclass(frozen=True)
class _Settings:
    """Do nothing."""

    GROUPS: ClassVar = {"place": ("device",)}

    device: Literal["cpu", "gpu"] = "cpu"  # where
    count: int | None = None
    """How
    many."""
    wet: bool = False
    inner: _Inner = _Inner()
    names: tuple[str, ...] = ()

    def __post_init__(self):
        if self.count == 0:
            raise ValueError("--count 0: at least one")


@cli.command(_Settings)
def _said(args):
    print("words")
    subprocess.run(["echo", "more"], check=True)
    if args.wet:
        return cli.Ended({"wet": pathlib.Path("sea")}, 3)
    return {"count": args.count}


def test_settings_come_back_from_where_the_help_has_them():
    words = ["--device", "gpu", "--inner.masks", "m", "--names", "a", "b", "--wet"]
    settled = cli.parse(_Settings, words)
    assert settled == _Settings(
        "gpu", None, True, _Inner(pathlib.Path("m")), ("a", "b")
    )
    with pytest.raises(SystemExit):
        cli.parse(_Settings, ["--device", "abacus"])
    with pytest.raises(ValueError, match="--count 0: at least one"):
        cli.parse(_Settings, ["--count", "0"])


def test_help_reads_well(capsys):
    with pytest.raises(SystemExit):
        _said(["--help"])
    page = re.sub(r"[\s│╭╮╰╯─]+", " ", capsys.readouterr().out)
    assert "--device {cpu,gpu} where (default: cpu)" in page.split("place options")[1]
    assert "--count INT How many. --wet" in page
    assert "--inner.masks PATH Where they are. (default: beside it)" in page
    assert "None" not in page
    assert "/" not in page.split("Do nothing")[0]  # no path of this machine


def test_json_alone_is_on_standard_output(capfd):
    assert _said([]) == {"count": None}
    assert capfd.readouterr().out == "words\nmore\n"
    _said(["--count", "2", "--json"])
    printed = capfd.readouterr()
    assert json.loads(printed.out) == {"count": 2}
    assert sorted(printed.err.split()) == ["more", "words"]
    with pytest.raises(SystemExit) as stop:
        _said(["--json", "--wet"])
    assert stop.value.code == 3
    assert json.loads(capfd.readouterr().out) == {"wet": "sea"}


def test_every_command_is_listed_with_a_line(capsys):
    every.main([])
    first = capsys.readouterr().out
    every.main(["study"])
    second = capsys.readouterr().out
    assert {*names.FOR_USERS} < every.commands().keys()
    for name in every.commands():
        here, elsewhere = first, second
        if name not in names.FOR_USERS:
            here, elsewhere = second, first
        assert f"\n{name} " in here
        assert f"\n{name} " not in elsewhere
    assert all(line.endswith((".", "?")) for line in every.commands().values())


# Their options are made of what they study.
NEED_JAX = {
    "hard_cases",
}
ASK_FOR_HELP = """
import contextlib, io, sys
from experiments import __main__ as every
from experiments import names
for name in sys.argv[1:]:
    try:
        with contextlib.redirect_stdout(io.StringIO()) as page:
            every.main([*names.line(name).split()[1:], "--help"])
    except SystemExit as stop:
        said = page.getvalue()
        told = "subcommands" in said or "--json" in said
        if stop.code or not told or f"usage: {names.line(name)}" not in said:
            sys.exit(f"{name} --help does not help")
    if "jax" in sys.modules:
        sys.exit(f"{name} --help imports JAX")
"""


WITHOUT_EXTRAS = """
import importlib, pathlib, sys
names = "av matplotlib pycolmap viser pillow_heif zstandard onnxruntime submitit"
for name in [*names.split(), "distributed"]:
    sys.modules[name] = None
for package in ("nerfies_jax", "gaussians_jax", "experiments"):
    for path in sorted(pathlib.Path(package).rglob("*.py")):
        # One does its work when it is loaded, and other packages load the others.
        if path.stem not in ("worker", "nerfbaselines_spec", "nerfstudio_method"):
            importlib.import_module(".".join(path.with_suffix("").parts))
"""


@pytest.mark.full
def test_everything_loads_without_the_extras():
    root = pathlib.Path(every.__file__).parents[1]
    words = [sys.executable, "-c", WITHOUT_EXTRAS]
    done = subprocess.run(words, capture_output=True, text=True, cwd=root)
    assert (done.returncode, done.stderr) == (0, "")


def test_help_is_quick():
    names = sorted(every.commands().keys() - NEED_JAX)
    words = [sys.executable, "-c", ASK_FOR_HELP, *names]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_unknown_command_names_those_there_are(capsys):
    with pytest.raises(SystemExit) as stop:
        every.main(["reconstrct"])
    assert stop.value.code == 2
    words = "did you mean reconstruct? there are reconstruct, download, "
    assert words in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        every.main(["study", "benchmrk"])
    assert stop.value.code == 2
    assert "did you mean benchmark? there are benchmark, " in capsys.readouterr().err


def test_one_version_is_told_everywhere(capsys):
    root = pathlib.Path(every.__file__).parents[1]
    version = nerfies_jax.__version__
    every.main(["--version"])
    assert capsys.readouterr().out.startswith(f"nerfies-jax {version}, jax ")
    assert gaussians_jax.__version__ == version
    assert f"\nversion: {version}\n" in (root / "CITATION.cff").read_text()
    assert f"\n## [{version}] " in (root / "CHANGELOG.md").read_text()


SHADOWED = """
import runpy, sys
sys.path[0] = sys.argv.pop(1)  # as in the script `nerfies`, whose folder comes first
from experiments.__main__ import main
main()
"""


def test_a_folder_named_experiments_does_not_matter(tmp_path):
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/__init__.py").write_text("raise ImportError('mine')")
    root = pathlib.Path(every.__file__).parents[1]
    words = [sys.executable, "-c", SHADOWED, str(root), "--version"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.full
def test_a_shell_completes_commands_options_and_presets(capsys):
    with pytest.raises(SystemExit):
        every.main(["--tyro-print-completion", "bash"])
    script = capsys.readouterr().out
    assert set(representations.PRESETS) == {
        preset
        for each in representations.installed().values()
        for preset in each.presets
    }
    for word in (*every.commands(), "--json", "--resume", *representations.PRESETS):
        assert f"'{word}'" in script or f'"{word}"' in script, word
