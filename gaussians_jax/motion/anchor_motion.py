"""Anchors whose features produce child Gaussians and their motion.

ADC-GS (Huang et al. 2025, IJCAI, arXiv:2505.08196, "Anchor-driven deformable and
compressed Gaussian splatting"): an anchor has a position, scales, a rotation and a
color, a reference feature, and a residual feature for each of its ten children. A
network computes the children from the features, relative to the anchor. A coarse
network of reference feature and time moves the anchor, a fine network of residual
feature and time moves each child. Features are quantized: they are trained with noise
as wide as a quantization step, and their bits under a learned prior are a loss.

The sources were the paper's abstract, a summary of its method and the settings of its
code (H-Huang774/ADC-GS). Its equations were not available. Our choices for the rest:

- Half of a residual feature produces a child, half moves it, as in the code, whose fine
  stage is disabled. Here it is enabled.
- The prior of a reference feature is normal, with a mean and a deviation per channel
  (in the paper with a hyperprior). That of residual features is normal with parameters
  from a network of the reference feature.
- Positions, scales, rotations, opacities and colors of anchors are stored at 32 bits
  per number, where the code has a codec for points.
- Colors and opacities do not change over time. In the summary an anchor's color does.
- Densification clones or splits anchors by the gradients of their children, weighted by
  their share in the visibility of the anchor at the sampled times (`significance`).
  The code places a new anchor at each child with a large gradient. The visibility of
  anchors over time relative to each other is not used otherwise.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Params, Splats
from gaussians_jax.init import motion_fit
from gaussians_jax.init.motion_fit import Guess, Paths, Points
from gaussians_jax.motion import carried
from gaussians_jax.motion import kan as kan_motion
from gaussians_jax.motion.anchors import (
    AnchorMotionSpec,
    Anchors,
    Features,
    add_noise,
    bits,
    coarse_spec,
    fine_spec,
    init,
    init_features,
    make_children,
    quantize,
    residual_width,
)
from gaussians_jax.motion.blocks import in_blocks
from gaussians_jax.motion.bound import BoundMotion
from gaussians_jax.motion.carried import Carried
from gaussians_jax.motion.kan import Offsets
from nerfies_jax.nn import codes, mlp
from nerfies_jax.nn.mlp import MLP, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import (
    FrameCondition,
    PenaltyContext,
    Term,
    stream,
)

NAME = "anchor_motion"
RESTING = 256  # features of static anchors in the penalty of a fit to tracks
# Quantile of the volumes above which one counts as large, exponent for smaller ones
# (both as in the code), and the number of Gaussians from which it is computed.
LARGE, VOLUME_POWER, VOLUME_ROWS = 0.8, 0.01, 512
NUMBER_BITS = 32  # of parameters without a prior


def coded_bytes(params: Params, spec: AnchorMotionSpec) -> tuple[float, float]:
    """Compute the storage of a trained scene, on the host.

    Args:
      params: Trained parameters.
      spec: Settings. With a prior, features count by their entropy-coded size.

    Returns:
      Bytes of the features, and of all other parameters at 32 bits each.
    """
    features, net = params.rows[NAME], params.nets[NAME]
    active = np.asarray(splats.active_mask(params.rows["splats"]))
    plain = sum(leaf[active].size for leaf in params.rows["splats"])
    plain += sum(leaf.size for leaf in jax.tree.leaves(params.nets))
    if net.law is None:
        numbers = sum(leaf[active].size for leaf in features)
        return numbers * NUMBER_BITS / 8, plain * NUMBER_BITS / 8
    feature_bits = bits(quantize(features, net.law, spec), net.law, spec)
    total = sum(
        float(np.asarray(leaf, np.float64)[active].sum()) for leaf in feature_bits
    )
    return total / 8, plain * NUMBER_BITS / 8


def offsets(
    network: MLP,
    spec: MLPSpec,
    features: Float[Array, "*rows reads"],
    code: Float[Array, " code"],
) -> Offsets:
    """Evaluate a deformation network on features and a time code.

    Args:
      network: Parameters.
      spec: Settings of the network.
      features: Features of the anchors or children.
      code: Code of the time.

    Returns:
      Offsets.
    """
    at_time = mlp.with_known(spec, network, code)
    feature_spec = dataclasses.replace(spec, inputs=features.shape[-1])
    return Offsets(**mlp.apply(feature_spec, at_time, features))


def _pose_children(
    net: Anchors,
    spec: AnchorMotionSpec,
    child_state: tuple[Splats, tuple[Carried, Features]],
    rows: Gaussians,
    code: Float[Array, " code"] | None,
) -> Gaussians:
    """Compute the child Gaussians of moved anchors, with their own motion at a time."""
    canonical, (children, features) = child_state
    if code is None:
        return carried.pose_children(children, None, canonical, rows)
    inputs = features.residual[..., spec.residual // 2 :]
    assert net.fine is not None
    fine = offsets(net.fine, fine_spec(spec), inputs, code)
    assert fine.position is not None
    assert fine.log_scale is not None
    children = children._replace(
        offset=children.offset + fine.position,
        log_scale=children.log_scale + fine.log_scale,
    )
    return carried.pose_children(children, fine.turn, canonical, rows)


def significance(gaussians: Gaussians) -> Float[Array, " gaussians"]:
    """Weight Gaussians by their visibility: opacity times a small power of the volume.

    Args:
      gaussians: The Gaussians.

    Returns:
      Weights in [0, 1].
    """
    volume = jnp.prod(gaussians.scale, axis=1)
    stride = -(-len(volume) // VOLUME_ROWS)
    large = jnp.quantile(volume[::stride], LARGE)
    relative = jnp.clip(volume / jnp.where(large > 0, large, 1), 0, 1)
    weight = gaussians.opacity * relative**VOLUME_POWER
    return jax.lax.stop_gradient(weight)


def _fit_to_paths(
    spec: AnchorMotionSpec, frames: int, paths: Paths, key: Key[Array, ""]
) -> Guess:
    """Initialize anchors at the middle of the video, with random features, on the host.

    Motion of other random features is penalized, so that anchors without paths are
    static.
    """
    rows_key, nets_key, rest_key = jax.random.split(key, 3)
    points = motion_fit.captured(motion_fit.positions_at_middle(paths))
    unit = motion_fit.captured(paths.unit)
    static_features = init_features(rest_key, spec, RESTING)

    def penalty(points, times):
        net = points.nets

        def motion(time):
            code = codes.at_time(net.times, time)
            residuals = offsets(
                net.coarse, coarse_spec(spec), static_features.reference, code
            )
            return residuals.turn, residuals.position

        return motion_fit.rest_loss(motion, unit, times)

    rows = init_features(rows_key, spec, len(points))
    start = Points(points, rows, init(nets_key, spec, frames))
    rates = Points._make((paths.unit, 1.0, 0.4, None))
    return Guess(start, rates, penalty)


def _features_of(
    spec: AnchorMotionSpec, params: MotionParams, condition: FrameCondition | None
) -> Features:
    """Return features with noise in training, and quantized features afterwards."""
    features, net = params
    if spec.rate is None:
        return features
    if condition is None or condition.step is None:
        return quantize(features, net.law, spec)
    assert condition.key is not None
    key = jax.random.fold_in(condition.key, stream(NAME))
    return jax.lax.cond(
        condition.step < spec.rate.start,
        lambda features, law: features,
        lambda features, law: add_noise(key, features, law),
        features,
        net.law,
    )


def _derive_rows(spec, scene, condition):
    params = MotionParams(scene.rows[NAME], scene.nets[NAME])
    features = _features_of(spec, params, condition)
    rows = scene.rows["splats"]
    params = make_children(scene.nets[NAME], spec, features, rows.sh_rest.shape[1])
    return carried.canonical_children(rows, params), (params, features)


def _derive(spec, scene, child_state, rows, condition):
    """Return the children, with fine motion after the warm-up."""
    net = scene.nets[NAME]
    if not spec.moves:
        return _pose_children(net, spec, child_state, rows, None)
    code = codes.at_time(net.times, condition.time)
    if not spec.warm_up or condition.step is None:
        return _pose_children(net, spec, child_state, rows, code)
    return jax.lax.cond(
        condition.step < spec.warm_up,
        lambda net, child_state, rows: _pose_children(
            net, spec, child_state, rows, None
        ),
        lambda net, child_state, rows: _pose_children(
            net, spec, child_state, rows, code
        ),
        net,
        child_state,
        rows,
    )


def penalty(spec: AnchorMotionSpec, context: PenaltyContext) -> dict[str, Term]:
    """Compute the mean bits per feature value, zero before quantization starts.

    Args:
      spec: Settings.
      context: Context of the step.

    Returns:
      The term.
    """
    assert spec.rate is not None
    scene = context.params
    active = splats.active_mask(scene.rows["splats"])
    numbers = spec.reference + spec.count * residual_width(spec)

    def evaluate(scene):
        motion_params = MotionParams(scene.rows[NAME], scene.nets[NAME])
        features = _features_of(spec, motion_params, context.condition)
        first, others = bits(features, scene.nets[NAME].law, spec)
        total = jnp.sum(first, axis=1) + jnp.sum(others, axis=(1, 2))
        count = jnp.maximum(jnp.sum(active), 1) * numbers
        return jnp.sum(jnp.where(active, total, 0)) / count.astype(total.dtype)

    value = jax.lax.cond(
        context.step < spec.rate.start,
        lambda scene: jnp.zeros((), scene.rows["splats"].mean.dtype),
        evaluate,
        scene,
    )
    return {"bits": Term(value, spec.rate.weight)}


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of an `AnchorMotionSpec` in a run of `steps` over `frames`."""

    spec: AnchorMotionSpec
    frames: int

    name = NAME
    significance = staticmethod(significance)

    @property
    def moves(self) -> bool:
        """True if anchors have a motion."""
        return self.spec.moves

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of features, networks and prior."""
        spec = self.spec

        def falling(of, name):
            first, last = getattr(of, name), getattr(of, f"{name}_end")
            return schedules.log_linear(first, last, self.steps)(step)

        moving = falling(spec, "learning_rate") if spec.moves else None
        law = None if spec.rate is None else falling(spec.rate, "learning_rate")
        make = falling(spec, "make_rate")
        shared_rates = Anchors(moving, make, moving, moving, law)
        return MotionParams(falling(spec, "feature_rate"), shared_rates)

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize features and networks."""
        rows_key, shared_key = jax.random.split(key)
        mean = gaussians.mean
        return MotionParams(
            init_features(rows_key, self.spec, len(mean), mean.dtype),
            init(shared_key, self.spec, self.frames),
        )

    def apply(
        self,
        params: MotionParams,
        cache: None,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the anchors by the coarse network."""
        spec, net = self.spec, params.shared
        code = codes.at_time(net.times, frame.time)
        residuals = in_blocks(
            lambda reference: offsets(net.coarse, coarse_spec(spec), reference, code),
            (_features_of(spec, params, frame).reference,),
            splats.in_use(gaussians),
            spec.block,
        )
        return kan_motion.apply(gaussians, residuals)

    def derive_rows(
        self, scene: Params, condition: FrameCondition | None
    ) -> tuple[Splats, tuple[Carried, Features]]:
        """Return the children in their canonical state, and their features."""
        return _derive_rows(self.spec, scene, condition)

    def derive(
        self,
        scene: Params,
        derived: tuple[Splats, tuple[Carried, Features]],
        rows: Gaussians,
        condition: FrameCondition,
    ) -> Gaussians:
        """Return the children at a time."""
        return _derive(self.spec, scene, derived, rows, condition)

    def loss(self, params: MotionParams, context: PenaltyContext) -> dict[str, Term]:
        """Compute the bits of the features."""
        if self.spec.rate is None:
            return {}
        return penalty(self.spec, context)

    def fit(self, paths: Paths, key: Key[Array, ""]) -> Guess:
        """Return anchors at the points of the paths, to start a fit from."""
        return _fit_to_paths(self.spec, self.frames, paths, key)
