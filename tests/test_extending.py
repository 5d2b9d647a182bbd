"""Parts of other packages in the fields of a scene, as docs/extending.md has them."""

import ast
import dataclasses
import json
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import gaussians_jax as gj
import nerfies_jax as nj
from gaussians_jax.core.splats import Params
from gaussians_jax.io import model_file
from gaussians_jax.scene.spec import SplatScene
from nerfies_jax import evaluation
from nerfies_jax.scene import scene
from nerfies_jax.scene import steps as field_steps
from nerfies_jax.training import specs
from tests import bare_scenes, scenes

PAGE = pathlib.Path(__file__).parents[1] / "docs" / "extending.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
MODULE = "extending_page"


@pytest.fixture
def page(tmp_path, monkeypatch):
    """The classes of the page as a module of somebody else's package."""
    names = ("Drift", "SlowMotion", "PruneUnseen", "Translation", "Phase", "Fog")
    source = (block for block in BLOCKS if any(f"class {n}:" in block for n in names))
    classes = (block[: re.search(r"^\w+ =", block, re.M).start()] for block in source)
    text = "\n".join([BLOCKS[0].partition("\nscene = ")[0], *classes])
    (tmp_path / f"{MODULE}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    return MODULE


def test_each_part_of_the_page_is_short():
    parts = [
        node
        for block in BLOCKS
        for node in ast.parse(block).body
        if isinstance(node, ast.ClassDef)
    ]
    assert len(parts) == 10
    assert all(node.end_lineno - node.lineno + 2 < 30 for node in parts)


@pytest.mark.slow
def test_the_parts_of_the_page_train():
    names = {"__name__": "extending"}
    with jax.numpy_dtype_promotion("standard"):  # as users run it
        exec(compile("\n".join(BLOCKS), str(PAGE), "exec"), names)
    state, row = names["trained"].state, names["trained"].history.rows[-1]
    # Twenty steps of Adam, each about as long as the part's own learning rate. Those
    # of the means (1.6e-4 of the extent) and of the template (5e-3) are others.
    assert 5e-3 < np.abs(names["velocity"]).max() < 3e-2
    assert 0.02 < np.abs(state.params.nets["gain"]).max() < 0.3
    assert 5e-4 < np.abs(state.params.nets["camera_shift"]).max() < 3e-3
    gains = names["balanced"].state.params.nets["white_balance"]
    assert 0.02 < np.abs(gains).max() < 0.3
    assert row["slow_motion/loss"] > 0
    assert len(state.aux_state.stats) == len(state.params.rows["splats"].mean)
    assert 3e-4 < np.abs(names["params"]["warp"]).max() < 3e-3
    assert names["params"]["fog"] != -3


def test_a_scene_takes_parts_by_name_and_remembers_them(page):
    names = (
        f"motion={page}:Drift",
        "motion.learning_rate=0.5",
        f"regularizers={page}:SlowMotion",
        f"strategy={page}:PruneUnseen",
    )
    spec = specs.override(gj.PRESETS["splats-static-small"], names)
    assert spec.motion.learning_rate == 0.5
    assert [type(one).__name__ for one in spec.regularizers] == ["SlowMotion"]
    stored = json.loads(json.dumps(specs.as_json(spec)))
    assert stored["motion"]["type"] == f"{page}:Drift"
    with pytest.raises(ValueError, match=f"'{page}:.*', which is no record"):
        specs.from_json(stored, SplatScene)
    kinds = (type(spec.motion), type(spec.strategy), type(spec.regularizers[0]))
    assert specs.from_json(stored, SplatScene, *kinds) == spec
    warped = specs.override(nj.PRESETS["nerf-small"], (f"warp={page}:Translation",))
    assert warped.warp.learning_rate == 1e-4


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("motion=nowhere_at_all:Drift", "nowhere_at_all cannot be imported"),
        ("motion=extending_page:Absent", "has no 'Absent'"),
        ("motion=extending_page:jnp", "a module; a component of a scene"),
        ("motion=extending_page:SlowMotion", "no Motion: it has no apply and no init"),
        ("strategy=extending_page:Drift", "no Strategy: it has no cap_max"),
        ("regularizers=extending_page:Drift", "no Regularizer: it has no loss"),
        ("sh_degree=extending_page:Drift", "cannot be read as"),
    ],
)
@pytest.mark.usefixtures("page")
def test_what_is_no_part_is_refused_by_name(assignment, words):
    with pytest.raises(ValueError, match=words):
        specs.override(gj.PRESETS["splats-static-small"], (assignment,))


def test_a_model_file_with_a_motion_of_another_package_needs_trust(page, tmp_path):
    named = (f"motion={page}:Drift",)
    spec = specs.override(gj.PRESETS["splats-static-small"], named)
    rows = gj.from_points(np.eye(3), np.eye(3), degree=0)
    params = Params({"splats": rows, "drift": jnp.ones((3, 3))}, {})
    path = tmp_path / "model.npz"
    model_file.save(path, params, {"spec": spec})
    with pytest.raises(ValueError, match=f"names '{page}:Drift' of another package"):
        model_file.load(path)
    loaded, about = model_file.load(path, trusted=(f"{page}:Drift",))
    assert about["spec"] == spec
    np.testing.assert_array_equal(loaded.rows["drift"], params.rows["drift"])


def test_a_motion_of_another_package_is_fitted_to_tracks(page):
    motion = specs.override(gj.Scene(steps=1), (f"motion={page}:Drift",)).motion
    start, times = np.random.default_rng(0).normal(size=(5, 1, 3)), np.linspace(0, 1, 6)
    tracks = start + times[:, None] * [0.3, 0.0, -0.2]
    fit = gj.fit_tracks(motion, tracks, steps=400)
    assert np.abs(fit.positions(times) - tracks).mean() < 0.01
    np.testing.assert_allclose(
        fit.params.rows["drift"].mean(axis=0), [0.3, 0, -0.2], atol=0.02
    )


@dataclasses.dataclass(frozen=True)
class Fog:
    """A medium that is the same everywhere and says how uncertain it is."""

    beta_min: float | None = 0.5
    beta_power: float = 0.0
    name: str = "fog"

    def init(self, key, features):
        return jnp.zeros(())

    def apply(self, params, sample, frame):
        ones = jnp.ones(())
        return nj.protocols.MediumSample(ones, jnp.full(3, 0.5), beta=ones)


def color_of(medium):
    """The loss of color of a step of a tiny field with this medium."""
    capture, spec = scenes.tiny_capture(), bare_scenes.tiny_field("nerf-small")
    spec = dataclasses.replace(spec, transient=medium)
    field = scene.field(spec, scene.metadata_of(capture, spec))
    frames = evaluation.frames_of(capture)

    @jax.jit
    def value(key):
        params = field.init(key)
        batch = field_steps.draw_batch(frames, 4, key)
        terms = field_steps.loss_terms(field, params, frames, batch, jnp.int32(0), key)
        return terms["color"].value

    return value(jax.random.key(0))


@pytest.mark.full
def test_a_medium_brings_its_own_least_uncertainty():
    near, far = (color_of(Fog(beta_min=b)) for b in (1e3, 1e4))
    # log beta, where it is so large that the residual adds next to nothing
    np.testing.assert_allclose(near, np.log(1e3), atol=2e-3)
    np.testing.assert_allclose(far - near, np.log(10), atol=2e-3)
    weighed = color_of(Fog(beta_min=1e3, beta_power=1.0))
    np.testing.assert_allclose(weighed / near, 1e3, rtol=1e-3)


@pytest.mark.parametrize(
    ("medium", "words"),
    [
        (Fog(beta_min=None), "'fog' has a beta, so the effect needs a beta_min"),
        (Fog(name="codes"), "named 'codes', but this name is in use"),
        (Fog(name="template"), "named 'template', but this name is in use"),
    ],
)
def test_a_field_refuses_what_it_cannot_serve(medium, words):
    with pytest.raises(ValueError, match=words):
        color_of(medium)


LION = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_lion())


def stepped(package, spec):
    """The state of a scene after one step."""
    capture = scenes.tiny_capture()
    seen = (spec,) if package is nj else ()
    model = package.build(spec, package.metadata_of(capture, *seen))
    frames = evaluation.frames_of(capture, model.required_data)
    state = model.init(capture, jax.random.key(0))
    state, metrics = jax.jit(model.step)(state, frames)
    assert np.isfinite(metrics["loss"])
    return state


@pytest.mark.full
def test_gaussians_train_with_an_optimizer_of_optax():
    state = stepped(gj, dataclasses.replace(scenes.TINY_SPLATS, optimizer=LION))
    everything = gj.strategy.Population(
        state.params, state.optimizer, (), jax.random.key(0), 1, 1.0, LION
    )
    few = gj.strategy.select(everything, np.array([4, 4, 2]), np.array([0, 1, 0]) > 0)
    before, after = (
        np.asarray(moments[1].mu.rows["splats"].opacity_logit)
        for moments in (state.optimizer, few.moments)
    )
    np.testing.assert_array_equal(after[[0, 2]], before[[4, 2]])
    assert before.any()
    assert not after[1].any()


@pytest.mark.full
def test_a_field_trains_with_an_optimizer_of_optax():
    field = dataclasses.replace(bare_scenes.tiny_field("nerf-small"), optimizer=LION)
    state = stepped(nj, field)
    assert jax.tree.structure(state.optimizer[1].mu) == jax.tree.structure(state.params)


@pytest.mark.parametrize("name", ["mlp_motion", "splats"])
def test_two_parts_of_one_name_are_refused(name):
    @dataclasses.dataclass(frozen=True)
    class Other:
        name: str

        def loss(self, params, context):
            return jnp.zeros(())

    spec = dataclasses.replace(scenes.TINY_DEFORMABLE, regularizers=(Other(name),))
    with pytest.raises(ValueError, match=f"named '{name}', but this name is in use"):
        gj.build(spec, gj.metadata_of(scenes.tiny_capture()))


def test_what_needs_the_layers_of_the_template_is_refused_with_another():
    @dataclasses.dataclass(frozen=True)
    class Empty:
        def init(self, key, features, condition):
            return jnp.zeros(())

        def apply(self, params, inputs):
            return params, jnp.zeros(3)

    field = nj.PRESETS["nerf-small"]
    with pytest.raises(ValueError, match=r"density_noise=1\.0 needs the layers"):
        dataclasses.replace(field, template=Empty(), density_noise=1.0)
