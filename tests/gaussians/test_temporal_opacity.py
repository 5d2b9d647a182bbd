"""Gaussians that come and go: against NumPy, and from a start by tracks."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core.splats import Params
from gaussians_jax.init import tracks as track_start
from gaussians_jax.init.tracks import TrackStart
from gaussians_jax.motion import temporal_opacity
from gaussians_jax.motion.temporal_opacity import Fading, TemporalOpacitySpec
from gaussians_jax.scene import presets, spec
from nerfies_jax.training.effects import FrameCondition
from tests.gaussians import bound
from tests.gaussians.shared import put, rows_of, some_gaussians
from tests.gradients import directional_error

NAME = temporal_opacity.NAME
EFFECT = bound.record(TemporalOpacitySpec(width=0.5))
TIME, LOG_WIDTH = [0.1, 0.5, 0.9, 0.4], [-2.0, 0.0, -1.0, 3.0]


@jax.jit
def shown(fading, gaussians, time):
    frame = FrameCondition(time)
    return EFFECT.deform(Params({NAME: fading}, {}), gaussians, frame, None)


@pytest.mark.parametrize("time", [0.0, 0.4, 1.0])
def test_opacity_falls_from_the_time_of_its_own(time, dtype):
    gaussians = some_gaussians(4, dtype)
    there = shown(put(Fading(TIME, LOG_WIDTH), dtype), gaussians, put(time, dtype))
    for row, opacity in enumerate(np.asarray(gaussians.opacity, float)):
        share = (time - TIME[row]) / math.exp(LOG_WIDTH[row])
        exact = opacity * math.exp(-share * share)
        assert abs(there.opacity[row] - exact) < 8 * np.finfo(dtype).eps
    np.testing.assert_array_equal(there.mean, gaussians.mean)
    assert there.opacity.dtype == dtype


def test_slopes_are_those_of_differences(float64):
    gaussians, weights = some_gaussians(4), np.array([1.0, -2.0, 3.0, 0.5])

    def value(fading, opacity, time):
        there = shown(fading, gaussians._replace(opacity=opacity), time)
        return jnp.sum(weights * there.opacity)

    args = put(Fading(TIME, LOG_WIDTH)), gaussians.opacity, put(0.37)
    assert directional_error(value, *args) < 1e-7


@pytest.mark.hard_cases
@pytest.mark.parametrize("time", [0.0, 0.5, 1.0])
def test_what_is_not_lifted_is_seen_all_the_time(time, dtype):
    gaussians = some_gaussians(4, dtype)
    fading = EFFECT.init(jax.random.key(0), rows_of(gaussians)).per_gaussian
    there = shown(fading, gaussians, put(time, dtype))
    np.testing.assert_allclose(there.opacity, gaussians.opacity, rtol=4e-5)
    slope = jax.grad(lambda f: jnp.sum(shown(f, gaussians, put(time, dtype)).opacity))
    assert all(np.isfinite(leaf).all() for leaf in slope(fading))


def test_the_lifted_ones_start_around_their_images():
    rows = rows_of(some_gaussians(5, "float32"))
    first = EFFECT.init(jax.random.key(0), rows).per_gaussian
    params = Params({"splats": rows, NAME: first}, {})
    times, followed = np.float32([0.25, 0.75]), np.float32([0.4, 0.0])
    tracked = TrackStart(rows.mean[:2], rows.mean[:2], None, None, times, followed)
    motion = spec.motion_of(
        dataclasses.replace(presets.SMALL_TRACKED, start=presets.SMALL_STATIC.start),
        spec.SceneMetadata(1.0, (0.0, 0.0, 0.0), 9),
    )
    fading = track_start.put_in(params, (motion, EFFECT), tracked).rows[NAME]
    np.testing.assert_allclose(fading.time, [0.5, 0.5, 0.5, 0.25, 0.75])
    # 0.5 times 0.4 of the video, and what was never followed as short as widths get.
    always, (least, _) = temporal_opacity.ALWAYS, temporal_opacity.LOG_WIDTH_RANGE
    widths = [always, always, always, math.log(0.2), least]
    np.testing.assert_allclose(fading.log_width, widths, rtol=1e-6)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"width=0.0 must be positive"):
        TemporalOpacitySpec(width=0.0)
    still = dataclasses.replace(
        presets.SMALL_STATIC, temporal_opacity=TemporalOpacitySpec()
    )
    with pytest.raises(ValueError, match="temporal_opacity without a motion"):
        spec.refuse_what_cannot_train(still)
