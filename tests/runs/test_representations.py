"""One registry of representations; their presets, threads and run folders agree."""

import dataclasses
import json

import jax
import pytest

from gaussians_jax.core import splats
from gaussians_jax.io import files, model_file
from nerfies_jax import runs
from nerfies_jax.evaluation.representation import MODEL
from nerfies_jax.runs import representations, run
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.runs.run_folder import CONFIG
from nerfies_jax.training import specs
from tests import scenes

THREADS = {"gaussians": "one", "radiance": "all"}


@pytest.mark.parametrize("name", THREADS)
def test_every_preset_finds_its_representation(name):
    kind = representations.named(name)
    assert (kind.name, kind.resources.threads) == (name, THREADS[name])
    assert kind.presets
    for preset, spec in kind.presets.items():
        assert representations.of_preset(preset) is kind
        assert isinstance(spec, kind.spec_type)
        assert kind.with_steps(spec, 77).steps == 77


def test_an_unknown_preset_names_those_of_every_representation():
    with pytest.raises(ValueError, match="no preset 'magic'") as error:
        representations.of_preset("magic")
    for each in representations.installed().values():
        assert all(preset in str(error.value) for preset in each.presets)


@dataclasses.dataclass(frozen=True)
class Foreign:
    """A spec of a package that is not ours."""

    steps: int


def test_a_spec_may_be_of_the_package_of_its_representation():
    kind = representations.named("gaussians")._replace(spec_type=Foreign)
    stored = json.loads(json.dumps(specs.as_json(Foreign(7))))
    assert representations.stored_spec(kind, stored) == Foreign(7)
    ours = representations.named("radiance")
    with pytest.raises(ValueError, match=r"Foreign', which is no record"):
        representations.stored_spec(ours, stored)


@pytest.mark.full
@pytest.mark.parametrize("moving", [False, True])
def test_a_scene_of_gaussians_is_saved_as_a_model_and_for_viewers(moving, tmp_path):
    kind = representations.named("gaussians")
    spec = scenes.TINY_DEFORMABLE if moving else scenes.TINY_SPLATS
    capture = scenes.tiny_capture()
    metadata = kind.metadata_of(capture, spec)
    state = kind.build(spec, metadata).init(capture, jax.random.key(0))
    saved = kind.products.save(tmp_path, spec, metadata, state)
    assert saved.model_bytes == (tmp_path / MODEL).stat().st_size
    assert [note.split()[0] for note in saved.notes] == ["gaussians.ply"] * moving
    params, about = model_file.load(tmp_path / MODEL)
    assert about == {"spec": spec, "metadata": metadata, "step": 0}
    assert jax.tree.structure(params) == jax.tree.structure(state.params)
    active = splats.active_mask(state.params.rows["splats"]).sum()
    assert len(params.rows["splats"].mean) == active
    assert len(files.load(tmp_path / "gaussians.ply").splats.mean) == active


@pytest.fixture
def opened(monkeypatch):
    """What `saved_run` opens, without reading a capture."""

    def unread(config, kind, spec):
        capture = scenes.tiny_capture()
        return runs.Run(config, capture, capture, kind, spec, None, None)

    monkeypatch.setattr(run, "open_run", unread)


def save(folder, preset):
    config = RunConfig(preset, CaptureSource(folder, max_side=9), overrides=("a=1",))
    kind = representations.of_preset(preset)
    spec = kind.presets[preset]
    runs.save_config(folder, runs.Run(config, None, None, kind, spec, None, None))
    return config, spec


@pytest.mark.usefixtures("opened")
@pytest.mark.parametrize("name", THREADS)
def test_a_run_folder_knows_its_representation(name, tmp_path):
    preset, *_ = representations.named(name).presets
    saved = save(tmp_path, preset)
    saved_run = runs.saved_run(tmp_path)
    assert (saved_run.config, saved_run.spec) == saved
    kind = saved_run.representation
    assert kind is representations.of_run(tmp_path) is representations.named(name)


def test_a_representation_of_another_version_is_refused(tmp_path):
    save(tmp_path, "splats-static")
    path = tmp_path / CONFIG
    stored = json.loads(path.read_text()) | {"representation": "voxels"}
    path.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=r"config\.json: .*'voxels'.*gaussians"):
        runs.saved_run(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"representation": {}}'])
def test_a_broken_run_folder_has_no_representation_yet(text, tmp_path):
    assert representations.of_run(tmp_path) is None
    (tmp_path / CONFIG).write_text(text)
    assert representations.of_run(tmp_path) is None
