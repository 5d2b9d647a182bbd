"""Output that cannot be written is lost, and nothing else is."""

import ast
import errno
import io
import os
import pathlib
import re
import subprocess
import sys
import threading
import time
from unittest import mock

import pytest
import rich.console

from nerfies_jax.runtime import console, events, progress

ROOT = pathlib.Path(__file__).resolve().parents[1]
PACKAGES = ("nerfies_jax", "gaussians_jax", "experiments")
FULL = pathlib.Path("/dev/full")
QUIET = rich.console.Console(quiet=True)


def raw_writes(path):
    """Calls that write to the terminal past `nerfies_jax.runtime.console`."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print":
            yield f"{path}:{node.lineno}: print"
        if isinstance(node, ast.Attribute) and node.attr in ("write", "writelines"):
            stream = ast.unparse(node.value)
            if stream in ("sys.stdout", "sys.stderr"):
                yield f"{path}:{node.lineno}: {stream}.{node.attr}"


def test_every_message_goes_through_the_console():
    paths = [path for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))]
    assert len(paths) > 300
    assert [call for path in paths for call in raw_writes(path)] == []


@pytest.fixture
def broken_pipe():
    """A stream whose reader is gone."""
    reader, writer = os.pipe()
    os.close(reader)
    stream = os.fdopen(writer, "w")
    yield stream
    stream.close()


def on(stream, name, monkeypatch):
    monkeypatch.setattr(sys, name, stream)


def test_a_message_to_a_broken_pipe_is_lost_and_work_goes_on(broken_pipe, monkeypatch):
    on(broken_pipe, "stdout", monkeypatch)
    with console.session() as session:
        for _ in range(3):
            console.say("a result")
            print("of another library")
        assert sys.stdout.failure.errno == errno.EPIPE
        assert session.lost() is None
    assert sys.stdout is broken_pipe
    broken_pipe.flush()  # as Python does when it exits: nothing is left in its buffer


def test_a_message_outside_a_session_does_not_raise(broken_pipe, monkeypatch):
    on(broken_pipe, "stdout", monkeypatch)
    console.say("a result")
    on(None, "stderr", monkeypatch)
    console.warn("nobody hears")
    closed = io.StringIO()
    closed.close()
    on(closed, "stdout", monkeypatch)
    console.say("a result")


def test_a_document_without_a_reader_is_a_failure(broken_pipe, monkeypatch, capsys):
    on(broken_pipe, "stdout", monkeypatch)
    with pytest.raises(SystemExit) as stop, console.session() as session:
        session.deliver("{}")
    assert stop.value.code == 1
    assert capsys.readouterr().err == "error: output was lost: Broken pipe\n"


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("ended", [None, SystemExit(0), SystemExit(3)])
def test_a_full_disk_fails_a_command_that_succeeded(ended, monkeypatch, capsys):
    with FULL.open("w") as stream:
        on(stream, "stdout", monkeypatch)

        def command():
            with console.session():
                console.say("a result")
                if ended is not None:
                    raise ended

        with pytest.raises(SystemExit) as stop:
            command()
    code = 3 if ended is not None and ended.code else 1
    assert stop.value.code == code
    assert ("No space left" in capsys.readouterr().err) == (code == 1)


def test_words_that_a_stream_cannot_encode_are_escaped(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    on(stream, "stdout", monkeypatch)
    console.say("θ = 3°")
    assert stream.buffer.getvalue() == b"\\u03b8 = 3\\xb0\n"


def test_rich_does_not_end_the_process_when_the_reader_goes(broken_pipe):
    stream = console.SafeStream(broken_pipe)
    rich.console.Console(file=stream).print("a line")
    assert stream.failure.errno == errno.EPIPE


CLOSED = """
import os, sys
import experiments  # what a command imports first
from nerfies_jax.runtime import console
path = sys.argv[1]
with open(path, "w") as file:
    os.write(2, b"a native library's words")
    assert file.fileno() > 2, file.fileno()
    print("to a closed stream", file=sys.stderr)
    with console.session():
        console.say("a result")
        console.error("a complaint")
    file.write("kept")
assert open(path).read() == "kept"
"""


@pytest.mark.skipif(os.name != "posix", reason="closes descriptors as a shell does")
@pytest.mark.parametrize("closed", ["2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_do_not_lend_their_numbers_to_files(closed, tmp_path):
    words = ["sh", "-c", f'exec "$0" "$@" {closed}', sys.executable, "-c", CLOSED]
    done = subprocess.run([*words, str(tmp_path / "file")], cwd=ROOT)
    assert done.returncode == 0
    assert (tmp_path / "file").read_text() == "kept"


def test_stages_are_nested_events_that_begin_and_end():
    received = []

    def work():
        with events.stage("outer", 2) as outer:
            outer.advance(text="half")
            with events.stage("inner"):
                events.emit("train", step=1)
            raise KeyError

    with (
        events.subscribe(received.append),
        events.shown_on(QUIET),
        pytest.raises(KeyError),
    ):
        work()
    summary = [(one["kind"], one.get("name"), one.get("status")) for one in received]
    assert summary == [
        ("stage", "outer", "begin"),
        ("stage", "inner", "begin"),
        ("train", None, None),
        ("stage", "inner", "done"),
        ("stage", "outer", "failed"),
    ]
    begin, inner, train, _, last = received
    assert inner["parent"] == begin["stage"] == last["stage"]
    assert [train["phase"], inner["phase"], begin["phase"]] == [
        "inner",
        "inner",
        "outer",
    ]
    assert (last["done"], last["total"], last["text"]) == (1, 2, "half")
    assert last["seconds"] >= 0


def test_stages_of_another_thread_are_its_own():
    received = []

    def work():
        with events.stage("elsewhere"):
            pass

    with (
        events.subscribe(received.append),
        events.shown_on(QUIET),
        events.stage("here"),
    ):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        events.emit("train")
    assert "parent" not in received[1]
    assert received[3]["phase"] == "here"


def test_a_sink_that_fails_is_left_out(capsys):
    received = []

    def failing(event):
        raise ConnectionError("no network")

    with events.subscribe(failing), events.subscribe(received.append):
        events.emit("train")
        events.emit("train")
    assert len(received) == 2
    said = capsys.readouterr().err
    assert said == (
        "warning: function receives no further events: ConnectionError: no network\n"
    )


def lines_of(monkeypatch, seconds):
    """What a log says of a stage, with the clock as fast as `seconds` has it."""
    monkeypatch.setattr(progress, "TICK_SECONDS", 0.01)
    for name, value in seconds.items():
        monkeypatch.setattr(progress, name, value)
    text = io.StringIO()
    with events.shown_on(rich.console.Console(file=text, width=200)):
        with events.stage("short"):
            pass
        with events.stage("structure from motion"), events.stage("features", 4) as one:
            for _ in range(4):
                time.sleep(0.25)
                one.advance()
    return text.getvalue().splitlines()


def test_a_log_gets_a_line_of_a_stage_that_lasts_and_one_now_and_then(monkeypatch):
    often = {"FIRST_LINE_SECONDS": 0.02, "LINE_SECONDS": 0.1}
    first, *more = lines_of(monkeypatch, often)
    assert first.startswith("features")
    assert re.fullmatch(r"features: [1-4] of 4.*", more[-1])
    assert lines_of(monkeypatch, {"FIRST_LINE_SECONDS": 60.0}) == []


def test_a_stage_without_a_count_says_ever_more_rarely_that_it_lasts(monkeypatch):
    target = io.StringIO()
    display = progress.Display(rich.console.Console(file=target))
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress.threading, "Thread", mock.Mock())
    event = {"kind": "stage", "stage": 1, "name": "compiling", "done": 0, "total": None}
    display(event | {"status": "begin"})
    shown = []
    for now[0] in range(0, 100):
        before = target.tell()
        display._view.tick(list(display._open.values()))
        shown += [now[0]] if target.tell() > before else []
    assert shown == [2, 12, 24, 48, 96]
