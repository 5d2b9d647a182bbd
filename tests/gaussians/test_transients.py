"""Pixels of transient objects, which splats do not learn from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.losses import transients
from gaussians_jax.losses.transients import TransientMaskSpec

SPEC = TransientMaskSpec(start=10, window=5)
pixels = jax.jit(transients.static_pixels, static_argnums=0)


def test_a_board_is_left_out_and_fine_detail_is_not(dtype):
    rng = np.random.default_rng(0)
    color = rng.uniform(0.3, 0.6, (40, 50, 3))
    truth = color + rng.normal(0, 0.02, color.shape)
    truth[:, 30] += 0.4  # a line of one pixel that the render does not have yet
    truth[10:30, 5:20] = 1.0
    truth[35:, 40:] = np.nan  # not observed
    valid = np.ones((40, 50), bool)
    valid[35:, 40:] = False
    color, truth = jnp.asarray(color, dtype), jnp.asarray(truth, dtype)
    static, share = pixels(SPEC, color, truth, jnp.asarray(valid), jnp.int32(10))
    assert not static[12:28, 7:18].any()
    assert not static[~valid].any()
    board = np.zeros((40, 50), bool)
    board[8:32, 3:22] = True
    assert np.asarray(static)[valid & ~board].all()
    assert share.dtype == dtype
    np.testing.assert_allclose(share, (valid & ~static).sum() / valid.sum(), rtol=1e-6)
    # In the first steps residuals are large everywhere, and all pixels count.
    static, share = pixels(SPEC, color, truth, jnp.asarray(valid), jnp.int32(9))
    np.testing.assert_array_equal(static, valid)
    assert share == 0
    static, _ = pixels(SPEC, color, color, None, jnp.int32(10))
    assert static.all()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"window": 4}, "window=4 must be odd"),
        ({"ratio": 1.0}, "ratio=1.0 must be above 1"),
        ({"start": -1}, "start=-1"),
        ({"least": 0.0}, "least=0.0"),
    ],
)
def test_wrong_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        TransientMaskSpec(**settings)
