"""The pages of docs/results say what the kept numbers say, and link what is there."""

import json

import pytest

from experiments import results
from experiments.results import PAGES, ROOT, STUDIES


@pytest.mark.parametrize("name", results.kept())
def test_a_page_is_what_its_kept_numbers_make(name):
    assert (PAGES / f"{name}.md").read_text() == results.page(name)


def test_the_index_lists_every_page_there_is():
    assert (PAGES / "README.md").read_text() == results.index()
    there = {path.stem for path in PAGES.glob("*.md")} - {"README"}
    assert there == set(results.kept())
    measured = {path.name for path in (ROOT / "experiments/measured").iterdir()}
    known = {study.measured.rpartition("/")[2] for study in STUDIES.values()}
    assert measured <= known


def test_new_numbers_are_kept_only_where_they_make_a_page(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(results, "ROOT", tmp_path)
    monkeypatch.setattr(results, "PAGES", tmp_path)
    monkeypatch.setitem(
        STUDIES, "kan_local", STUDIES["kan_local"]._replace(measured="kept.json")
    )
    new = tmp_path / "new.json"
    row = {"kernels": 8, "nearest": 4, "error": 8e-3, "seconds": 0.1, "over_dense": 5.3}
    machine = {"cpu": "a core", "backend": "cpu", "jax": "0"}
    new.write_text(json.dumps({"machine": machine, "rows": [row]}))
    results.main(["kan_local", "--measured", str(new)])
    assert "| 8 | 4 | 0.008 | 100.0 | 5.30 |" in (tmp_path / "kan_local.md").read_text()
    assert "[kan_local.md]" in (tmp_path / "README.md").read_text()
    new.write_text(json.dumps({"machine": machine, "rows": [{}]}))
    with pytest.raises(SystemExit) as stop:
        results.main(["kan_local", "--measured", str(new)])
    assert stop.value.code == 2
    assert "not what python -m experiments.kan_local" in capsys.readouterr().err
    assert json.loads((tmp_path / "kept.json").read_text())["rows"] == [row]


@pytest.mark.parametrize(
    ("page", "text", "words"),
    [
        ("kan_local", "words", "not JSON"),
        ("kan_local", '{"machine": {}, "rows": []}', "holds no rows"),
        ("transient_medium", '{"scene": "exposure"}', "of scene exposure, and the"),
        (
            "ablate_moba",
            '{"about": {"settings": {"suite": "sonata"}}}',
            "the page ablate_moba is of moba",
        ),
        ("solver_table_poses", '{"about": {"fit": "codes"}}', "of fit codes"),
    ],
)
def test_numbers_of_another_page_are_refused(
    page, text, words, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(results, "ROOT", tmp_path)
    new = tmp_path / "new.json"
    new.write_text(text)
    with pytest.raises(SystemExit) as stop:
        results.main([page, "--measured", str(new)])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert words in error
    assert "new.json" in error
    assert list(tmp_path.iterdir()) == [new]
