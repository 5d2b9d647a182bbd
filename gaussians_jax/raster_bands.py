"""One picture over several devices: each draws a band of rows."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from gaussians_jax import raster
from gaussians_jax.projection import Footprints
from gaussians_jax.raster_spec import RasterSpec

AXIS = "bands"


def rasterise_bands(
    footprints: Footprints,
    values: Float[Array, "gaussians channels"],
    size: tuple[int, int],
    spec: RasterSpec,
    devices: Sequence[jax.Device],
) -> tuple[Float[Array, "height width channels"], Float[Array, "height width"]]:
    """`raster.rasterise` with the rows of tiles split over `devices`.

    Every device sorts all Gaussians by depth but bins and blends only those that reach
    its band; the gradients of the bands are summed. `size` is (width, height).
    """
    width, height = size
    if not devices:
        raise ValueError("bands need at least one device, got none; try jax.devices()")
    mesh = Mesh(np.asarray(devices), (AXIS,))
    tile_rows = -(-height // spec.tile)
    band = -(-tile_rows // mesh.size) * spec.tile  # px, whole tiles

    def one_band(footprints, values):
        top = (lax.axis_index(AXIS) * band).astype(footprints.mean_px.dtype)
        down = jnp.stack([jnp.zeros_like(top), top])
        moved = footprints._replace(mean_px=footprints.mean_px - down)
        return raster.rasterise(moved, values, (width, band), spec)

    split = jax.shard_map(
        one_band,
        mesh=mesh,
        in_specs=PartitionSpec(),
        out_specs=PartitionSpec(AXIS),
        check_vma=False,  # while_loop carries start unvarying and become varying
    )
    image, transmittance = split(footprints, values)
    return image[:height], transmittance[:height]
