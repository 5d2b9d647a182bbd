"""Small optimization problems around a trained field: cameras and latent codes.

Inverse warps are in `tracks`. Everything takes plain functions, runs under `jit`, and
reports convergence by a flag, never by an exception. Flags are computed from the
result, since a solver's own report is about its last step only. jaxopt is imported in
this file and nowhere else. Both jaxopt and optimistix are imported only if one of their
solvers is requested.
"""

import dataclasses
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

from nerfies_jax.geometry.camera import Camera, move
from nerfies_jax.geometry.precision import exact_product

PyTree = Any
Scalar = Float[Array, ""]


class Fit(NamedTuple):
    """Result of one solve, with leading axes if it was vmapped."""

    value: PyTree  # finite where the start is, whether or not it converged
    converged: Bool[Array, "*batch"]
    steps: Int[Array, "*batch"]
    residual: Float[Array, "*batch"]  # what was to vanish, at `value`


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


def counted(steps) -> Int[Array, "*batch"]:
    """Convert step counts to int32, since solvers count in the default integer type.

    Args:
      steps: Step counts, [...].

    Returns:
      The counts as int32, [...].
    """
    return jnp.asarray(steps, jnp.int32)


@dataclasses.dataclass(frozen=True)
class CameraSpec:
    """Settings of the refinement of a camera, and its convergence criteria.

    A fit has converged if one more Gauss-Newton step would rotate the camera by less
    than `tolerance` (rad, and for other unknowns a step that changes the residuals as
    much), if the residuals determine all unknowns, and if their root mean square is at
    most `max_residual`. Set that bound wherever wrong minima exist: photometric
    residuals are flat there too.
    """

    unknowns: tuple[str, ...] = ("angular", "linear")  # and "focal"
    tolerance: float = 1e-5  # rad
    max_residual: float = math.inf  # in the residuals' own unit
    max_steps: int = 64

    def __post_init__(self):
        check_positive(tolerance=self.tolerance, max_steps=self.max_steps)
        if not self.max_residual > 0:
            raise ValueError(f"max_residual={self.max_residual} must be positive")
        unknown = set(self.unknowns) - set(_WIDTHS)
        if unknown or not self.unknowns or len(set(self.unknowns)) < len(self.unknowns):
            raise ValueError(
                f"unknowns={self.unknowns} must be different names of {tuple(_WIDTHS)}"
            )


_WIDTHS = {"angular": 3, "linear": 3, "focal": 1}
# Smallest over largest singular value of the Jacobian with columns of unit length. A
# camera that sees a few degrees of a far scene has 1e-3; float32 alone makes 1e-6.
DETERMINED = 1e-4


def refine_camera(
    residuals: Callable[[Camera], Float[Array, "..."]],
    camera: Camera,
    spec: CameraSpec = CameraSpec(),
) -> Fit:
    """Minimize the sum of squared residuals over a camera near the given one.

    The solver is Levenberg-Marquardt. The result carries no derivatives.

    Args:
      residuals: Function from a camera to residuals of any shape.
      camera: Initial camera.
      spec: Unknowns and convergence criteria.

    Returns:
      The fit, with the camera as `value`. `residual` is the root mean square of the
      residuals.

    Raises:
      ValueError: If there are fewer residuals than unknowns.
    """
    camera = jax.tree.map(lambda leaf: lax.stop_gradient(jnp.asarray(leaf)), camera)
    start = jnp.zeros(
        sum(_WIDTHS[name] for name in spec.unknowns), camera.position.dtype
    )

    def unscaled(step):
        return residuals(_stepped(camera, step, spec.unknowns)).reshape(-1)

    grads = jax.jacfwd(unscaled)(start)
    if grads.shape[0] < start.size:
        raise ValueError(
            f"{grads.shape[0]} residuals cannot determine {start.size} unknowns "
            f"{spec.unknowns}; give more, or fewer unknowns"
        )
    # Damping treats all unknowns alike, so they get columns of equal length, and rad,
    # scene units and logarithms of focal length become comparable.
    lengths = jnp.sqrt(jnp.sum(grads**2, axis=0))
    largest = jnp.max(lengths)
    unit = jnp.where(largest > 0, largest, 1)
    scale = jnp.where(lengths > 0, unit / jnp.where(lengths > 0, lengths, 1), 1)

    def scaled(step, _):
        return unscaled(step * scale) / unit

    import optimistix

    solver: optimistix.LevenbergMarquardt[Array, Array, None]
    solver = optimistix.LevenbergMarquardt(
        rtol=spec.tolerance / 10, atol=spec.tolerance / 10
    )
    solution: optimistix.Solution[Array, None] = optimistix.least_squares(
        scaled, solver, start, max_steps=spec.max_steps, throw=False
    )
    step = lax.stop_gradient(solution.value)
    rms = jnp.sqrt(jnp.mean(unscaled(step * scale) ** 2))
    settled = _settled(lambda y: scaled(y, None), step, spec.tolerance)
    converged = settled & (rms <= spec.max_residual)
    step = jnp.where(jnp.all(jnp.isfinite(step)), step, start)
    value = _stepped(camera, step * scale, spec.unknowns)
    return Fit(value, converged, counted(solution.stats["num_steps"]), rms)


def fit_code(
    loss: Callable[[PyTree], Scalar],
    start: PyTree,
    solver: str = "lbfgs",
    max_steps: int = 100,
    tolerance: float = 1e-4,
) -> Fit:
    """Minimize a loss over a latent code.

    The code returned is never worse than `start`, which is returned if the loss is not
    finite there. The result carries no derivatives. docs/results/solver_table.md
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
    kinds = {leaf.dtype.name for leaf in leaves}
    if len(kinds) != 1 or not jnp.issubdtype(leaves[0].dtype, jnp.floating):
        raise ValueError(f"a code is of one floating dtype, got {sorted(kinds)}")
    flat, rebuild = jax.flatten_util.ravel_pytree(lax.stop_gradient(start))

    def flat_loss(code):
        return loss(rebuild(code))

    # jaxopt and optax add steps to floats; the loss is also traced outside, strictly.
    with jax.numpy_dtype_promotion("standard"):
        minimum, steps = CODE_SOLVERS[solver](flat_loss, flat, max_steps, tolerance)
    minimum = lax.stop_gradient(minimum)
    reached = flat_loss(minimum)
    better = jnp.isfinite(reached) & (reached <= flat_loss(flat))
    code = jnp.where(better, minimum, flat)
    value, grad = jax.value_and_grad(flat_loss)(code)
    residual = _length(grad)
    converged = jnp.isfinite(value) & (residual <= tolerance)
    return Fit(rebuild(code), converged, counted(steps), residual)


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
        # Without, a search that fails at the rounding floor is repeated to max_steps.
        stop_if_linesearch_fails=True,
        # The loss closes over tracers, which its custom derivative refuses.
        implicit_diff=False,
        unroll=False,
    )
    code, state = solver.run(start)
    return code, state.iter_num


def _optimistix(name):
    def solve(loss, start, max_steps, tolerance):
        import optimistix

        solver = getattr(optimistix, name)
        # It stops on differences of code and loss, not on the gradient.
        ulps = 4 * float(jnp.finfo(start.dtype).eps)
        # Its L-BFGS keeps its history in the default precision and takes no other.
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


def _optax(transformation):
    """Descent by an optax transformation. Returns the best code of all steps, not the
    last.
    """

    def solve(loss, start, max_steps, tolerance):
        rule = optax.with_extra_args_support(transformation(max_steps))

        def unfinished(state):
            _, _, _, grad, _, step = state
            return (step < max_steps) & (_length(grad) > tolerance)

        def descend(state):
            code, memory, value, grad, best, step = state
            updates, memory = rule.update(
                grad, memory, code, value=value, grad=grad, value_fn=loss
            )
            code = optax.apply_updates(code, updates)
            value, grad = jax.value_and_grad(loss)(code)
            # At the rounding floor the loss no longer tells which code is better.
            better = (value < best[1]) | (_length(grad) <= tolerance)
            best = (
                jnp.where(better, code, best[0]),
                jnp.where(better, value, best[1]),
            )
            return code, memory, value, grad, best, step + 1

        value, grad = jax.value_and_grad(loss)(start)
        state = start, rule.init(start), value, grad, (start, value), jnp.int32(0)
        *_, best, steps = lax.while_loop(unfinished, descend, state)
        return best[0], steps

    return solve


CODE_SOLVERS: Mapping[str, CodeSolver] = {
    "lbfgs": _optax(lambda steps: optax.lbfgs()),
    "bfgs": _optimistix("BFGS"),
    "optimistix-lbfgs": _optimistix("LBFGS"),
    "jaxopt-lbfgs": _jaxopt_lbfgs,
    # Rates of 0.01, 0.03, 0.1, 0.3 end 200 steps 6e-4, 5e-5, 1e-6, 6e-10 above the
    # least loss in docs/results/solver_table.md; beyond, 50 steps get worse.
    "adam": _optax(lambda steps: optax.adam(optax.cosine_decay_schedule(0.2, steps))),
}


def _length(vector):
    return jnp.sqrt(jnp.sum(vector**2))


def _stepped(camera, step, unknowns):
    parts, at = {}, 0
    for name in unknowns:
        parts[name] = step[at : at + _WIDTHS[name]]
        at += _WIDTHS[name]
    none = jnp.zeros(3, step.dtype)
    camera = move(camera, parts.get("angular", none), parts.get("linear", none))
    if "focal" in parts:  # its logarithm: stays positive
        camera = camera._replace(focal_px=camera.focal_px * jnp.exp(parts["focal"][0]))
    return camera


def _settled(residuals, step, tolerance):
    """Test if the next Gauss-Newton step is small and well determined."""
    grads = jax.jacfwd(residuals)(step)
    basis, triangle = jnp.linalg.qr(grads)
    values = jnp.linalg.svd(triangle, compute_uv=False)
    determined = values[-1] > DETERMINED * values[0]
    onward = jax.scipy.linalg.solve_triangular(
        triangle, exact_product(basis.T, residuals(step))
    )
    return determined & (jnp.max(jnp.abs(onward)) <= tolerance)
