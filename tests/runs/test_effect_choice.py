"""Effects that a new run gets, and those that the user keeps out."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax import runs
from nerfies_jax.preprocessing.findings import CANNOT_TELL, CERTAIN, LIKELY, Finding
from nerfies_jax.runs import effect_choice, representations
from nerfies_jax.runs.config import RunConfig
from nerfies_jax.runs.effect_choice import Trial
from tests import scenes

EXPOSURE, DEPTH = "exposure.learning_rate=0.01", "depth.weight=0.1"


@pytest.fixture
def chosen(monkeypatch):
    """Choose effects for given findings; returns the overrides, lines and trials."""

    def choose(light, depth, gain=0.0, user=()):
        findings = []
        for effect, answer in (("appearance codes", light), ("depth", depth)):
            wanted = None if answer == CANNOT_TELL else True
            findings.append(Finding(effect, "numbers", "bound", wanted, answer))
        monkeypatch.setattr(
            effect_choice.inspection, "find", lambda *args: tuple(findings)
        )
        tried = []

        def try_out(config, changed, capture, name):
            tried.append(changed.overrides[len(config.overrides) :])
            return Trial(300, 8, 20.0, 20.0 + gain)

        capture = scenes.tiny_capture()
        config = RunConfig("splats-static-small", overrides=("sh_degree=1", *user))
        config, lines = effect_choice.choose(config, capture, user, try_out)
        assert config.overrides[0] == "sh_degree=1"
        assert config.overrides[len(config.overrides) - len(user) :] == user
        return config.overrides[1 : len(config.overrides) - len(user)], lines, tried

    return choose


def test_certain_effects_are_enabled_and_undecided_ones_are_not(chosen):
    overrides, lines, tried = chosen(CERTAIN, CANNOT_TELL)
    assert overrides == (EXPOSURE,)
    assert not tried
    assert lines == [f"effects: {EXPOSURE}, for appearance codes (certain: numbers)"]


@pytest.mark.parametrize(("gain", "pays"), [(0.3, True), (0.05, False), (-1, False)])
def test_likely_effects_are_enabled_if_a_trial_pays(chosen, gain, pays):
    overrides, (line,), tried = chosen(CANNOT_TELL, LIKELY, gain)
    assert tried == [(DEPTH,)]
    assert overrides == ((DEPTH,) if pays else ())
    assert f"20.00 dB without and {20 + gain:.2f} dB with" in line
    assert line.startswith("effects: not") == (not pays)


@pytest.mark.parametrize("setting", ["exposure=none", "exposure.learning_rate=0.1"])
def test_components_set_by_the_user_are_kept(chosen, setting):
    assert chosen(CERTAIN, CERTAIN, user=(setting,))[0] == (DEPTH,)


def test_splats_whose_motion_starts_from_tracks_get_no_depth_loss():
    wanted = {"depth": True, "appearance codes": True}
    kind = representations.of_preset("splats-tracked-small")
    for preset, expected in (
        ("splats-tracked-small", (EXPOSURE,)),
        ("splats-static-small", (EXPOSURE, DEPTH)),
    ):
        overrides = kind.recommendation.effect_overrides(wanted, kind.presets[preset])
        assert overrides == expected


@pytest.mark.full
def test_a_trial_finds_that_exposures_pay_where_brightness_alternates():
    capture = scenes.tiny_capture()
    gain = np.where(np.arange(len(capture.images)) % 2, 1.0, 0.5)
    images = (capture.images * gain[:, None, None, None]).astype(np.uint8)
    capture = dataclasses.replace(capture, images=images)
    config = RunConfig("splats-static-small", steps=60)
    before = runs.new_run(config, capture).capture.images.copy()
    changed = dataclasses.replace(config, overrides=(EXPOSURE,))
    trial = effect_choice.compare_configs(config, changed, capture, "exposures")
    assert trial.steps == 60
    assert trial.pays
    np.testing.assert_array_equal(capture.images, before)
