"""Motion as a slow displacement and a basis of directions for each Gaussian.

MoBa-GS, equations 3 to 6. A base network moves the canonical mean p with a
low-frequency time: p'(t) = p + D(p, t). A basis network maps p to K directions V(p). A
weight network maps p' and t to K weights w, a rotation and a change of scale. A
Gaussian is then at p' + V(p) w(p', t). Everything that depends on p only is cached by
`prepare` and valid for all times.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Key

from gaussians_jax.core import splats
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.motion.blocks import in_blocks
from gaussians_jax.motion.mlp import BoundNetworks, SmoothingSpec
from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.step_counts import steps

NAME = "motion_basis"
BASIS_FORMS = ("bounded", "free")


@dataclasses.dataclass(frozen=True)
class BasisMotionSpec:
    """Settings of the three networks and their schedule, with the paper's sizes if
    given.

    `count` is K. None removes the basis, and the weight network predicts the residual
    displacement, the paper's ablation "base + residual". All networks use SiLU, because
    the paper calls its motion C1 in time, which ReLU networks are not.

    V w = (V A)(A^-1 w) for every invertible A, so the size of V is arbitrary.
    `basis_form="bounded"` shortens directions longer than one to length one. Then w is
    in scene units, and |V w| <= sum |w| for any basis network. "free" keeps directions.
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
    # No gradient reaches the canonical means through the networks, as in Deformable
    # 3DGS, because the networks themselves change. The paper does not say.
    detach: bool = True
    warm_up: int = steps(3000)  # steps without motion
    smoothing: SmoothingSpec | None = None
    learning_rate: float = 8e-4
    learning_rate_end: float = 1.6e-6
    block: int = 512  # Gaussians per evaluation

    def __post_init__(self):
        if self.count is not None and self.count < 1:
            raise ValueError(
                f"count={self.count}: a basis needs at least one direction; None "
                "disables the basis"
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
                "block must be at least 1 and warm_up not negative, got "
                f"block={self.block} and warm_up={self.warm_up}"
            )
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        _base_spec(self)  # these validate sizes, layers and activation
        _weights_spec(self)
        if self.count is not None:
            _basis_spec(self)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.timestamps)


class BasisMotion(NamedTuple):
    """Parameters of the networks."""

    base: MLP
    basis: MLP | None  # None without a basis
    weights: MLP


class Prepared(NamedTuple):
    """Time-independent quantities of each Gaussian.

    They take 4 (3 K + base_width) bytes each: 608 with the paper's sizes, 24 MB for its
    39,000 Gaussians. On one core, the deformation of 10,000 takes 160 ms without this
    cache, 154 with cached directions, 147 with both, and 10.2, 8.5 and 6.8 in the small
    sizes.
    """

    base: Float[Array, "gaussians width"]  # contribution of p to the first base layer
    basis: Float[Array, "gaussians 3 count"] | None  # the directions


class Offsets(NamedTuple):
    """Residuals of position, scale and rotation."""

    mean: Float[Array, "*gaussians 3"]  # scene units
    turn: Float[Array, "*gaussians 3"]  # rotation vector, rad, in world axes
    log_scale: Float[Array, "*gaussians 3"]  # added to the logarithm


def _base_spec(spec: BasisMotionSpec) -> MLPSpec:
    """Settings of the network from [mean, time], encoded, to the slow displacement."""
    inputs = spec.position.width(3) + spec.base_time.width(1)
    heads = (("mean", HeadSpec(3, "small")),)
    return MLPSpec(
        inputs, spec.base_depth, spec.base_width, heads, (), spec.activation, "he"
    )


def _basis_spec(spec: BasisMotionSpec) -> MLPSpec:
    """Settings of the network from the encoded mean to K directions.

    Directions have a length of about one at first. One hidden layer and the output are
    the paper's "2 layers": its storage column leaves room for 570k to 590k numbers in
    all networks, and this gives 589k.
    """
    assert spec.count is not None
    heads = (("directions", HeadSpec(3 * spec.count)),)
    inputs = spec.position.width(3)
    return MLPSpec(inputs, 1, spec.basis_width, heads, (), spec.activation, "he")


def _weights_spec(spec: BasisMotionSpec) -> MLPSpec:
    """Settings of the network from [encoded p', encoded time] to weights and others.

    The other outputs are rotation and scale.

    All heads are initialized near zero, so that a Gaussian starts in its canonical
    state, but directions are not. If both were zero, neither would get a gradient.
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


# Forward and backward with `prepare`, for 5k and 10k Gaussians on one core: 17 and 33
# ms, compared with 14 and 28 for a `MotionSpec` of 4x64. The encoding has pi for its
# polynomial sines, which take 5 ms less than XLA's.
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


def init(
    key: Key[Array, ""], spec: BasisMotionSpec, dtype: DTypeLike = jnp.float32
) -> BasisMotion:
    """Initialize networks that hardly move anything.

    Args:
      key: PRNG key.
      spec: Settings of the motion.
      dtype: Type of the parameters.

    Returns:
      Parameters of the networks.
    """
    base_key, basis_key, weights_key = jax.random.split(key, 3)
    basis = None
    if spec.count is not None:
        basis = mlp.init(_basis_spec(spec), basis_key, dtype)
    return BasisMotion(
        mlp.init(_base_spec(spec), base_key, dtype),
        basis,
        mlp.init(_weights_spec(spec), weights_key, dtype),
    )


def prepare_point(
    params: BasisMotion, spec: BasisMotionSpec, point: Float[Array, "3"]
) -> Prepared:
    """Compute the cache of one canonical mean.

    Args:
      params: Parameters of the networks.
      spec: Settings of the motion.
      point: Canonical mean in scene units.

    Returns:
      The part of the first layer that does not depend on time, and the basis vectors.
    """
    features = encoding.encode(spec.position, point, None)
    base = features @ params.base.hidden[0].weight[: len(features)]
    if params.basis is None:
        return Prepared(base, None)
    return Prepared(base, basis_vectors(params.basis, spec, features))


def basis_vectors(
    basis: MLP, spec: BasisMotionSpec, encoded: Float[Array, " features"]
) -> Float[Array, "3 count"]:
    """Compute V(p), equation 4, for one encoded canonical mean.

    Args:
      basis: Network of the basis.
      spec: Settings of the motion.
      encoded: Encoded canonical mean.

    Returns:
      The vectors as columns. Unless they are free, their length is at most one.
    """
    directions = mlp.apply(_basis_spec(spec), basis, encoded)["directions"]
    directions = directions.reshape(3, spec.count)
    if spec.basis_form == "free":
        return directions
    # The gradient of the length is undefined at zero, where it is not needed.
    length_sq = jnp.sum(directions**2, axis=0)
    too_long = length_sq > 1
    return directions / jnp.sqrt(jnp.where(too_long, length_sq, 1))


class AtTime(NamedTuple):
    """The time-dependent networks at one time, as functions of position alone."""

    base: MLP
    weights: MLP


def _fold_time(
    params: BasisMotion, spec: BasisMotionSpec, time: Float[Array, ""]
) -> AtTime:
    """Evaluate the contribution of the time to the first layers of both networks.

    It is the same for all Gaussians and is computed once.
    """
    slow = encoding.encode(spec.base_time, time[None], None)
    fast = encoding.encode(spec.time, time[None], None)
    return AtTime(
        mlp.with_known(_base_spec(spec), params.base, slow),
        mlp.with_known(_weights_spec(spec), params.weights, fast),
    )


def _base_displacement(
    base: MLP, spec: BasisMotionSpec, first_layer: Float[Array, " width"]
) -> Float[Array, "3"]:
    """Compute D(p, t), equation 3, of one Gaussian from its cached first layer."""
    first, *others = base.hidden
    hidden = mlp.ACTIVATIONS[spec.activation](first_layer + first.bias)
    remaining = dataclasses.replace(
        _base_spec(spec), inputs=spec.base_width, depth=spec.base_depth - 1
    )
    return mlp.apply(remaining, MLP(tuple(others), base.heads), hidden)["mean"]


def residual(
    weights: MLP, spec: BasisMotionSpec, slow_mean: Float[Array, "3"]
) -> dict[str, Float[Array, " outputs"]]:
    """Compute w(p', t), equation 5, with rotation and scale, of one Gaussian.

    Args:
      weights: Network of the weights at one time.
      spec: Settings of the motion.
      slow_mean: Mean after the slow motion, in scene units.

    Returns:
      Outputs by name: the weights of the basis vectors, and changes of rotation and
      scale.
    """
    features = encoding.encode(spec.position, slow_mean, None)
    position_only = dataclasses.replace(_weights_spec(spec), inputs=len(features))
    return mlp.apply(position_only, weights, features)


def _offsets_at_time(
    at_time: AtTime, spec: BasisMotionSpec, point: Float[Array, "3"], cache: Prepared
) -> Offsets:
    """Evaluate equations 3, 5 and 6 for one Gaussian."""
    slow = _base_displacement(at_time.base, spec, cache.base)
    heads = residual(at_time.weights, spec, point + slow)
    fast = heads["weights"]
    if cache.basis is not None:
        fast = exact_product(cache.basis, fast)
    return Offsets(slow + fast, heads["turn"], heads["log_scale"])


def prepare(
    params: BasisMotion,
    spec: BasisMotionSpec,
    mean: Float[Array, "gaussians 3"],
    active: Bool[Array, " gaussians"] | None = None,
) -> Prepared:
    """Compute everything that `deform` needs and that does not depend on the time.

    The paper calls it time-invariant caching. The cache is valid for these means and
    parameters only, so it pays off for rendering. In training it runs in every step.

    Args:
      params: Shared parameters.
      spec: Settings.
      mean: Canonical means.
      active: Active Gaussians. Blocks without any are zero.

    Returns:
      The cache.
    """
    return in_blocks(
        jax.vmap(lambda point: prepare_point(params, spec, point)),
        (_network_input(spec, mean),),
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
    """Evaluate the residuals of all Gaussians at a time.

    Args:
      params: Shared parameters.
      spec: Settings.
      mean: Canonical means that `prepared` was computed from.
      time: Normalized time.
      prepared: Result of `prepare`.
      active: Active Gaussians. Blocks without any are zero.

    Returns:
      The residuals.
    """
    at_time = _fold_time(params, spec, time)
    return in_blocks(
        jax.vmap(lambda point, row: _offsets_at_time(at_time, spec, point, row)),
        (_network_input(spec, mean), prepared),
        active,
        spec.block,
    )


def blending_weights(
    params: BasisMotion,
    spec: BasisMotionSpec,
    mean: Float[Array, "gaussians 3"],
    time: Float[Array, ""],
    prepared: Prepared,
) -> Float[Array, "gaussians count"]:
    """Evaluate the weights w(p', t) of the basis, equation 5, at a time.

    Args:
      params: Shared parameters.
      spec: Settings.
      mean: Canonical means that `prepared` was computed from.
      time: Normalized time.
      prepared: Result of `prepare`.

    Returns:
      Weights, in scene units if the basis is bounded.
    """
    at_time = _fold_time(params, spec, time)

    def weights(point, row):
        slow = point + _base_displacement(at_time.base, spec, row.base)
        return residual(at_time.weights, spec, slow)["weights"]

    return in_blocks(jax.vmap(weights), (mean, prepared), None, spec.block)


def _network_input(spec, mean):
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
        quaternion=splats.rotate(gaussians, offsets.turn),
        scale=gaussians.scale * factor,
        opacity=gaussians.opacity,
    )


class Bound(BoundNetworks):
    """The `Motion` of a `BasisMotionSpec` in a run of `steps`."""

    name = NAME
    init_shared = staticmethod(init)

    def precompute(self, params: MotionParams, gaussians: Splats) -> Prepared:
        """Compute everything that does not depend on the time."""
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
        time, active = self.noisy_time(frame), splats.in_use(gaussians)
        mean = gaussians.mean
        offsets = deform(params.shared, self.spec, mean, time, cache, active)
        return apply(gaussians, offsets)
