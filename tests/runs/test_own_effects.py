"""Effects named on a command line are found, made and refused by name."""

import dataclasses

import jax
import pytest

from nerfies_jax import evaluation
from nerfies_jax.runs import own_effects, run
from nerfies_jax.runs.config import RunConfig
from nerfies_jax.training import loop
from tests import bare_scenes, scenes

MODULE = """
import jax.numpy as jnp
from nerfies_jax.training.effects import Effect, Term

def penalty(params, context):
    return {"one": Term(jnp.ones(()), 0.5)}

plain = Effect("plain", penalty=penalty)
number = 3

def made(metadata):
    return Effect(f"made_{len(metadata.times)}", penalty=penalty)
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "kept_elsewhere.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    return "kept_elsewhere"


@pytest.mark.full
def test_a_run_trains_with_effects_named_in_its_config(module, monkeypatch):
    capture = scenes.tiny_capture()
    small = dataclasses.replace(bare_scenes.tiny_field("nerf-small"), steps=1)
    monkeypatch.setattr(run, "scene_spec", lambda config: small)
    names = (f"{module}:plain", f"{module}:made")
    opened = run.new_run(RunConfig("nerf-small", effects=names), capture)
    times = len(opened.metadata.times)
    assert [effect.name for effect in opened.effects] == ["plain", f"made_{times}"]
    model, frames = opened.model, evaluation.frames_of(capture)
    state = model.init(capture, jax.random.key(0))
    (row,) = loop.fit(model, state, frames, steps=1).history.rows
    assert row["plain/one"] == row[f"made_{times}/one"] == 1
    assert row["loss"] == pytest.approx(row["fine"] + row.get("coarse", 0) + 1)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("plain", "expected MODULE:NAME"),
        ("nowhere_at_all:plain", "cannot be imported"),
        ("kept_elsewhere:other", "has no 'other'"),
        ("kept_elsewhere:number", "a int, and neither an Effect"),
    ],
)
@pytest.mark.usefixtures("module")
def test_what_is_no_effect_is_refused_by_name(name, words):
    with pytest.raises(ValueError, match=f"effect {name}: .*{words}"):
        own_effects.load((name,), None)
