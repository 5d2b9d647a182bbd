"""Every named field can be stretched and has its paper's networks; two train."""

import dataclasses

import jax
import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.fields import template
from nerfies_jax.fields.effects import scene_flow, warp
from nerfies_jax.scene import presets, scene
from nerfies_jax.scene.presets import PRESETS
from tests import scenes

# Fields of the effects that count steps.
COUNTED = {
    "warp": ("anneal_steps",),
    "ambient": ("closed_steps", "anneal_steps"),
    "elastic": ("hold_steps", "decay_steps"),
    "scene_flow": ("decay_steps",),
    "smoothness": ("until",),
    "surface": ("closed_steps", "anneal_steps"),
    "template": ("anneal_steps",),
}
PAPERS = ("nerf", "nerf-w", "d-nerf", "t-nerf", "nerfies", "hypernerf", "nsff")
PAPERS += ("tineuvox", "nerf-ds")


def test_every_paper_has_a_small_variant():
    on_grids = {name for name in PRESETS if name.endswith("-grid-small")}
    assert set(PRESETS) - on_grids == {*PAPERS, *(f"{name}-small" for name in PAPERS)}
    assert {name.removesuffix("-grid-small") for name in on_grids} <= set(PAPERS)


def test_half_the_steps_halve_the_schedules():
    for spec in PRESETS.values():
        half = presets.with_steps(spec, spec.steps // 2)
        assert half.steps == spec.steps // 2
        for effect, fields in COUNTED.items():
            whole = getattr(spec, effect)
            for field in fields if hasattr(whole, fields[0]) else ():
                count = getattr(whole, field)
                expected = max(1, count // 2) if count else count
                assert getattr(getattr(half, effect), field) == expected


# Rows of the weights of every layer. The codes of NeRF, D-NeRF and NSFF join the input
# to what the fifth layer answers, those of Nerfies and HyperNeRF to the fourth's.
@pytest.mark.parametrize(
    ("name", "inputs", "layer"),
    [("nerf", 63, 5), ("nerf-w", 63, 5), ("d-nerf", 63, 5), ("t-nerf", 84, 5),
     ("nsff", 63, 5), ("nerfies", 51, 4), ("hypernerf", 55, 4)],
)  # fmt: skip
def test_the_networks_read_their_input_again_where_the_papers_do(name, inputs, layer):
    spec, key = PRESETS[name], jax.random.key(0)
    read = jax.eval_shape(lambda: template.init(spec.template, key, inputs, 27))
    networks = {"template": (read.trunk.hidden, inputs, layer)}
    if name == "d-nerf":
        networks["warp"] = (
            jax.eval_shape(lambda: warp.init(spec.warp, key)).hidden,
            84,
            5,
        )
    if name == "nsff":
        medium = jax.eval_shape(lambda: scene_flow.init(spec.scene_flow, key, 256))
        networks["medium"] = medium.network.trunk.hidden, 84, 5
    for hidden, width, again in networks.values():
        rows = [width, *[256] * 7]
        rows[again] += width
        assert [one.weight.shape for one in hidden] == [(n, 256) for n in rows]


# Without what others train: "nerf" is in tests/fields/test_scene.py, the other papers
# in tests/hard_cases.
TRAINED = ("t-nerf-small", "hypernerf-small")


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINED)
def test_a_small_preset_learns_more_than_one_color(name):
    capture = scenes.tiny_capture()
    spec = dataclasses.replace(presets.with_steps(PRESETS[name], 200), rays=32)
    model = scene.build(spec, scene.metadata_of(capture, spec))
    frames = evaluation.frames_of(capture, model.required_data)
    state, step = model.init(capture, jax.random.key(0)), jax.jit(model.step)
    errors = []
    for _ in range(spec.steps):
        state, metrics = step(state, frames)
        errors.append(float(metrics["mse"]))
    assert np.isfinite(errors).all()
    # Papers' on waves reach 0.85 to 0.88 of it; an image of one color has all of it.
    images = capture.images[capture.train] / 255
    variance = np.mean((images - images.mean((0, 1, 2))) ** 2)
    assert np.mean(errors[-40:]) < 0.9 * variance
