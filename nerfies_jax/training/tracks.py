"""Inverse warps, and tracks of points through time that are computed from them.

A warp maps observed points to canonical points, x + d(x) = c. Its inverse has no closed
form. Where the warp folds, there are several solutions or none, which is reported by
flags.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix
from jax import lax
from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.training.fit import Fit, as_int32, check_positive

PyTree = Any
Vector = Float[Array, "3"]


@dataclasses.dataclass(frozen=True)
class InverseSpec:
    """Settings of the inversion of a warp, and its convergence criteria.

    A solve has converged if |x + d(x) - c| <= atol + rtol max|c|, in units of the
    field, and if the warp preserves orientation at x (det J > 0). If `reach` is
    positive, six more solves start at this distance along the axes. If one of them ends
    at another root, the point is observed at several positions, and the flag is False.
    This check is off by default because of its cost.
    """

    atol: float = 1e-5  # units of the field, as in the Broyden iteration of dycheck
    rtol: float = 1e-6  # 8 ulps of a float32 coordinate
    max_steps: int = 32  # of Newton's method
    continuation: int = (
        8  # steps from the identity to the warp without an initial guess
    )
    reach: float = 0.0  # units of the field

    def __post_init__(self):
        check_positive(atol=self.atol, max_steps=self.max_steps)
        for name in ("rtol", "continuation", "reach"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name}={value} must be finite and not negative")


def inverse_warp(
    displace: Callable[[PyTree, Vector], Vector],
    params: PyTree,
    canonical_point: Vector,
    start: Vector | None = None,
    spec: InverseSpec = InverseSpec(),
) -> Fit:
    """Find the observed point x with x + displace(params, x) = `canonical_point`.

    Without a `start`, x + s d(x) = c is followed from s = 0, where x = c, to s = 1.
    docs/numerics.md compares this with a solver that starts at c. Derivatives with
    respect to `params` and `canonical_point` are those of the implicit function, and
    zero where the flag is False. Other values that `displace` closes over are treated
    as constants.

    Args:
      displace: Displacement d, a function of parameters and a point [3].
      params: Parameters of the displacement.
      canonical_point: Canonical point c in units of the field, [3].
      start: Initial guess of x, [3], or None.
      spec: Solver settings and convergence criteria.

    Returns:
      The fit, with x as `value`. `residual` is |x + d(x) - c|.
    """
    frozen = lax.stop_gradient((params, canonical_point))
    if start is None:
        start = _continuation(displace, *frozen, spec.continuation)
    start = lax.stop_gradient(start)
    root, steps = _newton(displace, *frozen, start, spec)
    is_converged = _is_valid_root(displace, *frozen, root, spec)
    if spec.reach:
        directions = jnp.concatenate([jnp.eye(3), -jnp.eye(3)]).astype(root.dtype)
        others = jax.vmap(
            lambda axis: _newton(displace, *frozen, root + spec.reach * axis, spec)[0]
        )(directions)
        is_root = jax.vmap(lambda x: _is_root(displace, *frozen, x, spec))(others)
        distinct = jnp.max(jnp.abs(others - root), axis=-1) > spec.reach / 100
        is_converged &= ~jnp.any(is_root & distinct)
    value = _implicit(displace, params, canonical_point, root, is_converged)
    # Without a root the initial guess is better, because Newton's method may have
    # diverged. A root that is folded or not unique is kept. Its residual is small.
    root = jnp.where(_is_root(displace, *frozen, root, spec), root, start)
    value = jnp.where(is_converged, value, root)
    residual = _norm(_excess(displace, *frozen, lax.stop_gradient(value)))
    return Fit(value, is_converged, steps, residual)


class Tracks(NamedTuple):
    """Positions of points through time, in the coordinates of the warp."""

    points: Float[Array, "points times 3"]
    converged: Bool[Array, "points times"]


def point_tracks(
    displace: Callable[[PyTree, Vector, PyTree], Vector],
    params: PyTree,
    points: Float[Array, "points 3"],
    conditions: PyTree,
    row: int | None = None,
    spec: InverseSpec = InverseSpec(),
) -> Tracks:
    """Track points through time by inverting a warp.

    Points are tracked forward and backward from the time at which they are known. Each
    solve starts at the previous position. If a point is lost, its flag is False and its
    position is the last known one.

    Args:
      displace: Displacement, a function of parameters, a point [3] and the conditioning
        at one time.
      params: Parameters of the displacement.
      points: Points in units of the field, [points, 3].
      conditions: Conditioning at all times, a pytree with times along the first axis.
      row: Index of the time at which the points were observed. None for canonical
        points.
      spec: Solver settings and convergence criteria.

    Returns:
      Positions [points, times, 3] and convergence flags [points, times].

    Raises:
      ValueError: If `row` is out of range.
    """
    count = jax.tree.leaves(conditions)[0].shape[0]
    if row is not None and not 0 <= row < count:
        raise ValueError(
            f"row={row} is not in 0 .. {count - 1}; it is the index of the time at "
            "which the points were observed, or None for canonical points"
        )
    first = row or 0
    reference = jax.tree.map(lambda leaf: leaf[first], conditions)
    before = jax.tree.map(lambda leaf: leaf[:first][::-1], conditions)
    after = jax.tree.map(lambda leaf: leaf[first + 1 :], conditions)

    def displace_at(inputs, point):
        return displace(inputs[0], point, inputs[1])

    def track(point):
        if row is None:
            canonical = point
            fit = inverse_warp(displace_at, (params, reference), canonical, spec=spec)
            middle, is_converged = fit.value, fit.converged
        else:
            canonical = point + displace(params, point, reference)
            middle, is_converged = point, jnp.all(jnp.isfinite(canonical))

        def advance(position, condition):
            fit = inverse_warp(
                displace_at, (params, condition), canonical, position, spec
            )
            position = jnp.where(fit.converged, fit.value, position)
            return position, (position, fit.converged)

        _, (backward, backward_known) = lax.scan(advance, middle, before)
        _, (forward, forward_known) = lax.scan(advance, middle, after)
        return Tracks(
            jnp.concatenate([backward[::-1], middle[None], forward]),
            jnp.concatenate([backward_known[::-1], is_converged[None], forward_known]),
        )

    return jax.vmap(track)(points)


def _excess(displace, params, canonical_point, point):
    return point + displace(params, point) - canonical_point


def _norm(vector):
    return jnp.sqrt(jnp.sum(vector**2))


def _is_root(displace, params, canonical_point, point, spec):
    """Test if a point is a root. The result for NaN is False."""
    bound = spec.atol + spec.rtol * jnp.max(jnp.abs(canonical_point))
    return _norm(_excess(displace, params, canonical_point, point)) <= bound


def _is_valid_root(displace, params, canonical_point, point, spec):
    grads = jnp.eye(3, dtype=point.dtype) + jax.jacfwd(displace, 1)(params, point)
    is_unfolded = exact_product(grads[0], jnp.cross(grads[1], grads[2])) > 0
    return is_unfolded & _is_root(displace, params, canonical_point, point, spec)


def _newton(displace, params, canonical_point, start, spec):
    # From a close initial guess, Newton's method finds as many roots as dogleg and
    # Levenberg-Marquardt in fewer steps, and needs no second derivatives.
    solution = optimistix.root_find(
        lambda point, inputs: _excess(displace, *inputs, point),
        optimistix.Newton(rtol=spec.rtol, atol=spec.atol),
        start,
        (params, canonical_point),
        max_steps=spec.max_steps,
        throw=False,
    )
    return lax.stop_gradient(solution.value), as_int32(solution.stats["num_steps"])


def _continuation(displace, params, canonical_point, steps):
    """Make a Newton step on x + s d(x) = c for each of `steps` values of s up to 1."""

    def step(point, s):
        move, grads = displace(params, point), jax.jacfwd(displace, 1)(params, point)
        jacobian = jnp.eye(3, dtype=point.dtype) + s * grads
        excess = point + s * move - canonical_point
        new_point = point - jnp.linalg.solve(jacobian, excess)
        # The Jacobian can be singular on the way, as for a half turn at s = 1/2.
        return jnp.where(jnp.all(jnp.isfinite(new_point)), new_point, point), None

    factors = jnp.arange(1, steps + 1, dtype=canonical_point.dtype) / max(steps, 1)
    return lax.scan(step, canonical_point, factors)[0]


def _implicit(displace, params, canonical_point, root, is_converged):
    """Make one more Newton step from `root`, with the derivatives of the inverse.

    Without convergence the equation is replaced by x = root, whose Jacobian is the
    identity, so that no singular matrix is inverted.
    """
    root = jnp.where(jnp.all(jnp.isfinite(root)), root, 0)

    def equation(point, inputs):
        excess = _excess(displace, *inputs, point)
        return jnp.where(is_converged, excess, point - root)

    return optimistix.root_find(
        equation,
        optimistix.Newton(rtol=0.0, atol=0.0),
        root,
        (params, canonical_point),
        max_steps=1,
        throw=False,
    ).value
