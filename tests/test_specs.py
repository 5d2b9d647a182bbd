"""Settings as JSON and back, and changed from the command line."""

import dataclasses
import json
import math

import pytest

from gaussians_jax import presets
from gaussians_jax.raster_spec import INRIA
from nerfies_jax import presets as fields
from nerfies_jax.training import specs


def test_an_override_reaches_a_nested_field_with_its_type():
    spec = specs.override(
        presets.SMALL_DEFORMABLE,
        ("density.most=123", "motion.rate=1e-3", "raster.antialiased=true"),
    )
    assert spec.density.most == 123
    assert spec.motion.rate == 1e-3
    assert spec.raster.antialiased is True
    assert spec.start == presets.SMALL_DEFORMABLE.start


def test_an_effect_is_taken_out_with_none():
    assert specs.override(presets.SMALL_DEFORMABLE, ("motion=none",)).motion is None


def test_a_tuple_is_read_by_its_items():
    spec = specs.override(presets.SMALL_DEFORMABLE, ("motion.skips=1,2",))
    assert spec.motion.skips == (1, 2)


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("density.mots=3", "has no field 'mots'; it has .*most"),
        ("density.most=many", "cannot be read as"),
        ("steps", "expected path.to.field=value"),
        ("steps.more=1", "has no fields"),
        ("motion.width=8", "has no fields"),  # of which kind is not guessed
        ("sh_degree=7", "0, 1, 2 or 3"),
    ],
)
def test_a_wrong_override_names_itself_and_the_way_out(assignment, words):
    with pytest.raises(ValueError, match=words):
        specs.override(presets.SMALL_STATIC, (assignment,))


def there_and_back(value):
    return specs.from_json(
        json.loads(json.dumps(specs.as_json(value), allow_nan=False))
    )


@pytest.mark.parametrize("name", sorted(presets.PRESETS | fields.PRESETS))
def test_a_spec_comes_back_from_its_json(name):
    spec = (presets.PRESETS | fields.PRESETS)[name]
    assert there_and_back(spec) == spec


def test_an_infinite_setting_survives_json():
    spec = dataclasses.replace(presets.STATIC, raster=INRIA)
    assert there_and_back(spec) == spec
    assert math.isnan(there_and_back(math.nan))


def test_a_spec_of_another_version_is_refused():
    stored = specs.as_json(presets.STATIC)
    del stored["sh_every"]
    with pytest.raises(ValueError, match=r"SplatScene .* is none of this version"):
        specs.from_json(stored)


@pytest.mark.parametrize(
    "name", ["os.system", "gaussians_jax.spec.effects_of", "nowhere.Spec", "Spec", ""]
)
def test_a_name_that_is_no_setting_is_refused(name):
    with pytest.raises(ValueError, match="no record or setting"):
        specs.from_json({"type": name})
