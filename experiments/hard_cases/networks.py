"""Hard cases of networks and optimizers: RBF-KANs, Adam and RAdam of late rows."""

import dataclasses
import math

import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant, sides
from gaussians_jax.optim import optimizer
from nerfies_jax.nn import bsplines, kan
from nerfies_jax.nn.kan import KAN, KANLayer, KANSpec, Kernels
from nerfies_jax.nn.mlp import HeadSpec

KERNELS = 8
# Centers at whole numbers, which every precision holds, and w = h = 1.
HEADS = (("y", HeadSpec(1)),)
EDGE = KANSpec(1, heads=HEADS, kernels=KERNELS, grid=(0.0, 7.0), base=False)
FAR_EDGE = dataclasses.replace(EDGE, grid=(1024.0, 1031.0))
TRAINED_EDGE = dataclasses.replace(EDGE, trainable_kernels=True)
WEIGHTS = np.linspace(1, 2, KERNELS)


def _edge(spec, x, weights=WEIGHTS, kernels=None):
    """The function of one variable that one edge of a KAN is."""
    weight = constant(weights, x.dtype)[:, None, None]
    head = KANLayer(weight, None, constant(np.zeros(1), x.dtype))
    return kan.apply_heads(spec, KAN((), {"y": head}, kernels), x)["y"]


def _gaussians(x):
    """FastKAN's layer: nothing holds its inputs."""
    center = jnp.arange(KERNELS, dtype=x.dtype)
    return jnp.exp(-((x - center) ** 2)) @ constant(WEIGHTS, x.dtype)[:, None]


def _exact_edge(x, first=0):
    low, high, sigma = first, first + KERNELS - 1, mpmath.sqrt(mpmath.mpf(0.5))
    excess = max(low - x, x - high, 0) / sigma
    beyond = sigma * (1 - 1 / mpmath.sqrt(1 + 2 * excess + 3 * excess**2))
    clamped_x = low - beyond if x < low else high + beyond if x > high else x
    return [
        mpmath.fsum(
            mpmath.mpf(w) * mpmath.exp(-((clamped_x - first - g) ** 2))
            for g, w in enumerate(WEIGHTS)
        )
    ]


_PLACES = np.array(
    [-1e4, -50, -5, -1, *sides(0.0), 0.3, 3.5, *sides(7.0), 8, 12, 57, 1e4]
)
OUTSIDE = Case(
    name="KAN input outside its grid",
    breaks="Kernels are 1e-11 five spacings outside the grid, so value and gradient "
    "vanish.",
    formula="Inputs outside are clamped smoothly to the end plus w/√2 times 1 - "
    "1/√(1 + 2e + 3e²)",
    switch="switch at the ends of the grid",
    axis="x, grid 0 to 7",
    at=_PLACES,
    stable=lambda x: _edge(EDGE, x),
    textbook=_gaussians,
    exact=lambda x: _exact_edge(x[0]),
    bounds={
        "bfloat16": (6e-2, 6e-2),
        "float32": (1e-6, 2e-6, 6e-5),
        "float64": (2e-15, 4e-15, 1e-13),
    },
    timed=np.array([3.3]),
)


def _expand(x):
    """Expand the square as for a matrix product: |x|² - 2xμ + μ²."""
    center = 1024 + jnp.arange(KERNELS, dtype=x.dtype)
    squares = x**2 - 2 * x * center + center**2
    return jnp.exp(-squares) @ constant(WEIGHTS, x.dtype)[:, None]


_OFFSETS = 1024 + np.array([0, 1e-3, 0.25, 1, 3.3, 6.75, 7])
FAR_AWAY = Case(
    name="KAN grid far from zero",
    breaks="x² - 2xμ + μ² cancels.",
    formula="The difference is squared",
    axis="x",
    at=_OFFSETS,
    stable=lambda x: _edge(FAR_EDGE, x),
    textbook=_expand,
    exact=lambda x: _exact_edge(x[0], 1024),
    bounds={"float32": (4e-7, 1e-6, 2e-6), "float64": (1e-15, 2e-15, 4e-15)},
    floors=(0, 0.3, 1),
    timed=np.array([1027.3]),
)


CHOSEN = 3  # the one kernel of the next case, at x = 3


def _trained_kernel(x):
    """One kernel of a trained width e^s, with inputs x and s."""
    shape = KERNELS, 1
    center = jnp.arange(KERNELS, dtype=x.dtype)[:, None]
    kernels = (Kernels(center, jnp.broadcast_to(x[1], shape)),)
    return _edge(TRAINED_EDGE, x[:1], np.eye(KERNELS)[CHOSEN], kernels)


def _by_variance(x):
    sigma = jnp.exp(x[1]) / math.sqrt(2)
    center = jnp.arange(KERNELS, dtype=x.dtype)
    kernels = jnp.exp(-((x[0] - center) ** 2) / (2 * sigma**2))
    return kernels @ jnp.eye(KERNELS, dtype=x.dtype)[:, CHOSEN, None]


def _exact_trained(x):
    log_width = min(max(x[1], -kan.LOG_WIDTH_RANGE), kan.LOG_WIDTH_RANGE)
    return [mpmath.exp(-(((x[0] - CHOSEN) * mpmath.exp(-log_width)) ** 2))]


# One step of bfloat16 beside the kernel's center, 2^-6, is many narrow widths.
_WIDTHS = np.array(
    [
        [CHOSEN + offset, s]
        for s in (-200, -60, -10.25, -9.75, -4, 0, 3, 9.75, 10.25, 60, 200)
        for offset in (0, 2.0**-17, 2.0**-6)
    ]
)
WIDTH = Case(
    name="KAN kernel of a trained width",
    breaks="(x - μ)² over a squared width is 0/0 for widths below 1e-20, and its "
    "gradients fail earlier.",
    formula="((x - μ) e^-s)² is computed, with s clamped to ±10 of its initial value",
    switch="switch at s = ±10",
    axis="s, the width's logarithm",
    at=_WIDTHS[:, 1],
    points=_WIDTHS,
    stable=_trained_kernel,
    textbook=_by_variance,
    exact=_exact_trained,
    bounds={
        "bfloat16": (6e-3, 6e-3),
        "float32": (1e-6, 2e-6, 1e-6),
        "float64": (2e-15, 4e-15, 3e-15),
    },
    floors=(1, 1, 0),
    timed=np.array([3.3, 0.1]),
)


_PATTERN = np.array([1.0, -2.0, 0.5, 0.25])  # sums to -0.25, so the mean is not exact


def _standardize(x):
    return kan.standardize(64 + x[0] * constant(_PATTERN, x.dtype))


def _by_moments(x):
    """The variance as the mean square less the square of the mean."""
    features = 64 + x[0] * constant(_PATTERN, x.dtype)
    mean = jnp.mean(features)
    variance = jnp.mean(features**2) - mean**2
    return (features - mean) / jnp.sqrt(variance + kan.NORM_VARIANCE)


def _exact_standardized(x):
    features = [64 + x[0] * mpmath.mpf(p) for p in _PATTERN]
    mean = mpmath.fsum(features) / len(features)
    deviations = [f - mean for f in features]
    variance = mpmath.fsum(c**2 for c in deviations) / len(features)
    return [
        c / mpmath.sqrt(variance + mpmath.mpf(kan.NORM_VARIANCE)) for c in deviations
    ]


# Powers of two, so that what is standardized is exact in float32.
_SPREADS = np.array([0, 2.0**-13, 2.0**-12, 2.0**-10, 2.0**-7, 0.125, 1, 16])
NORM = Case(
    name="KAN features of small variance",
    breaks="The mean square minus the squared mean has no digits left, or is a "
    "negative variance.",
    formula="The mean square of the centered features is computed, plus 1e-6",
    axis="spread about 64",
    at=_SPREADS,
    stable=_standardize,
    textbook=_by_moments,
    exact=_exact_standardized,
    bounds={"float32": (1e-6, 1e-5), "float64": (1e-15, 1e-14)},
    floors=(1e-30, 1),
    timed=np.array([1.0]),
)


def _truncated_cubes(x):
    """The cubic B-spline as divided differences of truncated powers have it."""
    return sum(
        (-1) ** k * math.comb(4, k) * jnp.maximum(x + 2 - k, 0) ** 3 / 6
        for k in range(5)
    )


def _exact_spline(x):
    distance = abs(x[0])
    if distance < 1:
        return [mpmath.mpf(2) / 3 - distance**2 + distance**3 / 2]
    return [max(2 - distance, 0) ** 3 / 6]


_FROM_KNOT = np.array(
    [-1.999, -1.5, -1, -0.25, 0.5, *sides(1.0), 1.25, 1.9, 1.99, 1.999]
)
SPLINE = Case(
    name="cubic B-spline near the end of its support",
    breaks="A sum of truncated cubes cancels. Its noise is 1e-6 where the spline is "
    "1e-10.",
    formula="2/3 - x² + |x|³/2 is used within an interval of the middle knot, and (2 "
    "- |x|)³/6 beyond",
    switch="switch at |x| = 1",
    axis="x in intervals",
    at=_FROM_KNOT,
    stable=bsplines.cubic,
    textbook=_truncated_cubes,
    exact=_exact_spline,
    bounds={"float32": (1e-6, 1e-6, 1e-6), "float64": (2e-15, 2e-15, 2e-15)},
    timed=np.array([1.3]),
)


B1, B2 = 0.9, 0.999


def _length_as_printed(x):
    """Algorithm 2 of Liu et al. 2020."""
    power = constant(B2, x.dtype) ** x
    return 2 / (1 - B2) - 1 - 2 * x * power / (1 - power)


def _exact_length(x):
    b2 = mpmath.mpf(B2)
    power = b2 ** x[0]
    return [2 / (1 - b2) - 1 - 2 * x[0] * power / (1 - power)]


# The series ends at t = -1 / log b2 = 999.5.
_UPDATES = np.array(
    [1, 2, 3, 4, 5, 6, 7, 20, 100, 690, 999, 1000, 1001, 1e4, 1e5, 1e6], float
)
LENGTH = Case(
    name="length of RAdam's second moment",
    breaks="2/(1 - b) - 1 - 2tb^t/(1 - b^t) is off by 0.03 at t = 5, where RAdam "
    "decides about rectification.",
    formula="t - (2/L)(h(tL/2) - h(L/2)) is used, with h(x) = x coth x - 1 by its "
    "series",
    switch="switch to a closed form at t = 999.5",
    axis="updates",
    at=_UPDATES,
    stable=lambda x: optimizer.moment_length(x, B2),
    textbook=_length_as_printed,
    exact=_exact_length,
    bounds={"float32": (4e-7,), "float64": (2e-15,)},
    timed=np.array([40.0]),
)


def _nth_update(x):
    """Adam's n-th update with a constant gradient, with inputs n and the gradient."""
    count, slope = x[:1], x[1:]
    before = [slope**k * -jnp.expm1((count - 1) * math.log(b)) for k, b in _MOMENTS]
    state = optimizer.RowAdamState((count - 1).astype(jnp.int32), *before)
    return optimizer.scale_by_row_adam(B1, B2).update(slope, state)[0]


_MOMENTS = ((1, B1), (2, B2))


def _update_at(count, x):
    """Adam's update as its paper prints it."""
    slope = x[1:]
    before = [-jnp.expm1((x[:1] - 1) * math.log(b)) for _, b in _MOMENTS]
    first = B1 * slope * before[0] + (1 - B1) * slope
    second = B2 * slope**2 * before[1] + (1 - B2) * slope**2
    mean = first / (1 - constant(B1, x.dtype) ** count)
    square = second / (1 - constant(B2, x.dtype) ** count)
    return mean / (jnp.sqrt(square) + 1e-8)


def _exact_update(x):
    return [x[1] / (abs(x[1]) + mpmath.mpf("1e-15"))]


_AGES = np.array([[n, 1e-3] for n in (1, 2, 3, 5, 10, 100, 1000, 1e5)])
NEWBORN = Case(
    name="Adam's update of a new Gaussian",
    breaks="With one shared step count, here 1000 higher, updates are 2.5 to 4.6 "
    "times too large.",
    formula="Each Gaussian has its own step count",
    axis="updates since birth",
    at=_AGES[:, 0],
    points=_AGES,
    stable=_nth_update,
    textbook=lambda x: _update_at(1000 + x[:1], x),
    exact=_exact_update,
    bounds={"float32": (1e-6,), "float64": (2e-15,)},
    timed=np.array([10, 1e-3]),
)

BIAS = NEWBORN._replace(
    name="bias of Adam's moments",
    breaks="1 - bⁿ cancels in the first updates, with an error of 1.5e-5, and eps is "
    "1e-8.",
    formula="-expm1(n log b) and eps 1e-15 are used",
    textbook=lambda x: _update_at(x[:1], x),
    bounds={"float32": (1e-6,), "float64": (2e-15,)},
)

_SLOPES = np.array(
    [[3, g] for g in (1e-30, 1e-20, 1e-18, 1e-15, 1e-10, 1e-8, 1e-4, 1, 1e10, 1e18)]
)
SIZE = NEWBORN._replace(
    name="Adam's update for a gradient of any size",
    breaks="eps 1e-8 halves the update for gradients of 1e-8. For 1e-11 it is 1e-3 "
    "of a full one.",
    formula="eps 1e-15 is used",
    axis="gradient",
    at=_SLOPES[:, 1],
    points=_SLOPES,
    textbook=lambda x: _update_at(x[:1], x),
    bounds={"float32": (3e-6,), "float64": (2e-15,)},
    floors=(1,),  # of a full step; squares below 1e-38 are 0 in float32
)

CASES = (OUTSIDE, FAR_AWAY, WIDTH, NORM, SPLINE, LENGTH, NEWBORN, BIAS, SIZE)
