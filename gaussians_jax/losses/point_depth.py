"""Supervision of the rendered depth by the points of structure from motion.

Deng et al. 2022 ("Depth-supervised NeRF", arXiv:2107.02791) with a robust loss, because
a point may be an outlier, or hidden by something else in this frame.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gaussians_jax.core.splats import Params
from nerfies_jax.geometry.camera import Camera, project
from nerfies_jax.training.effects import PenaltyContext, Term
from nerfies_jax.training.fit import check_positive

NAME = "point_depth"
OPAQUE = 0.5  # pixels with less opacity have no reliable depth


@dataclasses.dataclass(frozen=True)
class PointDepthSpec:
    """Weight and range of the loss.

    Points whose relative depth differs from the rendered depth by more than `reach` are
    outliers or hidden, and have no gradient.
    """

    weight: float = 0.1
    reach: float = 0.05

    name = NAME
    required_data = frozenset({"points"})
    reads_depth = True

    def __post_init__(self):
        check_positive(weight=self.weight, reach=self.reach)

    def loss(self, params: Params, context: PenaltyContext) -> dict[str, Term]:
        """Compare the points in one frame with its rendered depth."""
        observation = context.observation
        assert observation is not None
        frames, rendering = observation.frames, observation.rendering
        assert frames is not None
        assert rendering is not None
        assert rendering.depth is not None
        if frames.points is None:
            return {}
        camera = jax.tree.map(lambda leaf: leaf[observation.row], frames.cameras)
        points = jnp.asarray(frames.points, rendering.color.dtype)
        error, valid = relative_errors(
            camera, points, rendering.depth, rendering.alpha, self.reach
        )
        count = jnp.maximum(jnp.sum(valid), 1).astype(error.dtype)
        value = jnp.sum(jnp.where(valid, error, 0)) / count
        return {"error": Term(value, self.weight)}


def relative_errors(
    camera: Camera,
    points: Float[Array, "points 3"],
    depth: Float[Array, "height width"],
    alpha: Float[Array, "height width"],
    reach: float,
) -> tuple[Float[Array, " points"], Bool[Array, " points"]]:
    """Compute the relative error of the rendered depth at each point.

    Inverse depth is interpolated bilinearly, which is exact on planes.

    Args:
      camera: The camera of the frame.
      points: Positions in scene units.
      depth: Rendered z-depth, positive where anything was rendered.
      alpha: Rendered opacity.
      reach: Errors are clipped at this value.

    Returns:
      Absolute errors, and True for points that project onto pixels with a depth.
    """
    height, width = depth.shape
    pixel, z = jax.vmap(lambda point: project(camera, point))(points)
    pixel = pixel - 0.5  # integers are pixel centers
    size = jnp.asarray([width, height], pixel.dtype)
    inside = jnp.all((pixel >= 0) & (pixel < size - 1), axis=1) & (z > 0)
    pixel = jnp.where(inside[:, None], pixel, 0)
    z = jnp.where(inside, z, 1)
    first = jnp.floor(pixel).astype(jnp.int32)
    share = pixel - first.astype(pixel.dtype)
    usable = (alpha >= OPAQUE) & (depth > 0)
    inverse = jnp.where(usable, 1 / jnp.where(usable, depth, 1), 0)
    value, valid = jnp.zeros_like(z), inside
    for right in (0, 1):
        for down in (0, 1):
            column, row = first[:, 0] + right, first[:, 1] + down
            across = share[:, 0] if right else 1 - share[:, 0]
            along = share[:, 1] if down else 1 - share[:, 1]
            value = value + across * along * inverse[row, column]
            valid = valid & usable[row, column]
    error = jnp.minimum(jnp.abs(value * z - 1), reach)
    return error, valid
