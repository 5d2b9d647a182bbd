import json

import numpy as np
import pytest

from experiments import solver_table

SMALL = dict(
    solvers=("lbfgs", "adam"),
    frames=2,
    pictures=3,
    pixels=6,
    width=8,
    code_width=2,
    training_steps=30,
    repeats=1,
)


@pytest.mark.slow
def test_the_table_holds_solvers_against_the_best_known_code(tmp_path, capsys):
    settings = solver_table.Settings(steps=(2, 8), out=tmp_path / "t.json", **SMALL)
    rows = solver_table.main(settings)
    assert {(r.solver, r.max_steps) for r in rows} == {
        (name, steps) for name in ("lbfgs", "adam") for steps in (2, 8)
    }
    assert all(0 < r.steps <= r.max_steps for r in rows)
    assert all(np.isfinite(r.loss) and r.seconds > 0 for r in rows)
    # The best known loss of each frame is one of the table's own, so nobody is below
    # it, and more steps of a descent that keeps its best never end above fewer.
    assert min(r.excess for r in rows) >= 0
    by = {(r.solver, r.max_steps): r for r in rows}
    # (Adam's rate decays over its steps, so its paths differ.)
    assert by["lbfgs", 8].excess <= by["lbfgs", 2].excess
    record = json.loads((tmp_path / "t.json").read_text())
    assert len(record["rows"]) == len(rows)
    assert record["about"]["pixels"] == 6
    assert record["rows"][0]["solver"] in capsys.readouterr().out


def test_held_out_pictures_are_not_among_the_known_ones():
    task = solver_table.problem(solver_table.Settings(**SMALL | {"training_steps": 1}))
    known = solver_table.pattern(np.arange(3) / 3, 6)
    apart = np.abs(np.asarray(task.unseen)[:, None] - known).max((2, 3))
    assert apart.min() > 0.05


def test_an_empty_table_is_refused():
    with pytest.raises(ValueError, match="must be among"):
        solver_table.Settings(solvers=("newton",))
    with pytest.raises(ValueError, match="at least 1"):
        solver_table.Settings(frames=0)
    with pytest.raises(ValueError, match="at least 1"):
        solver_table.Settings(steps=())
