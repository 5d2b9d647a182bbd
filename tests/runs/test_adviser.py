"""Every combination of decisions becomes a run that can be built."""

import functools
import itertools
import json
import math
import pathlib

import pytest

from gaussians_jax.per_frame.exposure import ExposureSpec
from gaussians_jax.scene.spec import refuse_what_cannot_train
from nerfies_jax.evaluation import method_curves
from nerfies_jax.evaluation.representation import Choice
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.preprocessing.findings import CANNOT_TELL, CERTAIN, Finding
from nerfies_jax.runs import adviser, representations
from nerfies_jax.runs.config import RunConfig
from nerfies_jax.runs.effect_choice import Trial
from nerfies_jax.runs.run import scene_spec
from nerfies_jax.training import specs
from tests import scenes
from tests.preprocessing import two_planes

EFFECTS = ("motion", "appearance_codes", "transient_objects")
EFFECTS += ("start_from_points", "background_points", "depth")
ROOT = pathlib.Path(__file__).resolve().parents[2]
TRACKED, STATIC = "splats-tracked-small", "splats-static-small"


def findings(**wanted):
    """Findings by effect, words joined by underscores; None cannot be told."""
    confidence = {True: CERTAIN, False: CERTAIN, None: CANNOT_TELL}
    named = ((name.replace("_", " "), choice) for name, choice in wanted.items())
    return tuple(
        Finding(name, "", "", choice, confidence[choice]) for name, choice in named
    )


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("name", representations.installed())
def test_all_decisions_lead_to_a_model_that_can_be_built(name, full):
    kind = representations.named(name)
    capture = scenes.tiny_capture()
    built = set()
    for choices in itertools.product((True, False, None), repeat=len(EFFECTS)):
        advice = adviser.advise(
            findings(**dict(zip(EFFECTS, choices, strict=True))), kind, full
        )
        if advice.arguments() in built:
            continue
        built.add(advice.arguments())
        spec = specs.override(kind.presets[advice.preset], advice.overrides)
        kind.build(spec, kind.metadata_of(capture, spec))
    assert len(built) > 4


def spec_of(name, **wanted):
    kind = representations.named(name)
    advice = adviser.advise(findings(**wanted), kind)
    return specs.override(kind.presets[advice.preset], advice.overrides), advice


def in_the_league():
    """PSNR of presets on a scene that moves, if they read nothing but images."""
    stored = json.loads((ROOT / "docs/results/league.json").read_text())
    rows = stored["contests"][0]["rows"].values()
    scores: dict[str, float] = {}
    for row in rows:
        if not row["reads"]:
            seeds = [cell["numbers"]["psnr"] for cell in row["cells"].values()]
            mean = sum(seeds) / len(seeds)
            scores[row["preset"]] = max(mean, scores.get(row["preset"], mean))
    return scores


@functools.cache
def benchmarks():
    stored = json.loads((ROOT / "experiments/measured/benchmark.json").read_text())
    return stored["benchmarks"]


def over_time(scene):
    """PSNR of presets after about the same processor seconds, at today's revision."""
    benchmark = benchmarks().get(f"--scene {scene} --suite curves")
    methods = {} if benchmark is None else benchmark["methods"]
    return {
        method["made_with"]["preset"]: method["mean"]["heldout.psnr"]
        for method in methods.values()
    }


MEASURED = {
    "league": (True, in_the_league),
    "static": (False, lambda: over_time("static")),
    "default": (True, lambda: over_time("default")),
    "fast": (True, lambda: over_time("fast")),
}


@pytest.mark.parametrize("place", MEASURED)
@pytest.mark.parametrize("name", ["gaussians", "radiance"])
def test_the_advised_preset_is_the_best_that_was_measured(name, place):
    """In about equal processor seconds, of the small presets that were measured."""
    moves, scores_of = MEASURED[place]
    kind = representations.named(name)
    scores = {key: x for key, x in scores_of().items() if key in kind.presets}
    if not scores:
        pytest.skip(f"no numbers of {place}")
    advice = adviser.advise(findings(motion=moves), kind)
    assert (advice.preset, advice.overrides) == (max(scores, key=scores.get), ())


@pytest.mark.parametrize("scene", ["static", "default", "fast"])
@pytest.mark.parametrize("name", ["gaussians", "radiance"])
@pytest.mark.parametrize("seconds", [10, 30, 60, 120, 1200])
def test_the_advice_for_a_time_is_the_best_curve_of_every_scene(name, scene, seconds):
    """Interpolated here between stored evaluations, of which the best so far counts."""
    benchmark = benchmarks()[f"--scene {scene} --suite curves"]
    kind, scores = representations.named(name), {}
    for method in benchmark["methods"].values():
        preset, *changes = method["settings"].split()
        if preset in kind.presets:
            runs = [run_psnr(run, seconds) for run in method["curves"].values()]
            scores[preset, tuple(changes)] = sum(runs) / len(runs)
    advice = adviser.advise(findings(motion=scene != "static"), kind, seconds=seconds)
    assert (advice.preset, advice.overrides) == max(scores, key=scores.get)
    assert advice.preset in advice.notes[-1]


def run_psnr(run, seconds):
    """PSNR of a stored run after a time, which its first evaluation precedes."""
    points = list(zip(run["cpu_seconds"], run["psnr"], strict=True))
    before = [point for point in points if point[0] <= seconds]
    best = max(psnr for _, psnr in before)
    if len(before) == len(points):
        return best
    (t0, psnr0), (t1, psnr1) = points[len(before) - 1 : len(before) + 1]
    between = psnr0 + (psnr1 - psnr0) * math.log(seconds / t0) / math.log(t1 / t0)
    return max(best, between)


def test_commands_without_a_preset_use_the_cores_of_the_best_one():
    """`cores` reads no curves, as it runs before JAX is imported."""
    splats = representations.named("gaussians").presets
    assert method_curves.ranking(splats, True)[0].preset == representations.USUAL


def test_a_measured_budget_changes_the_advice(monkeypatch):
    """Two curves that cross, of which the later one is better from 40 s on."""
    early = {"seconds": [5.0, 20.0, 80.0], "psnr": [25.0, 28.0, 28.0]}
    late = {"seconds": [10.0, 40.0, 80.0], "psnr": [20.0, 28.0, 30.0]}
    crossing = {"early-small": early, "late-small x=1": late, "other": late}
    scenes = {"static": {}, "default": crossing, "fast": crossing}
    monkeypatch.setattr(method_curves, "curves", lambda: scenes)
    candidates = ("early-small", "late-small", "unknown")
    for seconds, best in ((1, "early"), (20, "early"), (60, "late"), (None, "late")):
        ranked = method_curves.ranking(candidates, True, seconds)
        assert ranked[0].preset == f"{best}-small"
        assert len(ranked) == 2
    assert ranked[0].overrides == ("x=1",)
    # Before the first evaluation of all, at its time: 26.5 after 10 of 5 to 20 s.
    assert method_curves.ranking(candidates, True, 1)[0].psnr == pytest.approx(26.5)
    assert method_curves.ranking(["unknown"], True, 1) == []


def test_a_still_scene_gets_no_motion_and_a_moving_one_gets_it():
    assert spec_of("gaussians", motion=False)[0].motion is None
    assert spec_of("gaussians", motion=True)[0].motion is not None
    assert spec_of("radiance", motion=False)[0].warp is None
    radiance, _ = spec_of("radiance", motion=True)
    assert radiance.warp is not None or radiance.time is not None


def test_advice_is_followed_but_for_what_the_user_sets():
    wanted = RunConfig("splats-static-small", overrides=("exposure.learning_rate=0.5",))
    answers = findings(motion=True, appearance_codes=True)
    config, lines = adviser.follow(wanted, wanted.overrides, answers)
    assert config.preset == "splats-tracked-small"
    rates = tuple(f"exposure.learning_rate={rate}" for rate in (0.01, 0.5))
    assert config.overrides == rates
    assert any(line.split()[:3] == ["motion", "yes", "certain"] for line in lines)
    assert f"effects: --preset splats-tracked-small --set {rates[0]}" in lines


@pytest.mark.parametrize("motion", [None, False, True])
def test_what_tracks_chose_for_a_preset_stays_with_that_preset(motion):
    """As `by_tracks` chooses: the bases of a motion that another preset has not."""
    own = ("steps=7",)
    chosen = RunConfig("splats-tracked-small", overrides=("motion.bases=12", *own))
    config, _ = adviser.follow(chosen, own, findings(motion=motion))
    assert scene_spec(config).steps == 7
    same_preset = config.preset == chosen.preset
    assert ("motion.bases=12" in config.overrides) == same_preset
    assert same_preset == (motion is True)


@pytest.mark.parametrize(
    ("preset", "motion", "expected"),
    [
        ("sonata-small", True, "sonata-small"),
        ("moba-small", False, "moba-small"),
        ("hypernerf", None, "hypernerf"),
        ("nerf-w-small", None, "nerf-w-small"),
        ("nerf-w-small", True, "nerfies-small"),  # it has no motion
        ("nerf-w-grid-small", True, "d-nerf-grid-small"),
        ("splats-mcmc-small", True, "splats-tracked-small"),
    ],
)
def test_the_family_stays_where_it_has_what_is_called_for(preset, motion, expected):
    answers = findings(motion=motion, depth=False, transient_objects=False)
    config, lines = adviser.follow(RunConfig(preset), (), answers)
    assert config.preset == expected
    family = preset.removesuffix("-small")
    noted = any(f"motion: preset {family} is static" in line for line in lines)
    assert noted == (preset != expected)


def test_every_family_can_be_built_with_its_effects_on_and_off():
    capture = scenes.tiny_capture()
    for kind in representations.installed().values():
        for preset in kind.presets:
            for choice, others in ((True, True), (False, False), (False, True)):
                wanted = dict.fromkeys(EFFECTS, others) | {"motion": choice}
                advice = adviser.advise_for(findings(**wanted), preset)
                spec = specs.override(kind.presets[advice.preset], advice.overrides)
                kind.build(spec, kind.metadata_of(capture, spec))
                if kind.name == "gaussians":
                    refuse_what_cannot_train(spec)
                moving = ("motion", "warp", "time", "scene_flow", "ambient")
                moves = any(getattr(spec, name, None) is not None for name in moving)
                assert moves == choice, preset


def test_what_cannot_be_told_keeps_the_default_that_moves():
    spec, advice = spec_of("gaussians", motion=None)
    assert spec.motion is not None
    assert spec.start.motion == "none"  # there may be no tracks either
    assert any("undecided" in note for note in advice.notes)


def test_codes_and_media_come_in_where_the_preset_has_none():
    spec, _ = spec_of("radiance", motion=True, appearance_codes=True)
    assert spec.appearance == AppearanceSpec(4)
    assert spec.transient is None
    passed, _ = spec_of("radiance", motion=False, transient_objects=True)
    assert passed.transient.width == 48
    lit, _ = spec_of("gaussians", appearance_codes=True)
    assert lit.exposure == ExposureSpec()


def photographs(**numbers):
    """Findings about photographs among which nothing can be followed."""
    light = Finding("appearance codes", "", "", True, CERTAIN, numbers)
    return (*findings(motion=None, transient_objects=None), light)


def test_photographs_in_changing_light_get_an_appearance_of_each():
    actual = photographs(drift_stops=1.0)
    for preset in ("splats-static-small", "splats-tracked-small"):
        advice = adviser.advise_for(actual, preset)
        assert advice.preset == "splats-collection-small"
        assert advice.overrides == ()
    assert adviser.advise_for(actual, "moba-small").preset == "moba-small"
    moving = Finding("motion", "", "", True, CERTAIN, {"moving_share": 0.1})
    still = findings(transient_objects=False)
    for other in (
        photographs(drift_stops=0.3),  # as automatic exposure
        (*actual, moving),
        (*actual, *still),
        actual[1:],
    ):
        assert adviser.advise_for(other, "splats-static-small").preset != advice.preset


def test_no_medium_is_brought_in_beside_a_warp():
    spec, advice = spec_of("radiance", motion=True, transient_objects=True)
    assert spec.transient is None
    assert any("lowers scores next to a warp" in note for note in advice.notes)


@pytest.mark.parametrize(("gain", "preset"), [(0.4, STATIC), (0.0, TRACKED)])
def test_a_doubtful_motion_is_compared_with_a_static_scene(gain, preset, monkeypatch):
    other = Choice(STATIC, ("init.points=5000",))
    choice = Choice(TRACKED, ("motion.bases=12",), ("a reason",), other)
    kinds = [(None, lambda capture, seconds: choice)]
    monkeypatch.setattr(adviser.representations, "choosing", lambda: kinds)
    tried, capture = [], two_planes.make(frames=2)

    def try_out(config, changed, capture, name):
        tried.append((config.preset, changed.preset, name))
        return Trial(300, 8, 20.0, 20.0 + gain)

    config = RunConfig(overrides=("sh_degree=1",))
    chosen, lines = adviser.by_tracks(config, capture, None, try_out)
    assert tried == [(TRACKED, STATIC, STATIC)]
    assert chosen.preset == preset
    expected = other if gain else choice
    assert chosen.overrides == (*expected.overrides, "sh_degree=1")
    assert f"20.00 dB with {TRACKED} and {20 + gain:.2f} dB with {STATIC}" in lines[0]
    assert ("less than nothing" in lines[0]) == (gain > 0)
    assert lines[-1].startswith(f"preset: {preset} --set {expected.overrides[0]}")
    # Not if a setting of the user needs the motion, or if nothing may be trained.
    config = RunConfig(overrides=("motion.knots=30",))
    assert adviser.by_tracks(config, capture, None, try_out)[0].preset == TRACKED
    config = RunConfig()
    assert adviser.by_tracks(config, capture)[0].preset == TRACKED
    assert len(tried) == 1
