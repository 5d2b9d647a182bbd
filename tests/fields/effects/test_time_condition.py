"""T-NeRF: what the template reads of the time, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields.effects import time_condition
from nerfies_jax.fields.effects.time_condition import TimeSpec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training.effects import TIMESTAMP, FrameCondition, Table
from tests import gradients
from tests.oracles import networks

BY_CODE = TimeSpec(condition="code", code_width=5)


def condition(dtype, time, code=()):
    codes = {"motion": jnp.asarray(code, dtype)}
    return FrameCondition(jnp.asarray(time, dtype), codes, jnp.int32(7))


@pytest.mark.parametrize(
    "encoding", [EncodingSpec(10, times_pi=True), EncodingSpec(3, identity=False)]
)
def test_the_template_reads_the_encoded_time(encoding, dtype):
    spec = TimeSpec(encoding)
    assert not hasattr(spec, "init")
    assert spec.tables == ()
    times = np.asarray([0.0, 0.37, 1.0, -0.5], dtype)

    @jax.jit
    @jax.vmap
    def lift(time):
        return spec.apply(None, jnp.zeros(3, dtype), condition(dtype, time))

    lifted = lift(times)
    assert lifted.dtype == dtype
    assert lifted.shape == (4, spec.features)
    exact = [networks.waves(encoding, time) for time in times]
    # float32: sines of arguments up to 512π, rounded once more by the reduction
    tolerance = {"float32": 3e-7, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(lifted, exact, atol=tolerance)


def test_by_code_it_is_the_frame_s_code(dtype, rng):
    code = jnp.asarray(rng.normal(size=5), dtype)
    assert BY_CODE.tables == (Table("motion", TIMESTAMP, 5),)
    assert BY_CODE.features == 5
    lifted = BY_CODE.apply(None, None, condition(dtype, 0.2, code))
    assert lifted.dtype == dtype
    np.testing.assert_array_equal(lifted, code)


def test_time_has_a_slope(float64, rng):
    pull = jnp.asarray(rng.normal(size=TimeSpec().features))

    def read(times):
        features = jax.vmap(
            lambda time: time_condition.features(
                TimeSpec(), condition("float64", 0)._replace(time=time)
            )
        )(times)
        return jnp.sum(features @ pull)

    assert gradients.directional_error(read, np.array([0.3, 0.0])) < 1e-8
