"""The decisions on built-in scenes, at a smaller size; each has its own effects."""

import dataclasses

import pytest

from nerfies_jax.capture import synthetic
from nerfies_jax.preprocessing import inspection
from nerfies_jax.preprocessing.findings import CERTAIN, is_collection

# A scene without any effect, and one with two that only one built-in scene has each.
# The others differ in how things move, not in what is to be decided.
SCENES = {
    "static": synthetic.PRESETS["static"],
    "exposure and transient": dataclasses.replace(
        synthetic.PRESETS["exposure"],
        transient=synthetic.PRESETS["transient"].transient,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_no_decision_on_a_built_in_scene_is_wrong(name):
    small = dataclasses.replace(
        SCENES[name], size=(112, 84), frames=40, heldout_every=20
    )
    capture, _ = synthetic.make(small, seed=5)
    inspected = inspection.inspect(capture)
    effects = name != "static"
    truth = {
        "motion": effects,
        "appearance codes": effects,
        "transient objects": effects,
        "start from points": True,
        "background points": True,
        "depth": True,
        "masks of what moves": effects,
        "lens distortion": False,
    }
    answers = {
        one.effect: one.wanted for one in inspected.findings if one.effect in truth
    }
    # At 40 frames the camera pans half again as fast as at 60, and what leaves between
    # two frames looks like what goes: it may abstain, never be wrong.
    if not effects and answers["transient objects"] is None:
        answers["transient objects"] = False
    assert answers == truth
    assert not is_collection(inspected.findings)
    assert inspected.finding("motion").confidence == CERTAIN


@pytest.mark.slow
def test_photographs_in_changing_light_are_a_collection():
    small = dataclasses.replace(synthetic.PRESETS["collection"], frames=40)
    capture, _ = synthetic.make(small, seed=5)
    assert is_collection(inspection.find(capture, inspection.EFFECTS))
