"""The built-in scenes from the command line."""

import pytest

from experiments import cli, make_scene
from nerfies_jax import capture
from nerfies_jax.capture import synthetic
from nerfies_jax.capture.synthetic import truth
from nerfies_jax.runs import platform


@pytest.fixture(autouse=True)
def no_global_settings(monkeypatch):
    monkeypatch.setattr(platform, "start_jax", lambda *_, **__: None)


def test_a_scene_is_written_and_loads_as_a_capture(tmp_path, capsys):
    out = tmp_path / "scene"
    arguments = "--preset rigid --frames 4 --size 24 18 --set supersampling=1 points=20"
    make_scene.main([str(out), *arguments.split()])
    read = capture.load(out)
    assert read.images.shape == (5, 18, 24, 3)
    assert len(read.points.position) == 20
    assert truth.load(out / synthetic.TRUTH_FILE).ids == read.ids
    assert str(out) in capsys.readouterr().out


def test_every_preset_has_its_name_on_the_command_line():
    assert tuple(synthetic.PRESETS) == cli.SCENES


def test_a_folder_in_use_is_refused_before_anything_is_rendered(tmp_path, monkeypatch):
    (tmp_path / "mine").write_text("kept")

    def no_scene(*_):
        raise AssertionError("rendered for a folder that cannot be used")

    monkeypatch.setattr("nerfies_jax.capture.synthetic.record.make", no_scene)
    with pytest.raises(SystemExit):
        make_scene.main([str(tmp_path)])
    assert (tmp_path / "mine").read_text() == "kept"
