"""Child Gaussians: each core moves its children, and the children are rendered.

D-MiSo (Waczyńska et al. 2024, NeurIPS, arXiv:2405.14276, "Multi-Gaussians soup",
section 3): a core Gaussian (equation 1) has k sub-Gaussians in its own coordinates
(equation 2), and only these are rendered. A motion moves the cores. A second network,
the paper's Sub-Rot (section 3.1), rotates the children. Children follow a core that is
moved by hand (`pose_children`), and a core can also be edited as a triangle
(`gaussians_jax.core.faces`).

Differences from the paper: positions of children are in scales of the core (m + R S a,
in the paper m + R a), so that children follow a core that is split or enlarged by hand.
Cores have three scales, where the paper's are flat. Colors, opacities, scales and
rotations are relative to the core's (in its code scales and rotations are), so the
density control, which clones, splits and prunes cores, does not depend on children. It
uses and resets the opacity of the core, to which each child adds its own logit. There
is no first stage in which the cores themselves are rendered. Children are initialized
around their core with the core's color.
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
    rotation (section 3.1), as a quaternion in its code. Here the output is a rotation
    vector that is initially near zero.
    """

    time: EncodingSpec = EncodingSpec(10)
    depth: int = 0
    width: int = 32  # of hidden layers
    learning_rate: float = 8e-4
    learning_rate_end: float = 1.6e-6

    def __post_init__(self):
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        network_spec(self)  # validates the sizes


def network_spec(spec: TurnSpec) -> MLPSpec:
    """Settings of the network from [rotation, encoded time] to a rotation vector.

    Args:
      spec: Settings of the rotation.

    Returns:
      Settings of the network, whose first four inputs are a unit quaternion.
    """
    heads = (("turn", HeadSpec(3, "small")),)
    inputs = 4 + spec.time.width(1)
    return MLPSpec(inputs, spec.depth, spec.width, heads, (), "relu", "he")


@dataclasses.dataclass(frozen=True)
class CarriedSpec:
    """Settings of child Gaussians: number, initialization and learning rates.

    25 is the paper's number. Its code initializes all of them in the center of the core
    and at its size, where only gradients distinguish them. Rates are those of its code,
    except for offsets, which there are in scene units with a rate of 1e-3, and for
    higher harmonics, which there have the rate of the first.
    """

    count: int = 25
    spread: float = 0.7  # standard deviation of initial offsets, in scales of the core
    first_scale: float = 0.5  # initial scale relative to the core's
    turns: TurnSpec | None = TurnSpec()  # None: children do not rotate on their own
    offset_rate: float = 1e-2
    log_scale_rate: float = 5e-3
    quaternion_rate: float = 1e-3
    opacity_rate: float = 5e-2
    sh_dc_rate: float = 2.5e-3
    sh_rest_rate: float = 1.25e-4

    def __post_init__(self):
        if self.count < 1:
            raise ValueError(f"count={self.count}: a core needs at least one child")
        if not 0 <= self.spread < math.inf:
            raise ValueError(
                f"spread={self.spread} must be finite and not negative; 0 initializes "
                "all children in the center of the core"
            )
        if not 0 < self.first_scale < math.inf:
            raise ValueError(
                f"first_scale={self.first_scale} must be positive and finite; 1 "
                "initializes children at the size of the core"
            )
        for field in dataclasses.fields(self):
            rate = getattr(self, field.name)
            if field.name.endswith("_rate") and not 0 <= rate < math.inf:
                raise ValueError(f"{field.name}={rate} must be finite and not negative")


class Carried(NamedTuple):
    """Parameters of child Gaussians relative to their core: axes, scales and colors."""

    offset: Float[Array, "cores children 3"]  # of the mean, in scales of the core
    log_scale: Float[Array, "cores children 3"]  # added to the core's
    quaternion: Float[Array, "cores children 4"]  # wxyz, in the core's axes; any length
    opacity_logit: Float[Array, "cores children"]  # added to the core's
    sh_dc: Float[Array, "cores children 1 3"]  # added to the core's
    sh_rest: Float[Array, "cores children rest 3"]  # added to the core's


def _init_rows(key: Key[Array, ""], spec: CarriedSpec, rows: Splats) -> Carried:
    """Initialize children as smaller copies of their core, spread around it."""
    shape, dtype = (len(rows.mean), spec.count), rows.mean.dtype
    noise = jax.random.normal(key, (*shape, 3), jnp.float32).astype(dtype)
    return Carried(
        offset=spec.spread * noise,
        log_scale=jnp.full((*shape, 3), math.log(spec.first_scale), dtype),
        quaternion=jnp.broadcast_to(quaternion.identity(dtype), (*shape, 4)),
        opacity_logit=jnp.zeros(shape, dtype),
        sh_dc=jnp.zeros((*shape, 1, 3), dtype),
        sh_rest=jnp.zeros((*shape, *rows.sh_rest.shape[1:]), dtype),
    )


def canonical_children(rows: Splats, children: Carried) -> Splats:
    """Return the raw parameters of all children in their canonical state, core by core.

    Children of an inactive core are inactive if their `opacity_logit` is below 250.

    Args:
      rows: Raw parameters of the cores.
      children: Parameters of the children.

    Returns:
      Raw parameters of the children.
    """
    mean, rotation, _ = _place_children(children, None, splats.activate(rows))
    return Splats(
        mean=mean,
        log_scale=_flat(rows.log_scale[:, None] + children.log_scale),
        quaternion=rotation,
        opacity_logit=_flat(rows.opacity_logit[:, None] + children.opacity_logit),
        sh_dc=_flat(rows.sh_dc[:, None] + children.sh_dc),
        sh_rest=_flat(rows.sh_rest[:, None] + children.sh_rest),
    )


def pose_children(
    children: Carried,
    turn: Float[Array, "cores children 3"] | None,
    canonical: Splats,
    rows: Gaussians,
) -> Gaussians:
    """Compute the children of moved cores.

    Equation 2, with offsets in scales of the core. A core of zero size has all children
    at its center, and one with a zero quaternion has the axes of the world.

    Args:
      children: Parameters of the children.
      turn: Rotation vectors (rad) in the axes of the core, after the child's own
        rotation.
      canonical: Children in their canonical state (`canonical_children`), for their
        opacities.
      rows: Cores, moved by a network or by hand.

    Returns:
      The child Gaussians.
    """
    mean, rotation, scale = _place_children(children, turn, rows)
    return Gaussians(mean, rotation, scale, jax.nn.sigmoid(canonical.opacity_logit))


def _place_children(children, turn, rows):
    """Return means, rotations and scales of all children, core by core."""
    axes = jax.vmap(quaternion.to_matrix)(rows.quaternion)
    offsets = exact_einsum("nij,nkj->nki", axes, rows.scale[:, None] * children.offset)
    factor = jnp.exp(jnp.clip(children.log_scale, *splats.LOG_SCALE_RANGE))

    def rotate(row, orientation, turn):
        orientation = quaternion.normalize(orientation)
        if turn is not None:
            orientation = quaternion.multiply(quaternion.exp(turn), orientation)
        return quaternion.multiply(row, orientation)

    unit = jax.vmap(quaternion.normalize)(rows.quaternion)
    each = None if turn is None else 0
    over_rows = jax.vmap(jax.vmap(rotate, (None, 0, each)), (0, 0, each))
    return (
        _flat(rows.mean[:, None] + offsets),
        _flat(over_rows(unit, children.quaternion, turn)),
        _flat(rows.scale[:, None] * factor),
    )


def turns(
    network: MLP, spec: TurnSpec, children: Carried, time: Float[Array, ""]
) -> Float[Array, "cores children 3"]:
    """Evaluate the rotation of children at a time.

    Args:
      network: Parameters of the network.
      spec: Settings.
      children: Parameters of the children.
      time: Normalized time.

    Returns:
      Rotation vectors (rad) in the axes of the core.
    """
    features = encoding.encode(spec.time, time[None], None)
    at_time = mlp.with_known(network_spec(spec), network, features)
    unit = jax.vmap(jax.vmap(quaternion.normalize))(children.quaternion)
    rotation_only = dataclasses.replace(network_spec(spec), inputs=4)
    return mlp.apply(rotation_only, at_time, unit)["turn"]


def follow(
    params: Params, spec: CarriedSpec, rows: Gaussians, time: Float[Array, ""]
) -> Gaussians:
    """Compute the children of cores that were moved, rotated or scaled by hand.

    Args:
      params: Trained parameters.
      spec: Settings.
      rows: Cores of `deformation.deform_rows`, edited.
      time: Normalized time.

    Returns:
      The child Gaussians.
    """
    children = params.rows[NAME]
    canonical = canonical_children(params.rows["splats"], children)
    turn = None
    if spec.turns is not None:
        turn = turns(params.nets[NAME], spec.turns, children, time)
    return pose_children(children, turn, canonical, rows)


def effect(spec: CarriedSpec, steps: int, warm_up: int) -> SplatRecord:
    """Assemble the hooks of child Gaussians, which do not rotate before `warm_up`.

    Opacities and colors are those of the canonical state: changes of the cores' opacity
    by a motion have no effect.

    Args:
      spec: Settings of the children.
      steps: Length of the run in steps.
      warm_up: Steps before the motion begins.

    Returns:
      The record.
    """

    def rates(step):
        children = Carried(
            spec.offset_rate,
            spec.log_scale_rate,
            spec.quaternion_rate,
            spec.opacity_rate,
            spec.sh_dc_rate,
            spec.sh_rest_rate,
        )
        if spec.turns is None:
            return MotionParams(children)
        first, last = spec.turns.learning_rate, spec.turns.learning_rate_end
        return MotionParams(children, schedules.log_linear(first, last, steps)(step))

    def derive_rows(
        params: Params, condition: FrameCondition | None
    ) -> tuple[Splats, None]:
        del condition
        return canonical_children(params.rows["splats"], params.rows[NAME]), None

    def turn_of(params, condition):
        children = params.rows[NAME]

        def evaluate(network, children):
            return turns(network, spec.turns, children, condition.time)

        if not warm_up or condition.step is None:
            return evaluate(params.nets[NAME], children)
        return jax.lax.cond(
            condition.step < warm_up,
            lambda _, children: jnp.zeros_like(children.offset),
            evaluate,
            params.nets[NAME],
            children,
        )

    def derive(
        params: Params,
        derived: tuple[Splats, None],
        rows: Gaussians,
        condition: FrameCondition,
    ) -> Gaussians:
        turn = None if spec.turns is None else turn_of(params, condition)
        return pose_children(params.rows[NAME], turn, derived[0], rows)

    def init(key, gaussians):
        rows_key, shared_key = jax.random.split(key)
        children = _init_rows(rows_key, spec, gaussians)
        if spec.turns is None:
            return MotionParams(children)
        return MotionParams(children, mlp.init(network_spec(spec.turns), shared_key))

    return SplatRecord(
        name=NAME,
        init=init,
        learning_rate=rates,
        derive_rows=derive_rows,
        derive=derive,
    )


def _flat(leaf):
    """Reshape [cores, children, ...] to [cores * children, ...]."""
    cores, children, *rest = leaf.shape
    return leaf.reshape(cores * children, *rest)
