"""Seconds become steps: whose schedules stretch, by how much, and what is told."""

import dataclasses

import jax
import numpy as np
import pytest

from nerfies_jax import runs
from nerfies_jax.capture import nerfies_format
from nerfies_jax.runs import plan, representations
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.training import rate
from nerfies_jax.training.rate import StepTime
from tests import scenes


@pytest.mark.parametrize(
    ("steps", "expected"),
    [(0.3, 1), (7.9, 7), (99, 99), (101, 100), (1279.9, 1200), (98_765, 98_000)],
)
def test_steps_keep_two_digits_and_are_never_more(steps, expected):
    assert plan.rounded(steps) == expected


def test_schedules_stretch_with_steps_however_these_are_given():
    named = RunConfig("splats-tracked-small", steps=300)
    assigned = dataclasses.replace(named, steps=None, overrides=("steps=300",))
    assert runs.scene_spec(assigned) == runs.scene_spec(named)
    with pytest.raises(ValueError, match=r"^steps=few: cannot be read"):
        runs.scene_spec(dataclasses.replace(named, overrides=("steps=few",)))


@pytest.mark.parametrize("growing", [True, False])
def test_seconds_are_the_steps_that_they_allow(growing, tmp_path, monkeypatch):
    nerfies_format.write(scenes.tiny_capture(), tmp_path / "capture")
    overrides = ("sh_degree=1", "strategy.cap_max=400", "init.extra_random=0")
    if not growing:
        overrides = ("strategy=none",)
    config = RunConfig(
        "splats-static-small", CaptureSource(tmp_path / "capture"), None, overrides
    )
    run = runs.new_run(config)
    state = run.model.init(run.capture, jax.random.key(0))
    measured = []

    def step_time(model, state, frames, steps):
        measured.append((model, steps))
        return StepTime(0.01, 3.0)

    monkeypatch.setattr(rate, "step_time", step_time)
    planned, line = plan.with_seconds(run, state, 10)
    assert measured == [(run.model, 2000)]
    # 200 static points may become 400.
    steps = 1000 / 2**0.5 if growing else 1000
    assert planned.spec.steps == planned.config.steps == plan.rounded(steps)
    assert planned.spec == runs.scene_spec(planned.config)
    assert planned.spec.sh_every == 10 * round(70 * planned.spec.steps / 2000)
    longer = planned.model.init(planned.capture, jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, longer.params, state.params)
    assert planned.capture is run.capture
    assert planned.observed is run.observed
    assert line.startswith(
        f"plan: {planned.spec.steps:,} steps in 10 s of training (10"
    )
    assert ("grow 1.4 times" in line) == growing
    if growing:
        stop = planned.spec.strategy.refine_stop_iter
        assert stop % 10 == 0
        assert abs(stop - 0.65 * planned.spec.steps) <= 5


def test_growth_is_expected_within_bounds():
    kind = representations.named("gaussians")
    capture, spec = scenes.tiny_capture(), scenes.TINY_SPLATS
    model = kind.build(spec, kind.metadata_of(capture, spec))
    state = model.init(capture, jax.random.key(0))
    at_first = model.counts(state)["gaussians"]
    for cap, growth in ((at_first // 2, 1), (2 * at_first, 2**0.5), (10**6, 2)):
        density = dataclasses.replace(spec.strategy, cap_max=cap)
        growth_of_scene = kind.resources.growth(
            dataclasses.replace(spec, strategy=density), state
        )
        assert growth_of_scene == pytest.approx(growth)
    assert kind.resources.growth(dataclasses.replace(spec, strategy=None), state) == 1
    assert representations.named("radiance").resources.growth(None, state) == 1
