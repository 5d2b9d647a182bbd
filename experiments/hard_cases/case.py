"""Hard cases, and the error of a formula on them.

A case sweeps a function to the point where its textbook form loses digits, and compares
both forms with 120-digit arithmetic: value, gradient and, if anything differentiates
twice, curvature. `hard_cases` prints the table, and tests check the bounds.
"""

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from jax.typing import ArrayLike, DTypeLike

ORDERS = ("value", "gradient", "curvature")
ROWS = 16  # a program is compiled for a multiple of so many inputs


class Case(NamedTuple):
    """One function near its hard points.

    `stable` and `textbook` map one input [n] to one output [m], as jit and vmap
    require. `exact` maps n mpmath numbers to a list of m. Inputs are rounded to the
    precision under test first, so the effect of that rounding does not count as an
    error.
    """

    name: str  # "screw near zero"
    breaks: str  # the failure of the textbook form
    formula: str  # the one used
    axis: str  # the swept quantity, with its unit: "θ / rad"
    # [points] the sweep, ascending, float64; from both sides of switches
    at: np.ndarray
    stable: Callable
    textbook: Callable
    exact: Callable
    # By precision: largest error of value, gradient (and curvature). See `errors`.
    bounds: Mapping[str, tuple[float, ...]]
    along: ArrayLike = 1.0  # [n] inputs are multiples of it, by `at`
    points: np.ndarray | None = None  # [points, n] float64 instead
    # Errors are relative to the largest entry of the truth, which counts as at least
    # this: by order, for the points where the truth itself is or nears zero.
    floors: tuple[float, ...] = (0.0, 0.0, 0.0)
    switch: str = "no switch"  # where the formula changes
    timed: np.ndarray | None = None  # [n] a usual input, to time (default: the middle)
    alike: bool = True  # both forms do the same work, so that their times compare

    @property
    def inputs(self) -> np.ndarray:
        """Inputs of the sweep, [points, n]."""
        if self.points is not None:
            return self.points
        return self.at[:, None] * np.atleast_1d(np.asarray(self.along))

    @property
    def orders(self) -> int:
        """Number of tested derivatives, including the value."""
        return max(len(bounds) for bounds in self.bounds.values())


def sides(edge: float) -> list[float]:
    """Return an edge and its neighbors in both precisions, ascending."""
    places = [edge]
    for kind in (np.float32, np.float64):
        places += [
            float(np.nextafter(kind(edge), kind(to))) for to in (-np.inf, np.inf)
        ]
    return sorted(places)


def constant(values: ArrayLike, dtype: DTypeLike) -> jax.Array:
    """Convert to a JAX array without compiling a program, as `jnp.asarray` does."""
    return jax.device_put(np.asarray(values).astype(jnp.dtype(dtype)))


def derivatives(function: Callable, count: int) -> Callable:
    """Differentiate a function of [n].

    The curvature is forward over reverse mode. One trace gives all derivatives: traced
    one by one they take 1.2 times as long to compile.

    Args:
      function: The function, with values [m].
      count: Number of derivatives, including the value.

    Returns:
      A function with the first `count` of value [m], gradient [m, n] and curvature
      [m, n, n].
    """

    def value(x):
        result = function(x)
        return result, (result,)

    def gradient(x):
        result, pull = jax.vjp(function, x)
        unit = np.eye(result.shape[0], dtype=result.dtype)
        gradients = jax.vmap(lambda cotangent: pull(cotangent)[0])(unit)
        return gradients, (result, gradients)

    def curvature(x):
        second, lower = jax.jacfwd(gradient, has_aux=True)(x)
        return second, (*lower, second)

    highest = (value, gradient, curvature)[count - 1]
    return lambda x: highest(x)[1]


def truth(case: Case, inputs: np.ndarray, order: int, digits: int = 120) -> np.ndarray:
    """Compute [points, m, ...] exact values of `derivatives` as float64.

    Derivatives are central differences of `case.exact` with a step of 1e-32, accurate
    to more than 30 digits. A function with a kink inside the step would be averaged.
    """
    with mpmath.workdps(digits):
        return np.array([_differences(case.exact, row, order) for row in inputs])


def _differences(function, row, order):
    step = mpmath.mpf(10) ** -32
    center = [mpmath.mpf(float(x)) for x in row]
    axes = range(len(center))

    @functools.cache
    def after(steps):
        place = [x + count * step for x, count in zip(center, steps, strict=True)]
        return mpmath.matrix(function(place))

    def at(*steps):
        """Evaluate after steps (axis, sign), which may repeat or undo each other."""
        return after(tuple(sum(sign for i, sign in steps if i == j) for j in axes))

    if order == 0:
        return [float(x) for x in at()]
    if order == 1:
        columns = [(at((i, 1)) - at((i, -1))) / (2 * step) for i in axes]
        return [[float(each[m]) for each in columns] for m in range(len(columns[0]))]
    second = {
        (i, j): (_mixed_difference(at, i, j, 1) - _mixed_difference(at, i, j, -1))
        / (4 * step**2)
        for i in axes
        for j in axes
        if i <= j
    }
    return [
        [[float(second[min(i, j), max(i, j)][m]) for j in axes] for i in axes]
        for m in range(len(second[0, 0]))
    ]


def _mixed_difference(at, i, j, sign):
    return at((i, sign), (j, 1)) - at((i, sign), (j, -1))


def round_to(inputs: np.ndarray, dtype: str) -> np.ndarray:
    """Round inputs to a precision, and return them as float64."""
    return np.asarray(inputs).astype(jnp.dtype(dtype)).astype(np.float64)


def errors(case: Case, actual: np.ndarray, exact: np.ndarray, order: int) -> np.ndarray:
    """Compute the largest error over the largest exact entry of each point.

    It is infinite where a value is not finite. `case.floors[order]` bounds the divisor
    from below.
    """
    axes = tuple(range(1, exact.ndim))
    size = np.maximum(np.abs(exact).max(axis=axes), case.floors[order])
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(np.asarray(actual, np.float64) - exact).max(axis=axes)
    off = np.where(np.isfinite(off), off, np.inf)
    # A truth of exactly zero without a floor is met exactly or not at all.
    relative = off / np.where(size > 0, size, 1)
    return np.where(size > 0, relative, np.where(off == 0, 0.0, np.inf))


def evaluate(
    function: Callable,
    inputs: np.ndarray,
    dtype: str,
    count: int,
    options: tuple[tuple[str, int | bool], ...] = (),
) -> tuple[np.ndarray, ...]:
    """Evaluate a function and its derivatives, jitted over all inputs.

    Args:
      function: The function.
      inputs: Inputs, [points, n].
      dtype: Name of the precision.
      count: Number of derivatives, including the value.
      options: Options of the compiler.

    Returns:
      The first `count` of value, gradient and curvature, [points, m, ...] each.
    """
    rows = np.asarray(inputs).astype(jnp.dtype(dtype))
    # Cases of one function share a program: as many rows, the last one repeated.
    padding = -len(rows) % ROWS
    padded_rows = np.concatenate([rows, np.repeat(rows[-1:], padding, axis=0)])
    results = _program(function, count, options)(padded_rows)
    return tuple(np.asarray(result)[: len(rows)] for result in results)


@functools.cache
def _program(function, count, options):
    batch_derivatives = jax.vmap(derivatives(function, count))
    return jax.jit(batch_derivatives, compiler_options=dict(options))
