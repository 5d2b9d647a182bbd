"""Phases of training: alternating updates and annealing of positions.

MoBa-GS, sections 3.6 and 3.5 (equation 8). All are functions of a traced step, so that
a chunk of any length is one program. The phase before them, a warm-up without motion,
belongs to each motion (`SplatRecord.warm_up`).
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
SHARED = "shared"  # labels optimizer state that mirrors no parameter


@dataclasses.dataclass(frozen=True)
class AlternationSpec:
    """Alternate between networks and per-Gaussian parameters from `start` to `stop`.

    `nets` steps for the shared parameters are followed by `rows` steps for the
    per-Gaussian parameters. Outside of this interval all parameters train. In the paper
    the interval lies between densification and the annealing of positions.
    """

    start: int = steps()  # step
    stop: int = steps()  # first step in which all parameters train again
    nets: int = 2  # steps of a cycle
    rows: int = 1  # steps of a cycle

    def __post_init__(self):
        if not 0 <= self.start <= self.stop:
            raise ValueError(
                "an alternation needs 0 <= start <= stop, got "
                f"start={self.start} and stop={self.stop}; disable it (None) to train "
                "all parameters in every step"
            )
        if self.nets < 1 or self.rows < 1:
            raise ValueError(
                "each phase of an alternation needs at least one step, got "
                f"nets={self.nets} and rows={self.rows}; parameters without a phase "
                "would not train between start and stop"
            )


@dataclasses.dataclass(frozen=True)
class AnnealingSpec:
    """Decay of the learning rate of positions from step `after` on.

    The paper does not give the rate of its second phase, and of its beginning only that
    it is a share of the run (3/4 here). `annealed` computes the rate.
    """

    after: int = steps()  # step
    decay: float = 5.0  # the rate decays to exp(-decay) by the end of the run
    freeze_share: float = 0.05  # share of the run, at its end, with a rate of zero

    def __post_init__(self):
        if self.after < 0:
            raise ValueError(f"after={self.after} must not be negative")
        if not 0 <= self.decay < math.inf:
            raise ValueError(f"decay={self.decay} must be finite and not negative")
        if not 0 <= self.freeze_share < 1:
            raise ValueError(
                f"freeze_share={self.freeze_share} of the run must lie in [0, 1); "
                "to train shared parameters only, set the rate of the means to zero"
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
    """Return the parameter groups that train at a step.

    Args:
      spec: Settings of the alternation. None to train both groups.
      step: Number of completed steps.

    Returns:
      Booleans of the groups.
    """
    step = jnp.asarray(step, jnp.int32)
    if spec is None:
        return UpdateMask(jnp.asarray(True), jnp.asarray(True))
    outside = (step < spec.start) | (step >= spec.stop)
    # Python's remainder is not negative before `start`, where `outside` decides.
    position = (step - spec.start) % (spec.nets + spec.rows)
    return UpdateMask(
        outside | (position >= spec.nets), outside | (position < spec.nets)
    )


def freeze(
    optimizer: optax.GradientTransformation,
    mask: UpdateMask,
    before: Trained,
    after: Trained,
) -> Trained:
    """Undo a step for the frozen parameter group, including its moments and counts.

    Zero gradients would not suffice, because Adam's momentum would still move frozen
    parameters. Optax identifies the state that mirrors a parameter. A count belongs to
    the group with which it shares the smallest part of the state. It is refused if that
    part has both groups (`optax.adam` for all parameters).

    Args:
      optimizer: The optimizer.
      mask: Groups that the step trains.
      before: Parameters and optimizer state before the step.
      after: Parameters and optimizer state after the step.

    Returns:
      The state after the step, with the frozen group unchanged, bit for bit.
    """
    # A selection, not a branch. At 10k Gaussians of 59 numbers on one core, a step of
    # Adam takes 2.2 ms (2.8 ms with 524k network parameters), 1.7 (2.9) with the
    # selection and 0.9 (1.4) with branches. Branches overwrite fewer buffers and need
    # an optimizer for each group. Rendering takes 30 ms.
    params = _by_group(before.params)
    moments = _groups_of_moments(optimizer, params, before.opt_state)

    def select(group, old, new):
        return jnp.where(getattr(mask, group), new, old)

    return jax.tree.map(select, Trained(params, moments), before, after)


def stop_frozen_gradients(
    mask: UpdateMask, function: Callable[..., PyTree]
) -> Callable[..., PyTree]:
    """Skip the computation of gradients of frozen networks.

    Forward and backward of 10k Gaussians on one core take 127 ms instead of 539 for
    8x256, and 29 instead of 98 for 4x128. When the networks train, they take 537 and 96
    ms.

    Args:
      mask: Groups that the step trains.
      function: `function(params, ...)`.

    Returns:
      A function with the same values, whose gradients are zero for frozen networks.
    """

    def frozen(params, *others):
        return function(
            params._replace(nets=jax.lax.stop_gradient(params.nets)), *others
        )

    def either(params, *others):
        return jax.lax.cond(mask.nets, function, frozen, params, *others)

    return either


def annealed(rate: Schedule, spec: AnnealingSpec, steps: int) -> Schedule:
    """Anneal a learning rate: exponential decay after `spec.after`, zero at the end.

    Equation 8 with eta_anneal(i) = eta_main(a) exp(-decay (i - a) / (steps - a)), where
    a = `spec.after`. The rate is continuous at a. It is zero in the last `freeze_share`
    of the steps.

    Args:
      rate: The schedule before annealing.
      spec: Settings.
      steps: Total number of steps.

    Returns:
      The annealed schedule.

    Raises:
      ValueError: If annealing begins after the positions are frozen.
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
        # Subtracted as integers, so exp(0) is exactly 1 up to `after`.
        elapsed_steps = jnp.clip(step - spec.after, 0, length)
        progress = elapsed_steps.astype(jnp.result_type(float)) / length
        main = rate(jnp.minimum(step, spec.after))
        return jnp.where(step >= frozen, 0.0, main * jnp.exp(-spec.decay * progress))

    return schedule


def _by_group(params):
    """Label each leaf with its parameter group, for `optax.multi_transform`."""
    parts = zip(Params._fields, params, strict=True)
    return Params(*(jax.tree.map(lambda _, n=name: n, part) for name, part in parts))


def _groups_of_moments(optimizer, groups, moments):
    """Label each leaf of the optimizer's state with its parameter group."""

    def is_masked(node):
        return isinstance(node, optax.MaskedNode)

    labels = optax.tree_utils.tree_map_params(
        optimizer,
        lambda moment, group: moment if is_masked(moment) else group,
        moments,
        groups,
        transform_non_params=lambda _: SHARED,
        is_leaf=is_masked,
    )
    leaves, structure = jax.tree_util.tree_flatten_with_path(labels)
    return jax.tree.unflatten(structure, [_owner(path, leaves) for path, _ in leaves])


def _owner(path, leaves):
    """Return the group of the smallest part of the state around `path` that has one."""
    for depth in range(len(path), -1, -1):
        prefix = path[:depth]
        owners = {
            label for leaf_path, label in leaves if leaf_path[:depth] == prefix
        } - {SHARED}
        if len(owners) == 1:
            return owners.pop()
        if owners:
            break
    name = jax.tree_util.keystr(path, simple=True, separator=".")
    raise ValueError(
        f"the optimizer's {name} belongs to both per-Gaussian and shared parameters, "
        "so it cannot be frozen for one of them; give each its own with "
        "`optax.partition`, or use `scale_by_row_adam`, which counts per leaf"
    )
