"""The ablation's command: which arms there are, on a tiny scene, in seconds of time."""

import dataclasses
import json
import math
import types
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import cli
from experiments.ablate import __main__ as ablate
from experiments.ablate import job as ablate_job
from experiments.ablate import page as ablate_page
from experiments.ablate import results, suites
from experiments.ablate.arms import FIELDS
from experiments.ablate.job import Job
from experiments.ablate.measures import MEASURES
from experiments.ablate.results import ArmResult
from experiments.ablate.settings import Ablate
from nerfies_jax.capture import cache_files, synthetic
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.metrics import clock
from nerfies_jax.runs import platform
from nerfies_jax.training.track_start import FieldStartSpec
from tests import scenes


def test_arms_differ_from_nerfies_only_in_what_their_name_says():
    job = types.SimpleNamespace(suite=FIELDS, args=Ablate())
    specs = {name: Job.spec(job, name, 600) for name in FIELDS.arms}
    whole = specs["nerfies"]
    assert None not in (whole.elastic, whole.background, whole.warp)
    assert (specs["static"].warp, specs["t-nerf"].warp) == (None, None)
    changed = {
        "no-elastic": {"elastic": None},
        "no-background": {"background": None},
        "from-rest": {"start": FieldStartSpec()},
        "coarse-to-fine": {
            "start": FieldStartSpec(),
            "warp": dataclasses.replace(whole.warp, anneal_steps=300),
        },
        "translation": {"warp": dataclasses.replace(whole.warp, kind="translation")},
    }
    for name, fields in changed.items():
        assert specs[name] == dataclasses.replace(whole, **fields)
    shared = ("steps", "rays", "sampling", "template", "coarse", "extent")
    mlps = {name: specs.pop(name) for name in ("nerfies-mlp", "t-nerf")}
    for group in (specs, mlps):
        one = next(iter(group.values()))
        for spec in group.values():
            assert all(getattr(spec, x) == getattr(one, x) for x in shared)
            assert spec.learning_rate == one.learning_rate


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """The command on the tiny scene, with nothing global changed by it."""
    monkeypatch.setattr(platform, "start_jax", lambda *_: None)
    monkeypatch.setattr(platform, "CACHE", tmp_path / "cache")
    monkeypatch.setitem(synthetic.PRESETS, "tiny", scenes.TINY_FILM)
    return ["--scene", "tiny", "--out", str(tmp_path / "out"), "--frames", "1"]


def run(*arguments):
    """The command's exit code."""
    with pytest.raises(SystemExit) as stop:
        ablate.main(list(arguments))
    return stop.value.code


def test_arms_one_after_the_other_have_all_cores(tiny, monkeypatch):
    """Each of several at once has one, in a process of its own."""
    started = []
    nothing = types.SimpleNamespace(run=list, budgets=(), missing=list)
    monkeypatch.setattr(ablate_job, "Job", lambda _: nothing)
    monkeypatch.setattr(platform, "start_jax", lambda *given: started.append(given))
    presets = ("--suite", "presets", "--arms", "splats-static-small", "nerf-small")
    four = ("--set", "batch_size=4")
    assert run(*tiny, *presets[:4]) == 0
    assert run(*tiny, *presets[:4], *four) == 0
    assert run(*tiny, *presets) == 0
    assert run(*tiny, *presets[:4], *four, "--jobs", "2") == 0
    wanted = [("one", 1), ("one", 4), ("all", 2), ("one", 1)]
    assert started == [("auto", *cores) for cores in wanted]


def test_several_processes_do_not_share_an_accelerator(tiny, monkeypatch, capsys):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert run(*tiny, "--jobs", "2") == 2
    assert "would fight for one gpu" in capsys.readouterr().err


def kept(steps, seconds, stopped_by="steps"):
    both = dict.fromkeys(("train_seconds", "train_cpu_seconds"), seconds)
    numbers = dict.fromkeys(MEASURES, 0.0) | both
    return ArmResult(numbers, {}, {"steps": steps, "stopped_by": stopped_by})


@pytest.mark.parametrize(
    ("clock", "cost", "runs"),
    [
        ("wall", lambda steps: 0.1 * steps, [150, 600]),  # 60 s
        ("processor", lambda steps: 0.1 * steps, [150, 600]),
        # At 277 steps the first try has taken a tenth more than the time, and is left.
        ("wall", lambda steps: 0.1 * steps + 0.0005 * steps**2, [150, 343, 260]),
    ],
)
def test_the_steps_are_what_the_time_allows(tiny, clock, cost, runs, monkeypatch):
    """A step costs the more the longer the run: one more try comes near enough."""
    settled = cli.parse(Ablate, [*tiny, "--seconds", "60", "--clock", clock])
    job = Job(settled)
    trained = []

    def train(name, seed, steps, at_most=math.inf):
        trained.append(steps)
        done = next((n for n in range(steps) if cost(n) > at_most), steps)
        result = kept(done, 3 * cost(done), "steps" if done == steps else "seconds")
        # The three times as much is what the other clock says.
        result.numbers[job.budgets[0].measure] = cost(done)
        return result

    monkeypatch.setattr(job, "_train", train)
    steps, result = job._train_for("static", job.budgets[0])
    assert trained == runs
    assert steps == runs[-1] == result.notes["steps"]
    assert abs(cost(steps) / 60 - 1) < 0.05


def test_over_steps_and_seconds_the_run_over_steps_is_the_pilot(tiny, monkeypatch):
    settled = cli.parse(
        Ablate, [*tiny, "--steps", "40", "--seconds", "3", "--arms", "static"]
    )
    job = Job(settled)
    trained = []

    def train(name, seed, steps, at_most=None):
        trained.append((seed, steps))
        return kept(steps, 0.05 * steps)

    monkeypatch.setattr(job, "_train", train)
    for seed in (0, 1):
        for budget in job.budgets:
            job.make("static", seed, budget)
    assert trained == [(0, 40), (0, 60), (1, 40), (1, 60)]
    assert [len(job.finished(budget)) for budget in job.budgets] == [1, 1]  # one seed
    by_time = job.path("static", 1, job.budgets[1])
    assert json.loads(by_time.read_text())["identity"]["seconds"] == 3
    assert by_time.parent == job.out / "seconds-3"


def test_arms_long_past_are_forgotten(tiny, monkeypatch):
    """With their programs, of which a process can have so many."""
    monkeypatch.setattr(
        "nerfies_jax.training.loop.fit",
        lambda *_, **__: types.SimpleNamespace(compile_seconds=0.0),
    )
    monkeypatch.setattr("experiments.ablate.job.KEPT_ARMS", 1)
    arms = Job(cli.parse(Ablate, [*tiny, "--arms", "static"]))
    past = weakref.ref(arms._build("static", 2).model.step)
    last = arms._build("static", 3)
    assert arms._build("static", 3) is last
    assert past() is None


def test_what_another_process_makes_is_left_to_it(tiny, monkeypatch, capsys):
    job = Job(cli.parse(Ablate, [*tiny, "--arms", "static"]))
    monkeypatch.setattr(job, "_train", lambda *_: pytest.fail("trained twice"))
    with results.claimed(job.path("static", 0, job.budgets[0])) as ours:
        assert ours
        job.make("static", 0, job.budgets[0])
    assert "another process is making it" in capsys.readouterr().err
    assert not list(job.out.glob(".*"))
    assert job.missing() == [("static", 0)]


def test_arms_that_need_depth_are_not_run_without_it(tiny, monkeypatch):
    arms = {"all": FIELDS.arms["static"]}
    arms["less"] = dataclasses.replace(arms["all"], needs="depths")
    monkeypatch.setattr(suites, "named", lambda _: FIELDS._replace(arms=arms))
    settled = cli.parse(Ablate, tiny)
    assert Job(settled).names == ("all", "less")
    scene_of = synthetic.cached

    def blind(*arguments):
        capture, truth = scene_of(*arguments)
        return dataclasses.replace(capture, depths=None), truth

    monkeypatch.setattr(synthetic, "cached", blind)
    assert Job(settled).names == ("all",)


def test_arms_that_are_told_the_truth_are_not_run_where_none_is_known(
    tiny, monkeypatch
):
    tiny += ["--suite", "tracked"]
    job = Job(cli.parse(Ablate, tiny))
    assert "true-motion" in job.names
    given, capture = job.told.given, job.capture
    for row in range(len(capture.ids)):
        place = given.track_place[row]
        camera = jax.tree.map(jnp.asarray, cameras.take(capture.cameras, row))
        pixel = jax.vmap(cameras.project, (None, 0))(camera, place)[0]
        seen = given.track_seen[row]
        np.testing.assert_allclose(pixel[seen], given.track_pixel[row][seen], atol=1e-2)
    assert given.track_seen.any()
    opened = Job._open

    def untold(self):
        opened(self)
        self.told = None

    monkeypatch.setattr(Job, "_open", untold)
    assert "true-motion" not in Job(cli.parse(Ablate, tiny)).names
    with pytest.raises(ValueError, match="true-motion: starts from the truth"):
        Job(cli.parse(Ablate, [*tiny, "--arms", "true-motion"]))


@pytest.mark.slow
def test_the_command_measures_arms_and_goes_on_where_it_stopped(
    tiny, tmp_path, capsys, monkeypatch
):
    small = "rays=8 sampling.coarse=4 sampling.fine=0 template.depth=1 template.width=8"
    small += " template.position.levels=2 start.motion=none"
    tiny += ["--steps", "3", "--set", *small.split()]
    out = tmp_path / "out"
    assert run(*tiny, "--arms", "static") == 0
    assert run(*tiny, "--arms", "static", "nerfies") == 0
    assert "[1/2]" not in capsys.readouterr().err.split("[1/1]")[1]
    metrics = clock.read_metrics(out / "ablation.json")
    assert np.isnan(metrics["static.track_error"].value)
    for name in MEASURES:
        # No splats, two arms in one process, and no law of bits.
        if name not in ("gaussians", "peak_mb", "coded_mb"):
            assert np.isfinite(metrics[f"nerfies.{name}"].value), name
    # From rest, three steps move nothing.
    still = metrics["still.track_error"].value
    assert metrics["nerfies.track_error"].value == pytest.approx(still, rel=0.05)
    stored = json.loads((out / "ablation.json").read_text())
    page, about = ablate_page.page(stored), stored["about"]
    assert f"| `nerfies` | {metrics['nerfies.psnr'].value:.2f} |" in page
    assert "no spread to hold it against" in page
    assert about["claims"][0]["says"].endswith("no spread to hold it against")
    assert (out / "ablation.png").stat().st_size > 1000

    def no_training(*_):
        raise AssertionError("trained an arm that was finished")

    monkeypatch.setattr(Job, "_train", no_training)
    assert run(*tiny, "--arms", "static", "nerfies") == 0
    assert "A static field cannot show" in capsys.readouterr().out
    assert run(*tiny, "--arms", "static", "--steps", "4") == 2
    assert "made with other settings" in capsys.readouterr().err
    arrays = out / "static-0.npz"
    for cut in (arrays.read_bytes()[:-30], b"", None):
        arrays.unlink()
        if cut is not None:
            arrays.write_bytes(cut)
        monkeypatch.setattr(cache_files, "_reported", set())
        with pytest.raises(AssertionError, match="trained an arm"):
            run(*tiny, "--arms", "static")
        assert "static-0.json: unusable" in capsys.readouterr().err
    # With no time left nothing is begun, and what is finished is reported.
    monkeypatch.setattr(Job, "is_over", lambda *_: True)
    assert run(*tiny, "--arms", "nerfies", "translation") == 0
    assert "1 arms and seeds are left: translation 0" in capsys.readouterr().out
    assert jax.config.jax_enable_compilation_cache
