"""Every combination of decisions becomes a run that can be built."""

import itertools

import pytest

from experiments import reconstruct
from nerfies_jax import runs
from nerfies_jax.capture import nerfies_format
from nerfies_jax.effects.appearance import AppearanceSpec
from nerfies_jax.evidence.findings import CANNOT_TELL, CERTAIN, Finding
from nerfies_jax.runs import adviser, platform, representations
from nerfies_jax.runs.adviser import FIELDS, SPLATS
from nerfies_jax.training import specs
from tests import scenes
from tests.evidence import films

EFFECTS = (
    "motion",
    "appearance codes",
    "transient objects",
    "start from points",
    "background points",
    "depth",
)


def findings(**wanted):
    """Findings by effect, words joined by underscores; None cannot be told."""
    return tuple(
        Finding(
            name.replace("_", " "),
            "",
            "",
            choice,
            CANNOT_TELL if choice is None else CERTAIN,
        )
        for name, choice in wanted.items()
    )


def decided(choices):
    names = (name.replace(" ", "_") for name in EFFECTS)
    return findings(**dict(zip(names, choices, strict=True)))


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("kind", [SPLATS, FIELDS])
def test_all_decisions_lead_to_a_model_that_can_be_built(kind, full):
    capture = scenes.tiny_capture()
    built = set()
    for choices in itertools.product((True, False, None), repeat=len(EFFECTS)):
        advice = adviser.advise(decided(choices), kind, full)
        if advice.arguments() in built:
            continue
        built.add(advice.arguments())
        representation = representations.of_preset(advice.preset)
        spec = specs.override(representation.presets[advice.preset], advice.overrides)
        representation.build(spec, representation.metadata_of(capture, spec))
    assert len(built) > 4


def spec_of(kind, **wanted):
    advice = adviser.advise(findings(**wanted), kind)
    presets = representations.of_preset(advice.preset).presets
    return specs.override(presets[advice.preset], advice.overrides), advice


def test_a_still_scene_gets_no_motion_and_a_moving_one_gets_it():
    assert spec_of(SPLATS, motion=False)[0].motion is None
    assert spec_of(SPLATS, motion=True)[0].motion is not None
    assert spec_of(FIELDS, motion=False)[0].warp is None
    assert spec_of(FIELDS, motion=True)[0].warp is not None


def test_what_cannot_be_told_keeps_the_default_that_moves():
    spec, advice = spec_of(SPLATS, motion=None)
    assert spec.motion is not None
    assert any("cannot tell" in note for note in advice.notes)


def test_codes_and_media_come_in_where_the_preset_has_none():
    spec, _ = spec_of(FIELDS, motion=True, appearance_codes=True)
    assert spec.appearance == AppearanceSpec(4)
    assert spec.transient is None
    passed, _ = spec_of(FIELDS, motion=False, transient_objects=True)
    assert passed.transient.width == 48
    _, advice = spec_of(SPLATS, appearance_codes=True)
    assert any("prefer the field" in note for note in advice.notes)


def test_no_medium_is_brought_in_beside_a_warp():
    spec, advice = spec_of(FIELDS, motion=True, transient_objects=True)
    assert spec.transient is None
    assert any("left to the warp" in note for note in advice.notes)


def test_an_effect_that_is_one_of_several_kinds_is_not_guessed():
    preset = representations.gaussians().presets["splats-static-small"]
    with pytest.raises(ValueError, match="has no fields"):
        specs.override(preset, ("motion.width=8",))


def test_effects_auto_takes_the_advice_and_the_users_word_comes_last(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(platform, "start_jax", lambda *_: None)
    nerfies_format.write(films.film(), tmp_path / "film")
    taken = {}

    def caught(choices, stored):
        taken["choices"] = choices
        raise ValueError("caught")

    monkeypatch.setattr(runs, "new_run", caught)
    with pytest.raises(SystemExit):
        reconstruct.main(
            [str(tmp_path / "film"), "--effects", "auto", "--set", "sh_degree=0"]
        )
    assert taken["choices"].preset == "splats-static-small"
    assert taken["choices"].overrides[-1] == "sh_degree=0"
    assert "effects: --preset splats-static-small" in capsys.readouterr().out
