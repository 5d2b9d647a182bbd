"""Adam and RAdam with one step count per Gaussian, and the gather of their moments."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
import scipy.special
from jaxtyping import Array, Bool, Float, Int

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Params

PyTree = Any


class RowAdamState(NamedTuple):
    """Moments, and the number of updates of each Gaussian."""

    count: PyTree  # int32, [capacity] for every leaf
    first: PyTree
    second: PyTree


def scale_by_row_adam(
    b1: float = 0.9, b2: float = 0.999, eps: float = 1e-15
) -> optax.GradientTransformation:
    """Create Adam (Kingma and Ba, arXiv:1412.6980) with a step count per Gaussian.

    The first axis of all parameters must be that of the Gaussians. Moments and count of
    a Gaussian that is created late start at zero. With a shared count of 1000 its first
    five updates would be 2.5, 3.4, 3.9, 4.3 and 4.6 times too large for a constant
    gradient, as in the reference implementations. A Gaussian starts to count at its
    first nonzero gradient, so that harmonics that are enabled late and networks that
    wait for a warm-up start in the same way.

    Args:
      b1: Decay of the first moment.
      b2: Decay of the second moment.
      eps: Added to the denominator. This is the value of 3DGS: 1e-8 would halve the
        steps where gradients are 1e-8.

    Returns:
      An optax transformation.
    """

    def direction(age, first, second):
        del age
        return first / (jnp.sqrt(second) + eps)

    return _scale_by_row_moments(b1, b2, direction)


def scale_by_row_radam(
    b1: float = 0.9, b2: float = 0.999, eps: float = 1e-15, threshold: float = 5.0
) -> optax.GradientTransformation:
    """Create RAdam (Liu et al. 2020, arXiv:1908.03265) with a step count per Gaussian.

    Counts and moments are those of `scale_by_row_adam`. While the `moment_length` of a
    Gaussian is below `threshold` (its first five updates at b2 = 0.999), updates are
    its mean gradient without normalization. After that they are Adam's times
    `rectification`: 0.026 at first, 0.5 after 556 updates and 0.92 after 3000. A
    Gaussian that is created late has 0.15 of Adam's step after 50 updates and 0.31
    after 200.

    Args:
      b1: Decay of the first moment.
      b2: Decay of the second moment.
      eps: Added to the denominator.
      threshold: Length at which to switch. The paper uses 4, its code and optax use 5.

    Returns:
      An optax transformation.

    Raises:
      ValueError: If a decay or the threshold is out of its range.
    """
    _check_decays(b1, b2)
    max_length = _max_length(b2)
    if not 4 <= threshold < max_length:
        raise ValueError(
            f"threshold={threshold} must lie in [4, {max_length:g}), where the upper "
            f"bound follows from b2={b2}; raise b2 or choose a threshold in between"
        )

    def direction(age, first, second):
        length = moment_length(age, b2)
        adaptive_step = rectification(length, b2) * first / (jnp.sqrt(second) + eps)
        return jnp.where(length < threshold, first, adaptive_step)

    return _scale_by_row_moments(b1, b2, direction)


def moment_length(updates: Float[Array, "*rows"], b2: float) -> Float[Array, "*rows"]:
    """Compute the effective number of gradients in the second moment.

    rho_t = rho_inf - 2 t b2^t / (1 - b2^t) with rho_inf = 2 / (1 - b2) - 1, algorithm 2
    of Liu et al. 2020. It increases from 1 to rho_inf.

    Args:
      updates: Number of updates t, at least 1.
      b2: Decay of the second moment.

    Returns:
      The length rho_t.
    """
    # With L = -log b2 and h(x) = x coth x - 1 it is t - (2 / L) (h(tL/2) - h(L/2)).
    # The printed form has an error of 0.03 in float32 around t = 5, the threshold,
    # because rho_inf is 1999 and 1 - b2^t has four digits. Nothing cancels for tL > 1.
    rate = -math.log(b2)
    is_near = updates * rate < 1
    x_sq = jnp.square(jnp.where(is_near, updates, 1) * (rate / 2))
    series = updates - (2 / rate) * (_coth_excess(x_sq) - _coth_excess(rate**2 / 4))
    far_updates = jnp.where(is_near, 1 / rate, updates)
    return jnp.where(
        is_near,
        series,
        _max_length(b2) - 2 * far_updates / jnp.expm1(far_updates * rate),
    )


def rectification(length: Float[Array, "*rows"], b2: float) -> Float[Array, "*rows"]:
    """Compute RAdam's variance rectification, r_t of Liu et al. 2020, algorithm 2.

    Args:
      length: Length rho_t (`moment_length`).
      b2: Decay of the second moment.

    Returns:
      Factor of the step, at most 1, and zero up to a length of 4, where the variance is
      not finite.
    """
    max_length = _max_length(b2)
    usable = jnp.maximum(length, 4)
    scale = max_length / ((max_length - 4) * (max_length - 2))
    return jnp.sqrt((usable - 4) * (usable - 2) / usable * scale)


def _max_length(b2):
    return (1 + b2) / (1 - b2)


# x coth x - 1 as a series in x^2 with radius pi^2. Ten terms have an error of 1e-17 at
# x = 1/2. Python floats, because NumPy's would promote float32 to float64 with x64.
_COTH = tuple(
    float(2 * (-1) ** (n + 1) * scipy.special.zeta(2 * n) / math.pi ** (2 * n))
    for n in range(1, 11)
)


def _coth_excess(x_sq):
    value = 0 * x_sq
    for coefficient in reversed(_COTH):
        value = (value + coefficient) * x_sq
    return value


def _scale_by_row_moments(b1, b2, direction):
    """Create updates `direction(age, mean gradient, mean squared gradient)`.

    The square of a gradient above 5e20 is infinite in float32, and a parameter divided
    by it never changes again. The loop checks moments as well, and stops. (Scaling
    would not help: float64 forgets a gradient of 1e20 after 9e4 updates.)
    """
    _check_decays(b1, b2)

    def init(params):
        _check_wide(params)

        def count(leaf):
            return jnp.zeros(leaf.shape[:1], jnp.int32)

        zeros = jax.tree.map(jnp.zeros_like, params)
        return RowAdamState(jax.tree.map(count, params), zeros, zeros)

    def update(updates, state, params=None):
        del params
        count = jax.tree.map(_count_once_started, state.count, updates)
        first = jax.tree.map(lambda g, m: b1 * m + (1 - b1) * g, updates, state.first)
        second = jax.tree.map(
            lambda g, v: b2 * v + (1 - b2) * g * g, updates, state.second
        )

        def step(n, m, v):
            # Moments are zero before the first update, so any age but zero is fine.
            age = (
                jnp.maximum(n, 1).astype(m.dtype).reshape(n.shape + (1,) * (m.ndim - 1))
            )
            # 1 - b^n, which cancels in float32 for b = 0.999 and small n.
            correction = -jnp.expm1(age * math.log(b1))
            correction_sq = -jnp.expm1(age * math.log(b2))
            return direction(age, m / correction, v / correction_sq)

        return jax.tree.map(step, count, first, second), RowAdamState(
            count, first, second
        )

    return optax.GradientTransformation(init, update)


def _check_decays(b1, b2):
    if not (0 < b1 < 1 and 0 < b2 < 1):
        raise ValueError(
            f"b1={b1} and b2={b2} must lie strictly between 0 and 1; "
            "0.9 and 0.999 are usual"
        )


def _check_wide(params):
    """Raise for half precision, in which steps of a thousandth round to nothing."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(params)[0]:
        if leaf.dtype.itemsize < 4:
            name = (
                jax.tree_util.keystr(path, simple=True, separator=".") or "parameters"
            )
            raise ValueError(
                f"{name} is {leaf.dtype}, in which small updates round to nothing; "
                "train in float32 and cast where a network is evaluated"
            )


def _count_once_started(count, grads):
    has_gradient = jnp.any(grads.reshape(*count.shape, -1) != 0, axis=-1)
    return count + ((count > 0) | has_gradient).astype(count.dtype)


def _row_leaves(params: Params) -> Params:
    """Mark the leaves that have one entry per Gaussian."""
    return Params(
        rows=jax.tree.map(lambda _: True, params.rows),
        nets=jax.tree.map(lambda _: False, params.nets),
    )


def map_moments(
    optimizer: optax.GradientTransformation,
    change: Callable[[Array], Array],
    moments: PyTree,
    chosen: Params,
) -> PyTree:
    """Apply a function to all optimizer state that mirrors selected parameters.

    Optax identifies that state, not its shape. Parts that `optax.partition` or
    `optax.masked` hide are skipped.

    Args:
      optimizer: The optimizer.
      change: Function of one leaf of the state.
      moments: State of the optimizer.
      chosen: True for the selected parameters.

    Returns:
      The changed state.
    """

    def is_masked(node):
        return isinstance(node, optax.MaskedNode)

    def visit(moment, is_chosen):
        return change(moment) if is_chosen and not is_masked(moment) else moment

    return optax.tree_utils.tree_map_params(
        optimizer, visit, moments, chosen, is_leaf=is_masked
    )


def gather_rows(
    optimizer: optax.GradientTransformation,
    params: Params,
    moments: PyTree,
    rows: Int[Array, " capacity"],
    fresh: Bool[Array, " capacity"],
    inactive: Bool[Array, " capacity"],
) -> tuple[Params, PyTree]:
    """Gather Gaussians in parameters and optimizer state.

    Args:
      optimizer: The optimizer.
      params: All parameters.
      moments: State of the optimizer.
      rows: Index of the Gaussian that each slot takes.
      fresh: Slots whose moments and count start at zero.
      inactive: Slots to deactivate, whose moments and count start at zero as well.

    Returns:
      Parameters and optimizer state of the new capacity.
    """
    new_params = splats.take_rows(params, rows)
    new_rows = splats.deactivate(new_params.rows["splats"], inactive)
    new_params = new_params._replace(rows=new_params.rows | {"splats": new_rows})

    def gather(moment):
        is_reset = (fresh | inactive).reshape(fresh.shape + (1,) * (moment.ndim - 1))
        return jnp.where(is_reset, jnp.zeros_like(moment[:1]), moment[rows])

    return new_params, map_moments(optimizer, gather, moments, _row_leaves(params))
