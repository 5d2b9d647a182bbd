"""The table of the elastic penalty's estimators."""

import json

import pytest

from experiments import elastic_points


@pytest.mark.full
def test_draws_by_weight_are_unbiased_and_better_than_even_ones(tmp_path, capsys):
    out = tmp_path / "table.json"
    sizes = "--points 1 4 --rays 24 --samples 16 --draws 60 --repeats 1"
    elastic_points.main([*sizes.split(), "--device", "cpu", "--out", str(out)])
    record = json.loads(out.read_text())
    rows = record["rows"]
    assert list(rows) == ["uniform 4", "1", "4", "all"]
    assert capsys.readouterr().out.count("\n") == 5
    assert f"| 4 | {rows['4']['bias']:.4f} |" in elastic_points.page(record)
    assert rows["all"]["bias"] == rows["all"]["gradient_deviation"] == 0
    for name in ("1", "4"):
        assert rows[name]["error"] > 0
        assert abs(rows[name]["bias"]) < 4 * rows[name]["error"]
    for kind in ("value_deviation", "gradient_deviation"):
        assert rows["4"][kind] < 0.7 * rows["1"][kind]
        assert rows["4"][kind] < 0.7 * rows["uniform 4"][kind]
