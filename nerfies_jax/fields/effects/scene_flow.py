"""A time-dependent medium with scene flow (NSFF).

Li et al. 2021, arXiv:2011.13084. There is no canonical scene and no warp. A second
field of point and time is blended with the static field and predicts its flow to the
next and previous timestamps. The field at the next timestamp, evaluated at the points
to which the flow leads, is supervised by the current image. Weights and sizes are those
of the public code, and so are its first stage, with more rays on moving objects
(`moving_rays`), and its last, with chains over two timestamps (`chain_steps`).
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Key

from nerfies_jax.fields import compositing, template
from nerfies_jax.fields.effects import scene_flow_losses as flow_losses
from nerfies_jax.fields.effects import timestamps
from nerfies_jax.fields.effects.effect import Medium, RayOutput, Sample, Scalar, Vector
from nerfies_jax.fields.template import Template, TemplateSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training.effects import FrameCondition, PenaltyContext, Term, total
from nerfies_jax.training.step_counts import steps

NAME = "scene_flow"
FORWARD, BACKWARD = 0, 1  # indices of the two directions in time
SIGNS = (1, -1)


@dataclasses.dataclass(frozen=True)
class FlowWeights:
    """Weights of the loss terms. A term of weight zero is not computed.

    The last two need depth and optical flow of the capture. They decay by a factor of
    ten every `SceneFlowSpec.decay_steps` steps.
    """

    dynamic: float = 1.0  # squared error of the medium without the static field
    warped: float = 1.0  # squared error of neighboring timestamps, warped by the flow
    disocclusion: float = 0.1
    cycle: float = 1.0  # 0.1 in the code, 1 in its configuration files
    magnitude: float = 0.1
    smoothness: float = 0.1
    kinetic: float = 0.1  # the code adds it twice
    entropy: float = 1e-3  # of the blending weight
    depth: float = 0.04
    flow: float = 0.02  # per pixel of error

    def __post_init__(self):
        for name, value in dataclasses.asdict(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(
                    f"the weight {name}={value} must be finite and not negative"
                )


@dataclasses.dataclass(frozen=True)
class SceneFlowSpec:
    """Settings of the medium and its losses. The defaults are those of the public code.

    `flow_bound` bounds the motion of a point along each axis between two timestamps, in
    units of the field. Up to `decay_steps` the medium alone has to explain the whole
    image, afterwards only its part of the blend. With `flow_trunk` the flow has its own
    trunk of the same size, which preserves a flow that was initialized from tracks
    during the first steps of the medium. In the public code flow shares the trunk of
    the medium. A network on planes with `timestamps` (HexPlane) reads features of point
    and time instead of a positional encoding.

    `moving_rays` is the share of the rays of a step that are of moving objects up to
    `decay_steps`, if the capture has masks. In the public code a third is. From
    `chain_steps` completed steps on, the flow is also followed over two timestamps, in
    turn to the next and the previous ones, and the color there is compared with the
    weight of `warped`. In the public code that is after twice the `decay_steps`.
    """

    network: TemplateSpec = TemplateSpec()
    time: EncodingSpec = EncodingSpec(10)
    flow_bound: float = 1.0
    weights: FlowWeights = FlowWeights()
    decay_steps: int = steps(50_000)
    flow_trunk: bool = False
    moving_rays: float | None = None
    chain_steps: int | None = steps(None)

    def __post_init__(self):
        if not (math.isfinite(self.flow_bound) and self.flow_bound > 0):
            raise ValueError(
                f"flow_bound={self.flow_bound} must be positive and finite; the sides "
                "of the box of a scene are 2"
            )
        if self.decay_steps < 1:
            raise ValueError(f"decay_steps={self.decay_steps} must be at least 1")
        if self.moving_rays is not None and not 0 < self.moving_rays <= 1:
            raise ValueError(
                f"moving_rays={self.moving_rays} must be a share from above 0 to 1, or "
                "None"
            )
        if self.chain_steps is not None and self.chain_steps < 0:
            raise ValueError(
                f"chain_steps={self.chain_steps} must not be negative, or None for no "
                "chains"
            )
        if self.network.anneal_steps is not None:
            raise ValueError(
                f"network.anneal_steps={self.network.anneal_steps} is not supported by "
                "a medium, whose bands are always open; set it to none"
            )
        if self.network.reads_time and self.network.position.outside == "refuse":
            raise ValueError(
                'network.position.outside="refuse" is not supported: the medium is '
                "also evaluated before the first and after the last timestamp; set "
                '"clamp"'
            )

    def bind(self, run_steps: int, metadata: Any) -> "Bound":
        """Return the medium for a capture."""
        return Bound(self, metadata.times)


class SceneFlow(NamedTuple):
    """Parameters."""

    network: Template
    flow: mlp.Layer  # output: forward xyz, backward xyz, before the bound
    disocclusion: mlp.Layer  # output: two logits
    blend: mlp.Layer  # from features of the static template to the blending logit
    flow_trunk: mlp.MLP | None = None  # without heads; None to share the network


class Dynamic(NamedTuple):
    """The medium at one point and time."""

    density: Scalar  # per unit of the field
    color: Vector
    flow: Float[Array, "2 3"]  # to the next and previous timestamp, field units
    # Logits of the probability that the point at that timestamp is not visible now.
    disocclusion: Float[Array, "2"]


class Neighbor(NamedTuple):
    """Samples of the rays, followed to the next or the previous timestamp."""

    point: Float[Array, "rays samples 3"]  # at the other timestamp
    flow: Float[Array, "rays samples 3"]  # from now to there, over one interval
    back: Float[Array, "rays samples 3"]  # from there to now, over one interval
    onward: Float[Array, "rays samples 3"]  # from there further on, over one interval
    visible: Float[Array, "rays samples"]  # 1 - disocclusion
    disocclusion: Float[Array, "rays samples"]
    color: Float[Array, "rays 3"]  # of the medium at the other timestamp
    weight: Float[Array, "rays samples"]  # rendering weights of this color
    present: Bool[Array, " rays"]  # True if the capture has the other timestamp
    time: Float[Array, " rays"]  # the other timestamp


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Medium` of a `SceneFlowSpec` for a capture with these ascending times.

    The times need not be evenly spaced, because frames are held out.
    """

    spec: SceneFlowSpec
    times: tuple[float, ...] | Float[Array, " times"]

    name = NAME

    def __post_init__(self):
        timestamps.interval(len(self.times))  # checks that there are any

    @property
    def required_data(self) -> frozenset[str]:
        """Data of the capture that its losses read."""
        weights = self.spec.weights
        weight_of = {"depths": weights.depth, "flow": weights.flow}
        weight_of["moving"] = self.spec.moving_rays or 0.0
        return frozenset(name for name, weight in weight_of.items() if weight > 0)

    def init(self, key: Key[Array, ""], features: int) -> "SceneFlow":
        """Initialize the networks, for a trunk of `features` features."""
        return init(self.spec, key, features)

    def apply(
        self, params: "SceneFlow", sample: Sample, frame: FrameCondition
    ) -> Medium:
        """Compute the medium at one sample."""
        return medium(self.spec, params, sample, frame)

    def loss(self, params: "SceneFlow", context: PenaltyContext) -> dict[str, Term]:
        """Compute the losses of the flow."""
        return penalty(self.spec, self.times, params, context)


def init(
    spec: SceneFlowSpec,
    key: Key[Array, ""],
    features: int,
    dtype: DTypeLike = jnp.float32,
) -> SceneFlow:
    """Initialize the parameters: small flow, logits of disocclusion and blend near 0.

    Args:
      spec: Settings.
      key: PRNG key.
      features: Width of the static template's trunk.
      dtype: Floating-point type of the parameters.

    Returns:
      The parameters.
    """
    network_key, flow_key, disocclusion_key, blend_key = jax.random.split(key, 4)
    network = spec.network
    inputs = network.encoded_width + spec.time.width(1)
    condition = 0 if network.direction is None else network.direction.width(3)
    flow = mlp.init_layer(flow_key, network.width, 6, "small", dtype)
    trunk = None
    if spec.flow_trunk:
        # A separate key, so that the other parameters are the same as without it.
        trunk_key = jax.random.fold_in(key, 4)
        trunk = mlp.init(template.trunk_spec(network, inputs), trunk_key, dtype)
        trunk = trunk._replace(heads={})
    return SceneFlow(
        template.init(network, network_key, inputs, condition, dtype),
        # mlp.SMALL bounds the contribution of one feature. They have random signs.
        flow._replace(weight=flow.weight / math.sqrt(network.width)),
        mlp.init_layer(disocclusion_key, network.width, 2, "small", dtype),
        mlp.init_layer(blend_key, features, 1, "small", dtype),
        trunk,
    )


def dynamic(
    spec: SceneFlowSpec,
    params: SceneFlow,
    point: Vector,
    direction: Vector,
    time: Scalar,
) -> Dynamic:
    """Evaluate the medium at one point and time.

    Args:
      spec: Settings.
      params: Parameters.
      point: Observed point in units of the field, [3].
      direction: Unit viewing direction, [3].
      time: Time in [0, 1].

    Returns:
      Density, color, flow and disocclusion logits.
    """
    network = spec.network
    features = [
        template.encode(network, params.network, point, None, time),
        # The time is scaled to [-1, 1], as the axes of the box.
        encoding.encode(spec.time, 2 * time[None] - 1, None),
    ]
    condition = jnp.zeros(0, point.dtype)
    if network.direction is not None:
        condition = encoding.encode(network.direction, direction, None)
    inputs = jnp.concatenate(features)
    sample = template.apply(network, params.network, inputs, condition)
    hidden = sample.features
    if params.flow_trunk is not None:
        trunk = template.trunk_spec(network, len(inputs))
        hidden = mlp.hidden_features(trunk, params.flow_trunk, inputs)
    flow = spec.flow_bound * jnp.tanh(mlp.affine(params.flow, hidden))
    logits = mlp.affine(params.disocclusion, sample.features)
    return Dynamic(sample.density, sample.color, flow.reshape(2, 3), logits)


def medium(
    spec: SceneFlowSpec, params: SceneFlow, sample: Sample, condition: FrameCondition
) -> Medium:
    """Evaluate the medium at one sample, with its blending weight.

    Args:
      spec: Settings.
      params: Parameters.
      sample: The sample.
      condition: Conditioning of the frame.

    Returns:
      The medium.

    Raises:
      ValueError: If the template's trunk has another width.
    """
    width = params.blend.weight.shape[0]
    if sample.features.shape != (width,):
        raise ValueError(
            f"the blending layer reads {width} features, but the trunk of the template "
            f"has {sample.features.shape[0]}; initialize the effect with this number"
        )
    result = dynamic(spec, params, sample.point, sample.direction, condition.time)
    share = mlp.affine(params.blend, sample.features)[0]
    extras = {
        "flow_forward": result.flow[FORWARD],
        "flow_backward": result.flow[BACKWARD],
        "disocclusion": result.disocclusion,
    }
    return Medium(result.density, result.color, share=share, extras=extras)


def neighbor(
    spec: SceneFlowSpec,
    times: tuple[float, ...] | Float[Array, " times"],
    params: SceneFlow,
    context: PenaltyContext,
    side: int,
) -> Neighbor:
    """Follow the samples of the last level to the next or previous timestamp.

    If frames are held out, it may be more than one interval away. Points are then
    extrapolated at constant velocity, because only observed frames can be compared.

    Args:
      spec: Settings.
      times: Training timestamps in ascending order.
      params: Parameters.
      context: Context of the step.
      side: FORWARD or BACKWARD.

    Returns:
      The samples at the other timestamp.
    """
    level = context.levels[-1]
    extras = level.media[NAME].extras
    flow = extras[("flow_forward", "flow_backward")[side]]
    now = context.condition.time
    time, present = timestamps.neighbor(times, now, SIGNS[side])
    intervals = jnp.abs(time - now) / timestamps.interval(len(times))
    point = level.point + intervals[:, None, None] * flow
    neighbor_medium = _along_rays(spec, params, point, context.batch.direction, time)
    weight = flow_losses.dynamic_weights(level.spacing, neighbor_medium.density)
    logit = extras["disocclusion"][..., side]
    return Neighbor(
        point=point,
        flow=flow,
        back=neighbor_medium.flow[..., 1 - side, :],
        onward=neighbor_medium.flow[..., side, :],
        visible=jax.nn.sigmoid(-logit),  # 1 - sigmoid(logit) rounds to 0
        disocclusion=jax.nn.sigmoid(logit),
        color=_medium_color(level, weight, neighbor_medium.color),
        weight=weight,
        present=present,
        time=time,
    )


def _along_rays(spec, params, point, direction, time):
    """Evaluate the medium at the samples of rays, each ray at its time."""

    def evaluate(point, direction, time):
        return dynamic(spec, params, point, direction, time)

    # Nested, because the samples of a ray share its direction and time.
    evaluate_rays = jax.vmap(jax.vmap(evaluate, (0, None, None)))
    return evaluate_rays(point, direction, time)


def chain_error(
    spec: SceneFlowSpec,
    times: tuple[float, ...] | Float[Array, " times"],
    params: SceneFlow,
    context: PenaltyContext,
    sides: list[Neighbor],
    mask: Float[Array, " rays"],
) -> Scalar:
    """Compute the squared error of the colors two timestamps away.

    The flow of the neighboring timestamp leads on from the points to which that of this
    timestamp leads. Even steps go forward and odd ones backward.

    Args:
      spec: Settings.
      times: Training timestamps in ascending order.
      params: Parameters.
      context: Context of the step.
      sides: The neighbors, forward and backward.
      mask: Weights of rays.

    Returns:
      The error. Rays without a timestamp two away are left out.
    """
    level = context.levels[-1]
    ends = [
        timestamps.neighbor(times, one.time, sign)
        for one, sign in zip(sides, SIGNS, strict=True)
    ]
    forward = context.step % 2 == 0
    (one, (time, present)) = jax.tree.map(
        lambda *leaves: jnp.where(forward, *leaves), *zip(sides, ends, strict=True)
    )
    intervals = jnp.abs(time - one.time) / timestamps.interval(len(times))
    point = one.point + intervals[:, None, None] * one.onward
    medium = _along_rays(spec, params, point, context.batch.direction, time)
    weight = flow_losses.dynamic_weights(level.spacing, medium.density)
    error = jnp.square(_medium_color(level, weight, medium.color) - context.batch.color)
    return flow_losses.weighted_mean(error, jnp.where(one.present & present, mask, 0))


def penalty(
    spec: SceneFlowSpec,
    times: tuple[float, ...] | Float[Array, " times"],
    params: SceneFlow,
    context: PenaltyContext,
) -> dict[str, Term]:
    """Compute all loss terms except that of the blended image.

    Args:
      spec: Settings.
      times: Training timestamps in ascending order.
      params: Parameters.
      context: Context of the step.

    Returns:
      Terms by name.
    """
    batch, level = context.batch, context.levels[-1]
    medium = level.media[NAME]
    weight = flow_losses.dynamic_weights(level.spacing, medium.density)
    sides = [neighbor(spec, times, params, context, side) for side in (0, 1)]
    mask = jnp.where(batch.valid, _image_mask(spec, level, context.step), 0)
    values = {
        "dynamic": lambda: flow_losses.weighted_mean(
            jnp.square(_medium_color(level, weight, medium.color) - batch.color), mask
        ),
        "warped": lambda: total(
            flow_losses.warp_error(
                one.color,
                batch.color,
                one.weight,
                one.visible,
                jnp.where(one.present, mask, 0),
            )
            for one in sides
        ),
        "disocclusion": lambda: total(
            flow_losses.mean_where(one.disocclusion, one.present) for one in sides
        ),
        "cycle": lambda: total(
            flow_losses.cycle(one.flow, one.back, one.visible, one.present)
            for one in sides
        ),
        "magnitude": lambda: total(
            flow_losses.magnitude(one.flow, weight, one.present) for one in sides
        ),
        "smoothness": lambda: total(
            flow_losses.smoothness(one.flow, one.present) for one in sides
        ),
        "kinetic": lambda: flow_losses.kinetic(
            sides[0].flow, sides[1].flow, sides[0].present & sides[1].present
        ),
        "entropy": lambda: flow_losses.entropy(medium.share),
    }
    fade = flow_losses.fading(spec.decay_steps, context.step)
    terms = {}
    for name, value in values.items():
        if getattr(spec.weights, name) > 0:
            terms[name] = Term(value(), getattr(spec.weights, name))
    if spec.chain_steps is not None and spec.weights.warped > 0:
        error = jax.lax.cond(
            context.step >= spec.chain_steps,
            lambda: chain_error(spec, times, params, context, sides, mask),
            lambda: jnp.zeros((), mask.dtype),
        )
        terms["chain"] = Term(error, spec.weights.warped)
    frames = context.frames
    assert frames is not None
    if spec.weights.depth > 0 and frames.depths is not None:
        error = _depth_term(context, weight)
        terms["depth"] = Term(error, spec.weights.depth * fade)
    if spec.weights.flow > 0 and frames.flow is not None:
        error = _flow_term(context, timestamps.interval(len(times)), weight, sides)
        terms["flow"] = Term(error, spec.weights.flow * fade)
    return terms


def _medium_color(level, weight, color):
    """Composite the medium alone, in front of the known background if there is one."""
    composite = jax.vmap(compositing.composite)
    return composite(weight, color, level.distances, level.background).color


def _image_mask(
    spec: SceneFlowSpec, level: RayOutput, step: Int[Array, ""]
) -> Float[Array, " rays"]:
    """Compute the weight of rays in the loss of the medium alone, without gradient.

    It is one up to `decay_steps`, so that the medium learns geometry, and then the
    opacity of the medium in the blend.
    """
    share = jax.lax.stop_gradient(jnp.sum(level.media_weight[NAME], axis=-1))
    return jnp.where(step < spec.decay_steps, 1, jnp.clip(share, 0, 1))


def _depth_term(
    context: PenaltyContext, weight: Float[Array, "rays samples"]
) -> Scalar:
    """Compare the depth of the medium alone with that of the capture, normalized."""
    batch, level = context.batch, context.levels[-1]
    assert context.frames is not None
    image_row = context.frames.image_row(batch.row)
    target = _pixels(context.frames.depths, image_row, batch.pixel)
    distance = flow_losses.expected_value(weight, level.distances[..., None])[..., 0]
    depth = distance * batch.cosine / context.box.scale
    return flow_losses.normalized_depth(
        depth, target.astype(depth.dtype), batch.valid & (target > 0)
    )


def _flow_term(
    context: PenaltyContext,
    gap: float,
    weight: Float[Array, "rays samples"],
    sides: list[Neighbor],
) -> Scalar:
    """Compare the projected scene flow with the optical flow of the capture.

    If frames are held out, the neighboring frame may be more than one interval away.
    The flow is then scaled, which assumes motion at constant velocity.
    """
    batch, frames, level = context.batch, context.frames, context.levels[-1]
    assert frames is not None
    assert frames.flow is not None
    flow = frames.flow
    pairs = (
        (flow.forward, flow.forward_valid, flow.next_row),
        (flow.backward, flow.backward_valid, flow.previous_row),
    )
    total = jnp.zeros((), level.point.dtype)
    for sign, one, (shift, visible, rows) in zip(SIGNS, sides, pairs, strict=True):
        other = rows[batch.row].astype(batch.row.dtype)
        intervals = sign * (frames.times[other] - context.condition.time) / gap
        point = level.point + intervals[:, None, None] * one.flow
        mean_point = flow_losses.expected_value(weight, point) / context.box.scale
        camera = cameras.take(frames.cameras, other)
        pixel, depth = jax.vmap(cameras.project)(
            camera, mean_point + context.box.center
        )
        target = batch.pixel + _pixels(shift, batch.row, batch.pixel).astype(
            pixel.dtype
        )
        valid = (
            _pixels(visible, batch.row, batch.pixel)
            & (other != batch.row)
            & batch.valid
            & one.present
            & (depth > 0)
        )
        error = jnp.where(valid[:, None], pixel - target, 0)
        total = total + flow_losses.mean_where(jnp.abs(error), valid)
    return total


def _pixels(
    images: Array, row: Int[Array, " rays"], pixel: Float[Array, "rays 2"]
) -> Array:
    """Return the value of an image at the pixel of each ray."""
    column, line = jnp.floor(pixel).astype(jnp.int32).T
    return images[row, line, column]
