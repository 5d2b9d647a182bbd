"""When what is trained: alternating updates and the annealing of the positions.

MoBa-GS, sections 3.6 and 3.5 (equation 8). All are functions of a traced step, so that
a chunk of any length is one program. The phase before them, a warm-up without motion,
belongs to each motion: `SplatRecord.warm_up`.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Int

from gaussians_jax.core.splats import Params
from nerfies_jax.training.schedules import Schedule
from nerfies_jax.training.step_counts import steps

PyTree = Any
SHARED = "shared"  # marks what mirrors no parameter in an optimizer's state


@dataclasses.dataclass(frozen=True)
class AlternationSpec:
    """Alternate between networks and per-Gaussian parameters from `start` to `stop`.

    `nets` steps for the networks are followed by `rows` steps for the per-Gaussian
    parameters. Outside of this interval everything trains. The paper alternates between
    the end of densification and the annealing of positions.
    """

    start: int = steps()  # step
    stop: int = steps()  # the first step in which everything trains again
    nets: int = 2  # steps of a cycle
    rows: int = 1  # steps of a cycle

    def __post_init__(self):
        if not 0 <= self.start <= self.stop:
            raise ValueError(
                "an alternation needs 0 <= start <= stop, got "
                f"start={self.start} and stop={self.stop}; leave it out (None) where "
                "everything shall train in every step"
            )
        if self.nets < 1 or self.rows < 1:
            raise ValueError(
                "each turn of an alternation has at least one step, got "
                f"nets={self.nets} and rows={self.rows}; a group without a turn would "
                "not train between start and stop"
            )


@dataclasses.dataclass(frozen=True)
class AnnealingSpec:
    """From step `after` on the canonical positions learn less and less, then nothing.

    The paper gives neither its second phase's rate nor its beginning, only that it is a
    share of the run (3/4 here). `annealed` has the rate.
    """

    after: int = steps()  # step
    decay: float = 5.0  # the rate would fall to exp(-decay) by the end of the run
    freeze_share: float = 0.05  # of the whole run: its last steps, with a rate of zero

    def __post_init__(self):
        if self.after < 0:
            raise ValueError(f"annealing begins at a step >= 0, got after={self.after}")
        if not 0 <= self.decay < math.inf:
            raise ValueError(f"decay={self.decay} must be finite and not negative")
        if not 0 <= self.freeze_share < 1:
            raise ValueError(
                f"freeze_share={self.freeze_share} of the run must lie in [0, 1); "
                "to train nothing but networks, set the rate of the means to zero"
            )


class UpdateMask(NamedTuple):
    """Parameter groups that a step trains."""

    rows: Bool[Array, ""]
    nets: Bool[Array, ""]


class Trained(NamedTuple):
    """Parameters with the state of their optimizer."""

    params: Params
    opt_state: PyTree


def update_mask(spec: AlternationSpec | None, step: Int[Array, ""] | int) -> UpdateMask:
    """Whose turn it is at a traced step."""
    step = jnp.asarray(step, jnp.int32)
    if spec is None:
        return UpdateMask(jnp.asarray(True), jnp.asarray(True))
    outside = (step < spec.start) | (step >= spec.stop)
    # Before `start` the remainder is not negative either, and `outside` decides.
    place = (step - spec.start) % (spec.nets + spec.rows)
    return UpdateMask(outside | (place >= spec.nets), outside | (place < spec.nets))


def freeze(
    optimizer: optax.GradientTransformation,
    mask: UpdateMask,
    before: Trained,
    after: Trained,
) -> Trained:
    """Undo a step for the frozen parameter group, including its moments and counts.

    Zero gradients would not suffice: Adam's momentum goes on moving frozen parameters.
    Optax identifies the state that mirrors a parameter. A count belongs to the group
    with which it shares the smallest part of the state, and is refused if that is both
    (`optax.adam` over everything).

    Args:
      optimizer: The optimizer.
      mask: Groups that the step trains.
      before: Parameters and optimizer state before the step.
      after: The same after the step.

    Returns:
      The state after the step with the frozen group of before, bit for bit.
    """
    # Selected, not branched over: at 10k rows of 59 numbers, one core, a step of Adam
    # takes 2.2 ms (2.8 ms with 524k numbers of networks), 1.7 (2.9) with the selection
    # and 0.9 (1.4) in branches, which know less than `jnp.where` of what they may
    # overwrite and need an optimizer for each group. Drawing takes 30 ms.
    params = _by_group(before.params)
    moments = _groups_of_moments(optimizer, params, before.opt_state)

    def kept(group, old, new):
        return jnp.where(getattr(mask, group), new, old)

    return jax.tree.map(kept, Trained(params, moments), before, after)


def stop_frozen_gradients(
    mask: UpdateMask, function: Callable[..., PyTree]
) -> Callable[..., PyTree]:
    """Skip the computation of gradients of frozen networks.

    Forward and backward of 10k Gaussians on one core, 539 ms become 127 ms for 8x256,
    and 98 become 29 for 4x128. When the networks train, it takes 537 and 96 ms.

    Args:
      mask: Groups that the step trains.
      function: `function(params, ...)`.

    Returns:
      A function with the same values, whose gradients are zero for frozen networks.
    """

    def frozen(params, *rest):
        return function(params._replace(nets=jax.lax.stop_gradient(params.nets)), *rest)

    def either(params, *rest):
        return jax.lax.cond(mask.nets, function, frozen, params, *rest)

    return either


def annealed(rate: Schedule, spec: AnnealingSpec, steps: int) -> Schedule:
    """`rate` up to `spec.after`, decaying from its value there, at last zero.

    Equation 8 with eta_anneal(i) = eta_main(a) exp(-decay (i - a) / (steps - a)), where
    a = `spec.after`: continuous at a. The last `freeze_share` of the steps get 0. In a
    run of few steps nothing may lie between the two.
    """
    frozen = steps - round(spec.freeze_share * steps)
    if spec.after > frozen:
        raise ValueError(
            f"annealing from step {spec.after} on comes too late: of {steps} steps "
            f"those from {frozen} on are frozen; begin earlier (3/4 of the run is "
            f"{3 * steps // 4}) or lower freeze_share={spec.freeze_share}"
        )
    length = max(steps - spec.after, 1)

    def schedule(step):
        step = jnp.asarray(step, jnp.int32)
        # Subtracted as integers: exactly 0 up to `after`, where exp(0) is exactly 1.
        passed = jnp.clip(step - spec.after, 0, length)
        share = passed.astype(jnp.result_type(float)) / length
        main = rate(jnp.minimum(step, spec.after))
        return jnp.where(step >= frozen, 0.0, main * jnp.exp(-spec.decay * share))

    return schedule


def _by_group(params):
    """Label each leaf with its parameter group, for `optax.multi_transform`."""
    parts = zip(Params._fields, params, strict=True)
    return Params(*(jax.tree.map(lambda _, n=name: n, part) for name, part in parts))


def _groups_of_moments(optimizer, groups, moments):
    """Label each leaf of the optimizer's state with its parameter group."""

    def hidden(node):
        return isinstance(node, optax.MaskedNode)

    marked = optax.tree_utils.tree_map_params(
        optimizer,
        lambda moment, group: moment if hidden(moment) else group,
        moments,
        groups,
        transform_non_params=lambda _: SHARED,
        is_leaf=hidden,
    )
    leaves, structure = jax.tree_util.tree_flatten_with_path(marked)
    return jax.tree.unflatten(structure, [_owner(path, leaves) for path, _ in leaves])


def _owner(path, leaves):
    """The group of the smallest part of the state around `path` that has one."""
    for depth in range(len(path), -1, -1):
        around = path[:depth]
        owners = {mark for where, mark in leaves if where[:depth] == around} - {SHARED}
        if len(owners) == 1:
            return owners.pop()
        if owners:
            break
    name = jax.tree_util.keystr(path, simple=True, separator=".")
    raise ValueError(
        f"the optimizer's {name} belongs to rows and networks alike, so it cannot stay "
        "as it is for one of them; give each its own by `optax.partition`, or use "
        "`scale_by_row_adam`, which counts for each leaf"
    )
