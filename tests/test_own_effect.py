"""Effects from outside come in by one door, as docs/own_effect.md shows."""

import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import scene as splat_scene
from nerfies_jax import evaluation, scene
from nerfies_jax.effects.effect import Medium
from nerfies_jax.training.effects import Effect
from tests import bare_scenes, scenes

PAGE = pathlib.Path(__file__).parents[1] / "docs" / "own_effect.md"


@pytest.mark.full
def test_the_effects_of_the_page_are_short_and_train(capsys):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    assert len(blocks) == 2
    names = {}
    for block in blocks:
        code = block.split("\ndef ")[1].split("\n\n\n")[0]
        assert len(code.splitlines()) < 30
        exec(compile(block, str(PAGE), "exec"), names)
    capsys.readouterr()
    field, splats = names["field"], names["splats"]
    # Twenty steps of Adam, each about as long as the effect's own learning rate. Those
    # of the template (5e-3) and of the means (1.6e-4 of the extent) are others.
    assert 3e-4 < np.abs(field.state.params["drift"]).max() < 3e-3
    assert 5e-3 < np.abs(splats.state.params.rows["lines"]).max() < 3e-2
    assert "drift/speed_sq" in field.history.rows[-1]
    assert "lines/speed_sq" in splats.history.rows[-1]


def of_field(*effects):
    """The terms of a step of a tiny field with these effects, by name."""
    capture, spec = scenes.tiny_capture(), bare_scenes.tiny_field("nerf-small")
    metadata = scene.metadata_of(capture, spec)
    field = scene.field(spec, metadata, effects=effects)
    frames = evaluation.frames_of(capture)

    @jax.jit
    def values(key):
        params = field.init(key)
        batch = scene.draw_batch(frames, 4, key)
        terms = scene.loss_terms(field, params, frames, batch, jnp.int32(0), key)
        return {name: term.value for name, term in terms.items()}

    return values(jax.random.key(0))


def fog(name="fog", beta_min=0.5, beta_power=0.0):
    """A medium that is the same everywhere and says how uncertain it is."""

    def medium(params, sample, condition):
        return Medium(jnp.ones(()), jnp.full(3, 0.5), beta=jnp.ones(()))

    return Effect(name, medium=medium, beta_min=beta_min, beta_power=beta_power)


@pytest.mark.full
def test_a_medium_brings_its_own_least_uncertainty():
    """Of a field without a transient: what a ray's beta is at least, the loss shows."""
    near, far = (of_field(fog(beta_min=b))["color"] for b in (1e3, 1e4))
    # log beta, where it is so large that the residual adds next to nothing
    np.testing.assert_allclose(near, np.log(1e3), atol=2e-3)
    np.testing.assert_allclose(far - near, np.log(10), atol=2e-3)
    weighed = of_field(fog(beta_min=1e3, beta_power=1.0))["color"]
    np.testing.assert_allclose(weighed / near, 1e3, rtol=1e-3)


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ((fog(beta_min=None),), "'fog' has a beta, and the effect no beta_min"),
        ((fog(), fog("smoke")), "both 'fog' and 'smoke' say how uncertain"),
        ((fog(), fog()), "named 'fog' already"),
        ((Effect("codes"),), "named 'codes' already"),
        ((Effect("mine", deform=print),), "'mine' fills the seam 'deform'"),
        ((Effect("mine", warm_up=3),), "'mine' fills the seam 'warm_up'"),
    ],
)
def test_a_field_refuses_what_it_cannot_serve(effects, message):
    with pytest.raises(ValueError, match=message):
        of_field(*effects)


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (Effect("mlp_motion"), "named 'mlp_motion' already"),
        (Effect("splats"), "named 'splats' already"),
        (fog(), "'fog' fills the seam 'medium'"),
        (Effect("mine", init=print), "'mine' has init and no learning_rate"),
        (Effect("mine", init_rows=print), "init_rows and no row_learning_rate"),
    ],
)
def test_splats_refuse_what_they_cannot_serve(effect, message):
    metadata = splat_scene.metadata_of(scenes.tiny_capture())
    with pytest.raises(ValueError, match=message):
        splat_scene.build(scenes.TINY_DEFORMABLE, metadata, effects=(effect,))
