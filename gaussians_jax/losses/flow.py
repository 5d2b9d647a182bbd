"""Optical flow loss on the motion of Gaussians, without the flow of the camera.

Zhu et al. 2024 (MotionGS), arXiv:2410.07707, section 4.2 (equations 4 to 8) and
appendix A.1. The flow from one frame to the next consists of camera flow, which is
computed from the rendered depth and both cameras (equations 4 to 6), and of motion
flow, the remainder (equation 7). The motion flow is compared with the flow of the
Gaussians (equation 8): the displacement of each footprint between the two times in the
next camera's image, blended like colors (equations 10 to 14). The flow of a Gaussian is
linear in the pixel, so six channels are exact for all pixels.

The paper also masks static regions, as `FlowSpec.moving_only` does. It is inconsistent
about the camera of the Gaussians' flow (section 4.2: the next, the end of A.1: the
first). Here footprints move in the image of the next camera and are evaluated at the
pixels of the first.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from gaussians_jax.core.splats import Gaussians, Params
from gaussians_jax.splatting import projection, raster
from gaussians_jax.splatting.projection import Footprints
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import lens, rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.precision import exact_einsum, exact_product
from nerfies_jax.training import losses
from nerfies_jax.training.effects import PenaltyContext, Term
from nerfies_jax.training.step_counts import steps

NAME = "flow"
LEAST_SHARE = 1e-10  # smallest opacity that is divided by


@dataclasses.dataclass(frozen=True)
class FlowSpec:
    """Settings of the flow loss.

    Weight and form are those of the paper's code: absolute differences of flows in
    units of the image's width and height, clamped to ±1. The weight 0.5 is for NeRF-DS.
    The paper uses 0.1 for HyperNeRF. `opaque` is the smallest opacity of a pixel that
    is compared, where the paper compares all pixels with known flow. With
    `moving_only`, only pixels that the masks of a capture mark as moving are compared
    (all pixels without masks).

    As in the paper, the blending weights and the depth get no gradient. In contrast to
    the paper, the Gaussians get a gradient at both times. With the first time fixed,
    the Gaussian itself would be pulled along the flow.

    Cameras that are refined at the same time (`per_frame.poses`) get a gradient from
    the camera flow, and the next camera also from the flow of the Gaussians.
    """

    weight: float = 0.5
    start: int = steps(3000)
    opaque: float = 0.5
    moving_only: bool = True

    def __post_init__(self):
        if not (math.isfinite(self.weight) and self.weight >= 0):
            raise ValueError(
                f"weight={self.weight} of the flow loss must be finite and not negative"
            )
        if self.start < 0 or not 0 < self.opaque < 1:
            raise ValueError(
                "the flow loss needs start >= 0 and 0 < opaque < 1, got "
                f"start={self.start} and opaque={self.opaque}"
            )


class RenderedFlow(NamedTuple):
    """Flow of the Gaussians in one image."""

    flow: Float[Array, "height width 2"]  # px right and down, zero without Gaussians
    share: Float[Array, "height width"]  # opacity of Gaussians visible at both times
    depth: Float[Array, "height width"]  # expected z-depth, scene units, or 0


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Regularizer` of a `FlowSpec`, without a term if the capture has no flow."""

    spec: FlowSpec
    raster_spec: RasterSpec

    name = NAME

    @property
    def required_data(self) -> frozenset[str]:
        """Names of the capture data that the loss needs."""
        return frozenset({"flow", "moving"} if self.spec.moving_only else {"flow"})

    def loss(self, params: Params, context: PenaltyContext) -> dict[str, Term]:
        """Compute the difference between the flows of Gaussians and capture."""
        assert context.observation is not None
        frames, spec = context.observation.frames, self.spec
        if frames is None or frames.flow is None:
            return {}

        def evaluate(params):
            return flow_error(spec, self.raster_spec, params, context)

        def nothing(params):
            zero = jnp.zeros((), params.rows["splats"].mean.dtype)
            return zero, zero

        if spec.start == 0:
            error, share = evaluate(params)
        else:
            early = context.step < spec.start
            error, share = lax.cond(early, nothing, evaluate, params)
        return {"error": Term(error, spec.weight), "known": Term(share, None)}


def flow_error(
    spec: FlowSpec, raster_spec: RasterSpec, params: Any, context: PenaltyContext
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compute the flow error of a step's frame, and the share of compared pixels.

    Args:
      spec: Settings of the loss.
      raster_spec: Settings of the rasterizer.
      params: Parameters of the scene.
      context: The rendered frame, with the flow of the capture and the motion at other
        times.

    Returns:
      The error, and the share in [0, 1].
    """
    observation, at_time = context.observation, context.at_time
    assert observation is not None
    assert at_time is not None
    frames, row = observation.frames, observation.row
    assert frames is not None
    assert frames.flow is not None
    other = frames.flow.next_row[row]
    start, end = (at_time(params, frames.times[at]) for at in (row, other))
    first, second = (cameras.take(frames.cameras, at) for at in (row, other))
    pair = first, second
    size = frames.images.shape[2], frames.images.shape[1]
    flow_render = render_flow(start, end, pair, size, raster_spec)
    shift = frames.flow.forward[row].astype(flow_render.flow.dtype)
    valid = frames.flow.forward_valid[row] & (flow_render.share >= spec.opaque)
    if observation.valid is not None:
        valid = valid & observation.valid
    if spec.moving_only and frames.moving is not None:
        valid = valid & frames.moving[frames.image_row(row)]
    object_flow = shift - camera_flow(pair, flow_render.depth, raster_spec.distorted)
    return error(flow_render.flow, object_flow, valid), jnp.mean(
        valid.astype(shift.dtype)
    )


def render_flow(
    here: Gaussians,
    there: Gaussians,
    pair: tuple[Camera, Camera],
    size: tuple[int, int],
    raster_spec: RasterSpec,
) -> RenderedFlow:
    """Render the flow of the Gaussians between two times, as seen by the first camera.

    The flow is in pixels of the second camera. At a pixel x of the first, Gaussian k
    moves by m' - m + (L' - L) L1⁻¹ (x - m1), where m and L are the mean and the
    Cholesky factor of its footprint in the second camera at the first time, m' and L'
    at the second time, and m1 and L1 those in the first camera. A point keeps its
    position in the ellipse. (Equations 10 and 11 print covariances for factors, and m
    for m'.) Gaussians that are visible at only one of the times do not count, and the
    blend is normalized by the opacity of the others.

    Args:
      here: Gaussians at the first time.
      there: Gaussians at the second time.
      pair: Both cameras.
      size: (width, height) of both images in pixels.
      raster_spec: Settings of the rasterizer.

    Returns:
      Flow, opacity and depth.
    """
    first = lax.stop_gradient(projection.project(here, pair[0], size, raster_spec))
    start, end = (
        projection.project(g, pair[1], size, raster_spec) for g in (here, there)
    )
    stretch, shift = linear_flow(first, start, end)
    visible = (start.visible & end.visible)[:, None]
    # Selected before blending, because invisible footprints have arbitrary values.
    values = jnp.concatenate([stretch.reshape(-1, 4), shift], axis=1)
    values = jnp.where(visible, values, 0)
    extra = [first.depth[:, None], visible.astype(values.dtype)]
    image, transmittance = raster.rasterize(
        first, jnp.concatenate([values, *extra], axis=1), size, raster_spec
    )
    matrix, offset = image[..., :4].reshape(*image.shape[:2], 2, 2), image[..., 4:6]
    center = rays.pixel_centers(size, image.dtype)
    flow = exact_einsum("hwij,hwj->hwi", matrix, center) + offset
    depth, share = lax.stop_gradient(image[..., 6]), lax.stop_gradient(image[..., 7])
    alpha = lax.stop_gradient(1 - transmittance)
    return RenderedFlow(
        flow / jnp.maximum(share, LEAST_SHARE)[..., None],
        share,
        depth / jnp.maximum(alpha, LEAST_SHARE),
    )


def linear_flow(
    first: Footprints, start: Footprints, end: Footprints
) -> tuple[Float[Array, "gaussians 2 2"], Float[Array, "gaussians 2"]]:
    """Return A and b of the flow A x + b of each Gaussian (see `render_flow`).

    Args:
      first: Footprints in the first camera, at the first time.
      start: Footprints in the second camera, at the first time.
      end: Footprints in the second camera, at the second time.

    Returns:
      A, and b in pixels.
    """
    p, k, r = first.whitening.T
    zero = jnp.zeros_like(p)
    whiten = _matrix(p, zero, -r * k, r)
    before, after = (_factor(footprints.whitening) for footprints in (start, end))
    stretch = exact_einsum("gij,gjk->gik", after - before, whiten)
    displacement = end.mean_px - start.mean_px
    return stretch, displacement - exact_einsum("gij,gj->gi", stretch, first.mean_px)


def _factor(whitening):
    """Invert [[p, 0], [-rk, r]]: the Cholesky factor times the square root of two."""
    p, k, r = whitening.T
    return _matrix(1 / p, jnp.zeros_like(p), k / p, 1 / r)


def _matrix(a, b, c, d):
    return jnp.stack([jnp.stack([a, b], -1), jnp.stack([c, d], -1)], -2)


def camera_flow(
    pair: tuple[Camera, Camera],
    depth: Float[Array, "height width"],
    distorted: bool = False,
) -> Float[Array, "height width 2"]:
    """Compute the optical flow of a static scene from one camera to another.

    Equations 4 to 6.

    Args:
      pair: Both cameras.
      depth: z-depth in scene units. Where it is not positive, the flow is meaningless
        and finite.
      distorted: True if the cameras have lens distortion. Without it that of the first
        is ignored.

    Returns:
      Flow in pixels.
    """
    first, second = pair
    height, width = depth.shape
    center = rays.pixel_centers((width, height), depth.dtype)
    offset = center - first.principal_point_px
    y = offset[..., 1] / (first.focal_px * first.pixel_aspect)
    x = (offset[..., 0] - first.skew_px * y) / first.focal_px
    slopes = jnp.stack([x, y], axis=-1)
    if distorted:
        straighten = jax.vmap(jax.vmap(lambda point: lens.undistort(first, point)[0]))
        slopes = straighten(slopes)
    directions = jnp.concatenate([slopes, jnp.ones_like(x)[..., None]], axis=-1)
    point = first.position + depth[..., None] * exact_product(
        directions, first.camera_from_world
    )
    pixel, _ = jax.vmap(jax.vmap(cameras.project, (None, 0)), (None, 0))(second, point)
    return pixel - center


def error(
    rendered: Float[Array, "height width 2"],
    object_flow: Float[Array, "height width 2"],
    visible: Bool[Array, "height width"],
) -> Float[Array, ""]:
    """Compute the mean absolute difference of two flows.

    Equation 8. Horizontal flow is divided by the width and vertical flow by the height,
    and each is clamped to ±1.

    Args:
      rendered: Flow of the Gaussians in pixels.
      object_flow: Motion flow of the capture in pixels.
      visible: Pixels to compare.

    Returns:
      The mean, zero without pixels.
    """
    height, width = visible.shape
    side = jnp.asarray((width, height), rendered.dtype)
    # Selected first, because other pixels may have arbitrary values.
    flows = (
        jnp.where(visible[..., None], flow, 0) / side
        for flow in (rendered, object_flow)
    )
    rendered, object_flow = (jnp.clip(flow, -1, 1) for flow in flows)
    return losses.l1(rendered, object_flow, visible)
