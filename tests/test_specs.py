"""Settings as JSON and back, and changed from the command line."""

import dataclasses
import json
import math

import pytest

from gaussians_jax.core.splats import Params
from gaussians_jax.optim.densification import DefaultStrategySpec
from gaussians_jax.optim.mcmc import MCMCStrategySpec
from gaussians_jax.scene import presets
from gaussians_jax.scene.spec import SplatScene
from gaussians_jax.splatting.raster_spec import INRIA
from nerfies_jax.scene import presets as fields
from nerfies_jax.training import spec_fields, specs


def test_an_override_reaches_a_nested_field_with_its_type():
    spec = specs.override(
        presets.SMALL_DEFORMABLE,
        (
            "strategy.cap_max=123",
            "motion.learning_rate=1e-3",
            "raster.antialiased=true",
        ),
    )
    assert spec.strategy.cap_max == 123
    assert spec.motion.learning_rate == 1e-3
    assert spec.raster.antialiased is True
    assert spec.init == presets.SMALL_DEFORMABLE.init


def test_an_effect_is_taken_out_with_none():
    assert specs.override(presets.SMALL_DEFORMABLE, ("motion=none",)).motion is None


def test_one_of_several_kinds_is_chosen_by_the_name_of_its_class():
    spec = specs.override(
        presets.SMALL_DEFORMABLE,
        ("strategy=MCMCStrategySpec", "strategy.cap_max=123"),
    )
    assert spec.strategy == MCMCStrategySpec(cap_max=123)


@pytest.mark.parametrize("order", [1, -1])
def test_assignments_are_validated_together_in_any_order(order):
    rates = ("motion.learning_rate=5e-8", "motion.learning_rate_end=5e-10")[::order]
    motion = specs.override(presets.SMALL_DEFORMABLE, rates).motion
    assert (motion.learning_rate, motion.learning_rate_end) == (5e-8, 5e-10)
    # The last rate alone is valid, and would exceed the first.
    rates = ("motion.learning_rate=5e-8", "motion.learning_rate_end=5e-7")[::order]
    with pytest.raises(specs.OverrideError) as refusal:
        specs.override(presets.SMALL_DEFORMABLE, ("sh_degree=0", *rates))
    assert str(refusal.value).startswith(f"{' '.join(rates)}: the rate falls from")


def test_a_later_assignment_replaces_earlier_ones_below_it():
    lines = ("strategy.cap_max=7", "strategy=MCMCStrategySpec", "motion=none")
    spec = specs.override(presets.SMALL_DEFORMABLE, lines)
    assert spec.strategy == MCMCStrategySpec()
    assert spec.motion is None


def test_a_tuple_is_read_by_its_items():
    spec = specs.override(presets.SMALL_DEFORMABLE, ("motion.skips=1,2",))
    assert spec.motion.skips == (1, 2)


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("strategy.cap_mxa=3", r"no field 'cap_mxa'; did you mean cap_max\?"),
        ("cap_max=3", r"SplatScene has no .*; did you mean strategy.cap_max\?"),
        ("strategy.cap_max=many", "cannot be read as"),
        ("strategy=MCMC", "one of DefaultStrategySpec, MCMCStrategySpec"),
        ("alternation.nets=3", "no defaults for start and stop"),
        ("steps", "expected path.to.field=value"),
        ("steps.more=1", "has no fields"),
        ("motion.width=8", "has no fields"),  # of which kind is not guessed
        ("sh_degree=7", "0, 1, 2 or 3"),
    ],
)
def test_a_wrong_override_names_itself_and_the_way_out(assignment, words):
    with pytest.raises(ValueError, match=words):
        specs.override(presets.SMALL_STATIC, (assignment,))


@pytest.mark.parametrize("name", sorted(presets.PRESETS | fields.PRESETS))
def test_every_field_that_is_listed_can_be_set_to_what_it_is(name):
    spec = (presets.PRESETS | fields.PRESETS)[name]
    listed = list(spec_fields.fields_of(spec))
    # One that holds settings is changed by their fields, which are listed after it.
    lines = [f"{f.path}={f.value}" for f in listed if not f.value[0:1].isupper()]
    assert specs.override(spec, lines) == spec
    assert {f.path for f in listed} >= {f.name for f in dataclasses.fields(spec)}


def test_a_field_is_listed_with_its_words_and_default():
    listed = {f.path: f for f in spec_fields.fields_of(presets.SMALL_STATIC)}
    every = listed["strategy.refine_every"]
    assert (every.default, every.kind, every.about) == ("100", "int", "steps")
    assert every.holder is DefaultStrategySpec
    assert listed["strategy"].kind.endswith("MCMCStrategySpec or MODULE:NAME or none")
    start = spec_fields.fields_of(fields.SMALL_NERFIES)
    (jitter,) = (f.about for f in start if f.path == "elastic.points")
    assert jitter.startswith("`points` samples of each ray are chosen at random")


def there_and_back(value):
    stored = json.loads(json.dumps(specs.as_json(value), allow_nan=False))
    return specs.from_json(stored, type(value))


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
        specs.from_json(stored, SplatScene)


@pytest.mark.parametrize(
    "name",
    [
        *(
            "os.system",
            "gaussians_jax.scene.spec.effects_of",
            "nowhere.Spec",
            "Spec",
            "",
        ),
        *(
            "nerfies_jax.fields.spec.RadianceScene",
            "subprocess.Popen",
            ["os.abort"],
            None,
        ),
    ],
)
def test_a_name_that_is_no_setting_is_refused(name):
    with pytest.raises(ValueError, match="no record or setting"):
        specs.from_json({"type": name}, SplatScene)


@pytest.mark.parametrize(
    "name",
    [
        *(
            "collections.OrderedDict",
            "gaussians_jax.scene.spec.SplatScene",
            "Params",
            None,
        ),
        # Found by another name, through an import; private modules and `__main__`
        *("gaussians_jax.io.model_file.Params", "nerfies_jax._private.Params"),
        *("gaussians_jax.__main__.Params", "gaussians_jax..splats.Params"),
    ],
)
def test_only_a_named_tuple_where_it_is_defined_is_a_record_of_arrays(name):
    assert specs.record_named("gaussians_jax.core.splats.Params") is Params
    with pytest.raises(ValueError, match="no record or setting"):
        specs.record_named(name)
