"""Preprocessing is budgeted in counted work: the same result on a busy machine."""

import dataclasses
import itertools
import time

import jax
import numpy as np
import pytest

from nerfies_jax.preprocessing import dense_flow, record, watch
from nerfies_jax.runs import products, representations, run
from nerfies_jax.runs.config import CaptureSource, RunConfig
from tests.preprocessing import two_planes

pytestmark = pytest.mark.slow

LITTLE = 1e-9  # of the default budget: nothing that can be left out is within it


def moving_capture(**changes):
    capture = two_planes.make(card=lambda time: (0.5 * (time - 0.5), 0.0), frames=12)
    return dataclasses.replace(capture, **changes)


def same(one, other):
    parts = zip(one._replace(seconds=0), other._replace(seconds=0), strict=True)
    for here, there in parts:
        jax.tree.map(np.testing.assert_array_equal, here, there)


@pytest.fixture
def forgetful(monkeypatch):
    """As in a new process."""
    monkeypatch.setattr(record, "_told_of", {})
    monkeypatch.setattr(record, "_unkept", {})


@pytest.fixture
def once(monkeypatch, forgetful):
    """How often evidence was gathered."""
    calls, gather = [], record.gather

    def counted(*arguments, **options):
        calls.append(arguments)
        return gather(*arguments, **options)

    monkeypatch.setattr(record, "gather", counted)
    return calls


def test_a_busy_machine_finds_the_same(monkeypatch):
    """With a budget that is used up in the middle of the work."""
    capture = moving_capture(preprocessing=0.002)
    quick = record.gather(capture)
    assert quick.left_out
    hours = itertools.count(step=3600.0)
    for clock in ("perf_counter", "monotonic", "time", "process_time"):
        monkeypatch.setattr(time, clock, lambda: next(hours))
    slow = record.gather(capture)
    assert sum(slow.seconds) >= 3600
    same(slow, quick)


def test_what_is_beyond_the_budget_is_kept_and_stated(tmp_path, once, capsys):
    capture, log = moving_capture(preprocessing=LITTLE), []
    hasty = record.cached(capture, tmp_path, tell=log.append)
    assert "skipped, beyond the budget of work: dense static points" in log
    assert not len(hasty.static_cloud.position)
    assert "half of the tracks" in hasty.left_out
    said = capsys.readouterr().err
    assert said.count("Preprocessing skipped half of the tracks") == 1
    assert record.notes_on(capture, tmp_path) == [record.left_out_note(hasty)]
    true = capture.moving[hasty.row]
    assert (hasty.moving & true).sum() / (hasty.moving | true).sum() > 0.6
    # Read again, in this process and in another one, which says it as well
    same(record.cached(capture, tmp_path), hasty)
    assert not capsys.readouterr().err
    record._told_of.clear()
    record.cached(capture, tmp_path)
    assert "Preprocessing skipped" in capsys.readouterr().err
    assert len(once) == 1
    # A larger budget is another record, from which nothing is missing.
    whole = record.cached(moving_capture(), tmp_path)
    assert not whole.left_out
    assert not record.notes_on(moving_capture(), tmp_path)
    assert 0.3 < len(hasty.score) / len(whole.score) < 0.7


def test_a_run_records_what_was_left_out(tmp_path):
    """In its config.json, from which the report has it, also after `--resume`."""
    capture = moving_capture(notes=("of the reader",))
    kind = representations.named("gaussians")
    spec = kind.presets["splats-static"]
    opened = run.Run(RunConfig(), capture, capture, kind, spec, None, None)
    for left_out in ((), ("Preprocessing skipped half of the tracks.",)):
        run.save_config(tmp_path, opened, left_out)
        notes = [*products._capture_notes(opened, tmp_path)]
        assert notes == ["of the reader", *left_out]
        assert run.read_settings(tmp_path).spec == spec


def test_a_folder_that_cannot_be_written_costs_the_next_command_alone(tmp_path, once):
    capture, log = moving_capture(), []
    (tmp_path / "file").touch()
    first = record.cached(capture, tmp_path / "file", tell=log.append)
    assert "could not be cached" in log[-1]
    same(record.cached(capture, tmp_path / "file"), first)
    assert len(once) == 1


@pytest.mark.usefixtures("forgetful")
def test_as_many_wide_steps_as_there_is_room_for_are_searched_again(monkeypatch):
    looked = []

    def improved(views, images, pair, flow, search, span):
        looked.append(pair)
        return flow

    monkeypatch.setattr(dense_flow.wide_steps, "improved", improved)
    monkeypatch.setattr(dense_flow.wide_steps, "is_wide", lambda *_: True)
    views = record.view_set.in_time_order(two_planes.make(frames=6))
    images = dense_flow.leveled(views)
    requests = []

    def room_for(count):
        requests.append(count)
        return 3

    dense_flow.between_neighbors(views, images, (1.0, 3.0), room_for)
    assert requests == [10]
    assert sorted(looked) == [(0, 1), (1, 2), (2, 3)]


def test_pieces_begin_while_their_share_of_the_budget_is_left():
    said = []
    budget = watch.Watch(said.append, 10.0)
    budget.spend(2.0)
    assert budget.room_for(9, 0.5, "pieces", 1.5) == 2  # at 2.0 and 3.5 of 5.0
    assert budget.has_room(0.6, "a part", 100.0)
    assert not budget.has_room(0.9, "another", 0.0)
    assert budget.left_out == "pieces, another"
    assert said == [
        "skipped, beyond the budget of work: pieces",
        "skipped, beyond the budget of work: another",
    ]
    with pytest.raises(ValueError, match=r"work=0\.0 must be positive"):
        watch.Watch(said.append, 0.0)


@pytest.mark.parametrize("budget", [0.0, -1.0, float("nan"), float("inf")])
def test_a_budget_that_is_none_is_refused(budget):
    with pytest.raises(ValueError, match="positive, finite multiple of the"):
        CaptureSource(preprocessing=budget)
    assert CaptureSource(preprocessing=2.0).arguments[-2:] == ("--preprocessing", "2.0")
