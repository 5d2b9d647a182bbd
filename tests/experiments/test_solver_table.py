import json

import jax
import numpy as np
import pytest

from experiments.solver_table import __main__ as solver_table
from experiments.solver_table import problems
from nerfies_jax.geometry.camera import move

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
    words = ["--steps", "2", "8", "--out", str(tmp_path / "t.json")]
    for name, value in SMALL.items():
        many = value if isinstance(value, tuple) else (value,)
        words += [f"--{name.replace('_', '-')}", *map(str, many)]
    rows = solver_table.main(words)["rows"]
    rows = [solver_table.SolverResult(**row) for row in rows]
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
    assert f"| adam | 8 | {by['adam', 8].steps:.0f} |" in solver_table.page(record)


@pytest.mark.full
def test_held_out_pictures_are_not_among_the_known_ones():
    settings = solver_table.Settings(**SMALL | {"training_steps": 1})
    task = problems.code_problem(settings)
    known = problems.pattern(np.arange(3) / 3, 6)
    apart = np.abs(np.asarray(task.unseen)[:, None] - known).max((2, 3))
    assert apart.min() > 0.05


def test_a_screw_between_cameras_is_that_which_moved_one():
    camera = problems.looking_down_z()
    screw = np.float32([0.3, -0.2, 0.1, 0.5, -0.4, 0.2])

    @jax.jit
    def there_and_back(camera, screw):
        moved = move(camera, screw[:3], screw[3:])
        return problems.screw_between(camera, moved)

    back = there_and_back(camera, screw)
    np.testing.assert_allclose(back, screw, atol=1e-6)
