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


def test_a_run_keeps_what_it_did_not_touch(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(budget, "BUDGET", tmp_path / "budget.json")
    for name in ("a.py", "b.py", "gone.py"):
        (tmp_path / name).touch()
    budget.write({("core", "a.py"): (3, 1.26), ("slow", "gone.py"): (1, 1.0)})
    (tmp_path / "gone.py").unlink()
    budget.write({("full", "b.py"): (5, 2.0)})
    assert budget.read() == {("core", "a.py"): [3, 1.3], ("full", "b.py"): [5, 2.0]}
