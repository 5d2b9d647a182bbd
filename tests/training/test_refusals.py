"""Refusals of `nerfies_jax.training`, where they are raised and in which words."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.training import losses, schedules
from nerfies_jax.training.fit import fit_code
from nerfies_jax.training.track_start import TrackStartSpec
from nerfies_jax.training.tracks import InverseSpec, point_tracks

FLAT, TWO, HALF, WHOLE = jax.device_put(
    (np.zeros((10, 20, 3), "f4"), np.ones(2, "f4"), np.ones(2, "f2"), np.ones(2, "i4"))
)


def tracks_from(row):
    points = FLAT[:1, 0]
    return point_tracks(lambda p, x, t: t * x, None, points, FLAT[0, :3, 0], row)


REFUSED = [
    (lambda: schedules.log_linear(0.0, 1e-3, 10), "start > 0, got 0.0"),
    (lambda: schedules.log_linear(1e-3, -1.0, 10), "end > 0, got -1.0"),
    (lambda: schedules.log_linear(1e-3, math.nan, 10), "end > 0, got nan"),
    (lambda: schedules.log_linear(math.inf, 1e-4, 9), "finite start > 0, got inf"),
    (lambda: schedules.log_linear(1e-3, 1e-4, 0), "steps=0"),
    (lambda: schedules.check_falling(math.inf, 1e-4), "=inf to.*positive and finite"),
    (lambda: schedules.log_linear(1.0, 0.1, 9, delay_steps=-1), "delay_steps=-1"),
    (lambda: schedules.log_linear(1.0, 0.1, 9, delay=0.0), "delay=0.0"),
    (lambda: schedules.ramp(0.0, math.inf, 10), "finite end, got inf"),
    (lambda: schedules.ramp(0.0, 1.0, -3), "steps=-3"),
    (lambda: schedules.cosine(0.0, 1.0, 10, after=-1), "after=-1"),
    (lambda: schedules.time_noise(0), "frames=0"),
    (lambda: schedules.time_noise(5, scale=-0.1), "scale=-0.1"),
    (lambda: losses.ssim(FLAT, FLAT, padding="same"), "'zero' or 'valid'"),
    (lambda: losses.ssim(FLAT, FLAT, padding="valid"), "smaller than the 11x11 window"),
    (lambda: losses.charbonnier(TWO, 0.0), "width > 0, got 0"),
    (lambda: losses.huber(TWO, 0.0), "width > 0, got 0"),
    (lambda: losses.geman_mcclure(TWO, 0.0), "width > 0, got 0"),
    (lambda: losses.huber(TWO, math.inf), "finite width > 0, got inf"),
    (lambda: losses.geman_mcclure(TWO, 1.0, "neat"), "'paper' or 'official'"),
    (lambda: losses.photometric(FLAT, FLAT, dssim_weight=1.5), r"\[0, 1\], got 1.5"),
    (lambda: TrackStartSpec(fit_rate=math.inf), "fit_rate=inf must be positive and"),
    (lambda: InverseSpec(atol=0.0), r"atol=0\.0 must"),
    (lambda: InverseSpec(reach=-1.0), r"reach=-1\.0 must"),
    (lambda: tracks_from(3), r"row=3 is not in 0 \.\. 2"),
    (lambda: fit_code(jnp.sum, TWO, "newton"), "unknown solver 'newton'; choose from"),
    (lambda: fit_code(jnp.sum, WHOLE), r"one floating-point dtype, got \['int32'\]"),
    (lambda: fit_code(jnp.sum, (TWO, HALF)), "float16"),
    (lambda: fit_code(jnp.sum, TWO, max_steps=0), "max_steps=0"),
]


@pytest.mark.parametrize(("call", "words"), REFUSED)
def test_nonsense_is_refused_where_it_is_built(call, words):
    with pytest.raises(ValueError, match=words):
        call()
