"""Cost of effects: the scenes that are compared, and their numbers."""

import jax
import numpy as np
import pytest

from experiments.speed import effects, effects_page
from experiments.speed.__main__ import Effects
from gaussians_jax.scene import presets as splat_presets
from nerfies_jax import runs
from nerfies_jax.fields.field_ray import Ray
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.scene import presets as field_presets
from nerfies_jax.scene import scene
from nerfies_jax.training import matrix_flops
from nerfies_jax.training.effects import FrameCondition
from tests import bare_scenes, scenes


@pytest.mark.parametrize("name", ["nerf", "nerf-small", "d-nerf", "nsff"])
def test_the_products_of_a_static_field_are_those_of_its_networks(name):
    preset = bare_scenes.tiny_field(name)
    spec = effects.without(preset, tuple(effects.effects_in(preset)))
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
    for name in effects.PRESETS:
        presets = field_presets.PRESETS | splat_presets.PRESETS
        alone = effects.effects_in(presets[name])
        priced = effects.effects_in(effects.spec_of(name, Effects()))
        assert (set(priced) > set(alone)) == (name in effects.ADDED), name
        assert priced, name
    left_out = {"nerf-small", "d-nerf-small", "t-nerf-small"}
    left_out |= {"splats-mcmc-small"}
    # Two effects, which both read the photographs of a collection.
    left_out |= {"splats-collection-small"}
    small = {n for n in presets if n.endswith("-small")}
    left_out |= {n for n in small if "-grid-" in n}  # the same effects once more
    assert small - set(effects.PRESETS) == left_out  # nothing, or the warp alone


def test_scenes_of_a_preset_stand_behind_those_they_are_compared_with():
    for presets in (field_presets.PRESETS, splat_presets.PRESETS):
        for name, preset in presets.items():
            if not effects.effects_in(preset):
                continue
            spec = effects.spec_of(name, Effects())
            variants = effects.variants_of(name, Effects())
            assert len({one.name for one in variants}) == len(variants)
            by_name = {one.name: one.spec for one in variants}
            assert effects.effects_in(by_name["bare"]) == []
            assert by_name.get("all", variants[1].spec) == spec


def test_parts_of_effects_are_priced_beside_the_rest_of_them():
    for preset, part, field in (
        ("adc-gs-small", "bits", "rate"),
        ("edgs-small", "mask", "mask"),
        ("sc-gs-small", "rigidity", "rigidity"),
    ):
        (*_, whole, rest) = effects.variants_of(preset, Effects())
        assert (whole.name, rest.name) == ("only motion", f"without {part}")
        assert getattr(whole.spec.motion, field) is not None
        assert getattr(rest.spec.motion, field) is None
    names = [one.name for one in effects.variants_of("motion-gs-small", Effects())]
    assert names[-3:] == ["without motion", "without flow", "without poses"]


@pytest.mark.slow
def test_a_small_run_measures_a_transient_medium(monkeypatch):
    spec = bare_scenes.tiny_field("nerf-w")
    capture = scenes.tiny_capture()
    variants = effects.variants(spec, {})
    variants = [one for one in variants if one.name in ("bare", "only transient")]
    monkeypatch.setattr(runs, "read_capture", lambda _: capture)
    metrics = {
        metric.key.removeprefix("nerf-w-small."): metric.value
        for metric in effects.measure("nerf-w-small", variants, 0.4, 2)
    }
    bare, transient = (
        {
            key.removeprefix(f"{name}."): value
            for key, value in metrics.items()
            if key.startswith(f"{name}.")
        }
        for name in ("bare", "only_transient")
    )
    for name in ("loss", "step"):
        assert bare[f"{name}.flops"] < transient[f"{name}.flops"]
        products = [one[f"{name}.matrix_flops"] for one in (bare, transient)]
        assert products[0] < products[1] < transient[f"{name}.flops"]
        assert bare[f"{name}.bytes_accessed"] < transient[f"{name}.bytes_accessed"]
        assert min(one[f"{name}.seconds"] for one in (bare, transient)) > 0
        assert transient[f"{name}.compile_seconds"] > 0
        assert bare[f"{name}.over_bare"] == 1
    assert bare["loss.flops"] < bare["step.flops"]
    # A step runs every product and, for weights and inputs, two more, but not those of
    # the inputs of the first layers.
    loss, step = (bare[f"{name}.matrix_flops"] for name in ("loss", "step"))
    assert 2 * loss < step < 3 * loss
    assert bare["parameters"] < transient["parameters"]
    stored = {key: Metric(key, 1.0, "", "lower") for key in _keys(metrics)}
    (head, _, names, _, *rows) = effects_page.tables(stored)
    assert head == "### `nerf-w-small`"
    assert names.startswith("| scene | parameters |")
    assert [row.split(" | ")[0] for row in rows] == ["| bare", "| only transient"]


def _keys(metrics):
    return [f"nerf-w-small.{key}" for key in metrics]
