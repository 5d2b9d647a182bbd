"""Hard cases of volume rendering: weights, distances, samples where light stops."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from nerfies_jax.fields import compositing, sampling
from nerfies_jax.fields.compositing import AT_INFINITY, EMPTY_BELOW, THIN_BELOW
from nerfies_jax.fields.effects import surface


def _times(sizes, pattern):
    return {"at": np.array(sizes), "along": np.array(pattern)}


def _by_product(depth):
    """The weights of the NeRF and Nerfies codes."""
    opacity = 1 - jnp.exp(-depth)
    through = jnp.cumprod(1 - opacity[:-1] + 1e-10)
    return opacity * jnp.concatenate([jnp.ones_like(depth[:1]), through])


def _exact_weights(depth):
    before, weights = mpmath.mpf(0), []
    for one in depth:
        weights.append(mpmath.exp(-before) * -mpmath.expm1(-one))
        before += one
    return weights


WEIGHTS = Case(
    name="rendering weights of thin and opaque samples",
    breaks="1 - exp(-d) is 0 below d = 6e-8, so a ray through a thin medium has no "
    "weight.",
    formula="-expm1(-d) exp(-sum of the optical depths before) is computed",
    axis="depth of a sample",
    **_times([1e-30, 1e-12, 1e-8, 1e-4, 0.01, 0.3, 1, 5, 16, 30, 1e3], [1, 0.5, 2, 1]),
    stable=compositing.weights,
    textbook=_by_product,
    exact=_exact_weights,
    bounds={
        "bfloat16": (8e-3, 8e-3),
        "float32": (4e-7, 4e-7),
        "float64": (8e-16, 8e-16),
    },
    # expm1's slope is exp to a rounding unit of one.
    floors=(0, 1),
    timed=np.array([0.1, 0.05, 0.2, 0.1]),
)


def _exact_direction(vector):
    length = mpmath.sqrt(mpmath.fsum(x**2 for x in vector))
    return [x / length for x in vector]


NORMALS = Case(
    name="normals from tiny and huge density gradients",
    breaks="The square of a gradient of 1e-24 is 0, and that of 1e20 is infinite.",
    formula="The gradient is divided by its largest entry first",
    axis="length of the gradient",
    **_times([1e-24, 1e-22, 1e-6, 1, 1e10, 1e20, 1e30], [0.5, -1, 0.25]),
    stable=surface.unit,
    textbook=lambda vector: vector / jnp.sqrt(jnp.sum(vector * vector)),
    exact=_exact_direction,
    bounds={"float32": (3e-7, 1e-6), "float64": (6e-16, 2e-15)},
)


DISTANCES = np.array([1.0, 1.25, 2.0, 2.125, 3.0])


def _closed_by_infinity(density):
    distances = constant(DISTANCES, density.dtype)
    spacing = compositing.intervals(distances, AT_INFINITY)
    return compositing.weights(density * spacing)


def _depth_in_front(density):
    """The depth in front of a sample as the sum up to it without it."""
    spacing = jnp.diff(constant([*DISTANCES, DISTANCES[-1] + 1e10], density.dtype))
    depth = density * spacing
    through = jnp.exp(-(jnp.cumsum(depth) - depth))
    return through * -jnp.expm1(-depth)


def _exact_closed(density):
    spacing = [mpmath.mpf(float(s)) for s in (*np.diff(DISTANCES), AT_INFINITY)]
    return _exact_weights([d * s for d, s in zip(density, spacing, strict=True)])


LAST = Case(
    name="last interval of 1e10",
    breaks="cumsum(d) - d loses the optical depths in front, and weights sum to 1.6.",
    formula="The sum over the samples before is computed without the sample itself",
    axis="density",
    **_times([1e-20, 1e-14, 1e-11, 1e-10, 1e-4, 0.1, 1, 10, 1e3], [1, 1, 0.5, 2, 1]),
    stable=_closed_by_infinity,
    textbook=_depth_in_front,
    exact=_exact_closed,
    bounds={"float32": (4e-7, 4e-7), "float64": (1e-15, 1e-15)},
    floors=(0, 1),
    timed=np.array([0.1, 0.2, 0.3, 0.4, 0.5]),
)


FAR = 3.0
_SHARES = [0.5, 1.0, 0.25, 2.0, 0.25]  # sum to 4


def _expected_distance(weights):
    distances = constant(DISTANCES, weights.dtype)
    far = constant(FAR, weights.dtype)
    return compositing.expected_distance(weights, distances, far)[None]


def _quotient(weights):
    distances = constant(DISTANCES, weights.dtype)
    return (jnp.sum(weights * distances) / jnp.sum(weights))[None]


def _exact_expected(weights):
    alpha = sum(weights)
    deficit = max(EMPTY_BELOW - alpha, 0)
    along = sum(w * d for w, d in zip(weights, DISTANCES, strict=True))
    return [(along + deficit * FAR) / (alpha + deficit)]


_EDGE = EMPTY_BELOW / 4
DISTANCE = Case(
    name="expected distance of an empty ray",
    breaks="The distance is 0/0, and its gradient grows as 1/opacity.",
    formula="The opacity missing to 1e-3 is added at the far end",
    switch="switch at an opacity of 1e-3",
    axis="opacity / 4",
    **_times(
        [
            0,
            1e-38,
            1e-30,
            1e-8,
            1e-5,
            _EDGE * (1 - 1e-6),
            _EDGE * (1 + 1e-6),
            0.01,
            0.2,
        ],
        _SHARES,
    ),
    stable=_expected_distance,
    textbook=_quotient,
    exact=_exact_expected,
    bounds={"float32": (3e-7, 1e-6), "float64": (8e-16, 2e-15)},
    timed=0.1 * np.array(_SHARES),
)


def _thin(x):
    return compositing.scale_opacity(x[0], x[1])[None]


def _thinned_as_printed(x):
    return -jnp.log(1 - jax.nn.sigmoid(x[1]) * (1 - jnp.exp(-x[0])))[None]


def _exact_thinned(x):
    share = 1 / (1 + mpmath.exp(-x[1]))
    return [-mpmath.log(1 - share * -mpmath.expm1(-x[0]))]


def _sides(edge):
    """Below and above an edge, by its neighbors in both precisions and by 1e-6."""
    places = [edge * (1 - 1e-6), edge, edge * (1 + 1e-6)]
    for kind in (np.float32, np.float64):
        places += [float(np.nextafter(kind(edge), kind(to))) for to in (-9, 9)]
    return sorted(places)


# The logit of a share of 3/4, and the depth whose opacity it brings to the switch.
_LOGIT = np.log(3.0)
_SWITCH = -np.log1p(-THIN_BELOW / 0.75)
_THINNED = np.array(
    [[d, v] for d in (1e-8, 0.1, 1, 17, 50, 1e10) for v in (-60, -1, 3, 20, 80)]
    + [[d, _LOGIT] for d in _sides(_SWITCH)]
    + [[1e-30, 0.5], [0.7, 16.7]]
)
_THINNED = _THINNED[np.argsort(_THINNED[:, 0], kind="stable")]
THINNED = Case(
    name="opacity times a blending weight",
    breaks="-log(1 - v(1 - exp(-d))) is infinite for v → 1, and 0 in a thin medium.",
    formula="-log1p(v expm1(-d)) is used for thin samples, and -logaddexp(log(1 - "
    "v), log v - d) for opaque ones",
    switch=f"switch at an opacity of {THIN_BELOW:g}",
    axis="depth",
    at=_THINNED[:, 0],
    points=_THINNED,
    stable=_thin,
    textbook=_thinned_as_printed,
    exact=_exact_thinned,
    bounds={
        "bfloat16": (8e-3, 8e-3),
        "float32": (1e-6, 1.5e-6),
        "float64": (2e-15, 3e-15),
    },
    floors=(1e-37, 1),
    timed=np.array([0.5, 0.3]),
)


EDGES = np.linspace(2, 4, 9)
DRAWN = 11


def _samples(weights):
    edges = constant(EDGES, weights.dtype)
    return sampling.sample_pdf(None, edges, weights, DRAWN)


def _with_a_floor(weights):
    """Sample as the Nerfies code: 1e-5 on every weight, masks on shares and edges."""
    edges = constant(EDGES, weights.dtype)
    weights = weights + 1e-5
    share = jnp.cumsum(weights / jnp.sum(weights))
    share = jnp.concatenate([jnp.zeros_like(share[:1]), share])
    args = jnp.linspace(0, 1, DRAWN, dtype=weights.dtype)
    is_reached = args[:, None] >= share
    low, high = (
        (
            jnp.max(jnp.where(is_reached, x, x[0]), axis=1),
            jnp.min(jnp.where(~is_reached, x, x[-1]), axis=1),
        )
        for x in (share, edges)
    )
    span = jnp.where(low[1] - low[0] < 1e-5, 1, low[1] - low[0])
    return high[0] + (args - low[0]) / span * (high[1] - high[0])


def _exact_samples(weights):
    """Sample without any epsilon, with the ends of the range included."""
    total = sum(weights)
    if total == 0:
        weights, total = [mpmath.mpf(1)] * len(weights), mpmath.mpf(len(weights))
    samples = []
    for k in range(1, DRAWN - 1):
        target = total * k / (DRAWN - 1)
        index = 0
        while target > weights[index]:
            target -= weights[index]
            index += 1
        start, stop = EDGES[index], EDGES[index + 1]
        samples.append(start + target / weights[index] * (stop - start))
    return [mpmath.mpf(EDGES[0]), *samples, mpmath.mpf(EDGES[-1])]


_UNEVEN = np.array([0.2, 1.3, 0.7, 2.1, 0.45, 0.9, 0.31, 1.1])
_PEAK = np.eye(8)[3]
_DRAWS = [
    (0, _UNEVEN),
    (1e-37, _UNEVEN),
    (1e-31, _PEAK),
    (1e-31, _UNEVEN),
    (1e-10, _PEAK + np.eye(8)[6] * 1.17),
    (1e-5, _UNEVEN),
    (1, _PEAK),
    (1, _UNEVEN),
    (1e30, _UNEVEN),
    (1.6e38, _PEAK),
    (1.6e38, _UNEVEN),
]
SAMPLES = Case(
    name="importance sampling by faint weights",
    breaks="1e-5, added to all weights, dominates faint ones. Samples are off by 0.4 "
    "of the range.",
    formula="Weights are scaled by the largest in two steps, one rounding unit is "
    "added, and above 65 bins a running maximum keeps sums sorted",
    switch="switch to equal weights below a largest weight of 1.2e-38",
    axis="size of the weights",
    at=np.array([size for size, _ in _DRAWS]),
    points=np.array([size * pattern for size, pattern in _DRAWS]),
    stable=_samples,
    textbook=_with_a_floor,
    exact=_exact_samples,
    bounds={
        "bfloat16": (6e-3,),
        "float32": (1e-6,),
        "float64": (2e-15,),
    },
    timed=_UNEVEN,
)

CASES = (WEIGHTS, NORMALS, LAST, DISTANCE, THINNED, SAMPLES)
