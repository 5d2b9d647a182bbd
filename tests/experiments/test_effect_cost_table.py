"""What effects cost: scenes chosen right, operations and numbers kept."""

import json

import jax
import numpy as np
import pytest

from experiments.effect_cost import __main__ as effect_cost
from experiments.effect_cost import report
from experiments.effect_cost.__main__ import EffectCost, Priced, PricedScene, SceneCost
from gaussians_jax.scene import presets as splat_presets
from nerfies_jax import runs
from nerfies_jax.fields.field_ray import Ray
from nerfies_jax.metrics import baselines, clock
from nerfies_jax.scene import presets as field_presets
from nerfies_jax.scene import scene
from nerfies_jax.training import matrix_flops
from nerfies_jax.training.effects import FrameCondition
from tests import bare_scenes, scenes


@pytest.mark.parametrize("name", ["nerf", "nerf-small", "d-nerf", "nsff"])
def test_the_products_of_a_static_field_are_those_of_its_networks(name):
    preset = bare_scenes.tiny_field(name)
    spec = effect_cost.without(preset, tuple(effect_cost.effects_in(preset)))
    metadata = scene.metadata_of(scenes.tiny_capture(), spec)
    field = scene.field(spec, metadata)
    forward, near, far = np.float32([0, 0, 1]), np.float32(0.5), np.float32(1)
    ray = Ray(*jax.device_put((0 * forward, forward, near, far)))
    condition = FrameCondition(near, {}, jax.device_put(np.int32(0)))

    def colors(params):
        return [level.color for level in field.render_ray(params, ray, condition)]

    params = jax.eval_shape(lambda: field.init(jax.random.key(0)))
    counted = matrix_flops.count(colors, params)
    plan = spec.sampling
    expected = network_flops(spec.template, plan.coarse + plan.fine)
    if plan.fine:
        shared = plan.shared or spec.coarse is None
        first = spec.template if shared else spec.coarse
        expected += network_flops(first, plan.coarse)
    assert counted == (expected, False)


def network_flops(one, samples):
    """Figure 7 of Mildenhall et al. 2020, layer by layer."""
    point = 3 * (1 + 2 * one.position.bands)
    view = 0 if one.direction is None else 3 * (1 + 2 * one.direction.bands)
    each, width = point * one.width, one.width
    for layer in range(1, one.depth):
        each += (width + point * (layer in one.skips)) * width
    each += width + (width + 3) * one.color_width  # density, color
    bottleneck = (width + 1) * width  # once, joined to the layer that reads it
    return 2 * (samples * each + (view + bottleneck) * one.color_width)


def test_every_default_preset_has_effects_and_every_paper_is_there():
    for name in effect_cost.PRESETS:
        presets = field_presets.PRESETS | splat_presets.PRESETS
        alone = effect_cost.effects_in(presets[name])
        priced = effect_cost.effects_in(effect_cost._spec(name, EffectCost()))
        assert (set(priced) > set(alone)) == (name in effect_cost.BESIDE), name
        assert priced, name
    left_out = {"nerf-small", "d-nerf-small", "t-nerf-small"}
    left_out |= {"splats-mcmc-small"}
    small = {n for n in presets if n.endswith("-small")}
    left_out |= {n for n in small if "-grid-" in n}  # the same effects once more
    assert small - set(effect_cost.PRESETS) == left_out  # nothing, or the warp alone


def test_scenes_of_a_preset_stand_behind_those_they_are_compared_with():
    for presets in (field_presets.PRESETS, splat_presets.PRESETS):
        for name, preset in presets.items():
            if not effect_cost.effects_in(preset):
                continue
            spec = effect_cost._spec(name, EffectCost())
            arms = effect_cost._arms(name, EffectCost())
            seen = []
            for arm in arms:
                assert arm.base is None or arm.base in [a.name for a in arms]
                assert arm.name not in seen
                seen.append(arm.name)
            by_name = {arm.name: arm.spec for arm in arms}
            assert effect_cost.effects_in(by_name["bare"]) == []
            assert by_name.get("all", arms[1].spec) == spec


def test_parts_of_effects_are_priced_beside_the_rest_of_them():
    for preset, part, field in (
        ("adc-gs-small", "bits", "rate"),
        ("edgs-small", "mask", "mask"),
        ("sc-gs-small", "rigidity", "rigidity"),
    ):
        (*_, whole, rest) = effect_cost._arms(preset, EffectCost())
        assert (rest.name, rest.effect) == (f"without {part}", part)
        assert rest.base == whole.name == "only motion"
        assert getattr(whole.spec.motion, field) is not None
        assert getattr(rest.spec.motion, field) is None
    names = [arm.name for arm in effect_cost._arms("motion-gs-small", EffectCost())]
    assert names[-3:] == ["without motion", "without flow", "without poses"]


def row(name, base, seconds, flops=2e9):
    step = Priced(flops, 3e6, 4_000_000, 5e8, base is None, 1.5, seconds, 2 * seconds)
    loss = step._replace(seconds=seconds / 4)
    return SceneCost(
        PricedScene(name, None, base, None), 1234, {"loss": loss, "step": step}
    )


ROWS = [
    row("bare", None, 0.010),
    row("only warp", "bare", 0.016),
    row("all", "bare", 0.020),
    row("without warp", "all", 0.012),
]


def test_the_table_says_what_an_effect_adds_alone_and_beside_the_others():
    lines = report.table("nerfies-small", ROWS).splitlines()
    assert lines[1] == "nerfies-small"
    bare, alone, whole, beside = lines[3:]
    assert bare.split()[:4] == ["bare", "1,234", "2000", "2000"]
    assert bare.count("500+") == 2
    assert alone.endswith("+6.0 ms over bare, x1.60")
    assert whole.endswith("+10.0 ms over bare, x2.00")
    assert beside.endswith("+8.0 ms all over without warp, x1.67")
    assert "loop's body counts once" in report.heading()


@pytest.mark.full
def test_what_became_dearer_than_its_tolerance_is_named(tmp_path):
    args = EffectCost(presets=("nerfies-small",))
    report.write(tmp_path, {"nerfies-small": ROWS}, args)
    assert (tmp_path / "effect_cost.png").stat().st_size > 5000
    stored = json.loads((tmp_path / "effect_cost.json").read_text())
    assert stored["about"]["cpu"] == clock.machine()["cpu"]
    assert "a loop's body once" in stored["about"]["counts"]
    before = clock.read_metrics(tmp_path / "effect_cost.json")
    same = report.metrics_of({"nerfies-small": ROWS})
    assert baselines.changes(same, before) == []
    # A hundredth more flops, a tenth more time: only the first repeats exactly.
    dearer = [*ROWS[:1], row("only warp", "bare", 0.0176, 2.02e9)]
    worse = baselines.changes(report.metrics_of({"nerfies-small": dearer}), before)
    assert [line.split()[1] for line in worse] == [
        f"nerfies-small.only_warp.{name}.flops" for name in ("loss", "step")
    ]
    slower = [*ROWS[:1], row("only warp", "bare", 0.024)]
    worse = baselines.changes(report.metrics_of({"nerfies-small": slower}), before)
    assert {line.split()[1].split(".")[-1] for line in worse} == {"over_bare"}
    with pytest.raises(ValueError, match=r"none\.json: No such file"):
        baselines.read(tmp_path / "none.json", "effect_cost.json")


@pytest.mark.slow
def test_a_small_run_prices_a_transient_medium(tmp_path, capsys, monkeypatch):
    spec = bare_scenes.tiny_field("nerf-w")
    capture = scenes.tiny_capture()
    arms = effect_cost.arms(spec, {})
    arms = [arm for arm in arms if arm.name in ("bare", "only transient")]
    monkeypatch.setattr(runs, "read_capture", lambda _: capture)
    bare, transient = effect_cost.measure("nerf-w-small", arms, 0.4, 2)
    for name in effect_cost.PROGRAMS:
        cheap, dear = bare.programs[name], transient.programs[name]
        assert cheap.flops < dear.flops
        assert cheap.matrix_flops < dear.matrix_flops < dear.flops
        assert cheap.bytes_accessed < dear.bytes_accessed
        assert min(cheap.seconds, dear.seconds, dear.compile_seconds) > 0
    loss, step = (bare.programs[name] for name in effect_cost.PROGRAMS)
    assert loss.flops < step.flops
    # A step runs every product and, for weights and inputs, two more, but the inputs'
    # of the first layers.
    assert 2 * loss.matrix_flops < step.matrix_flops < 3 * loss.matrix_flops
    assert bare.parameters < transient.parameters
