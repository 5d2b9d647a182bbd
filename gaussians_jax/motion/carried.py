"""Child Gaussians: each row is a core, and its children move with it and are rendered.

D-MiSo (Waczyńska et al. 2024, NeurIPS, arXiv:2405.14276, "Multi-Gaussians soup",
section 3): a core Gaussian (equation 1) carries k sub-Gaussians in its own coordinates
(equation 2), and these alone are drawn. A motion moves the cores; a second network, the
paper's Sub-Rot (section 3.1), turns what they carry. A core moved by hand takes what it
carries along (`posed`), and a core is a triangle as well (`gaussians_jax.core.faces`).

What is not as in the paper. Places count in the scales of the core (m + R S a, there
m + R a), so that what is split, or enlarged by hand, takes along what it carries. Cores
have three scales, where the paper's are flat. Looks, opacities, scales and turns are
against those of the core (in its code scales and turns are), and so the density control
of the rows, which clones, splits and prunes cores, needs to know nothing of them: it
judges and lowers the core's share, and one that is carried is more or less opaque by
what its own number says. There is no first stage in which the cores themselves are
drawn: what is carried starts spread about its core with the core's looks.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from gaussians_jax.core import splats
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Gaussians, Params, Splats
from nerfies_jax.geometry import quaternion
from nerfies_jax.geometry.precision import exact_einsum
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import FrameCondition

NAME = "carried"


@dataclasses.dataclass(frozen=True)
class TurnSpec:
    """Settings of the network that rotates children by their own rotation and the time.

    The paper's network has one layer (`depth` 0), and its output is added to the
    rotation (section 3.1), as a quaternion in its code. Here it is a rotation vector
    that starts near zero.
    """

    time: EncodingSpec = EncodingSpec(10)
    depth: int = 0
    width: int = 32  # of hidden layers
    learning_rate: float = 8e-4
    learning_rate_end: float = 1.6e-6

    def __post_init__(self):
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        network_spec(self)  # checks its sizes


def network_spec(spec: TurnSpec) -> MLPSpec:
    """From [turn as a unit quaternion, encoded time] to a rotation vector."""
    heads = (("turn", HeadSpec(3, "small")),)
    inputs = 4 + spec.time.width(1)
    return MLPSpec(inputs, spec.depth, spec.width, heads, (), "relu", "he")


@dataclasses.dataclass(frozen=True)
class CarriedSpec:
    """Settings of child Gaussians: number, initialization and learning rates.

    25 is the paper's number. Its code starts all of them in the center of the core,
    where only gradients distinguish them, and at its size. Rates are those of its code,
    except for those of offsets, which there are in scene units and have 1e-3, and of
    the higher harmonics, which there have the rate of the first.
    """

    count: int = 25
    spread: float = 0.7  # standard deviation of first offsets, in scales of the core
    first_scale: float = 0.5  # over the core's
    turns: TurnSpec | None = TurnSpec()  # None: what is carried does not turn by itself
    offset_rate: float = 1e-2
    log_scale_rate: float = 5e-3
    quaternion_rate: float = 1e-3
    opacity_rate: float = 5e-2
    sh_dc_rate: float = 2.5e-3
    sh_rest_rate: float = 1.25e-4

    def __post_init__(self):
        if self.count < 1:
            raise ValueError(f"count={self.count}: a row carries at least one Gaussian")
        if not 0 <= self.spread < math.inf:
            raise ValueError(
                f"spread={self.spread} must be finite and not negative; 0 starts all "
                "in the middle of the core"
            )
        if not 0 < self.first_scale < math.inf:
            raise ValueError(
                f"first_scale={self.first_scale} must be positive and finite; 1 starts "
                "them as large as the core"
            )
        for field in dataclasses.fields(self):
            rate = getattr(self, field.name)
            if field.name.endswith("_rate") and not 0 <= rate < math.inf:
                raise ValueError(f"{field.name}={rate} is finite and not negative")


class Carried(NamedTuple):
    """Parameters of child Gaussians relative to their core: axes, scales and colors."""

    offset: Float[Array, "rows carried 3"]  # of the mean, in scales of the row
    log_scale: Float[Array, "rows carried 3"]  # added to the logarithm
    quaternion: Float[Array, "rows carried 4"]  # wxyz, in the row's axes; any length
    opacity_logit: Float[Array, "rows carried"]  # added
    sh_dc: Float[Array, "rows carried 1 3"]  # added
    sh_rest: Float[Array, "rows carried rest 3"]  # added


def init_rows(key: Key[Array, ""], spec: CarriedSpec, rows: Splats) -> Carried:
    """Initialize children as smaller copies of their core, spread around it.

    Args:
      key: Random key.
      spec: Settings.
      rows: Raw parameters of the cores.

    Returns:
      Parameters of the children.
    """
    shape, kind = (len(rows.mean), spec.count), rows.mean.dtype
    drawn = jax.random.normal(key, (*shape, 3), jnp.float32).astype(kind)
    return Carried(
        offset=spec.spread * drawn,
        log_scale=jnp.full((*shape, 3), math.log(spec.first_scale), kind),
        quaternion=jnp.broadcast_to(quaternion.identity(kind), (*shape, 4)),
        opacity_logit=jnp.zeros(shape, kind),
        sh_dc=jnp.zeros((*shape, 1, 3), kind),
        sh_rest=jnp.zeros((*shape, *rows.sh_rest.shape[1:]), kind),
    )


def at_rest(rows: Splats, own: Carried) -> Splats:
    """Return the raw parameters of all children in canonical position, core by core.

    An inactive row carries inactive ones, as long as `own.opacity_logit` is below 250.
    """
    mean, turned, _ = _standing(own, None, splats.activate(rows))
    return Splats(
        mean=mean,
        log_scale=_flat(rows.log_scale[:, None] + own.log_scale),
        quaternion=turned,
        opacity_logit=_flat(rows.opacity_logit[:, None] + own.opacity_logit),
        sh_dc=_flat(rows.sh_dc[:, None] + own.sh_dc),
        sh_rest=_flat(rows.sh_rest[:, None] + own.sh_rest),
    )


def posed(
    own: Carried,
    turn: Float[Array, "rows carried 3"] | None,
    still: Splats,
    rows: Gaussians,
) -> Gaussians:
    """Compute the children of moved cores (equation 2, with offsets in the core's
    scales).

    A core of zero size has all children at its center, and one with a zero quaternion
    has the axes of the world.

    Args:
      own: Parameters of the children.
      turn: Rotation vectors (rad) in the axes of the core, after the child's own
        rotation.
      still: Children in canonical position (`at_rest`), for their opacities.
      rows: Cores, moved by a network or by hand.

    Returns:
      The child Gaussians.
    """
    mean, turned, scale = _standing(own, turn, rows)
    return Gaussians(mean, turned, scale, jax.nn.sigmoid(still.opacity_logit))


def _standing(own, turn, rows):
    """Means, rotations and scales of what rows carry, one after the other."""
    axes = jax.vmap(quaternion.to_matrix)(rows.quaternion)
    places = exact_einsum("nij,nkj->nki", axes, rows.scale[:, None] * own.offset)
    growth = jnp.exp(jnp.clip(own.log_scale, *splats.LOG_SCALE_RANGE))

    def turned(row, one, turn):
        one = quaternion.normalize(one)
        if turn is not None:
            one = quaternion.multiply(quaternion.exp(turn), one)
        return quaternion.multiply(row, one)

    unit = jax.vmap(quaternion.normalize)(rows.quaternion)
    each = None if turn is None else 0
    over_rows = jax.vmap(jax.vmap(turned, (None, 0, each)), (0, 0, each))
    return (
        _flat(rows.mean[:, None] + places),
        _flat(over_rows(unit, own.quaternion, turn)),
        _flat(rows.scale[:, None] * growth),
    )


def turns(
    network: MLP, spec: TurnSpec, own: Carried, time: Float[Array, ""]
) -> Float[Array, "rows carried 3"]:
    """Evaluate the rotation of children at a time (rad, axes of their core)."""
    moment = encoding.encode(spec.time, time[None], None)
    at_time = mlp.with_known(network_spec(spec), network, moment)
    unit = jax.vmap(jax.vmap(quaternion.normalize))(own.quaternion)
    alone = dataclasses.replace(network_spec(spec), inputs=4)
    return mlp.apply(alone, at_time, unit)["turn"]


def follow(
    params: Params, spec: CarriedSpec, rows: Gaussians, time: Float[Array, ""]
) -> Gaussians:
    """Compute the children of cores that were moved, rotated or scaled by hand.

    `rows` are those of `deformation.deform_rows`, moved, turned or enlarged.
    """
    own = params.rows[NAME]
    still = at_rest(params.rows["splats"], own)
    turn = None
    if spec.turns is not None:
        turn = turns(params.nets[NAME], spec.turns, own, time)
    return posed(own, turn, still, rows)


def effect(spec: CarriedSpec, steps: int, warm_up: int) -> SplatRecord:
    """Assemble the hooks of child Gaussians, which do not rotate before `warm_up`.

    Opacities and looks are those at rest: a motion of the rows that changes opacities
    has no say in them.
    """

    def rates(step):
        own = Carried(
            spec.offset_rate,
            spec.log_scale_rate,
            spec.quaternion_rate,
            spec.opacity_rate,
            spec.sh_dc_rate,
            spec.sh_rest_rate,
        )
        if spec.turns is None:
            return MotionParams(own)
        first, last = spec.turns.learning_rate, spec.turns.learning_rate_end
        return MotionParams(own, schedules.log_linear(first, last, steps)(step))

    def derive_rows(
        params: Params, condition: FrameCondition | None
    ) -> tuple[Splats, None]:
        del condition
        return at_rest(params.rows["splats"], params.rows[NAME]), None

    def turn_of(params, condition):
        own = params.rows[NAME]

        def evaluate(network, own):
            return turns(network, spec.turns, own, condition.time)

        if not warm_up or condition.step is None:
            return evaluate(params.nets[NAME], own)
        return jax.lax.cond(
            condition.step < warm_up,
            lambda _, own: jnp.zeros_like(own.offset),
            evaluate,
            params.nets[NAME],
            own,
        )

    def derive(
        params: Params,
        derived: tuple[Splats, None],
        rows: Gaussians,
        condition: FrameCondition,
    ) -> Gaussians:
        turn = None if spec.turns is None else turn_of(params, condition)
        return posed(params.rows[NAME], turn, derived[0], rows)

    def init(key, gaussians):
        rows_key, shared_key = jax.random.split(key)
        own = init_rows(rows_key, spec, gaussians)
        if spec.turns is None:
            return MotionParams(own)
        return MotionParams(own, mlp.init(network_spec(spec.turns), shared_key))

    return SplatRecord(
        name=NAME,
        init=init,
        learning_rate=rates,
        derive_rows=derive_rows,
        derive=derive,
    )


def _flat(leaf):
    """[rows, carried, ...] as [rows * carried, ...]."""
    rows, carried, *rest = leaf.shape  # of which the last may be none
    return leaf.reshape(rows * carried, *rest)
