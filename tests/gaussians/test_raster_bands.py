"""Bands over devices equal the whole picture."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import raster, raster_bands
from gaussians_jax.raster_spec import GSPLAT
from tests import fresh_process
from tests.gaussians import shared, test_raster

SIZE = (29, 37)


def both(devices):
    rng = np.random.default_rng(0)
    footprints, _ = test_raster.some_footprints(rng, 80, SIZE, "float64")
    values = rng.uniform(size=(80, 3))
    row = jax.devices()[:devices]
    assert len(row) == devices

    def grads(draw):
        def loss(mean_px, opacity, values):
            moved = footprints._replace(mean_px=mean_px, opacity=opacity)
            image, left = draw(moved, values)
            return jnp.sum(jnp.sin(3 * image)) + jnp.sum(left**2), image

        differentiate = jax.grad(loss, argnums=(0, 1, 2), has_aux=True)
        return jax.jit(differentiate)(footprints.mean_px, footprints.opacity, values)

    whole = grads(lambda f, v: raster.rasterise(f, v, SIZE, GSPLAT))
    bands = grads(lambda f, v: raster_bands.rasterise_bands(f, v, SIZE, GSPLAT, row))
    shared.close(bands, whole, 1e-12)


def test_bands_have_the_size_of_the_picture():
    footprints, _ = test_raster.some_footprints(
        np.random.default_rng(0), 80, SIZE, "float32"
    )
    values = np.zeros((80, 5), np.float32)
    image, left = jax.eval_shape(
        lambda f, v: raster_bands.rasterise_bands(f, v, SIZE, GSPLAT, jax.devices()),
        footprints,
        values,
    )
    assert image.shape == (*SIZE[::-1], 5)
    assert left.shape == SIZE[::-1]


@pytest.mark.full
def test_one_device_draws_the_whole_picture(float64):
    both(1)


@pytest.mark.slow
def test_three_devices_draw_the_whole_picture():
    fresh_process.run(
        "import jax; jax.config.update('jax_enable_x64', True);"
        "jax.config.update('jax_num_cpu_devices', 3);"
        "from tests.gaussians import test_raster_bands; test_raster_bands.both(3)"
    )
