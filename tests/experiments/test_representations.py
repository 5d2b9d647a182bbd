"""One registry of representations; their presets, threads and run folders agree."""

import json

import jax
import pytest

from experiments import representations, runs, settings
from gaussians_jax import files, model_file, splats
from tests import scenes

CHOICES = dict(
    capture=None,
    scene="default",
    steps=None,
    overrides=(),
    factor=None,
    max_side=None,
    heldout=None,
    seed=0,
)
THREADS = {"gaussians": "one", "radiance": "all"}


@pytest.mark.parametrize("name", representations.MAKERS)
def test_every_preset_finds_its_representation_and_its_threads(name):
    found = representations.named(name)
    assert found.name == name
    assert found.presets
    for preset, spec in found.presets.items():
        assert representations.of_preset(preset) is found
        assert isinstance(spec, found.spec_type)
        assert settings.threads_for(preset) == THREADS[name]
        assert found.with_steps(spec, 77).steps == 77


def test_preset_names_are_unique_over_all_representations():
    names = [p for make in representations.MAKERS.values() for p in make().presets]
    assert len(names) == len(set(names))


def test_an_unknown_preset_names_those_of_every_representation():
    with pytest.raises(ValueError, match="--preset magic: no such preset") as error:
        representations.of_preset("magic")
    for make in representations.MAKERS.values():
        assert all(preset in str(error.value) for preset in make().presets)


def test_a_preset_takes_steps_and_settings():
    choices = runs.Choices(
        preset="splats-static-small",
        **CHOICES | {"steps": 50, "overrides": ("sh_degree=0",)},
    )
    spec = runs.scene_spec(choices)
    assert (spec.steps, spec.sh_degree) == (50, 0)


@pytest.mark.parametrize("moving", [False, True])
def test_a_scene_of_gaussians_is_saved_as_a_model_and_for_viewers(moving, tmp_path):
    kind = representations.named("gaussians")
    spec = scenes.TINY_DEFORMABLE if moving else scenes.TINY_SPLATS
    capture = scenes.tiny_capture()
    facts = kind.facts_of(capture, spec)
    state = kind.build(spec, facts).init(capture, jax.random.key(0))
    saved = kind.save(tmp_path, spec, facts, state)
    assert saved.model_bytes == (tmp_path / representations.MODEL).stat().st_size
    assert [note.split()[0] for note in saved.notes] == ["gaussians.ply"] * moving
    params, about = model_file.load(tmp_path / representations.MODEL)
    assert about == {"spec": spec, "facts": facts, "step": 0}
    assert jax.tree.structure(params) == jax.tree.structure(state.params)
    active = splats.active_mask(state.params.rows["splats"]).sum()
    assert len(params.rows["splats"].mean) == active
    assert len(files.load(tmp_path / "gaussians.ply").splats.mean) == active


@pytest.fixture
def opened(monkeypatch):
    """What `saved_run` opens, without reading a capture."""
    monkeypatch.setattr(runs, "open_run", lambda *given: given)


def save(folder, preset):
    choices = runs.Choices(preset=preset, **CHOICES)
    kind = representations.of_preset(preset)
    run = runs.Run(choices, None, kind, runs.scene_spec(choices), None, None)
    runs.save_choices(folder, run)
    return run


@pytest.mark.usefixtures("opened")
@pytest.mark.parametrize("name", representations.MAKERS)
def test_a_run_folder_knows_its_representation(name, tmp_path):
    preset, *_ = representations.named(name).presets
    run = save(tmp_path, preset)
    choices, kind, spec = runs.saved_run(tmp_path)
    assert (choices, kind.name, spec) == (run.choices, name, run.spec)
    assert settings.stored_preset(tmp_path) == preset


@pytest.mark.usefixtures("opened")
def test_an_old_run_folder_holds_splats(tmp_path):
    save(tmp_path, "splats-static")
    path = tmp_path / runs.CONFIG
    stored = json.loads(path.read_text())
    del stored["representation"]
    path.write_text(json.dumps(stored))
    assert runs.saved_run(tmp_path)[1].name == "gaussians"


def test_a_representation_of_another_version_is_refused(tmp_path):
    save(tmp_path, "splats-static")
    path = tmp_path / runs.CONFIG
    stored = json.loads(path.read_text()) | {"representation": "voxels"}
    path.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=r"config\.json: .*'voxels'.*gaussians"):
        runs.saved_run(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"choices": {}}', '{"choices": 3}'])
def test_a_broken_run_folder_has_no_preset_yet(text, tmp_path):
    assert settings.stored_preset(tmp_path) == ""
    (tmp_path / settings.CONFIG).write_text(text)
    assert settings.stored_preset(tmp_path) == ""
