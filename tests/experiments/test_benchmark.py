"""The benchmark keeps every run under what was run, and shows medians and ends."""

import concurrent.futures
import json
import time
from types import SimpleNamespace

import pytest

from experiments import cli
from experiments.benchmark import __main__ as benchmark
from experiments.benchmark import job, page
from nerfies_jax import runs
from nerfies_jax.runs import representations
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.runs.reconstruction import Refused
from nerfies_jax.training import specs

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
    del runs["2"]
    written = page.page({"machine": MACHINE, "runs": {"--scene default": runs}})
    assert "32.25 (31.00 to 33.50)" in written
    assert "EPE at rest |" not in written  # no truth: the column is left out


def test_a_run_is_named_without_where_it_lies(tmp_path):
    words = [str(tmp_path / "film"), "--max-side", "256", "--steps", "20"]
    args = cli.parse(benchmark.Benchmark, words)
    assert benchmark._label(args) == "film --max-side 256 --steps 20"
    assert benchmark._stem(args) == "film-max-side-256-steps-20"


def test_a_run_goes_on_where_it_was_cut_and_belongs_to_one_capture(
    tmp_path, monkeypatch
):
    """Nothing is trained: what stands in for it writes what a run writes."""
    done = []
    spec = representations.of_preset("nerf-small").presets["nerf-small"]

    def config_of(folder):
        source = CaptureSource(capture=str(tmp_path / folder / "dog"))
        return RunConfig(preset="nerf-small", source=source)

    def begin(config, folder, seconds):
        done.append("begun")
        folder.mkdir()
        stored = {"config": specs.as_json(config), "spec": specs.as_json(spec)}
        stored["representation"] = "radiance"
        (folder / "config.json").write_text(json.dumps(stored))
        result = SimpleNamespace(stopped_by="SIGINT")
        return SimpleNamespace(errors=(), result=result)

    def go_on(folder):
        done.append("resumed")
        (folder / "metrics.json").write_text(json.dumps({"heldout.psnr": 30.0}))
        run = SimpleNamespace(config=SimpleNamespace(preset="nerf-small"))
        return SimpleNamespace(errors=(), run=run)

    monkeypatch.setattr(job.platform, "start_jax", lambda *_: None)
    monkeypatch.setattr(runs, "reconstruct", begin)
    monkeypatch.setattr(runs, "resume", go_on)
    out, first = tmp_path / "dog-0", config_of("a")
    with pytest.raises(RuntimeError, match="the same command goes on"):
        job.score(first, out, None, alone=True)
    for _ in range(2):
        assert job.score(first, out, None, True)["metrics"] == {"heldout.psnr": 30.0}
    assert done == ["begun", "resumed"]
    with pytest.raises(ValueError, match=r"holds a run of .*dog, and .*dog is asked"):
        job.score(config_of("b"), out, None, alone=True)


def test_what_refuses_one_seed_ends_all_in_a_line(tmp_path, monkeypatch, capsys):
    tried = []

    def refused(config, *_, **__):
        tried.append(config.seed)
        time.sleep(0.02)
        raise Refused("no width; move the scene")

    def threads(jobs, *_, **__):
        return concurrent.futures.ThreadPoolExecutor(jobs)

    monkeypatch.setattr(job, "score", refused)
    monkeypatch.setattr(concurrent.futures, "ProcessPoolExecutor", threads)
    words = ["--scene", "static", "--seeds", "99", "--out", str(tmp_path)]
    for more, message in [
        ((), "no width"),
        (("--preset", "nerf-small", "--set", "rays=-1"), "rays=-1"),
    ]:
        with pytest.raises(SystemExit) as ended:
            benchmark.main([*words, *more])
        assert ended.value.code == 2
        assert message in capsys.readouterr().err
    assert len(tried) < 99
    assert not list(tmp_path.iterdir())
