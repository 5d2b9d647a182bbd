"""Motion as a slow displacement and a basis of directions for each Gaussian.

MoBa-GS, equations 3 to 6. A base network moves the canonical mean p with a
low-frequency time: p'(t) = p + D(p, t). A basis network makes of p alone K directions
V(p), a weight network of p' and t the K lengths to go along them, the turn and the
stretch. A Gaussian is then at p' + V(p) w(p', t). What depends on p alone (`prepare`)
stays as it is for all times while the parameters do.
"""

import dataclasses
import zlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.motion import mlp as mlp_motion
from gaussians_jax.motion.blocks import in_blocks
from gaussians_jax.motion.bound import BoundMotion
from gaussians_jax.motion.mlp import SmoothingSpec
from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.step_counts import steps

NAME = "motion_basis"
BASIS_FORMS = ("bounded", "free")
_STREAM = zlib.crc32(NAME.encode()) >> 1  # of the step's key, for the noise on the time


@dataclasses.dataclass(frozen=True)
class BasisMotionSpec:
    """The three networks and their schedule, with the paper's sizes where it has them.

    `count` is K. None removes the basis, and the weight network predicts the residual
    displacement, the paper's ablation "base + residual". All networks use SiLU: the
    paper calls its motion C1 in time, which ReLU networks are not.

    V w = (V A)(A^-1 w) for every invertible A, so the size of V has no meaning alone.
    The form "bounded" shortens directions longer than one to length one. Then w is in
    scene units, and |V w| <= sum |w| for any basis network. The form "free" keeps them.
    """

    position: EncodingSpec = EncodingSpec(10)
    base_time: EncodingSpec = EncodingSpec(4)
    time: EncodingSpec = EncodingSpec(10)
    base_depth: int = 4
    base_width: int = 128
    count: int | None = 8
    basis_form: str = "bounded"
    basis_width: int = 256
    depth: int = 8
    width: int = 256
    skips: tuple[int, ...] = (5,)  # layers of the weight network that read p' again
    activation: str = "silu"
    # No gradient to the canonical means through the networks, as in Deformable 3DGS:
    # they would chase a moving target. The paper does not say.
    detach: bool = True
    warm_up: int = steps(3000)  # steps without motion
    smoothing: SmoothingSpec | None = None
    learning_rate: float = 8e-4
    learning_rate_end: float = 1.6e-6
    block: int = 512  # Gaussians per evaluation

    def __post_init__(self):
        if self.count is not None and self.count < 1:
            raise ValueError(
                f"a basis has at least one direction, got count={self.count}; None "
                "leaves the basis out"
            )
        if self.basis_form not in BASIS_FORMS:
            raise ValueError(
                f"unknown basis_form {self.basis_form!r}; choose from {BASIS_FORMS}"
            )
        if self.base_depth < 1 or self.depth < 1:
            raise ValueError(
                "the base and the weight network need a hidden layer each, got "
                f"base_depth={self.base_depth}, depth={self.depth}"
            )
        if self.block < 1 or self.warm_up < 0:
            raise ValueError(
                f"block >= 1 and warm_up >= 0, got {self.block} and {self.warm_up}"
            )
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        base_spec(self)  # these check sizes, layers and activation
        weights_spec(self)
        if self.count is not None:
            basis_spec(self)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.moments)


class BasisMotion(NamedTuple):
    """Parameters of the field."""

    base: MLP
    basis: MLP | None  # None where the spec has no basis
    weights: MLP


class Prepared(NamedTuple):
    """Time-independent quantities of each Gaussian.

    They take 4 (3 K + base_width) bytes each: 608 with the paper's sizes, 24 MB for its
    39,000 Gaussians. On one core, deforming 10,000 takes 160 ms without, 154 with the
    directions, 147 with both, and 10.2, 8.5 and 6.8 in the small sizes.
    """

    base: Float[Array, "gaussians width"]  # p's share of the base's first layer
    basis: Float[Array, "gaussians 3 count"] | None  # the directions


class Offsets(NamedTuple):
    """Residuals of position, scale and rotation."""

    mean: Float[Array, "*gaussians 3"]  # scene units
    turn: Float[Array, "*gaussians 3"]  # rotation vector, rad, in world axes
    log_scale: Float[Array, "*gaussians 3"]  # added to the logarithm


def base_spec(spec: BasisMotionSpec) -> MLPSpec:
    """From [encoded canonical mean, encoded time] to the slow displacement."""
    inputs = spec.position.width(3) + spec.base_time.width(1)
    heads = (("mean", HeadSpec(3, "small")),)
    return MLPSpec(
        inputs, spec.base_depth, spec.base_width, heads, (), spec.activation, "he"
    )


def basis_spec(spec: BasisMotionSpec) -> MLPSpec:
    """From the encoded canonical mean to K directions, about as long as one at first.

    One hidden layer and the output are the paper's "2 layers": its storage column
    leaves room for 570k to 590k numbers in all networks, and this makes 589k.
    """
    assert spec.count is not None
    heads = (("directions", HeadSpec(3 * spec.count)),)
    inputs = spec.position.width(3)
    return MLPSpec(inputs, 1, spec.basis_width, heads, (), spec.activation, "he")


def weights_spec(spec: BasisMotionSpec) -> MLPSpec:
    """Settings of the network from [encoded p', encoded time] to weights, rotation and
    scale.

    All heads start near zero, so that a Gaussian starts in its canonical state while
    its directions are nonzero. If both were zero, neither would get a gradient.

    Args:
      spec: Settings of the motion.

    Returns:
      Settings of the network.
    """
    heads = (
        ("weights", HeadSpec(spec.count or 3, "small")),
        ("turn", HeadSpec(3, "small")),
        ("log_scale", HeadSpec(3, "small")),
    )
    inputs = spec.position.width(3) + spec.time.width(1)
    return MLPSpec(
        inputs, spec.depth, spec.width, heads, spec.skips, spec.activation, "he"
    )


# One core, forward and backward with what is prepared, at 5k and 10k Gaussians: 17 and
# 33 ms; `mlp_motion.SMALL_MOTION` takes 14 and 28 in the same run. The encoding has pi
# for its polynomial sines, which take 5 ms less here than XLA's.
SMALL_BASIS_MOTION = BasisMotionSpec(
    position=EncodingSpec(4, times_pi=True),
    base_time=EncodingSpec(2),
    time=EncodingSpec(4),
    base_depth=2,
    base_width=32,
    basis_width=32,
    depth=3,
    width=48,
    skips=(),
)


def init(key: Key[Array, ""], spec: BasisMotionSpec, dtype=jnp.float32) -> BasisMotion:
    """A field that hardly moves anything yet."""
    base_key, basis_key, weights_key = jax.random.split(key, 3)
    basis = None
    if spec.count is not None:
        basis = mlp.init(basis_spec(spec), basis_key, dtype)
    return BasisMotion(
        mlp.init(base_spec(spec), base_key, dtype),
        basis,
        mlp.init(weights_spec(spec), weights_key, dtype),
    )


def prepare_point(
    params: BasisMotion, spec: BasisMotionSpec, point: Float[Array, "3"]
) -> Prepared:
    """The row of `Prepared` of one canonical mean."""
    encoded = encoding.encode(spec.position, point, None)
    base = encoded @ params.base.hidden[0].weight[: len(encoded)]
    if params.basis is None:
        return Prepared(base, None)
    return Prepared(base, basis_vectors(params.basis, spec, encoded))


def basis_vectors(
    basis: MLP, spec: BasisMotionSpec, encoded: Float[Array, " features"]
) -> Float[Array, "3 count"]:
    """V(p), equation 4, of one encoded canonical mean."""
    directions = mlp.apply(basis_spec(spec), basis, encoded)["directions"]
    directions = directions.reshape(3, spec.count)
    if spec.basis_form == "free":
        return directions
    # The length has no slope at zero, and is not needed there.
    length_sq = jnp.sum(directions**2, axis=0)
    too_long = length_sq > 1
    return directions / jnp.sqrt(jnp.where(too_long, length_sq, 1))


class AtTime(NamedTuple):
    """The networks that know the time, at one time: functions of position alone."""

    base: MLP
    weights: MLP


def fold_time(
    params: BasisMotion, spec: BasisMotionSpec, time: Float[Array, ""]
) -> AtTime:
    """Both networks with what they read of the time moved into their biases.

    It is the same vector for every Gaussian, summed once instead of for each.
    """
    slow = encoding.encode(spec.base_time, time[None], None)
    fast = encoding.encode(spec.time, time[None], None)
    return AtTime(
        mlp.with_known(base_spec(spec), params.base, slow),
        mlp.with_known(weights_spec(spec), params.weights, fast),
    )


def base_displacement(
    base: MLP, spec: BasisMotionSpec, share: Float[Array, " width"]
) -> Float[Array, "3"]:
    """Compute D(p, t), equation 3, of one Gaussian from prepared parameters."""
    first, *others = base.hidden
    hidden = mlp.ACTIVATIONS[spec.activation](share + first.bias)
    rest = dataclasses.replace(
        base_spec(spec), inputs=spec.base_width, depth=spec.base_depth - 1
    )
    return mlp.apply(rest, MLP(tuple(others), base.heads), hidden)["mean"]


def residual(
    weights: MLP, spec: BasisMotionSpec, moved: Float[Array, "3"]
) -> dict[str, Float[Array, " outputs"]]:
    """Compute w(p', t), equation 5, with rotation and scale, of one Gaussian."""
    encoded = encoding.encode(spec.position, moved, None)
    position_only = dataclasses.replace(weights_spec(spec), inputs=len(encoded))
    return mlp.apply(position_only, weights, encoded)


def offsets_at_time(
    at_time: AtTime, spec: BasisMotionSpec, point: Float[Array, "3"], prepared: Prepared
) -> Offsets:
    """Equations 3, 5 and 6 of one Gaussian, from its row of `Prepared`."""
    slow = base_displacement(at_time.base, spec, prepared.base)
    heads = residual(at_time.weights, spec, point + slow)
    fast = heads["weights"]
    if prepared.basis is not None:
        fast = exact_product(prepared.basis, fast)
    return Offsets(slow + fast, heads["turn"], heads["log_scale"])


def prepare(
    params: BasisMotion,
    spec: BasisMotionSpec,
    mean: Float[Array, "gaussians 3"],
    active: Bool[Array, " gaussians"] | None = None,
) -> Prepared:
    """All that `deform` needs and the time does not change. Pure.

    The paper calls it time-invariant caching: right for these means and parameters
    only, so it pays when a trained scene is drawn. In training it runs in every step.
    """
    return in_blocks(
        jax.vmap(lambda point: prepare_point(params, spec, point)),
        (_seen(spec, mean),),
        active,
        spec.block,
    )


def deform(
    params: BasisMotion,
    spec: BasisMotionSpec,
    mean: Float[Array, "gaussians 3"],
    time: Float[Array, ""],
    prepared: Prepared,
    active: Bool[Array, " gaussians"] | None = None,
) -> Offsets:
    """Evaluate the residuals of all Gaussians at a time, zero in blocks without active
    ones.

    `mean` is canonical, and what `prepared` was made of.
    """
    at_time = fold_time(params, spec, time)
    return in_blocks(
        jax.vmap(lambda point, row: offsets_at_time(at_time, spec, point, row)),
        (_seen(spec, mean), prepared),
        active,
        spec.block,
    )


def _seen(spec, mean):
    return jax.lax.stop_gradient(mean) if spec.detach else mean


def apply(gaussians: Gaussians, offsets: Offsets) -> Gaussians:
    """Apply residuals to Gaussians.

    The rotation is exp(turn) q / |q|, which has unit length for any network output. The
    paper adds to q as Deformable 3DGS does. Near q + dq = 0, rounding would then decide
    the rotation (1e-4 rad at |q + dq| = 1e-3). The logarithm of the factor of the scale
    is clamped to the range of the scale.

    Args:
      gaussians: Canonical Gaussians.
      offsets: Residuals.

    Returns:
      The deformed Gaussians.
    """
    factor = jnp.exp(jnp.clip(offsets.log_scale, *splats.LOG_SCALE_RANGE))
    return Gaussians(
        mean=gaussians.mean + offsets.mean,
        quaternion=splats.turned(gaussians, offsets.turn),
        scale=gaussians.scale * factor,
        opacity=gaussians.opacity,
    )


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `BasisMotionSpec` in a run of `steps`."""

    spec: BasisMotionSpec
    frames: int

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rate of the networks."""
        return MotionParams(shared=self.rate(step))

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the networks."""
        _, shared_key = jax.random.split(key)
        return MotionParams(shared=init(shared_key, self.spec))

    def precompute(self, params: MotionParams, gaussians: Splats) -> Prepared:
        """Evaluate what does not depend on the time."""
        active = splats.active_mask(gaussians)
        return prepare(params.shared, self.spec, gaussians.mean, active)

    def apply(
        self,
        params: MotionParams,
        cache: Prepared,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to a time, which is noisy early in training."""
        time, smoothing = frame.time, self.spec.smoothing
        if smoothing is not None and frame.step is not None:
            assert frame.key is not None
            key = jax.random.fold_in(frame.key, _STREAM)
            time = mlp_motion.smooth_time(key, smoothing, time, frame.step, self.frames)
        active, mean = splats.in_use(gaussians), gaussians.mean
        offsets = deform(params.shared, self.spec, mean, time, cache, active)
        return apply(gaussians, offsets)
