"""Overrides, run folders and one-line errors."""

import dataclasses
import json

import pytest

from experiments import settings
from gaussians_jax import presets
from gaussians_jax.mcmc import MCMCStrategySpec
from gaussians_jax.raster_spec import INRIA


def test_an_override_reaches_a_nested_field_with_its_type():
    spec = settings.override(
        presets.SMALL_DEFORMABLE,
        ("densification.cap_max=123", "motion.rate=1e-3", "raster.antialiased=true"),
    )
    assert spec.densification.cap_max == 123
    assert spec.motion.rate == 1e-3
    assert spec.raster.antialiased is True
    assert spec.init == presets.SMALL_DEFORMABLE.init


def test_an_effect_is_taken_out_with_none():
    assert settings.override(presets.SMALL_DEFORMABLE, ("motion=none",)).motion is None


def test_one_of_several_kinds_is_chosen_by_the_name_of_its_class():
    spec = settings.override(
        presets.SMALL_DEFORMABLE,
        ("densification=MCMCStrategySpec", "densification.cap_max=123"),
    )
    assert spec.densification == MCMCStrategySpec(cap_max=123)


def test_a_tuple_is_read_by_its_items():
    spec = settings.override(presets.SMALL_DEFORMABLE, ("motion.skips=1,2",))
    assert spec.motion.skips == (1, 2)


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("densification.cap_mxa=3", "has no field 'cap_mxa'; it has .*cap_max"),
        ("densification.cap_max=many", "cannot be read as"),
        ("densification=MCMC", "one of DefaultStrategySpec, MCMCStrategySpec"),
        ("alternation.nets=3", "no defaults for start and stop"),
        ("steps", "expected path.to.field=value"),
        ("steps.more=1", "has no fields"),
        ("sh_degree=7", "0, 1, 2 or 3"),
    ],
)
def test_a_wrong_override_names_itself_and_the_way_out(assignment, words):
    with pytest.raises(ValueError, match=words):
        settings.override(presets.SMALL_STATIC, (assignment,))


def test_a_spec_is_written_as_plain_json():
    text = json.dumps(settings.as_json(presets.DEFORMABLE))
    stored = json.loads(text)
    assert stored["class"] == "SplatScene"
    assert stored["motion"]["width"] == 256
    assert set(stored) - {"class"} == {
        field.name for field in dataclasses.fields(presets.DEFORMABLE)
    }


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_a_spec_comes_back_from_its_json(name):
    spec = presets.PRESETS[name]
    stored = json.loads(json.dumps(settings.as_json(spec)))
    assert settings.from_json(type(spec), stored) == spec


def test_a_field_called_kind_comes_back():
    spec = _Warp()
    stored = json.loads(json.dumps(settings.as_json(spec)))
    assert settings.from_json(_Warp, stored) == spec


def test_a_spec_of_the_first_run_folders_comes_back():
    stored = settings.as_json(presets.DEFORMABLE)

    def earlier(value):
        if not isinstance(value, dict):
            return value
        return {
            "kind" if key == "class" else key: earlier(x) for key, x in value.items()
        }

    found = settings.from_json(type(presets.DEFORMABLE), earlier(stored))
    assert found == presets.DEFORMABLE


def test_an_infinite_setting_survives_json():
    spec = dataclasses.replace(presets.STATIC, raster=INRIA)
    stored = json.loads(json.dumps(settings.as_json(spec), allow_nan=False))
    assert settings.from_json(type(spec), stored) == spec


def test_a_spec_of_another_version_is_refused():
    stored = settings.as_json(presets.STATIC)
    del stored["sh_every"]
    with pytest.raises(ValueError, match="no SplatScene of this version"):
        settings.from_json(type(presets.STATIC), stored)


def test_run_folders_are_numbered_and_never_shared(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, second = (settings.new_run_folder(None, "ball") for _ in range(2))
    assert (first.name, second.name) == ("ball", "ball-2")
    (first / "note").write_text("kept")
    with pytest.raises(ValueError, match=r"not empty.*--resume"):
        settings.new_run_folder(first, "ball")


def test_a_run_folder_that_cannot_be_written_is_an_early_error(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ValueError, match=r"run folder .*--out"):
            settings.new_run_folder(folder, "x")


def test_user_errors_are_one_line_and_exit_code_two(capsys):
    with pytest.raises(SystemExit) as stop, settings.user_errors():
        raise ValueError("first\nsecond")
    assert stop.value.code == 2
    assert capsys.readouterr().err == "error: first second\n"


def test_our_own_bugs_keep_their_traceback():
    with pytest.raises(KeyError), settings.user_errors():
        raise KeyError("bug")


def test_an_unknown_device_is_refused():
    with pytest.raises(SystemExit):
        settings.parse(_Device, ["--device", "abacus"])


@dataclasses.dataclass(frozen=True)
class _Device:
    """A device."""

    device: settings.typing.Literal["cpu", "gpu"] = "cpu"


@dataclasses.dataclass(frozen=True)
class _Warp:
    """A spec that tells its kinds apart."""

    kind: str = "se3"
