"""What experiment trackers receive, read back by their own readers."""

import json
import struct
import sys
import time

import pytest

from nerfies_jax.capture.extras import MissingExtra
from nerfies_jax.runs import trackers
from nerfies_jax.runtime import events

# Of each tracker the module that reads what it wrote.
READERS = {
    "tensorboard": "tensorboard.backend.event_processing.event_accumulator",
    "wandb": "wandb.proto.wandb_internal_pb2",
    "rerun": "rerun.chunk",
}


def train(step, psnr):
    events.emit(
        "train",
        step=step,
        steps=4,
        seconds=float(step),
        steps_per_second=2.0,
        eta_seconds=0.0,
        psnr=psnr,
        metrics={"loss": 1 / step},
        counts={"gaussians": 5},
        memory_bytes=100,
    )


def tracked(name, folder, step=0):
    """What a run of two steps more gives a tracker."""
    run = trackers.TrackedRun(folder, "abc123", "a run", {"preset": "nerf"}, step)
    with trackers.opened(name, run) as sink, events.subscribe(sink):
        with events.stage("training"):
            train(step + 1, None)
            train(step + 2, 20.0)
        numbers = {"psnr": 18.0}
        events.emit(
            "evaluation", hook="held out", step=step + 2, seconds=2.0, metrics=numbers
        )


def test_the_numbers_of_an_event_have_names():
    received = []
    with events.subscribe(received.append):
        train(1, None)
        train(2, 20.0)
        events.message("not a number")
    first, second, other = map(trackers.scalars, received)
    assert first == {
        "train/loss": 1.0,
        "train/gaussians": 5.0,
        "train/steps_per_second": 2.0,
        "train/memory_bytes": 100.0,
    }
    assert second["train/psnr"] == 20.0
    assert other == {}


def test_a_tracker_that_is_missing_is_said_at_once(monkeypatch):
    with pytest.raises(ValueError, match="did you mean tensorboard"):
        trackers.check(["tensorbord"])
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r"nerfies-jax\[log\]"):
        trackers.check(["rerun"])


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # theirs
@pytest.mark.parametrize("name", list(trackers.TRACKERS))
def test_a_tracker_reads_back_what_it_was_sent(name, tmp_path, monkeypatch):
    pytest.importorskip(trackers.PACKAGES[name])
    pytest.importorskip(READERS[name])
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    tracked(name, tmp_path)
    time.sleep(1.1)  # names of files are seconds
    tracked(name, tmp_path, step=1)  # resumed from an earlier checkpoint
    until = time.monotonic() + 60  # W&B has a process of its own write
    metrics = READ[name](tmp_path)
    while metrics["held_out/psnr"][-1][0] != 3 and time.monotonic() < until:
        time.sleep(0.1)
        metrics = READ[name](tmp_path)
    assert metrics["train/loss"][-1] == (3, pytest.approx(1 / 3))
    assert metrics["train/psnr"][-1] == (3, 20.0)
    assert metrics["held_out/psnr"][-1] == (3, 18.0)
    if name != "wandb":  # it numbers what it is sent by itself
        assert [step for step, _ in metrics["train/loss"]] == [1, 2, 3]


def _of_tensorboard(folder):
    from tensorboard.backend.event_processing.event_accumulator import (
        EventAccumulator,
    )

    read = EventAccumulator(str(folder / "tensorboard"))
    read.Reload()
    names = read.Tags()["scalars"]
    return {name: [(x.step, x.value) for x in read.Scalars(name)] for name in names}


def _of_wandb(folder):
    from wandb.proto import wandb_internal_pb2

    metrics = {}
    for path in sorted(folder.glob("wandb/offline-run-*/*.wandb")):
        for data in _records(path.read_bytes()):
            record = wandb_internal_pb2.Record()
            record.ParseFromString(data)
            items = record.history.item
            row = {
                each.key or each.nested_key[0]: json.loads(each.value_json)
                for each in items
            }
            for key, value in row.items():
                metrics.setdefault(key, []).append((row.get("step"), value))
    return metrics


def _records(log):
    """Of a log of LevelDB, after the 7 bytes by which W&B knows its own."""
    at, record = 7, b""
    while at < len(log):
        left = 32768 - at % 32768
        if left < 7:  # too little for a head: the block is filled up
            at += left
            continue
        length, part = struct.unpack("<HB", log[at + 4 : at + 7])
        record += log[at + 7 : at + 7 + length]
        at += 7 + length
        if part in (1, 4):  # whole, or the last part
            yield record
            record = b""


def _of_rerun(folder):
    from rerun.chunk import RrdReader

    metrics = {}
    for path in sorted(folder.glob("rerun/*.rrd")):
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            if "step" not in batch.schema.names:
                continue
            values = batch.column("Scalars:scalars").to_pylist()
            rows = metrics.setdefault(str(chunk.entity_path).strip("/"), {})
            rows |= zip(batch.column("step").to_pylist(), values, strict=True)
    return {
        name: [(step, value) for step, (value,) in sorted(rows.items())]
        for name, rows in metrics.items()
    }


READ = {"tensorboard": _of_tensorboard, "wandb": _of_wandb, "rerun": _of_rerun}
