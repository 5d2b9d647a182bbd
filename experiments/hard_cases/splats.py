"""Hard cases of Gaussians: compositing, activations, relocation, motion."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from gaussians_jax.core import splats
from gaussians_jax.core.splats import Splats
from gaussians_jax.losses import acceleration
from gaussians_jax.optim import densification, mcmc
from gaussians_jax.splatting import raster
from gaussians_jax.splatting.projection import Footprints
from gaussians_jax.splatting.raster_spec import GSPLAT

NEAR = 1e-6  # how close to a switch its two sides are tried, as a share of it
OPEN = dataclasses.replace(
    GSPLAT, transmittance_threshold=0.0, tile=4, batch=1, chunk=1
)
COUNT = 300
_VALUES = np.cos(np.arange(COUNT) * 0.7)


def _pixel(x):
    """A pixel behind `COUNT` wide Gaussians, the first with alpha x0, all others x1."""
    others = constant(np.ones(COUNT - 1), x.dtype) * x[1]
    footprints = Footprints(
        mean_px=constant(np.full((COUNT, 2), 0.5), x.dtype),
        whitening=constant(np.tile([1e-3, 0, 1e-3], (COUNT, 1)), x.dtype),
        opacity=jnp.concatenate([x[:1], others]),
        depth=constant(np.arange(1, COUNT + 1), x.dtype),
        extent_px=constant(np.full((COUNT, 2), 2.0), x.dtype),
    )
    values = constant(_VALUES[:, None], x.dtype)
    image, _ = raster.rasterize(footprints, values, (1, 1), OPEN)
    return image[0, 0]


@jax.custom_vjp
def _composite_dividing(alpha, values):
    """Composite as INRIA's kernel, whose backward pass divides the transmittance."""
    transmittance = jnp.cumprod(1 - alpha)
    before = jnp.concatenate([jnp.ones_like(transmittance[:1]), transmittance[:-1]])
    return jnp.sum(before * alpha * values)


def _dividing_forward(alpha, values):
    return _composite_dividing(alpha, values), (alpha, values, jnp.prod(1 - alpha))


def _dividing_backward(residuals, cotangent):
    alpha, values, final = residuals

    def step(carry, row):
        transmittance, behind = carry
        opacity, value = row
        transmittance = transmittance / (1 - opacity)
        slope = transmittance * (value - behind)
        behind = opacity * value + (1 - opacity) * behind
        return (transmittance, behind), slope

    start = (final, jnp.zeros_like(final))
    slopes = jax.lax.scan(step, start, (alpha, values), reverse=True)[1]
    return cotangent * slopes, jnp.zeros_like(values)


_composite_dividing.defvjp(_dividing_forward, _dividing_backward)


def _pixel_textbook(x):
    alpha = jnp.concatenate([x[:1], constant(np.full(COUNT - 1, 1), x.dtype) * x[1]])
    alpha = jnp.where(
        alpha < OPEN.alpha_threshold, 0, jnp.minimum(alpha, OPEN.alpha_max)
    )
    return _composite_dividing(alpha, constant(_VALUES, x.dtype))[None]


def _exact_pixel(x):
    def opacity(alpha):
        if alpha < mpmath.mpf(OPEN.alpha_threshold):
            return mpmath.mpf(0)
        return min(alpha, mpmath.mpf(OPEN.alpha_max))

    first, other = opacity(x[0]), opacity(x[1])
    total, transmittance = first * mpmath.mpf(float(_VALUES[0])), 1 - first
    for value in _VALUES[1:].tolist():
        total += transmittance * other * mpmath.mpf(value)
        transmittance *= 1 - other
    return [total]


_CUT = OPEN.alpha_threshold
_MOST = OPEN.alpha_max
_SEEN = [_CUT * (1 - NEAR), _CUT * (1 + 1e-4), 0.01, 0.1, 0.5, 0.9]
_ALPHAS = np.array([*_SEEN, _MOST * (1 - NEAR), _MOST * (1 + NEAR), 1.0])

LONG_LIST = Case(
    name=f"pixel behind {COUNT} Gaussians",
    breaks="The backward pass computes T / (1 - alpha) from a transmittance of 0 "
    "(126 times 0.5 in f32).",
    formula="Both passes go front to back, and the color behind is a running "
    "difference",
    switch="switch at alpha = 1/255 (threshold) and 0.99 (clamp)",
    axis="alpha",
    at=_ALPHAS,
    points=np.stack([np.full(len(_ALPHAS), 0.25), _ALPHAS], axis=1),
    stable=_pixel,
    textbook=_pixel_textbook,
    exact=_exact_pixel,
    bounds={"float32": (2e-6, 2e-4), "float64": (5e-15, 1e-12)},
    alike=False,  # a whole rasterizer against one product
)


_SWITCH = densification.FAINT_LOGIT
_BOTH = [_SWITCH * (1 + NEAR), _SWITCH * (1 - NEAR)]
_LOGITS = np.array(
    [-500.0, -100, -88, -30, *_BOTH, -8, -1, 0, 1, 8, 16, 17, 37, 40, 80, 100]
)


def _halved_textbook(logit):
    opacity = 1 - jnp.sqrt(1 - 1 / (1 + jnp.exp(-logit)))
    return jnp.log(opacity / (1 - opacity))


def _exact_halved(logit):
    half = mpmath.log1p(mpmath.exp(logit[0])) / 2
    return [mpmath.log(-mpmath.expm1(-half)) + half]


HALVED = Case(
    name="halved opacity",
    breaks="1 - o is 0 from a logit of 17 on (37 in f64), and 1 - √(1 - o) is 0 "
    "below -17.",
    formula="The logit is log(-expm1(h)) - h with h = log_sigmoid(-l) / 2, and a "
    "series for small l",
    switch="switch at a logit of -20",
    axis="logit",
    at=_LOGITS,
    stable=densification.halve_opacity,
    textbook=_halved_textbook,
    exact=_exact_halved,
    bounds={"float32": (1e-6, 1e-6), "float64": (1e-14, 1e-14)},
    floors=(1.0, 0.0, 0.0),
)


_LOW, _HIGH = splats.LOG_SCALE_RANGE
_INSIDE = [_LOW * (1 - NEAR), -1, 0, 5, _HIGH * (1 - NEAR)]
_LOGS = np.array(
    [-1e30, -100, _LOW * (1 + NEAR), *_INSIDE, _HIGH * (1 + NEAR), 45, 89, 800, 1e30]
)


def _variance(log_scale):
    one = constant(np.zeros(1), log_scale.dtype)
    rows = Splats(
        constant(np.zeros((1, 3)), log_scale.dtype),
        constant(np.full((1, 3), 1), log_scale.dtype) * log_scale,
        constant(np.zeros((1, 4)), log_scale.dtype),
        one,
        constant(np.zeros((1, 1, 3)), log_scale.dtype),
        constant(np.zeros((1, 0, 3)), log_scale.dtype),
    )
    return splats.activate(rows).scale[0, :1] ** 2


def _exact_variance(log_scale):
    return [mpmath.exp(2 * max(min(log_scale[0], _HIGH), _LOW))]


LOG_SCALE = Case(
    name="variance of a log-scale",
    breaks="exp(s)² is infinite from s = 45 on (355 in f64), and its gradient is NaN.",
    formula="exp(clip(s, -20, 15)) is used, without gradient outside",
    switch="switch at -20 and 15",
    axis="log-scale",
    at=_LOGS,
    stable=_variance,
    textbook=lambda s: jnp.exp(s) ** 2,
    exact=_exact_variance,
    bounds={"float32": (3e-6, 3e-6, 4e-7), "float64": (1e-14, 1e-14, 2e-15)},
    alike=False,  # all of a row is activated, not one scale
)


COPIES = 40
_OPACITIES = np.array([1e-4, 0.01, 0.1, 0.5, 0.9, 0.999, 1 - 1e-6])


def _spread(opacity):
    each, scale = mcmc.compute_relocation(
        opacity,
        constant(np.ones((1, 3)), opacity.dtype),
        constant(np.full(1, COPIES), jnp.int32),
        least=0.0,
    )
    return jnp.concatenate([each, scale[0, :1]])


@functools.cache
def _binomials():
    """Factor of each^(k+1) in equation 9, summed over the copies i: [COPIES]."""
    return [
        mpmath.mpf(-1) ** k
        * sum(mpmath.binomial(i, k) for i in range(COPIES))
        / mpmath.sqrt(k + 1)
        for k in range(COPIES)
    ]


def _spread_textbook(opacity):
    """Equation 9, its alternating sum in the precision of the opacity."""
    each = 1 - (1 - opacity) ** (1 / COPIES)
    factors = constant([float(f) for f in _binomials()], opacity.dtype)
    powers = each ** jnp.arange(1, COPIES + 1).astype(opacity.dtype)
    return jnp.concatenate([each, opacity / jnp.sum(factors * powers)])


def _exact_spread(opacity):
    each = 1 - (1 - opacity[0]) ** (mpmath.mpf(1) / COPIES)
    total = sum(f * each ** (k + 1) for k, f in enumerate(_binomials()))
    return [each, opacity[0] / total]


RELOCATION = Case(
    name=f"relocation to {COPIES} copies",
    breaks="Alternating binomial coefficients of 1e10 cancel, and so does 1 - (1 - "
    "o)^(1/n).",
    formula="The composite of n copies is integrated with positive terms only, by "
    "expm1 and log1p",
    axis="opacity",
    at=_OPACITIES,
    stable=_spread,
    textbook=_spread_textbook,
    exact=_exact_spread,
    bounds={"float32": (2e-6,), "float64": (1e-13,)},
    timed=np.array([0.5]),
)


_SPEEDS = np.array([0, 1e-4, 1e-3, 1e-2, 1])


def _bend(x):
    before, now, after = (x[None, 3 * i : 3 * i + 3] for i in range(3))
    return acceleration.acceleration_loss(now, before, now, after, 1.0, 0.0)[None]


def _bend_textbook(x):
    second = x[:3] + x[6:] - 2 * x[3:6]
    return jnp.sum(second**2)[None]


def _exact_bend(x):
    second = [x[i] - 2 * x[3 + i] + x[6 + i] for i in range(3)]
    return [mpmath.fdot(second, second)]


_FROM, _MOVE = np.array([10.3, -20.7, 5.1]), np.array([0.6, -0.3, 0.5])

ACCELERATION = Case(
    name="acceleration of a slow motion",
    breaks="The sum in p₊ + p₋ - 2p is rounded before it cancels.",
    formula="(p₊ - p) - (p - p₋) is computed, whose differences are exact for close "
    "positions",
    axis="scene units per interval",
    at=_SPEEDS,
    points=np.concatenate(
        [_FROM + _SPEEDS[:, None] * share * _MOVE for share in (-1.0, 0.0, 1.25)], 1
    ),
    stable=_bend,
    textbook=_bend_textbook,
    exact=_exact_bend,
    bounds={"float32": (1e-6, 1e-6), "float64": (1e-15, 1e-15)},
)

CASES = (LONG_LIST, HALVED, LOG_SCALE, RELOCATION, ACCELERATION)
