"""Anchors whose features produce child Gaussians and their motion.

ADC-GS (Huang et al. 2025, IJCAI, arXiv:2505.08196, "Anchor-driven deformable and
compressed Gaussian splatting"): an anchor has a place, scales, a turn and a color, a
reference feature, and a residual feature for each of the ten Gaussians it carries. A
network makes these of the features, against the anchor; a coarse network of reference
feature and time moves the anchor, a fine one of residual feature and time each of what
it carries. Features are kept rounded: they are trained with noise as wide as a step,
and their bits under a learned law are part of the loss.

Read were the paper's abstract, a summary of its method and the settings of its code
(H-Huang774/ADC-GS); its equations were not at hand. What they leave open is settled so.
Half of a residual feature makes a Gaussian, half moves it, as in the code, whose fine
stage is switched off; here it is on. The law of a reference feature is normal, with a
mean and a deviation for each channel (there with a hyperprior), that of the residual
ones is normal as a network makes it of the former. Places, scales, turns, opacities and
colors of anchors are kept as they are, at 32 bits a number, where the code has a codec
for points. Colors and opacities do not change over time; in the summary an anchor's
color does. Growth clones or splits anchors by the slopes of what they carry, each by
its share in what is to be seen of the anchor at the moments that were drawn
(`significance`), where the code puts a new anchor at each carried Gaussian of a steep
slope; how much anchors are seen over time beside each other counts for nothing more.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Params, Splats
from gaussians_jax.init import path_fit
from gaussians_jax.init.path_fit import Guess, Paths, Points
from gaussians_jax.motion import carried
from gaussians_jax.motion import kan as kan_motion
from gaussians_jax.motion.anchors import (
    AnchorMotionSpec,
    Anchors,
    Features,
    bits,
    coarse_spec,
    fine_spec,
    init,
    init_features,
    kept,
    made,
    noised,
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
RESTING = 256  # features at rest that a fit to tracks looks at
# Of the volumes, where one counts as large, and how little smaller ones lose (the
# code's); at most so many give that volume.
LARGE, VOLUME_POWER, VOLUME_ROWS = 0.8, 0.01, 512
NUMBER_BITS = 32  # of what has no law


def kept_bytes(params: Params, spec: AnchorMotionSpec) -> tuple[float, float]:
    """Compute the bytes of a trained scene, on the host.

    Args:
      params: Trained parameters.
      spec: Settings. With a prior, features count by their bits.

    Returns:
      Bytes of the features, and of all other parameters at 32 bits each.
    """
    own, net = params.rows[NAME], params.nets[NAME]
    active = np.asarray(splats.active_mask(params.rows["splats"]))
    plain = sum(leaf[active].size for leaf in params.rows["splats"])
    plain += sum(leaf.size for leaf in jax.tree.leaves(params.nets))
    if net.law is None:
        numbers = sum(leaf[active].size for leaf in own)
        return numbers * NUMBER_BITS / 8, plain * NUMBER_BITS / 8
    each = bits(kept(own, net.law, spec), net.law, spec)
    total = sum(float(np.asarray(leaf, np.float64)[active].sum()) for leaf in each)
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
    alone = dataclasses.replace(spec, inputs=features.shape[-1])
    return Offsets(**mlp.apply(alone, at_time, features))


def posed(
    net: Anchors,
    spec: AnchorMotionSpec,
    derived: tuple[Splats, tuple[Carried, Features]],
    rows: Gaussians,
    code: Float[Array, " code"] | None,
) -> Gaussians:
    """Compute the child Gaussians of moved anchors, with their own motion at a time.

    Args:
      net: Parameters of the networks.
      spec: Settings.
      derived: Children in canonical position.
      rows: Anchors, moved by the motion or by hand.
      code: Code of the time. None disables the motion of the children.

    Returns:
      The child Gaussians.
    """
    still, (own, features) = derived
    if code is None:
        return carried.posed(own, None, still, rows)
    reads = features.residual[..., spec.residual // 2 :]
    assert net.fine is not None
    fine = offsets(net.fine, fine_spec(spec), reads, code)
    assert fine.position is not None
    assert fine.log_scale is not None
    own = own._replace(
        offset=own.offset + fine.position, log_scale=own.log_scale + fine.log_scale
    )
    return carried.posed(own, fine.turn, still, rows)


def significance(gaussians: Gaussians) -> Float[Array, " gaussians"]:
    """Weight Gaussians by their visibility: opacity times a small power of the volume.

    Args:
      gaussians: The Gaussians.

    Returns:
      Weights in [0, 1].
    """
    volume = jnp.prod(gaussians.scale, axis=1)
    every = -(-len(volume) // VOLUME_ROWS)
    large = jnp.quantile(volume[::every], LARGE)
    share = jnp.clip(volume / jnp.where(large > 0, large, 1), 0, 1)
    weight = gaussians.opacity * share**VOLUME_POWER
    return jax.lax.stop_gradient(weight)


def fit_to_paths(
    spec: AnchorMotionSpec, frames: int, paths: Paths, key: Key[Array, ""]
) -> Guess:
    """Anchors where points are in the middle of the film, their features as drawn.

    Features of anchors that no path tells of are asked to be at rest. Host side.
    """
    rows_key, nets_key, rest_key = jax.random.split(key, 3)
    points = jnp.asarray(path_fit.places_at_one_moment(paths), jnp.float32)
    rest = init_features(rest_key, spec, RESTING)

    def penalty(points, times):
        net = points.nets

        def moved(time):
            code = codes.at_time(net.times, time)
            by = offsets(net.coarse, coarse_spec(spec), rest.reference, code)
            return by.turn, by.position

        return path_fit.rest_loss(moved, paths.unit, times)

    rows = init_features(rows_key, spec, len(points))
    start = Points(points, rows, init(nets_key, spec, frames))
    rates = Points._make((paths.unit, 1.0, 0.4, None))
    return Guess(start, rates, penalty)


def features_of(
    spec: AnchorMotionSpec, params: MotionParams, condition: FrameCondition | None
) -> Features:
    """Features as they are read: with noise in training, kept afterwards."""
    own, net = params
    if spec.rate is None:
        return own
    if condition is None or condition.step is None:
        return kept(own, net.law, spec)
    assert condition.key is not None
    key = jax.random.fold_in(condition.key, stream(NAME))
    return jax.lax.cond(
        condition.step < spec.rate.start,
        lambda own, law: own,
        lambda own, law: noised(key, own, law),
        own,
        net.law,
    )


def _derive_rows(spec, scene, condition):
    own = MotionParams(scene.rows[NAME], scene.nets[NAME])
    features = features_of(spec, own, condition)
    rows = scene.rows["splats"]
    own = made(scene.nets[NAME], spec, features, rows.sh_rest.shape[1])
    return carried.at_rest(rows, own), (own, features)


def _derive(spec, scene, derived, rows, condition):
    """Return what anchors carry, moved finely once the warm-up is over."""
    net = scene.nets[NAME]
    if not spec.moves:
        return posed(net, spec, derived, rows, None)
    code = codes.at_time(net.times, condition.time)
    if not spec.warm_up or condition.step is None:
        return posed(net, spec, derived, rows, code)
    return jax.lax.cond(
        condition.step < spec.warm_up,
        lambda net, derived, rows: posed(net, spec, derived, rows, None),
        lambda net, derived, rows: posed(net, spec, derived, rows, code),
        net,
        derived,
        rows,
    )


def penalty(
    spec: AnchorMotionSpec, _: Anchors, context: PenaltyContext
) -> dict[str, Term]:
    """Compute the mean bits of a feature value, zero before quantization starts."""
    assert spec.rate is not None
    scene = context.params
    active = splats.active_mask(scene.rows["splats"])
    numbers = spec.reference + spec.count * residual_width(spec)

    def evaluate(scene):
        own = MotionParams(scene.rows[NAME], scene.nets[NAME])
        features = features_of(spec, own, context.condition)
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
        """Evaluate the learning rates of features, networks and law."""
        spec = self.spec

        def falling(of, name):
            first, last = getattr(of, name), getattr(of, f"{name}_end")
            return schedules.log_linear(first, last, self.steps)(step)

        moving = falling(spec, "learning_rate") if spec.moves else None
        law = None if spec.rate is None else falling(spec.rate, "learning_rate")
        make = falling(spec, "make_rate")
        shared = Anchors(moving, make, moving, moving, law)
        return MotionParams(falling(spec, "feature_rate"), shared)

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
        """Move the anchors coarsely."""
        spec, net = self.spec, params.shared
        code = codes.at_time(net.times, frame.time)
        by = in_blocks(
            lambda reads: offsets(net.coarse, coarse_spec(spec), reads, code),
            (features_of(spec, params, frame).reference,),
            splats.in_use(gaussians),
            spec.block,
        )
        return kan_motion.apply(gaussians, by)

    def derive_rows(
        self, scene: Params, condition: FrameCondition | None
    ) -> tuple[Splats, tuple[Carried, Features]]:
        """Return what anchors carry at rest, and what it was made of."""
        return _derive_rows(self.spec, scene, condition)

    def derive(
        self,
        scene: Params,
        derived: tuple[Splats, tuple[Carried, Features]],
        rows: Gaussians,
        condition: FrameCondition,
    ) -> Gaussians:
        """Return what anchors carry where they are now."""
        return _derive(self.spec, scene, derived, rows, condition)

    def loss(self, params: MotionParams, context: PenaltyContext) -> dict[str, Term]:
        """Compute the bits of the features."""
        if self.spec.rate is None:
            return {}
        return penalty(self.spec, params.shared, context)

    def fit(self, paths: Paths, key: Key[Array, ""]) -> Guess:
        """Return anchors at the points of the paths, to fit from."""
        return fit_to_paths(self.spec, self.frames, paths, key)
