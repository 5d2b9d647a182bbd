"""Files that cost more than the budget grants are named, the worst first."""

import pytest

from tests import budget

GRANTED = {("core", "a.py"): (100, 10.0), ("full", "a.py"): (10, 1.0)}


@pytest.mark.parametrize(
    ("spent", "words"),
    [
        ({("core", "a.py"): (275, 69.0)}, []),
        (
            {("core", "a.py"): (276, 69.0)},
            ["a.py (core): 276 programs for 275 at most"],
        ),
        ({("full", "a.py"): (10, 35.0)}, ["a.py (full): 35 processor seconds for 34"]),
        ({("core", "b.py"): (1, 0.1)}, ["b.py (core) is not in budget.json"]),
    ],
)
def test_what_is_over_the_budget_is_named(spent, words):
    lines = budget.over_budget(spent, GRANTED)
    assert len(lines) == len(words)
    for line, expected in zip(lines, words, strict=True):
        assert line.startswith(expected)


@pytest.mark.parametrize(("times", "files"), [(1.0, 20), (3.0, 20), (3.0, 5)])
def test_a_slow_machine_is_over_no_budget_and_a_slow_file_is(times, files):
    granted = {("core", f"{i}.py"): (0, 10.0) for i in range(files)}
    spent = {key: (0, times * 10.0) for key in granted}
    spent["core", "0.py"] = (0, times * 69.0)
    few = times > 1 and files < budget.PACED_FILES  # which tell no pace
    assert len(budget.over_budget(spent, granted)) == few
    spent["core", "0.py"] = (0, times * 71.0)
    assert len(budget.over_budget(spent, granted)) == 1


def test_a_run_keeps_what_it_did_not_touch(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(budget, "BUDGET", tmp_path / "budget.json")
    for name in ("a.py", "b.py", "gone.py"):
        (tmp_path / name).touch()
    budget.write({("core", "a.py"): (3, 1.26), ("slow", "gone.py"): (1, 1.0)})
    (tmp_path / "gone.py").unlink()
    budget.write({("full", "b.py"): (5, 2.0)})
    assert budget.read() == {("core", "a.py"): [3, 1.3], ("full", "b.py"): [5, 2.0]}


def test_the_budget_names_every_file_of_every_tier(pytestconfig):
    unnamed = pytestconfig.stash[budget.COLLECTED] - budget.read().keys()
    assert not unnamed, "run these files with --write-budget"
