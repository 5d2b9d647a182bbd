"""Hard cases of Fourier features, of the window of their bands, and of grids."""

import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, sides
from nerfies_jax.nn import encoding, grids, sines
from nerfies_jax.nn.encoding import EncodingSpec

BANDS = 10
TIMES_PI = EncodingSpec(BANDS, identity=False, times_pi=True)
PLAIN = EncodingSpec(BANDS, identity=False)
TOP = 2.0 ** (BANDS - 1)  # of the last band, whose slopes and bends are the largest


def _with_negatives(places):
    return np.unique(np.concatenate([np.negative(places), places]))


def _features(spec):
    return lambda x: encoding.encode(spec, x, None)


def _rounded_pi(x):
    """Evaluate as in the papers, with π rounded before argument reduction."""
    angles = 2 ** jnp.arange(BANDS, dtype=x.dtype)[:, None] * jnp.pi * x
    return jnp.stack([jnp.sin(angles), jnp.cos(angles)], axis=1).reshape(-1)


def _exact_features(unit):
    """Band by band, where `unit` is a half turn in terms of x."""

    def features(x):
        turns = [2**k * x[0] / unit() for k in range(BANDS)]
        return [wave(t) for t in turns for wave in (mpmath.sinpi, mpmath.cospi)]

    return features


# Quadrants meet at odd eighths of a period of the last band, x = (2k + 1) / 2048.
_SEAMS = [x / TOP for edge in (0.25, 0.75, 2.25) for x in sides(edge)]
_PI_PLACES = _with_negatives([0, 1e-30, 1e-8, 1e-4, *_SEAMS, 0.7371, 1, 10, 1e3, 1e4])
HALF_TURNS = Case(
    name="sin and cos of 2ᵏπx",
    breaks="The product with π is rounded before the reduction. At x = 1e4, k = 9 is "
    "noise.",
    formula="x - 2 round(x/2) is computed first, then quadrants and a polynomial on "
    "[-¼, ¼]",
    switch="switch of quadrants at odd eighths of a period",
    axis="x",
    at=_PI_PLACES,
    stable=_features(TIMES_PI),
    textbook=_rounded_pi,
    exact=_exact_features(lambda: mpmath.mpf(1)),
    bounds={
        "bfloat16": (4e-3, 8e-3),
        "float32": (2e-7, 3e-7, 4e-7),
        "float64": (4e-16, 6e-16, 8e-16),
    },
    floors=(1, TOP * np.pi, (TOP * np.pi) ** 2),
    timed=np.array([0.3]),
)


def _quarter_turn_on(x):
    """The cosine as the Nerfies code has it, the sine of a quarter turn more."""
    angles = 2 ** jnp.arange(BANDS, dtype=x.dtype)[:, None] * x
    waves = jnp.sin(angles), jnp.sin(angles + 0.5 * jnp.pi)
    return jnp.stack(waves, axis=1).reshape(-1)


_PLACES = _with_negatives([0, 1e-30, 1e-8, 1e-4, 0.01, 0.7371, 1, 10, 1e3, 1e4])
PLAIN_WAVES = Case(
    name="sin and cos of 2ᵏx",
    breaks="cos a is computed as sin(a + π/2), and the sum is rounded to an ulp of a.",
    formula="sin and cos of the exact product are those of XLA",
    switch="switch of the whole array if any |2ᵏx| exceeds 12,800",
    axis="x",
    at=_PLACES,
    stable=_features(PLAIN),
    textbook=_quarter_turn_on,
    exact=_exact_features(lambda: +mpmath.pi),
    bounds={
        "bfloat16": (4e-3, 8e-3),
        "float32": (2e-7, 2e-7, 2e-7),
        "float64": (4e-16, 4e-16, 4e-16),
    },
    floors=(1, TOP, TOP**2),
    timed=np.array([0.3]),
)


def _one_part(x):
    """Reduced by quarter turns that are rounded once, and then to their product."""
    angles = 2 ** jnp.arange(BANDS, dtype=x.dtype)[:, None] * x
    turns = jnp.round(angles / (0.5 * jnp.pi))
    remainder = angles - turns * jnp.asarray(0.5 * jnp.pi, x.dtype)
    swap, flip = turns % 2 == 1, turns % 4
    sine = jnp.where(swap, jnp.cos(remainder), jnp.sin(remainder))
    cosine = jnp.where(swap, jnp.sin(remainder), jnp.cos(remainder))
    waves = (
        jnp.where(flip >= 2, -sine, sine),
        jnp.where((flip == 1) | (flip == 2), -cosine, cosine),
    )
    return jnp.stack(waves, axis=1).reshape(-1)


# Odd eighths of a period of the last band, where quadrants meet, and the last number
# that is reduced in vectors.
_EIGHTHS = [edge for n in (1, 3, 9, 16001) for edge in sides(n * np.pi / 4 / TOP)]
_LAST = sines.LARGEST_REDUCED / TOP
_NEAR = _with_negatives(
    [0, 1e-30, 1e-8, 1e-4, 0.01, 0.7371, 1, 10, *_EIGHTHS, *sides(_LAST)]
)
NEAR_WAVES = PLAIN_WAVES._replace(
    name="sin and cos of 2ᵏx up to 12,800",
    breaks="x - n π/2 with a rounded π/2 has n times its error, 3e-4 at the end.",
    formula="π/2 is subtracted in three parts, then quadrants and a polynomial on "
    "[-π/4, π/4] are used",
    switch="switch of quadrants at odd eighths of a period, and to XLA at |2ᵏx| = "
    "12,800",
    at=_NEAR,
    textbook=_one_part,
)


OPENED = 6


def _by_cosine(alpha):
    """Equation 14 of Nerfies as printed."""
    share = jnp.clip(alpha[0] - jnp.arange(OPENED, dtype=alpha.dtype), 0, 1)
    return (1 - jnp.cos(jnp.pi * share)) / 2


def _exact_window(alpha):
    share = [min(max(alpha[0] - k, 0), 1) for k in range(OPENED)]
    return [mpmath.sinpi(x / 2) ** 2 for x in share]


_OPENING = np.array(
    [0, 1e-15, 1e-8, 1e-5, 1e-4, 1e-3, 0.01, 0.1, *sides(0.5), *sides(1.0), 3.25, 6]
)
WINDOW = Case(
    name="coarse-to-fine window of a band",
    breaks="½(1 - cos πa) cancels. It is 0 below a = 1e-4, and its gradient is not 0 "
    "at 0.",
    formula="sin²(πa/2) is computed by the polynomial for 2ᵏπx",
    switch="switch of quadrants at a = ½",
    axis="bands open, a",
    at=_OPENING,
    stable=lambda alpha: encoding.anneal(OPENED, alpha[0]),
    textbook=_by_cosine,
    exact=_exact_window,
    bounds={
        "bfloat16": (8e-3, 2e-2),
        "float32": (4e-7, 4e-7),
        "float64": (8e-16, 8e-16),
    },
    floors=(1e-35, 1e-14),  # differences of 1e-32 see past the end at 0
    timed=np.array([0.3]),
)

_RAY = (1.0, 0.3, -0.2)


def _contract(contract):
    return lambda x: contract(x[0] * jnp.asarray(_RAY, x.dtype))


def _contracted_as_printed(point):
    """Both branches of the paper's equation are differentiated, also at the center."""
    size = jnp.max(jnp.abs(point))
    return jnp.where(size > 1, (2 - 1 / size) * (point / size), point)


def _exact_contraction(x):
    size = abs(x[0])
    factor = (2 - 1 / size) / size if size > 1 else 1
    return [factor * x[0] * mpmath.mpf(part) for part in _RAY]


_DISTANCES = _with_negatives([0, 1e-30, 1e-8, 0.5, *sides(1.0), 2, 100, 1e8, 1e30])
CONTRACTION = Case(
    name="scene contraction",
    breaks="The branch that is not selected, (2 - 1/|x|) x/|x|, has a NaN gradient "
    "at the center.",
    formula="The norm is clamped to at least 1 there, and x / |x| is computed before "
    "the factor",
    switch="switch at the box, |x| = 1",
    axis="|x|",
    at=_DISTANCES,
    stable=_contract(grids.contract),
    textbook=_contract(_contracted_as_printed),
    exact=_exact_contraction,
    bounds={
        "bfloat16": (1e-2, 2e-2),
        "float32": (2e-7, 4e-7),
        "float64": (4e-16, 8e-16),
    },
    floors=(1, 1),
    timed=np.array([0.5]),
)

CASES = (HALF_TURNS, PLAIN_WAVES, NEAR_WAVES, WINDOW, CONTRACTION)
