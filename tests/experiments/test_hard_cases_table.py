"""The table of hard cases, from the command line to the page."""

import json
import pathlib
import re

import numpy as np
import pytest

from experiments.hard_cases import __main__ as hard_cases
from experiments.hard_cases import case as hard_case
from experiments.hard_cases import report
from experiments.hard_cases.__main__ import TOPICS

DOCUMENT = pathlib.Path(__file__).parents[2] / "docs/numerics.md"
PAGE = f"before\n{report.BEGIN}\nold\n{report.END}\nbehind\n"


def test_names_tell_all_cases_apart():
    names = [case.name for cases, _ in TOPICS.values() for case in cases]
    assert len(set(names)) == len(names)
    for cases, _ in TOPICS.values():
        for case in cases:
            assert len(case.at) == len(case.inputs)
            assert {"float32", "float64"} <= set(case.bounds)


def rows_of_the_page():
    table = DOCUMENT.read_text().split(report.BEGIN)[1].split(report.END)[0]
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    return [re.split(r" (?<!\\)\| ", line[2:]) for line in lines[1:]]


def test_the_page_has_a_row_of_every_case_and_no_other():
    rows = [row[:3] for row in rows_of_the_page()]
    cases = [case for cases, _ in TOPICS.values() for case in cases]
    described = [
        (one.name, one.breaks, f"{one.formula}; {one.switch}") for one in cases
    ]
    assert rows == [[cell.replace("|", r"\|") for cell in row] for row in described]


def test_textbook_forms_miss_a_bound_by_far():
    """The test of each case can fail: the page has the errors of its textbook form."""
    cases = [case for cases, _ in TOPICS.values() for case in cases]
    for case, row in zip(cases, rows_of_the_page(), strict=True):
        factors = []
        for dtype, cell in zip(("float32", "float64"), row[3:5], strict=True):
            for name, bound in zip(hard_case.ORDERS, case.bounds[dtype], strict=False):
                error = re.search(rf"{name} (.*?) →", cell)[1]
                finite = not error.startswith("not finite")
                factors.append(float(error) / bound if finite else np.inf)
        assert max(factors) > 9, case.name  # the page rounds to one digit


@pytest.mark.full
def test_the_command_measures_prints_and_renews_the_page(tmp_path, capsys):
    page, out = tmp_path / "page.md", tmp_path / "out"
    page.write_text(PAGE)
    words = ["--topics", "encodings", "--cases", "window", "--numbers", "10"]
    words += ["--repeats", "1", "--out", str(out), "--document", str(page)]
    hard_cases.main(words)
    printed = capsys.readouterr().out
    assert "coarse-to-fine window of a band" in printed
    assert "1 of 1 textbook forms" in printed
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("behind\n")
    assert "old" not in text
    assert (
        "test_encoding_cases.py::test_held[coarse-to-fine window of a band-…]" in text
    )
    stored = json.loads((out / "hard_cases.json").read_text())["metrics"]
    key = "coarse-to-fine_window_of_a_band.float32.gradient"
    assert stored[f"{key}.ours"]["value"] < 1e-5 < stored[f"{key}.textbook"]["value"]


def test_errors_are_of_the_largest_entry_and_never_forgiving():
    case = TOPICS["encodings"][0][0]._replace(floors=(0.0, 0.0, 0.0))
    exact = np.array([[1.0, -4.0], [0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    got = np.array([[1.0, -3.0], [0.0, 0.0], [0.0, 1e-9], [1.0, np.nan]])
    errors = hard_case.errors(case, got, exact, 0)
    np.testing.assert_array_equal(errors, [0.25, 0.0, np.inf, np.inf])
    floored = hard_case.errors(case._replace(floors=(2.0,)), got, exact, 0)
    np.testing.assert_allclose(floored, [0.25, 0.0, 5e-10, np.inf])


def test_the_truth_of_a_derivative_is_that_of_the_closed_form():
    case = TOPICS["encodings"][0][0]._replace(exact=lambda x: [x[0] ** 3 * x[1]])
    row = np.array([[2.0, 5.0]])
    np.testing.assert_allclose(hard_case.truth(case, row, 1), [[[60.0, 8.0]]])
    np.testing.assert_allclose(
        hard_case.truth(case, row, 2), [[[[60.0, 12.0], [12.0, 0.0]]]]
    )
