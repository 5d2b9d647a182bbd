"""The pages of docs/results say what the kept numbers say, and link what is there."""

import json

import PIL.Image
import pytest

from experiments import results
from experiments.benchmark import claims, curves
from experiments.growth import page as growth
from experiments.results import PAGES, REVISIONS, ROOT, STUDIES, SUMMARIES
from nerfies_jax.visualization import figures


@pytest.mark.parametrize("name", results.stored_pages())
def test_a_page_is_what_its_kept_numbers_make(name):
    assert (PAGES / f"{name}.md").read_text() == results.page(name)


@pytest.mark.parametrize("name", SUMMARIES)
def test_a_summary_is_what_the_numbers_of_its_pages_make(name):
    assert (PAGES / f"{name}.md").read_text() == results.summary(name)


def test_the_figure_shows_the_kept_numbers():
    stored = json.loads(results.path_of("benchmark").read_text())
    path = PAGES / "benchmark.png"
    assert path.exists() == bool(curves.panels(stored))
    if path.exists():
        with PIL.Image.open(path) as image:
            assert image.text[figures.DIGEST] == figures.digest(curves.panels(stored))


def test_presets_are_ranked_by_the_kept_curves():
    stored = json.loads(results.path_of("benchmark").read_text())
    advice = json.loads((ROOT / STUDIES["benchmark"].advice).read_text())
    assert advice == curves.advice(stored)
    assert set(advice) == {"static", "default", "fast"}


@pytest.mark.skipif("growth" not in results.stored_pages(), reason="no stored numbers")
def test_the_figure_of_growth_shows_the_kept_numbers():
    stored = json.loads(results.path_of("growth").read_text())
    with PIL.Image.open(PAGES / "growth.png") as image:
        assert image.text[figures.DIGEST] == figures.digest(
            growth.collect_points(stored)
        )


def test_the_index_lists_every_page_there_is():
    assert (PAGES / "README.md").read_text() == results.index()
    there = {path.stem for path in PAGES.glob("*.md")} - {"README"}
    assert there == {*results.stored_pages(), *REVISIONS, *SUMMARIES}
    measured = {path.name for path in (ROOT / "experiments/measured").iterdir()}
    known = {results.path_of(name).name for name in STUDIES}
    assert measured <= known


@pytest.mark.parametrize("name", REVISIONS)
def test_a_finished_page_has_its_numbers_and_names_the_revision(name):
    last = (PAGES / f"{name}.md").read_text().splitlines()[-1]
    assert f"the numbers are in `docs/results/{name}.json`" in last
    assert f"revision {REVISIONS[name]} can run it." in last
    assert json.loads((PAGES / f"{name}.json").read_text())


def test_new_numbers_are_kept_only_where_they_make_a_page(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(results, "ROOT", tmp_path)
    monkeypatch.setattr(results, "PAGES", tmp_path)
    monkeypatch.setattr(claims, "draw", lambda path: None)
    monkeypatch.setitem(
        STUDIES, "benchmark", STUDIES["benchmark"]._replace(measured="kept.json")
    )
    new = tmp_path / "new.json"
    method = {"settings": "nerf", "seeds": 1, "spread": {}}
    method["mean"] = {"heldout.psnr": 21.5}
    default = {"suite": None, "claims": [], "methods": {"nerf": method}}
    default["revision"] = 40 * "a" + "+changes"
    benchmarks = {"--scene default": default}
    machine = {"cpu": "a core", "backend": "cpu", "jax": "0"}
    new.write_text(json.dumps({"machine": machine, "benchmarks": benchmarks}))
    results.main(["benchmark", "--measured", str(new)])
    assert (tmp_path / "claims.md").exists()
    written = (tmp_path / "benchmark.md").read_text()
    assert "| `--scene default` | 21.50 |" in written
    assert "| nerf | not stored | 1 | aaaaaaaa+ |" in written
    assert not (tmp_path / "benchmark.png").exists()  # there are no curves
    assert "[benchmark.md]" in (tmp_path / "README.md").read_text()
    broken = {"machine": machine, "benchmarks": {"--scene default": {"suite": None}}}
    new.write_text(json.dumps(broken))
    with pytest.raises(SystemExit) as stop:
        results.main(["benchmark", "--measured", str(new)])
    assert stop.value.code == 2
    assert "not what nerfies study benchmark" in capsys.readouterr().err
    stored = json.loads((tmp_path / "kept.json").read_text())
    assert stored["benchmarks"] == benchmarks
    # Others are added, and those of the same options replaced.
    later = {"--scene fast": default, "--scene default": default | {"revision": "b"}}
    other = {"machine": {**machine, "cpu": "b core"}, "benchmarks": later}
    new.write_text(json.dumps(other))
    results.main(["benchmark", "--measured", str(new)])
    stored = json.loads((tmp_path / "kept.json").read_text())
    assert list(stored["benchmarks"]) == ["--scene default", "--scene fast"]
    assert stored["benchmarks"]["--scene default"]["revision"] == "b"
    assert stored["machine"]["cpu"] == "a core; b core"


def test_a_seed_of_0_is_no_lack_of_results(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "ROOT", tmp_path)
    (tmp_path / "experiments/measured").mkdir(parents=True)
    stored = json.loads((ROOT / "experiments/measured/fuzz.json").read_text())
    assert stored["seed"] == 0
    new = tmp_path / "new.json"
    new.write_text(json.dumps(stored))
    results.keep("fuzz", new)
    file = tmp_path / "experiments/measured/fuzz.json"
    assert json.loads(file.read_text()) == stored


@pytest.mark.parametrize(
    ("page", "text", "words"),
    [
        ("benchmark", "words", "not JSON"),
        ("benchmark", '{"machine": {}, "rows": []}', "holds no results"),
        (
            "ablate_poses",
            '{"benchmarks": {"--scene fast --suite poses": {}}}',
            "of --scene fast --suite poses, and the",
        ),
        (
            "ablate_moba",
            '{"benchmarks": {"--scene default --suite sonata": {}}}',
            "the page ablate_moba is of --suite moba",
        ),
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
