"""Fit latent codes of a trained field to a loss, with a choice of solvers.

Inverse warps are in `tracks`, and cameras in `evaluation.fitted_cameras`. Convergence
is reported by a flag, never by an exception. The flag is computed from the result,
because solvers report only on their last step. jaxopt is imported in this file only.
jaxopt and optimistix are imported when one of their solvers is used.
"""

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int

PyTree = Any
Scalar = Float[Array, ""]


class Fit(NamedTuple):
    """Result of one solve, with leading axes if it was vmapped."""

    value: PyTree  # finite if the initial value is, also without convergence
    converged: Bool[Array, "*batch"]
    steps: Int[Array, "*batch"]
    residual: Float[Array, "*batch"]  # quantity to be made zero, at `value`


def check_positive(**values):
    """Check that numbers are positive and finite.

    Args:
      **values: Numbers by name.

    Raises:
      ValueError: If one is not, with its name and value.
    """
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise ValueError(f"{name}={value} must be positive and finite")


def as_int32(steps) -> Int[Array, "*batch"]:
    """Convert step counts to int32. Solvers count in the default integer type.

    Args:
      steps: Step counts, [...].

    Returns:
      The counts as int32, [...].
    """
    return jnp.asarray(steps, jnp.int32)


def fit_code(
    loss: Callable[[PyTree], Scalar],
    start: PyTree,
    solver: str = "lbfgs",
    max_steps: int = 100,
    tolerance: float = 1e-4,
) -> Fit:
    """Minimize a loss over a latent code.

    The result is never worse than `start`, which is returned if the loss is not finite
    there. The result has no derivatives. docs/results/solver_table.md
    compares the solvers.

    Args:
      loss: Function from a code to a scalar.
      start: Initial code, any pytree of floats of one dtype.
      solver: Name of one of `CODE_SOLVERS`. "lbfgs" is that of optax.
      max_steps: Largest number of steps.
      tolerance: Norm of the gradient (loss per unit of code) that counts as converged.

    Returns:
      The fit, with the code as `value`. `residual` is the norm of the gradient.

    Raises:
      ValueError: If the solver is unknown, a bound is not positive, or the code has
        mixed or integer types.
    """
    check_positive(max_steps=max_steps, tolerance=tolerance)
    if solver not in CODE_SOLVERS:
        raise ValueError(
            f"unknown solver {solver!r}; choose from {sorted(CODE_SOLVERS)}"
        )
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(start)]
    dtypes = {leaf.dtype.name for leaf in leaves}
    if len(dtypes) != 1 or not jnp.issubdtype(leaves[0].dtype, jnp.floating):
        raise ValueError(
            f"a code must have one floating-point dtype, got {sorted(dtypes)}"
        )
    flat, rebuild = jax.flatten_util.ravel_pytree(lax.stop_gradient(start))

    def flat_loss(code):
        return loss(rebuild(code))

    # jaxopt and optax add integer steps to floats. The loss itself is also traced
    # outside of this context, under strict promotion.
    with jax.numpy_dtype_promotion("standard"):
        minimum, steps = CODE_SOLVERS[solver](flat_loss, flat, max_steps, tolerance)
    minimum = lax.stop_gradient(minimum)
    final_loss = flat_loss(minimum)
    better = jnp.isfinite(final_loss) & (final_loss <= flat_loss(flat))
    code = jnp.where(better, minimum, flat)
    value, grad = jax.value_and_grad(flat_loss)(code)
    residual = _length(grad)
    is_converged = jnp.isfinite(value) & (residual <= tolerance)
    return Fit(rebuild(code), is_converged, as_int32(steps), residual)


# (loss of a flat code, start, max_steps, tolerance) -> code, steps
CodeSolver = Callable[[Callable, Array, int, float], tuple[Array, Array]]


def _jaxopt_lbfgs(loss, start, max_steps, tolerance):
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", "JAXopt is no longer maintained", DeprecationWarning
        )
        import jaxopt
    solver = jaxopt.LBFGS(
        loss,
        maxiter=max_steps,
        tol=tolerance,
        # Otherwise a line search that fails because of rounding is repeated to the end.
        stop_if_linesearch_fails=True,
        # jaxopt's custom derivative does not support losses that close over tracers.
        implicit_diff=False,
        unroll=False,
    )
    code, state = solver.run(start)
    return code, state.iter_num


def _optimistix_solver(name):
    def solve(loss, start, max_steps, tolerance):
        import optimistix

        solver = getattr(optimistix, name)
        # The stopping criterion is the change of code and loss, not the gradient.
        ulps = 4 * float(jnp.finfo(start.dtype).eps)
        # L-BFGS stores its history in the default precision and accepts no other.
        default = jnp.result_type(float)
        solution = optimistix.minimise(
            lambda code, _: loss(code.astype(start.dtype)).astype(default),
            solver(rtol=ulps, atol=tolerance / 100, norm=optimistix.two_norm),
            start.astype(default),
            max_steps=max_steps,
            throw=False,
        )
        return solution.value.astype(start.dtype), solution.stats["num_steps"]

    return solve


def _optax_solver(transformation):
    """Make a solver from an optax transformation, which returns the best code."""

    def solve(loss, start, max_steps, tolerance):
        rule = optax.with_extra_args_support(transformation(max_steps))

        def has_more(state):
            _, _, _, grad, _, step = state
            return (step < max_steps) & (_length(grad) > tolerance)

        def descend(state):
            code, memory, value, grad, best, step = state
            updates, memory = rule.update(
                grad, memory, code, value=value, grad=grad, value_fn=loss
            )
            code = optax.apply_updates(code, updates)
            value, grad = jax.value_and_grad(loss)(code)
            # Close to the minimum, rounding hides which code has the smaller loss.
            better = (value < best[1]) | (_length(grad) <= tolerance)
            best = (
                jnp.where(better, code, best[0]),
                jnp.where(better, value, best[1]),
            )
            return code, memory, value, grad, best, step + 1

        value, grad = jax.value_and_grad(loss)(start)
        state = start, rule.init(start), value, grad, (start, value), jnp.int32(0)
        *_, best, steps = lax.while_loop(has_more, descend, state)
        return best[0], steps

    return solve


CODE_SOLVERS: Mapping[str, CodeSolver] = {
    "lbfgs": _optax_solver(lambda steps: optax.lbfgs()),
    "bfgs": _optimistix_solver("BFGS"),
    "optimistix-lbfgs": _optimistix_solver("LBFGS"),
    "jaxopt-lbfgs": _jaxopt_lbfgs,
    # With rates of 0.01, 0.03, 0.1 and 0.3 the loss after 200 steps is 6e-4, 5e-5, 1e-6
    # and 6e-10 above the minimum of docs/results/solver_table.md. Larger rates are
    # worse after 50 steps.
    "adam": _optax_solver(
        lambda steps: optax.adam(optax.cosine_decay_schedule(0.2, steps))
    ),
}


def _length(vector):
    return jnp.sqrt(jnp.sum(vector**2))
