"""Image bands: several devices rasterize what one does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.splatting import bands
from nerfies_jax.runtime import data_parallel
from tests import fresh_process
from tests.gaussians import test_raster as raster

SIZE = (21, 30)  # bands of three devices are 16 rows high, and the third is outside


def stretched(state):
    """The state with anisotropic Gaussians.

    The gradient of the rotation of isotropic ones is nothing but rounding, which Adam
    amplifies.
    """
    splats = state.params.rows["splats"]
    noise = jax.random.normal(jax.random.key(1), splats.log_scale.shape)
    splats = splats._replace(log_scale=splats.log_scale + 0.3 * noise)
    rows = state.params.rows | {"splats": splats}
    return state._replace(params=state.params._replace(rows=rows))


def compare(devices):
    """Compare image and gradients of one device with those of several."""
    rng = np.random.default_rng(0)
    footprints, _ = raster.some_footprints(rng, 40, SIZE, "float32")
    values = jnp.asarray(rng.uniform(size=(40, 3)), jnp.float32)
    results = []
    for count in (1, devices):

        def loss(shapes, values, footprints, count=count):
            moved = footprints._replace(**shapes)
            image, left = bands.rasterize(moved, values, SIZE, raster.QUICK, count)
            return jnp.sum(jnp.sin(3 * image)) + jnp.sum(left**2), (image, left)

        shapes = {
            k: getattr(footprints, k) for k in ("mean_px", "whitening", "opacity")
        }
        inputs = data_parallel.replicate((shapes, values, footprints), count)
        gradient = jax.jit(jax.grad(loss, (0, 1), has_aux=True))
        results.append(gradient(*inputs))
    image = results[1][1][0]
    assert image.shape == (30, 21, 3)
    assert len(image.sharding.device_set) == devices
    for old, new in zip(*map(jax.tree.leaves, results), strict=True):
        old, new = np.asarray(old), np.asarray(new)
        assert np.linalg.norm(new - old) <= 1e-6 * np.linalg.norm(old)


@pytest.mark.full
def test_three_devices_rasterize_what_one_does():
    fresh_process.run(
        "import os; os.environ['JAX_NUM_CPU_DEVICES'] = '3';"
        "os.environ['XLA_FLAGS'] = '--xla_backend_optimization_level=0';"
        "from tests.gaussians import test_bands as t; t.compare(3)"
    )
