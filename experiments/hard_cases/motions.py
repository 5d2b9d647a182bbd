"""Hard cases of motions: what is at rest, opacities over time, bits of features."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from gaussians_jax.motion import skinning, temporal_opacity, time_basis
from nerfies_jax.nn import entropy, planes

NEAR = 1e-6  # how close to a switch its two sides are tried, as a share of it
_SHARES = np.array([1.0, -0.25, 0.125])
_SIZES = np.array([0, 1e-30, 1e-12, 1e-6, 1e-3, 1e-2, 0.3, 1, 100, 1e6])


def _sparsity(x):
    return time_basis.sparsity(x[None], constant(np.ones(1, bool), bool))[None]


def _quotient(x):
    size = jnp.abs(x)
    return (jnp.sum(size) / jnp.max(size))[None]


def _exact_sparsity(x):
    size = [abs(one) for one in x]
    return [mpmath.fsum(size) / (max(size) + mpmath.mpf(time_basis.REST))]


SPARSITY = Case(
    name="trajectory sparsity of a static Gaussian",
    breaks="sum |c| / max |c| is 0/0, and its gradient at 1e-12 is 1e12.",
    formula="1e-3, a negligible coefficient, is added to the denominator",
    axis="largest coefficient",
    at=_SIZES,
    along=_SHARES,
    stable=_sparsity,
    textbook=_quotient,
    exact=_exact_sparsity,
    bounds={"float32": (1e-6, 2e-6), "float64": (2e-15, 4e-15)},
    floors=(1.0, 1.0, 0.0),
)

_LOW, _HIGH = temporal_opacity.LOG_WIDTH_RANGE
_EDGES = [end * (1 + side) for end in (_LOW, _HIGH) for side in (-NEAR, NEAR)]
_WIDTHS = np.array(
    [
        [since, width]
        for width in sorted([-1e4, -400, -100, *_EDGES, -4, -1, 0, 3, 100, 1e4])
        for since in (0, 1e-3, 0.4)
    ]
)


def _visible(x):
    return temporal_opacity.visible_share(x[0], x[1])[None]


def _exact_visible(x):
    clamped_log_width = max(min(x[1], mpmath.mpf(_HIGH)), mpmath.mpf(_LOW))
    return [mpmath.exp(-((x[0] * mpmath.exp(-clamped_log_width)) ** 2))]


VISIBLE = Case(
    name="temporal opacity of any width",
    breaks="s / w is 0/0 where the width has underflowed, at a logarithm of -104 "
    "(-745 in f64).",
    formula="exp(-(s e^-w)²) is computed, with the logarithm of the width clamped to "
    "±9",
    switch="switch at -9 and 9",
    axis="logarithm of the width, videos",
    at=_WIDTHS[:, 1],
    points=_WIDTHS,
    stable=_visible,
    textbook=lambda x: jnp.exp(-jnp.square(x[0] / jnp.exp(x[1])))[None],
    exact=_exact_visible,
    bounds={"float32": (2e-6, 4e-6), "float64": (2e-15, 4e-15)},
    floors=(1.0, 1.0, 0.0),
    timed=np.array([0.4, 0.0]),
)

_PLACES = np.array([0.0, 0.5, 1 - 2.0**-20, 1.0, 1 + 2.0**-20, 1.5, 1e6])
UNREST = Case(
    name="L1 distance of time planes from one",
    breaks="Planes start at one, where |1 - p| has the gradient 1, and all features "
    "move the same way.",
    formula="(p - 1) sign(p - 1) is used, whose gradient there is 0",
    switch="switch at 1",
    axis="feature",
    at=_PLACES,
    stable=lambda x: planes.l1_time_planes(x[None, None])[None],
    textbook=lambda x: jnp.mean(jnp.abs(1 - x))[None],
    exact=lambda x: [abs(x[0] - 1)],
    bounds={"float32": (1e-6, 1e-6), "float64": (1e-15, 1e-15)},
    floors=(0.0, 1.0, 0.0),
)

_ROW, _SLANT = np.array([0.0, 1.0, 2.0]), np.array([0.0, 0.125, -0.25])
_AWAY = np.array([0, 0.1, 1, 5, 12, 14, 40, 100, 1e3, 1e4])
_RADII = np.array([-30.0, -20 * (1 + NEAR), -20 * (1 - NEAR), -2.0, 0.0, 3.0])


def _shares(x):
    """Weights of three nodes a unit apart, by the distance along their line."""
    row, slant = (constant(values, x.dtype) for values in (_ROW, _SLANT))
    return skinning.weights(jnp.square(x[0] + row), x[1] + slant)


def _quotients(x):
    row, slant = (constant(values, x.dtype) for values in (_ROW, _SLANT))
    near = jnp.exp(-jnp.square((x[0] + row) / jnp.exp(x[1] + slant)) / 2)
    return near / jnp.sum(near)


def _exact_shares(x):
    scores = []
    for place, slant in zip(_ROW, _SLANT, strict=True):
        clamped_log_radius = max(x[1] + mpmath.mpf(slant), mpmath.mpf(-20))
        scores.append(
            -(((x[0] + mpmath.mpf(place)) * mpmath.exp(-clamped_log_radius)) ** 2) / 2
        )
    shares = [mpmath.exp(one - max(scores)) for one in scores]
    return [one / mpmath.fsum(shares) for one in shares]


SHARES = Case(
    name="skinning weights far from the nodes",
    breaks="exp(-d²/2r²) over its sum is 0/0 from 13 radii on (38 in f64).",
    formula="softmax of -d² e^-2l / 2 is used, with l = log r clamped to -20 .. 15",
    switch="switch at -20 and 15",
    axis="distance, in distances of nodes",
    at=np.repeat(_AWAY, len(_RADII)),
    points=np.array([[distance, radius] for distance in _AWAY for radius in _RADII]),
    stable=_shares,
    textbook=_quotients,
    exact=_exact_shares,
    bounds={"float32": (1e-4, 1e-4), "float64": (1e-12, 1e-12)},
    floors=(1.0, 1.0, 0.0),
    timed=np.array([0.4, 0.0]),
)

_STEPS = np.array([1e-4, 0.002 * (1 - NEAR), 0.002 * (1 + NEAR), 1.0, 50.0])
_FAR = np.array([0, 1e-12, 0.1, 1, 3, 6, 9, 20, 40])


def _bits(x):
    """Bits of a value some deviations from the mean, by the step size."""
    none = jnp.zeros_like(x[0])
    return entropy.bits(x[0], none, none, x[1])[None]


def _log_of_difference(x):
    above = jax.scipy.special.ndtr(x[0] + x[1] / 2)
    return -jnp.log2(above - jax.scipy.special.ndtr(x[0] - x[1] / 2))[None]


def _exact_bits(x):
    near, far = ((side * x[1] / 2 - x[0]) / mpmath.sqrt(2) for side in (1, -1))
    return [-mpmath.log((mpmath.erfc(-near) - mpmath.erfc(-far)) / 2, 2)]


BITS = Case(
    name="bit rate of unlikely values",
    breaks="The difference of two probabilities is 0 from 5.5 deviations on, and its "
    "-log2 is infinite.",
    formula="Log probabilities in the tail are used, and a parabola for small steps",
    switch="switch at a step of 0.002 deviations",
    axis="distance, deviations",
    at=np.repeat(_FAR, len(_STEPS)),
    # Where a step is wide, from its end on.
    points=np.array(
        [[distance + step // 2, step] for distance in _FAR for step in _STEPS]
    ),
    stable=_bits,
    textbook=_log_of_difference,
    exact=_exact_bits,
    bounds={"float32": (2e-5, 2e-3), "float64": (1e-6, 1e-5)},
    floors=(1.0, 1.0, 0.0),
    timed=np.array([0.4, 1.0]),
)

CASES = (SPARSITY, VISIBLE, UNREST, SHARES, BITS)
