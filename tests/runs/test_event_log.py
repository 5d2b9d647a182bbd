"""The events of a run in its folder: whole lines, whatever ends the process."""

import json
import os
import pathlib

import pytest

from nerfies_jax.runs import curves, event_log
from nerfies_jax.runs.event_log import EVENTS, EventLog, EventReader, read_events
from nerfies_jax.runtime import events
from nerfies_jax.training.loop import History

FULL = pathlib.Path("/dev/full")


def logged(folder, *received):
    """A log into which these events went."""
    log = EventLog()
    log.open(folder)
    for event in received:
        log(event)
    log.close()


def train(step, **more):
    numbers = {"step": step, "steps": 9, "seconds": float(step), "compile_seconds": 1.0}
    return {"kind": "train", **numbers, "metrics": {"loss": 1 / step}, **more}


def evaluation(step, psnr):
    about = {"kind": "evaluation", "hook": "held out", "step": step}
    return {**about, "seconds": float(step), "metrics": {"psnr": psnr, "ssim": 0.5}}


def run(status, step, **more):
    return {"kind": "run", "status": status, "step": step, **more}


def test_events_before_the_folder_is_known_are_written_too(tmp_path):
    log = EventLog()
    with events.subscribe(log):
        events.emit("run", status="early")
        log.open(tmp_path)
        events.emit("run", status="late", value=float("nan"))
    log.close()
    early, late = read_events(tmp_path)
    assert (early["status"], late["status"]) == ("early", "late")
    assert late["value"] is None
    assert early["time"] <= late["time"]


def test_a_torn_last_line_is_left_out_and_removed_by_who_resumes(tmp_path):
    logged(tmp_path, run("begin", 0), train(1))
    path = tmp_path / EVENTS
    whole = path.read_bytes()
    path.write_bytes(whole[:-9])
    assert [event["kind"] for event in read_events(tmp_path)] == ["run"]
    logged(tmp_path, run("resume", 0))
    first = whole.splitlines(keepends=True)[0]
    assert path.read_bytes().startswith(first)
    assert [event.get("status") for event in read_events(tmp_path)] == [
        "begin",
        "resume",
    ]
    path.write_bytes(b"{")
    logged(tmp_path, run("begin", 0))
    assert len(read_events(tmp_path)) == 1


def test_damaged_lines_are_skipped(tmp_path):
    logged(tmp_path, train(1), train(2), run("end", 2))
    text = (tmp_path / EVENTS).read_text()
    (tmp_path / EVENTS).write_text("\0\0\n[1]\n" + "[" * 9999 + "\n{}\n" + text)
    assert [event["kind"] for event in read_events(tmp_path)][-1] == "run"
    (tmp_path / EVENTS).write_text('{"kind": "train", "step": "no"}\n' + text)
    assert curves.course_of(tmp_path).step == 2


def test_a_reader_follows_what_is_written(tmp_path):
    with pytest.raises(ValueError, match="events cannot be read"):
        EventReader(tmp_path).new()
    logged(tmp_path, run("begin", 0))
    reader = EventReader(tmp_path)
    assert len(reader.new()) == 1
    assert reader.new() == []
    with (tmp_path / EVENTS).open("a") as file:
        file.write('{"kind": "run", ')
        file.flush()
        assert reader.new() == []
        file.write('"status": "end"}\n')
    assert [event["status"] for event in reader.new()] == ["end"]


def test_rows_of_training_are_thinned_out_but_for_the_last(tmp_path):
    steps = range(1, 1000)
    logged(tmp_path, *map(train, steps), evaluation(999, 20.0), train(1000))
    read = read_events(tmp_path)
    assert [event["step"] for event in read] == [1, 999, 999, 1000]


def test_a_full_disk_keeps_events_waiting(tmp_path, monkeypatch, capsys):
    write, full = os.write, True

    def limited(descriptor, data):
        if not full:
            return write(descriptor, data)
        if len(data) > 10:  # as the last block fills up
            return write(descriptor, data[:10])
        raise OSError(28, "No space left on device")

    log = EventLog()
    log.open(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(event_log.os, "write", limited)
        log(run("begin", 0))
        assert read_events(tmp_path) == []
        full = False
        log(run("end", 1))
    log.close()
    assert [event["status"] for event in read_events(tmp_path)] == ["begin", "end"]
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
def test_events_that_are_lost_are_told_at_the_end(tmp_path, monkeypatch, capsys):
    (tmp_path / EVENTS).symlink_to(FULL)
    monkeypatch.setattr(event_log, "MAX_PENDING_BYTES", 100)
    logged(tmp_path, *(run("begin", step) for step in range(9)))
    assert "some events could not be written (No space left" in (
        capsys.readouterr().err
    )


def test_a_resumed_run_has_each_step_once(tmp_path):
    logged(tmp_path, run("begin", 0, steps=9, machine={"cpu": "one"}))
    logged(tmp_path, train(2), evaluation(2, 20.0), train(4), evaluation(4, 22.0))
    logged(tmp_path, run("resume", 2, steps=9), train(3), evaluation(4, 23.0))
    course = curves.course_of(tmp_path)
    assert [row["step"] for row in course.training] == [2, 3]
    assert [row["psnr"] for row in course.evaluations] == [20.0, 23.0]
    assert (course.step, course.steps, course.stopped_by) == (3, 9, None)
    curve = curves.read(tmp_path)
    assert curve.psnr == (20.0, 23.0)
    assert curve.machine == {"cpu": "one"}
    logged(tmp_path, run("end", 3, stopped_by="SIGTERM"))
    assert not curves.course_of(tmp_path).ended


def test_the_curve_is_made_of_events_unless_some_are_lost(tmp_path):
    row = {"hook": "held out", "step": 2, "seconds": 2.0, "psnr": 20.0, "ssim": 0.5}
    history = History(({"step": 1, "seconds": 1.0, "loss": 9.0},), (row,), 2.0, 1.0)
    logged(tmp_path, run("begin", 0), train(2), evaluation(2, 20.0))
    curves.write(tmp_path, history, ["a"], curves.course_of(tmp_path))
    stored = json.loads((tmp_path / "curve.json").read_text())
    assert stored["training"] == [{"step": 2, "seconds": 2.0, "loss": 0.5}]
    assert stored["evaluations"] == [row]
    history = history._replace(evaluations=(row, {**row, "step": 4}))
    curves.write(tmp_path, history, ["a"], curves.course_of(tmp_path))
    stored = json.loads((tmp_path / "curve.json").read_text())
    assert stored["training"] == [{"step": 1, "seconds": 1.0, "loss": 9.0}]
    assert len(stored["evaluations"]) == 2
