"""The benchmark runs `reconstruct`, stores means and spreads, and judges claims."""

import json
import math
import signal
import threading
import time

import numpy as np
import PIL.Image
import pytest
import scipy.stats

from experiments import cli
from experiments.batch import task
from experiments.benchmark import __main__ as benchmark
from experiments.benchmark import curves, origin, page, suites, verdicts
from experiments.benchmark.suites import SUITES, Claim
from nerfies_jax.metrics.metric_table import METRICS
from nerfies_jax.runs import representations
from nerfies_jax.runs.config import RunConfig
from nerfies_jax.runs.run import scene_spec
from nerfies_jax.training import specs
from nerfies_jax.visualization import figures
from tests.experiments import stand_in_run


@pytest.fixture
def stand_in(monkeypatch):
    """Run `stand_in_run` instead of `reconstruct`."""

    def use(wait=0.0):
        monkeypatch.setenv("WAIT", str(wait))
        monkeypatch.setattr(task.Task, "command", stand_in_run.command)

    return use


def run(*words):
    """Run the command and return its exit code."""
    with pytest.raises(SystemExit) as stop:
        benchmark.main(list(map(str, words)))
    return stop.value.code


def test_a_benchmark_is_named_without_where_it_lies(tmp_path):
    words = [str(tmp_path / "capture"), "--max-side", "256", "--steps", "20"]
    args = cli.parse(benchmark.Benchmark, words)
    assert args.label == "capture --max-side 256 --steps 20"
    planned = benchmark.plan_runs(args)
    folders = [run.task.folder for run in planned]
    assert [folder.name for folder in folders] == [f"default-{k}" for k in range(3)]
    assert folders[0].parent.name == "capture-max-side-256-steps-20"


def test_a_run_is_one_of_reconstruct():
    words = "--scene fast --suite sonata --methods no-depth --set sh_degree=0"
    args = cli.parse(benchmark.Benchmark, [*words.split(), "--seconds", "9"])
    first = benchmark.plan_runs(args)[0].task
    changes = ("depth=none", suites.TRACKS, "sh_degree=0")
    assert first.words == (
        *("--scene", "fast", "--seed", "0", "--preset", "sonata-small"),
        *("--set", *changes),
    )
    assert first.seconds == 9


def test_methods_over_time_are_evaluated_at_halves_of_their_own_steps():
    words = ["--suite", "curves", "--methods", "static", "moba", "--seeds", "1"]
    for more, steps in ([], suites.CURVES.steps), (["--steps", "20"], {"static": 20}):
        args = cli.parse(benchmark.Benchmark, words + more)
        line = " ".join(benchmark.plan_runs(args)[0].task.words)
        count = steps["static"]
        points = [count // 16, count // 8, count // 4, count // 2, count]
        shown = " ".join(map(str, points))
        assert f"--steps {count} --evaluate-at {shown}" in line
    timed = cli.parse(benchmark.Benchmark, [*words, "--seconds", "9"])
    assert "--evaluate-at" not in benchmark.plan_runs(timed)[0].task.words


def test_a_method_says_if_its_preset_has_changed_since():
    config = RunConfig("nerf-small", steps=30, overrides=("rays=16",))
    spec = specs.as_json(scene_spec(config))
    made_with = origin.of_run({"config": specs.as_json(config), "spec": spec})
    stored = json.loads(json.dumps(made_with))
    assert origin.age(stored) == "current"
    before = origin.of_run({"config": specs.as_json(config), "spec": spec | {"x": 1}})
    assert origin.age(before) == "old"
    other = origin.of_run({"config": specs.as_json(config), "spec": spec | {"x": None}})
    assert origin.age(other) == "current"  # a later effect, which it does not have
    assert origin.age(stored | {"overrides": ["no_such_field=1"]}) == "old"
    assert origin.age(stored | {"preset": "no-such-preset"}) == "old"
    assert origin.age(None) == "unknown"


def stored_curve(seconds, psnr, steps=(10, 20, 40)):
    return {"steps": list(steps), "cpu_seconds": list(seconds), "psnr": list(psnr)}


def test_curves_are_averaged_over_the_steps_that_all_seeds_have(tmp_path):
    seeds = {
        "0": stored_curve([1.0, 10.0, 90.0], [10.0, 20.0, 25.0]),
        "1": stored_curve([3.0, 10.0, 110.0], [14.0, 20.0, None]),
    }
    methods = {"moba": {"curves": seeds}, "sonata": {}}  # an earlier row without curves
    rows = {"methods": methods}
    (line,) = curves.lines(rows).values()
    assert line == ((2.0, 10.0), (12.0, 20.0), (10.0, 20.0), (14.0, 20.0))
    # The middle of 2 and 10 on a logarithmic axis is at the root of 20, 4.5.
    middle = 12 + 8 * math.log(5 / 2) / math.log(5)
    assert f"| `moba` | {middle:.2f} | 20.00 | 20.00 | 10 |" in curves.table(rows)
    stored = {"benchmarks": {"--scene fast --suite curves": rows}}
    curves.draw(stored, tmp_path / "curves.png")
    with PIL.Image.open(tmp_path / "curves.png") as image:
        assert image.text[figures.DIGEST] == figures.digest(curves.panels(stored))


def test_labels_of_lines_that_end_together_do_not_overlap():
    heights = curves._spread([1.0, 5.0, 5.1, 5.2, 9.0], 1.0)
    np.testing.assert_allclose(heights, [1.0, 4.1, 5.1, 6.1, 9.0])
    assert (np.diff(curves._spread([0.0, 0.1, 1.2, 1.3], 1.0)) > 0.999).all()


def test_interrupted_runs_continue_and_finished_ones_are_not_repeated(
    tmp_path, stand_in, capsys
):
    stand_in()
    words = ("--scene", "fast", "--preset", "nerf-small", "--seconds", "9")
    out = ("--jobs", "2", "--out", tmp_path / "out")
    args = cli.parse(benchmark.Benchmark, [*words, "--out", str(tmp_path / "out")])
    first, second, _ = (run.task for run in benchmark.plan_runs(args))
    first.folder.mkdir(parents=True)
    (first.folder / "config.json").write_text("{}")
    assert run(*words, *out) == 0
    assert "--resume" in first.folder.with_suffix(".calls").read_text()
    calls = second.folder.with_suffix(".calls").read_text()
    assert "--seconds 9" in calls
    assert run(*words, *out) == 0
    assert second.folder.with_suffix(".calls").read_text() == calls
    stored = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert stored["machine"] == stand_in_run.MACHINE
    (method,) = stored["benchmarks"][args.label]["methods"].values()
    assert method["settings"] == "nerf-small"
    assert method["mean"] == {"heldout.psnr": 21.0, "train.seconds": 1.0}
    assert method["spread"]["heldout.psnr"] == 1.0
    assert method["made_with"]["preset"] == "nerf-small"
    (point,) = {tuple(one["psnr"]) for one in method["curves"].values()}
    assert point == (20.123,)
    shown = "| 21.00 ± 1.00 |"
    assert shown in capsys.readouterr().out
    assert shown in page.page(stored)
    # The results of another benchmark stay.
    assert run("--scene", "topology", "--seeds", "1", *out) == 0
    stored = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert len(stored["benchmarks"]) == 2


def test_a_run_that_fails_is_named_and_the_others_go_on(tmp_path, stand_in, capsys):
    stand_in()
    methods = ("--suite", "presets", "--methods", "sonata-small", "nerf-small")
    assert run(*methods, "--seeds", "2", "--out", tmp_path / "out") == 1
    printed = capsys.readouterr().out
    assert "sonata-small, seed 1: failed with exit code 1: no such luck" in printed
    assert "| `nerf-small` | nerf-small | **old** | 2 |" in printed
    assert "| `sonata-small`" not in printed


def test_wrong_input_of_one_run_ends_all(tmp_path, stand_in, capsys, monkeypatch):
    stand_in()
    words = ("--preset", "nerf-small", "--set", "rays=-1", "--out", tmp_path / "out")
    assert run(*words) == 2
    assert "rays=-1" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()  # refused before any run
    monkeypatch.setattr(representations, "cores", lambda *_: None)
    assert run(*words) == 2
    assert capsys.readouterr().err.endswith("error: rays=-1\n")
    assert len(list((tmp_path / "out").rglob("*.calls"))) == 1


@pytest.mark.full
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (15, 143)])
def test_a_signal_ends_every_run(tmp_path, stand_in, number, code, monkeypatch):
    stand_in(wait=60.0)
    started = []
    start = task.children.start

    def noted(*arguments, **more):
        started.append(start(*arguments, **more))
        return started[-1]

    monkeypatch.setattr(task.children, "start", noted)

    def interrupt():
        while len(list(tmp_path.rglob("config.json"))) < 2:
            time.sleep(0.02)
        signal.raise_signal(number)

    thread = threading.Thread(target=interrupt)
    thread.start()
    assert run("--jobs", "2", "--out", tmp_path / "out") == code
    thread.join()
    assert len(started) == 2
    assert all(one.poll() is not None for one in started)


CLAIM = Claim("A warp helps", "warp", "static", ("tracks.epe", "heldout.psnr"))


@pytest.mark.parametrize(
    ("warp", "static", "verdict"),
    [
        ([0.010, 0.012, 0.011], [0.020, 0.023, 0.020], "supported"),
        ([0.020, 0.023, 0.020], [0.010, 0.012, 0.011], "contradicted"),
        ([0.010, 0.030, 0.011], [0.020, 0.013, 0.020], "not significant"),
        ([0.010], [0.020], "one seed, not significant"),
        # Only seeds that both methods have are compared.
        ([0.010, 0.012, 0.011, 9.0], [0.020, 0.023, 0.020], "supported"),
    ],
)
def test_a_claim_is_judged_by_the_spread_over_seeds(warp, static, verdict):
    numbers = {
        (method, seed): {"tracks.epe": x, "heldout.psnr": -x}
        for method, values in (("warp", warp), ("static", static))
        for seed, x in enumerate(values)
    }
    first, second = verdicts.judge(numbers, [CLAIM])
    # A lower error and a higher PSNR are both a gain.
    assert first.verdict == second.verdict == verdict
    count = min(len(warp), len(static))
    gains = np.subtract(static[:count], warp[:count])
    np.testing.assert_allclose(first.gain, gains.mean(), rtol=1e-12)
    if count > 1:
        interval = scipy.stats.ttest_1samp(gains, 0).confidence_interval(0.95)
        width = (interval.high - interval.low) / 2
        assert first.half_width == pytest.approx(width, rel=1e-9)
    benchmark = {
        "suite": "fields",
        "revision": "a",
        "claims": [first._asdict()],
        "methods": {},
    }
    assert f"| {verdict} |" in page.page({"benchmarks": {"--scene fast": benchmark}})


def test_a_claim_without_both_numbers_is_not_judged():
    numbers = {("warp", 0): {"heldout.psnr": 9.0}, ("static", 0): {}}
    assert verdicts.judge(numbers, [CLAIM]) == []
    numbers["static", 0] = {"heldout.psnr": math.nan}
    assert verdicts.judge(numbers, [CLAIM]) == []


def test_methods_that_are_measured_again_replace_only_themselves():
    def claim(better, worse):
        return {"better": better, "worse": worse, "claim": better, "metric": "m"}

    old = {
        "revision": "old",
        "methods": {"a": {"mean": 1}, "b": {"mean": 2}, "c": {"mean": 3}},
        "claims": [claim("a", "b"), claim("b", "c")],
    }
    new = {
        "revision": "new",
        "methods": {"a": {"mean": 4, "revision": "new"}},
        "claims": [],
    }
    merged = verdicts.merge({"one": old, "other": old}, {"one": new, "third": new})
    assert list(merged) == ["one", "other", "third"]
    assert merged["other"] == old
    one = merged["one"]
    revisions = {name: of["revision"] for name, of in one["methods"].items()}
    assert revisions == {"a": "new", "b": "old", "c": "old"}
    assert one["methods"]["a"]["mean"] == 4
    assert one["claims"] == [claim("b", "c")]


@pytest.mark.parametrize("name", SUITES)
def test_suites_are_consistent(name):
    suite = SUITES[name]
    for settings in suite.methods.values():
        preset, changes = suites.parse_settings(settings)
        specs.override(representations.of_preset(preset).presets[preset], changes)
    for claim in suite.claims:
        assert {claim.better, claim.worse} <= set(suite.methods)
        assert set(claim.metrics) <= set(METRICS)
    judged = {method for claim in suite.claims for method in claim[1:3]}
    assert judged == (set(suite.methods) if suite.claims else set())
    assert set(suite.steps) in (set(suite.methods), set())
    assert not suite.steps or set(curves.STYLES) == set(suite.methods)


def test_every_column_has_an_explanation():
    assert {column[0] for group in page.GROUPS for column in group} <= set(METRICS)
