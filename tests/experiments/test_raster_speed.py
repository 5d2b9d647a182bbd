"""The baselines draw the same picture; the report has its columns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.raster_speed import __main__ as raster_speed
from experiments.raster_speed import baselines
from gaussians_jax import raster

CASE = "150@40x24"


@pytest.fixture(scope="module")
def case():
    return raster_speed.Case(CASE, None)


@pytest.mark.slow
def test_dense_and_lockstep_draw_the_same_picture_and_slopes(case):
    longest, pairs = raster_speed.longest_tile(case)
    expected = case.gradient()(*case.arguments())
    image, left = case.forward()(case.footprints, case.values)
    for drawing, sizes in (
        (baselines.dense, {}),
        (baselines.lockstep, dict(pairs=pairs, longest=longest)),
    ):
        picture = case.forward(drawing, **sizes)(case.footprints, case.values)
        np.testing.assert_allclose(picture[0], image, atol=2e-5)
        np.testing.assert_allclose(picture[1], left, atol=2e-5)
        drawn = case.gradient(drawing, **sizes)(*case.arguments())
        for one, other in zip(drawn, expected, strict=True):
            scale = float(jnp.max(jnp.abs(other)))
            np.testing.assert_allclose(one, other, atol=2e-4 * scale)


@pytest.mark.full
def test_blended_pairs_are_the_tiles_that_show_a_gaussian(case):
    """With nothing opaque enough to stop a pixel, all of them and no other."""
    faint = case.footprints._replace(opacity=case.footprints.opacity * 0 + 0.02)
    reach = np.sqrt(2 * np.log(0.02 * 255))
    p, k, r = np.asarray(faint.whitening, np.float64).T
    a = 1 / (2 * p * p)
    extent = reach * np.sqrt(np.stack([a, 1 / (2 * r * r) + k * k * a], 1))
    faint = faint._replace(extent_px=jnp.asarray(extent, jnp.float32))
    y, x = np.mgrid[:24, :40] + 0.5
    dx = x - np.asarray(faint.mean_px)[:, 0, None, None]
    dy = y - np.asarray(faint.mean_px)[:, 1, None, None]
    p, k, r = (part[:, None, None] for part in (p, k, r))
    shows = 0.02 * np.exp(-((p * dx) ** 2) - (r * (dy - k * dx)) ** 2) >= 1 / 255
    expected = shows.reshape(150, 3, 8, 5, 8).any((2, 4)).sum()
    spec = dataclasses.replace(raster_speed.SPEC, capacity=128)
    pairs = jax.jit(lambda f: raster.blended_pairs(f, (40, 24), spec))(faint)
    assert abs(int(pairs) - expected) <= 1  # a pixel on the cut itself
    nothing = jax.tree.map(lambda leaf: leaf[:0], faint)
    assert int(raster.blended_pairs(nothing, (40, 24), spec)) == 0


@pytest.mark.slow
def test_a_case_is_timed_and_a_wrong_one_refused():
    settings = raster_speed.Settings(cases=(CASE,), repeats=1)
    row = raster_speed.time_case(CASE, settings, limit_ns=0.5)
    assert row["forward_backward_ms"] > 0
    assert row["forward_ms"] > 0
    assert 0 < row["share_of_limit"] < 1
    assert 0 < row["temporaries_mb"] < 10
    with pytest.raises(ValueError, match="GAUSSIANS@WIDTHxHEIGHT"):
        raster_speed.Case("many", None)
