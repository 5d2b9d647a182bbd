"""A time-dependent medium with scene flow (NSFF).

Li et al. 2021, arXiv:2011.13084: no canonical scene and no warp, but a second field of
point and time, blended with the static one, which predicts its own flow to the next and
previous timestamps. The field of the next timestamp, evaluated where the flow leads,
must look like the current one. Weights and sizes are those of the public code. Chains
over two timestamps (its last stage) and extra rays on moving regions (its first) are
left out.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from nerfies_jax.fields import compositing, template
from nerfies_jax.fields.effects import learned_moments
from nerfies_jax.fields.effects import scene_flow_losses as flow_losses
from nerfies_jax.fields.effects.effect import Medium, RayOutput, Sample, Scalar, Vector
from nerfies_jax.fields.template import Template, TemplateSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training.effects import FrameCondition, PenaltyContext, Term, total
from nerfies_jax.training.step_counts import steps

NAME = "scene_flow"
FORWARD, BACKWARD = 0, 1  # places in everything that has a side
SIGNS = (1, -1)


@dataclasses.dataclass(frozen=True)
class FlowWeights:
    """Weights of the loss terms. A term of weight zero is not computed.

    The last two need depth and optical flow of the capture, and decay tenfold every
    `SceneFlowSpec.decay_steps`.
    """

    dynamic: float = 1.0  # squared error of the medium alone
    warped: float = 1.0  # of the neighboring moments, brought here along the flow
    disocclusion: float = 0.1
    cycle: float = 1.0  # 0.1 in the code, 1 in its configurations
    magnitude: float = 0.1
    smoothness: float = 0.1
    kinetic: float = 0.1  # the code adds it twice
    entropy: float = 1e-3  # of the blending
    depth: float = 0.04
    flow: float = 0.02  # per pixel

    def __post_init__(self):
        for name, value in dataclasses.asdict(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(
                    f"the weight {name}={value} must be finite and not negative"
                )


@dataclasses.dataclass(frozen=True)
class SceneFlowSpec:
    """Settings of the medium and its losses. The defaults are those of the public code.

    `flow_bound` is the largest motion of a point along each axis between two
    timestamps, in units of the field. After `decay_steps` the medium need no longer
    explain the whole image by itself, only its share of the blend. `flow_trunk` gives
    the flow a trunk of its own, of the same size, where the public code reads it from
    the medium's. Flow initialized from tracks then survives the first steps of the
    medium. A network on planes of `moments` (HexPlane) reads features of a point at a
    time instead of a positional encoding.
    """

    network: TemplateSpec = TemplateSpec()
    time: EncodingSpec = EncodingSpec(10)
    flow_bound: float = 1.0
    weights: FlowWeights = FlowWeights()
    decay_steps: int = steps(50_000)
    flow_trunk: bool = False

    def __post_init__(self):
        if not (math.isfinite(self.flow_bound) and self.flow_bound > 0):
            raise ValueError(
                f"flow_bound={self.flow_bound} must be positive and finite; the box of "
                "a scene has sides of two"
            )
        if self.decay_steps < 1:
            raise ValueError(f"decay_steps={self.decay_steps} must be at least 1")
        if self.network.anneal_steps is not None:
            raise ValueError(
                f"network.anneal_steps={self.network.anneal_steps}: all bands of a "
                "medium are open from the first step; leave it out (none)"
            )
        if self.network.reads_time and self.network.position.outside == "refuse":
            raise ValueError(
                'network.position.outside="refuse": the moments before the first and '
                'after the last are asked for as well; set "clamp"'
            )

    def bind(self, run_steps: int, metadata: Any) -> "Bound":
        """Return the medium of a field of this capture."""
        return Bound(self, metadata.times)


class SceneFlow(NamedTuple):
    """Parameters."""

    network: Template
    flow: mlp.Layer  # to forward xyz, backward xyz, before the bound
    disocclusion: mlp.Layer  # to two logits
    blend: mlp.Layer  # from the static template's features to the logit of the share
    flow_trunk: mlp.MLP | None = None  # without heads; None where it is the network's


class Dynamic(NamedTuple):
    """The medium at one point and time."""

    density: Scalar  # per unit of the field
    color: Vector
    flow: Float[Array, "2 3"]  # to the next moment and the previous one, field units
    # Logits of how likely what is there then was hidden or not there now.
    disocclusion: Float[Array, "2"]


class Neighbor(NamedTuple):
    """Samples of the rays, followed to the next or the previous timestamp."""

    point: Float[Array, "rays samples 3"]  # where the flow leads
    flow: Float[Array, "rays samples 3"]  # that led there, over one interval
    back: Float[Array, "rays samples 3"]  # the flow from there to here, likewise
    visible: Float[Array, "rays samples"]  # 1 - disocclusion
    disocclusion: Float[Array, "rays samples"]
    color: Float[Array, "rays 3"]  # of that moment along these rays
    weight: Float[Array, "rays samples"]  # that it was composited with
    present: Bool[Array, " rays"]  # whether the capture has that moment


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Medium` of a `SceneFlowSpec` for a capture with these rising times.

    They need not be even: frames are held out.
    """

    spec: SceneFlowSpec
    times: tuple[float, ...]

    name = NAME

    def __post_init__(self):
        learned_moments.interval(len(self.times))  # refuses none

    @property
    def required_data(self) -> frozenset[str]:
        """Data of the capture that its losses read."""
        weights = self.spec.weights
        read = {"depths": weights.depth, "flow": weights.flow}
        return frozenset(name for name, weight in read.items() if weight > 0)

    def init(self, key: Key[Array, ""], features: int) -> "SceneFlow":
        """Initialize the networks, for a trunk with so many features."""
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
    spec: SceneFlowSpec, key: Key[Array, ""], features: int, dtype=jnp.float32
) -> SceneFlow:
    """Initialize the parameters: small flow, undecided disocclusion and blending.

    Args:
      spec: Settings.
      key: PRNG key.
      features: Width of the static template's trunk.
      dtype: Floating-point type of the parameters.

    Returns:
      The parameters.
    """
    network_key, flow_key, disocclusion_key, blend_key = jax.random.split(key, 4)
    one = spec.network
    inputs = one.encoded_width + spec.time.width(1)
    condition = 0 if one.direction is None else one.direction.width(3)
    flow = mlp.init_layer(flow_key, one.width, 6, "small", dtype)
    trunk = None
    if spec.flow_trunk:
        trunk_key = jax.random.fold_in(key, 4)  # the others are as without
        trunk = mlp.init(template.trunk_spec(one, inputs), trunk_key, dtype)
        trunk = trunk._replace(heads={})
    return SceneFlow(
        template.init(one, network_key, inputs, condition, dtype),
        # mlp.SMALL bounds what one feature adds; `width` of them have random signs
        flow._replace(weight=flow.weight / math.sqrt(one.width)),
        mlp.init_layer(disocclusion_key, one.width, 2, "small", dtype),
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
    one = spec.network
    features = [
        template.encode(one, params.network, point, None, time),
        # time runs from -1 to 1 like the axes of the box
        encoding.encode(spec.time, 2 * time[None] - 1, None),
    ]
    condition = jnp.zeros(0, point.dtype)
    if one.direction is not None:
        condition = encoding.encode(one.direction, direction, None)
    inputs = jnp.concatenate(features)
    sample = template.apply(one, params.network, inputs, condition)
    hidden = sample.features
    if params.flow_trunk is not None:
        trunk = template.trunk_spec(one, len(inputs))
        hidden = mlp.hidden_features(trunk, params.flow_trunk, inputs)
    flow = spec.flow_bound * jnp.tanh(mlp.affine(params.flow, hidden))
    logits = mlp.affine(params.disocclusion, sample.features)
    return Dynamic(sample.density, sample.color, flow.reshape(2, 3), logits)


def medium(
    spec: SceneFlowSpec, params: SceneFlow, sample: Sample, condition: FrameCondition
) -> Medium:
    """Evaluate the medium at one sample, with its share of the opacity.

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
            f"the blending reads {width} features of the template, whose trunk has "
            f"{sample.features.shape[0]}; build the effect with the trunk's width"
        )
    own = dynamic(spec, params, sample.point, sample.direction, condition.time)
    share = mlp.affine(params.blend, sample.features)[0]
    extras = {
        "flow_forward": own.flow[FORWARD],
        "flow_backward": own.flow[BACKWARD],
        "disocclusion": own.disocclusion,
    }
    return Medium(own.density, own.color, share=share, extras=extras)


def neighbor(
    spec: SceneFlowSpec,
    times: tuple[float, ...],
    params: SceneFlow,
    context: PenaltyContext,
    side: int,
) -> Neighbor:
    """Follow the samples of the last level to the next or previous timestamp.

    If that is more or less than one interval away, because frames are held out, points
    continue at constant velocity, since only observed frames can be compared.

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
    time, present = learned_moments.beside(times, now, SIGNS[side])
    intervals = jnp.abs(time - now) / learned_moments.interval(len(times))
    point = level.point + intervals[:, None, None] * flow

    def ask(point, direction, time):
        return dynamic(spec, params, point, direction, time)

    # A ray is asked for its samples, whose direction and time are one.
    there = jax.vmap(jax.vmap(ask, (0, None, None)))(
        point, context.batch.direction, time
    )
    weight = flow_losses.dynamic_weights(level.spacing, there.density)
    logit = extras["disocclusion"][..., side]
    return Neighbor(
        point=point,
        flow=flow,
        back=there.flow[..., 1 - side, :],
        visible=jax.nn.sigmoid(-logit),  # 1 - sigmoid(logit) would round to 0
        disocclusion=jax.nn.sigmoid(logit),
        color=_alone(level, weight, there.color),
        weight=weight,
        present=present,
    )


def penalty(
    spec: SceneFlowSpec,
    times: tuple[float, ...],
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
    own = level.media[NAME]
    weight = flow_losses.dynamic_weights(level.spacing, own.density)
    sides = [neighbor(spec, times, params, context, side) for side in (0, 1)]
    mask = jnp.where(batch.valid, picture_mask(spec, level, context.step), 0)
    values = {
        "dynamic": lambda: flow_losses.weighted_mean(
            jnp.square(_alone(level, weight, own.color) - batch.color), mask
        ),
        "warped": lambda: total(
            flow_losses.warped(
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
        "entropy": lambda: flow_losses.entropy(own.share),
    }
    fade = flow_losses.fading(spec.decay_steps, context.step)
    terms = {}
    for name, value in values.items():
        if getattr(spec.weights, name) > 0:
            terms[name] = Term(value(), getattr(spec.weights, name))
    frames = context.frames
    assert frames is not None
    if spec.weights.depth > 0 and frames.depths is not None:
        error = depth_term(context, weight)
        terms["depth"] = Term(error, spec.weights.depth * fade)
    if spec.weights.flow > 0 and frames.flow is not None:
        error = flow_term(context, learned_moments.interval(len(times)), weight, sides)
        terms["flow"] = Term(error, spec.weights.flow * fade)
    return terms


def _alone(level, weight, color):
    """Colors of rays through the medium alone, before what is known to be behind."""
    composite = jax.vmap(compositing.composite)
    return composite(weight, color, level.distances, level.background).color


def picture_mask(
    spec: SceneFlowSpec, level: RayOutput, step: Int[Array, ""]
) -> Float[Array, " rays"]:
    """Compute the weight of rays in the loss of the medium alone, without gradient.

    It is one up to `decay_steps`, so that the medium finds geometry to move, and then
    the opacity of the medium in the blend.

    Args:
      spec: Settings.
      level: Output of the last level.
      step: Number of completed steps.

    Returns:
      Weights in [0, 1], [rays].
    """
    share = jax.lax.stop_gradient(jnp.sum(level.media_weight[NAME], axis=-1))
    return jnp.where(step < spec.decay_steps, 1, jnp.clip(share, 0, 1))


def depth_term(context: PenaltyContext, weight: Float[Array, "rays samples"]) -> Scalar:
    """Compare the medium's own depth with that of the capture, both normalized.

    Args:
      context: Context of the step.
      weight: Rendering weights of the medium alone, [rays, samples].

    Returns:
      The error, a scalar.
    """
    batch, level = context.batch, context.levels[-1]
    assert context.frames is not None
    known = _pixels(context.frames.depths, batch.row, batch.pixel)
    distance = flow_losses.settle(weight, level.distances[..., None])[..., 0]
    predicted = distance * batch.cosine / context.box.scale
    return flow_losses.normalized_depth(
        predicted, known.astype(predicted.dtype), batch.valid & (known > 0)
    )


def flow_term(
    context: PenaltyContext,
    gap: float,
    weight: Float[Array, "rays samples"],
    sides: list[Neighbor],
) -> Scalar:
    """Compare the projected scene flow with the optical flow of the capture.

    The neighboring frame may be more or less than one interval away, if frames are held
    out. The flow is then scaled for motion at constant velocity.

    Args:
      context: Context of the step.
      gap: Interval between timestamps.
      weight: Rendering weights of the medium alone, [rays, samples].
      sides: Samples at the next and previous timestamps.

    Returns:
      The error in pixels, a scalar.
    """
    batch, frames, level = context.batch, context.frames, context.levels[-1]
    assert frames is not None
    assert frames.flow is not None
    flow = frames.flow
    pairs = (
        (flow.forward, flow.forward_seen, flow.next_row),
        (flow.backward, flow.backward_seen, flow.previous_row),
    )
    total = jnp.zeros((), level.point.dtype)
    for sign, one, (shift, seen, rows) in zip(SIGNS, sides, pairs, strict=True):
        other = rows[batch.row].astype(batch.row.dtype)
        elapsed = sign * (frames.times[other] - context.condition.time) / gap
        point = level.point + elapsed[:, None, None] * one.flow
        place = flow_losses.settle(weight, point) / context.box.scale
        camera = cameras.take(frames.cameras, other)
        pixel, depth = jax.vmap(cameras.project)(camera, place + context.box.center)
        target = batch.pixel + _pixels(shift, batch.row, batch.pixel).astype(
            pixel.dtype
        )
        counted = (
            _pixels(seen, batch.row, batch.pixel)
            & (other != batch.row)
            & batch.valid
            & one.present
            & (depth > 0)
        )
        off = jnp.where(counted[:, None], pixel - target, 0)
        total = total + flow_losses.mean_where(jnp.abs(off), counted)
    return total


def _pixels(
    pictures: Array, row: Int[Array, " rays"], pixel: Float[Array, "rays 2"]
) -> Array:
    """Value of an image at the pixel of each ray."""
    column, line = jnp.floor(pixel).astype(jnp.int32).T
    return pictures[row, line, column]
