"""Rasterization of one image by several devices, in horizontal bands of tile rows."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from gaussians_jax.splatting import raster
from gaussians_jax.splatting.projection import Footprints
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax.runtime import data_parallel


def rasterize(
    footprints: Footprints,
    values: Float[Array, "gaussians channels"],
    size: tuple[int, int],
    spec: RasterSpec,
    devices: int,
) -> tuple[Float[Array, "height width channels"], Float[Array, "height width"]]:
    """Composite per-Gaussian values, with an equal band of the image on each device.

    The result and its derivatives are those of `raster.rasterize` up to rounding. Each
    device bins and sorts only the Gaussians that overlap its band. The image is
    assembled on every device, and the gradients of all bands are summed, so that losses
    over windows of pixels are exact at the borders of bands.

    Args:
      footprints: N projected Gaussians.
      values: Any number of channels per Gaussian, [N, channels].
      size: (width, height) of the image in pixels.
      spec: Thresholds and tile sizes.
      devices: Number of devices. With 1 the image is not divided.

    Returns:
      The image [height, width, channels] and the remaining transmittance of each pixel
      [height, width].
    """
    if devices == 1:
        return raster.rasterize(footprints, values, size, spec)
    width, height = size
    # Whole tiles, so that no tile is blended twice. The last bands may end below the
    # image or lie outside of it.
    rows = -(-height // (spec.tile * devices)) * spec.tile

    def band(index, footprints, values):
        first = (index * rows).astype(footprints.mean_px.dtype)
        mean_px = footprints.mean_px - jnp.stack([jnp.zeros_like(first), first])
        in_band = footprints._replace(mean_px=mean_px)
        return raster.rasterize(in_band, values, (width, rows), spec)

    image, transmittance = data_parallel.assembled(band, devices, footprints, values)
    image = image.reshape(-1, width, values.shape[1])
    return image[:height], transmittance.reshape(-1, width)[:height]
