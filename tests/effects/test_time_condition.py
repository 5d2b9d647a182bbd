"""T-NeRF: what the template reads of the time, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.effects import time_condition
from nerfies_jax.effects.time_condition import TimeSpec
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.training.effects import MOMENT, FrameCondition, Table
from tests import gradients

BY_CODE = TimeSpec(condition="code", code_width=5)


def condition(dtype, time, code=()):
    codes = {"motion": jnp.asarray(code, dtype)}
    return FrameCondition(jnp.asarray(time, dtype), codes, jnp.int32(7))


def by_hand(encoding, time):
    """Sines and cosines of one number, in float64."""
    scale = np.pi if encoding.times_pi else 1.0
    features = [time] if encoding.identity else []
    for band in range(encoding.bands):
        features += [np.sin(scale * 2.0**band * time), np.cos(scale * 2.0**band * time)]
    return np.asarray(features)


@pytest.mark.parametrize(
    "encoding",
    [EncodingSpec(4), EncodingSpec(10, times_pi=True), EncodingSpec(3, identity=False)],
    ids=["default", "many", "waves"],
)
@pytest.mark.parametrize("time", [0.0, 0.37, 1.0, -0.5])
def test_the_template_reads_the_encoded_time(encoding, time, dtype, rng):
    made = time_condition.effect(TimeSpec(encoding))
    point = jnp.asarray(rng.normal(size=3), dtype)
    found = jax.jit(lambda when: made.lift(None, point, when))(condition(dtype, time))
    assert found.dtype == dtype
    assert found.shape == (made.lift_width,)
    exact = by_hand(encoding, float(np.asarray(time, dtype)))
    # float32: sines of arguments up to 512π, rounded once more by the reduction
    tolerance = {"float32": 3e-7, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(found, exact, atol=tolerance)


def test_by_code_it_is_the_frame_s_code(dtype, rng):
    made = time_condition.effect(BY_CODE)
    code = jnp.asarray(rng.normal(size=5), dtype)
    assert made.tables == (Table("motion", MOMENT, 5),)
    assert made.lift_width == 5
    found = made.lift(None, jnp.zeros(3, dtype), condition(dtype, 0.2, code))
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, code)


@pytest.mark.full
def test_it_has_no_parameters_and_by_time_no_codes():
    made = time_condition.effect(TimeSpec())
    assert made.name == "time"
    assert made.init is None
    assert made.tables == ()
    assert made.displace is None
    assert made.condition is None


def test_time_has_a_slope(float64, rng):
    pull = jnp.asarray(rng.normal(size=TimeSpec().width))

    def read(time):
        found = time_condition.features(
            TimeSpec(), condition(float64, 0)._replace(time=time)
        )
        return pull @ found

    assert gradients.directional_error(read, jnp.asarray(0.3)) < 1e-8
    assert gradients.directional_error(read, jnp.asarray(0.0)) < 1e-8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"condition": "frame"}, "unknown condition 'frame'.*time"),
        ({"code_width": 0}, "code_width=0 must be at least 1"),
    ],
)
def test_wrong_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        TimeSpec(**changes)
