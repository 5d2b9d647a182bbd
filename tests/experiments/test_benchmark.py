"""The benchmark keeps every run under what was run, and shows medians and ends."""

import json

from experiments import cli
from experiments.benchmark import __main__ as benchmark
from experiments.benchmark import page

MACHINE = {"cpu": "one", "backend": "cpu", "jax": "0"}


def scored(psnr, **more):
    metrics = {"heldout.psnr": psnr, "train.seconds": 1.0, **more}
    return {"preset": "splats-tracked-small", "machine": MACHINE, "metrics": metrics}


def test_runs_are_kept_by_what_was_run_and_their_seed(tmp_path):
    path = tmp_path / "benchmark.json"
    benchmark.keep(path, "--scene fast", 0, scored(20.0))
    benchmark.keep(path, "--scene default", 0, scored(30.0))
    benchmark.keep(path, "--scene fast", 1, scored(22.0))
    benchmark.keep(path, "--scene fast", 0, scored(21.0))  # made again
    stored = json.loads(path.read_text())
    assert stored["machine"] == MACHINE
    fast = stored["runs"]["--scene fast"]
    assert [fast[seed]["metrics"]["heldout.psnr"] for seed in "01"] == [21.0, 22.0]
    assert "machine" not in fast["0"]


def test_the_page_has_the_median_and_the_ends():
    runs = {str(seed): scored(psnr) for seed, psnr in enumerate([31.0, 33.5, 32.0])}
    written = page.page({"machine": MACHINE, "runs": {"--scene default": runs}})
    assert "| `--scene default` | splats-tracked-small | 3 |" in written
    assert "32.00 (31.00 to 33.50)" in written
    assert "EPE at rest |" not in written  # no truth: the column is left out


def test_a_run_is_named_without_where_it_lies(tmp_path):
    words = [str(tmp_path / "film"), "--max-side", "256", "--steps", "20"]
    args = cli.parse(benchmark.Benchmark, words)
    assert benchmark._label(args) == "film --max-side 256 --steps 20"
    assert benchmark._stem(args) == "film-max-side-256-steps-20"
