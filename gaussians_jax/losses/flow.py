"""Optical flow loss on the motion of Gaussians, without the flow of the camera.

Zhu et al. 2024 (MotionGS), arXiv:2410.07707, section 4.2 (equations 4 to 8) and
appendix A.1. Flow from one frame to the next is that of the camera, which the drawn
depth and both cameras say (equations 4 to 6), and that of things, which is left
(equation 7). The latter is held against the flow of the Gaussians (equation 8): where
each goes in the next camera's picture between the two moments, with the ellipse that it
is drawn as, blended as its color is (equations 10 to 14). A Gaussian's flow is linear
in the pixel, so that six channels are exact for all pixels.

The paper also masks out what is at rest, as `FlowSpec.moving_only` does. In which
camera the Gaussians flow it says twice and differently (section 4.2: the next, the end
of A.1: the first); here footprints move in the picture of the next, and are met at the
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
from nerfies_jax.geometry import rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.precision import exact_einsum, exact_product
from nerfies_jax.training import losses
from nerfies_jax.training.effects import PenaltyContext, Term
from nerfies_jax.training.step_counts import steps

NAME = "flow"
LEAST_SHARE = 1e-10  # of opacity that is divided by


@dataclasses.dataclass(frozen=True)
class FlowSpec:
    """Weight of the flow loss, and its first step.

    Weight and form are the paper's code's: absolute differences of flows in units of
    the picture's sides, each held to one side; 0.5 is for NeRF-DS, and for HyperNeRF
    the paper has 0.1. `opaque` is the least opacity of a pixel that is compared, where
    flow is known as well; there all are. With `moving_only` those are compared alone
    that a capture's masks mark as moving (all where it has none).

    As there, neither the weights of the blending nor the depth get a slope. Otherwise
    than there, both ends of a Gaussian's way get one: with the first held still, the
    Gaussian itself would be pulled along the flow.

    Cameras that are refined beside it (`pose_refinement`) get a slope by the camera's
    flow, both of them, and the next one by what Gaussians do in its picture.
    """

    weight: float = 0.5
    start: int = steps(3000)
    opaque: float = 0.5
    moving_only: bool = True

    def __post_init__(self):
        if not (math.isfinite(self.weight) and self.weight >= 0):
            raise ValueError(
                f"weight={self.weight} of the flow must be finite and not negative"
            )
        if self.start < 0 or not 0 < self.opaque < 1:
            raise ValueError(
                "flow needs start >= 0 and 0 < opaque < 1, got "
                f"start={self.start} and opaque={self.opaque}"
            )


class Drawn(NamedTuple):
    """The Gaussians' flow in one picture."""

    flow: Float[Array, "height width 2"]  # px right and down; zero where nothing is
    share: Float[Array, "height width"]  # opacity of what both moments show
    depth: Float[Array, "height width"]  # expected z-depth, scene units; 0 of nothing


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Regularizer` of a `FlowSpec`, without a term if the capture has no flow."""

    spec: FlowSpec
    picture: RasterSpec

    name = NAME

    @property
    def required_data(self) -> frozenset[str]:
        """Data of the capture that it reads."""
        return frozenset({"flow", "moving"} if self.spec.moving_only else {"flow"})

    def loss(self, params: Params, context: PenaltyContext) -> dict[str, Term]:
        """Compute the difference of the Gaussians' flow and that of the capture."""
        assert context.observation is not None
        frames, spec = context.observation.frames, self.spec
        if frames is None or frames.flow is None:
            return {}

        def evaluate(params):
            return compared(spec, self.picture, params, context)

        def nothing(params):
            zero = jnp.zeros((), params.rows["splats"].mean.dtype)
            return zero, zero

        if spec.start == 0:
            error, known = evaluate(params)
        else:
            early = context.step < spec.start
            error, known = lax.cond(early, nothing, evaluate, params)
        return {"error": Term(error, spec.weight), "known": Term(known, None)}


def compared(
    spec: FlowSpec, picture: RasterSpec, params: Any, context: PenaltyContext
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Error of the frame of a step, and the share of its pixels that are compared."""
    observation, at_time = context.observation, context.at_time
    assert observation is not None
    assert at_time is not None
    frames, row = observation.frames, observation.row
    assert frames is not None
    assert frames.flow is not None
    other = frames.flow.next_row[row]
    here, there = (at_time(params, frames.times[at]) for at in (row, other))
    first, second = (cameras.take(frames.cameras, at) for at in (row, other))
    pair = first, second
    size = frames.images.shape[2], frames.images.shape[1]
    drawn = drawn_flow(here, there, pair, size, picture)
    shift = frames.flow.forward[row].astype(drawn.flow.dtype)
    seen = frames.flow.forward_seen[row] & (drawn.share >= spec.opaque)
    if observation.valid is not None:
        seen = seen & observation.valid
    if spec.moving_only and frames.moving is not None:
        seen = seen & frames.moving[row]
    things = shift - camera_flow(pair, drawn.depth)
    return error(drawn.flow, things, seen), jnp.mean(seen.astype(shift.dtype))


def drawn_flow(
    here: Gaussians,
    there: Gaussians,
    pair: tuple[Camera, Camera],
    size: tuple[int, int],
    picture: RasterSpec,
) -> Drawn:
    """Flow of the Gaussians from `here` to `there`, seen by the first camera.

    In pixels of the second camera, which stands still meanwhile: at a pixel x of the
    first, Gaussian k goes by m' - m + (L' - L) L1⁻¹ (x - m1), with means m and Cholesky
    factors L of its footprint in the second camera, before and after, and those with a
    1 in the first: a point keeps its place in the ellipse. (Equations 10 and 11 print
    covariances for factors, and m for m'.) What only one moment shows does not count,
    and the blend is over the opacity of what does. `size` is (width, height) of both.
    """
    first = lax.stop_gradient(projection.project(here, pair[0], size, picture))
    start, end = (projection.project(g, pair[1], size, picture) for g in (here, there))
    stretch, shift = linear_flow(first, start, end)
    both = (start.visible & end.visible)[:, None]
    # Selected before they are blended: what is not drawn has stand-ins, of any size.
    values = jnp.concatenate([stretch.reshape(-1, 4), shift], axis=1)
    values = jnp.where(both, values, 0)
    more = [first.depth[:, None], both.astype(values.dtype)]
    image, left = raster.rasterize(
        first, jnp.concatenate([values, *more], axis=1), size, picture
    )
    matrix, offset = image[..., :4].reshape(*image.shape[:2], 2, 2), image[..., 4:6]
    center = rays.pixel_centers(size, image.dtype)
    flow = exact_einsum("hwij,hwj->hwi", matrix, center) + offset
    depth, share = lax.stop_gradient(image[..., 6]), lax.stop_gradient(image[..., 7])
    alpha = lax.stop_gradient(1 - left)
    return Drawn(
        flow / jnp.maximum(share, LEAST_SHARE)[..., None],
        share,
        depth / jnp.maximum(alpha, LEAST_SHARE),
    )


def linear_flow(
    first: Footprints, start: Footprints, end: Footprints
) -> tuple[Float[Array, "gaussians 2 2"], Float[Array, "gaussians 2"]]:
    """A and b of each Gaussian's flow A x + b at a pixel x, as `drawn_flow` says."""
    p, k, r = first.whitening.T
    zero = jnp.zeros_like(p)
    into = _matrix(p, zero, -r * k, r)
    before, after = (_factor(one.whitening) for one in (start, end))
    stretch = exact_einsum("gij,gjk->gik", after - before, into)
    moved = end.mean_px - start.mean_px
    return stretch, moved - exact_einsum("gij,gj->gi", stretch, first.mean_px)


def _factor(whitening):
    """The inverse of [[p, 0], [-rk, r]]: the Cholesky factor, times the root of two."""
    p, k, r = whitening.T
    return _matrix(1 / p, jnp.zeros_like(p), k / p, 1 / r)


def _matrix(a, b, c, d):
    return jnp.stack([jnp.stack([a, b], -1), jnp.stack([c, d], -1)], -2)


def camera_flow(
    pair: tuple[Camera, Camera], depth: Float[Array, "height width"]
) -> Float[Array, "height width 2"]:
    """Compute the optical flow of a static scene from one camera to another.

    Equations 4 to 6, for cameras without distortion.

    Args:
      pair: Both cameras.
      depth: z-depth in scene units. Where it is not positive, the flow is meaningless
        and finite.

    Returns:
      Flow in pixels.
    """
    first, second = pair
    height, width = depth.shape
    center = rays.pixel_centers((width, height), depth.dtype)
    offset = center - first.principal_point_px
    y = offset[..., 1] / (first.focal_px * first.pixel_aspect)
    x = (offset[..., 0] - first.skew_px * y) / first.focal_px
    slopes = jnp.stack([x, y, jnp.ones_like(x)], axis=-1)
    place = first.position + depth[..., None] * exact_product(
        slopes, first.camera_from_world
    )
    pixel, _ = jax.vmap(jax.vmap(cameras.project, (None, 0)), (None, 0))(second, place)
    return pixel - center


def error(
    drawn: Float[Array, "height width 2"],
    things: Float[Array, "height width 2"],
    seen: Bool[Array, "height width"],
) -> Float[Array, ""]:
    """Compute the mean absolute difference of two flows.

    Equation 8. Horizontal flow is divided by the width and vertical flow by the height,
    and each is clamped to ±1.

    Args:
      drawn: Flow of the Gaussians in pixels.
      things: Flow of the objects in pixels.
      seen: Pixels to compare.

    Returns:
      The mean, zero without pixels.
    """
    height, width = seen.shape
    side = jnp.asarray((width, height), drawn.dtype)
    # Selected first: pixels that are not seen may hold anything.
    ways = (jnp.where(seen[..., None], flow, 0) / side for flow in (drawn, things))
    drawn, things = (jnp.clip(way, -1, 1) for way in ways)
    return losses.l1(drawn, things, seen)
