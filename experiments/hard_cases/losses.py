"""Hard cases of losses: penalties, uncertainty, light."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from nerfies_jax.capture.synthetic import texture
from nerfies_jax.fields.effects import transient
from nerfies_jax.training import losses

AXIS = np.array([2.0, -1.0, 2.0]) / 3
WIDTH = 0.03125  # 2^-5: the same number in every precision
PENALTY = {"float32": (6e-7, 1e-6, 3e-6), "float64": (1e-15, 2e-15, 5e-15)}
NEAR = 1e-6  # how close to a switch its two sides are tried, as a share of it


def _sides(switch):
    return [switch * (1 - NEAR), switch * (1 + NEAR)]


def _along(lengths):
    return {"axis": "|r|", "at": np.array(lengths), "along": AXIS}


def _geman_by_power(r):
    """Barron 2019, equation 8 with alpha = -2 and the width 2c, of a length."""
    length = jnp.sqrt(jnp.sum(r**2))
    return (2 - 2 * (jnp.square(length / WIDTH) / 4 + 1) ** -1)[None]


def _exact_sq(r):
    return sum(x**2 for x in r)


GEMAN = Case(
    name="Geman-McClure of a vector",
    breaks="A norm has no gradient at 0, and 2 - 2/(1 + u) is 0 below u = 1e-8.",
    formula="2u/(1 + u) of u = |r|²/4c² is used, as 2/(1 + 1/u) for large u, and "
    "u/(1 + u) has the derivative 1/(1 + u)²",
    switch="switch at u = 1",
    **_along([0, 1e-15, 1e-9, 1e-6, 1e-3, *_sides(2 * WIDTH), 1, 1e3, 1e6, 1e15]),
    stable=lambda r: losses.geman_mcclure(jnp.sum(r**2), WIDTH)[None],
    textbook=_geman_by_power,
    exact=lambda r: [2 * _exact_sq(r) / (_exact_sq(r) + 4 * mpmath.mpf(WIDTH) ** 2)],
    bounds=PENALTY | {"bfloat16": (2e-2, 3e-2)},
    floors=(0, 1e-30, 1e-20),
    timed=0.01 * AXIS,
)


def _charbonnier_by_difference(r):
    return (jnp.sqrt(jnp.sum(r**2) + WIDTH**2) - WIDTH)[None]


def _exact_charbonnier(r):
    width = mpmath.mpf(WIDTH)
    return [mpmath.sqrt(_exact_sq(r) + width**2) - width]


CHARBONNIER = Case(
    name="Charbonnier of a vector",
    breaks="√(s + c²) - c is 0 below s = 1e-7 c², and loses digits earlier.",
    formula="s / (√(s + c²) + c) is used, and √(s + c²) - c for large s",
    switch="switch at s = 8 c²",
    **_along([0, 1e-15, 1e-9, 1e-6, 1e-3, WIDTH, 1, 1e3, 1e6, 1e15]),
    stable=lambda r: losses.charbonnier(jnp.sum(r**2), WIDTH)[None],
    textbook=_charbonnier_by_difference,
    exact=_exact_charbonnier,
    bounds=PENALTY,
    timed=0.01 * AXIS,
)


def _huber_of_length(r):
    length = jnp.sqrt(jnp.sum(r**2))
    far = WIDTH * (length - WIDTH / 2)
    return jnp.where(length < WIDTH, length**2 / 2, far)[None]


def _exact_huber(r):
    square, width = _exact_sq(r), mpmath.mpf(WIDTH)
    if square < width**2:
        return [square / 2]
    return [width * (mpmath.sqrt(square) - width / 2)]


HUBER = Case(
    name="Huber of a vector",
    breaks="A norm has no gradient at 0.",
    formula="s / 2 is computed from the squared norm, and the root only of larger ones",
    switch="switch at |r| = c",
    **_along([0, 1e-15, 1e-9, 1e-3, *_sides(WIDTH), 1, 1e3, 1e6, 1e15]),
    stable=lambda r: losses.huber(jnp.sum(r**2), WIDTH)[None],
    textbook=_huber_of_length,
    exact=_exact_huber,
    bounds=PENALTY,
    timed=0.01 * AXIS,
)

_ERRORS = np.array([0, 1e-30, *_sides(1e-10), 1e-8, 1e-4, 0.1, 10, 1e6])


PSNR = Case(
    name="PSNR of equal images",
    breaks="log 0 is infinite. log(mse + 1e-10) gives 79.957 dB instead of 80 and a "
    "gradient of -4e10 at 0.",
    formula="log of max(mse, 1e-10) is used",
    switch="switch at mse = 1e-10",
    axis="mean squared error",
    at=_ERRORS,
    stable=losses.psnr,
    textbook=lambda mse: -10 * jnp.log10(mse + 1e-10),
    exact=lambda mse: [-10 * mpmath.log10(max(mse[0], mpmath.mpf(losses.LEAST_MSE)))],
    bounds={"float32": (1e-6, 1e-6, 6e-7), "float64": (1e-15, 1e-15, 1e-15)},
    floors=(10.0, 0.0, 0.0),
    timed=np.array([1e-3]),
)


BETA_MIN = 0.03125
_RESIDUAL = np.array([0.125, -0.0625, 0.25])
_RAW = np.array([-1000, -100, -30, -5, 0, 5, 30, 88, 89, 100, 1e4])


def _uncertain(x):
    """NeRF-W's loss of a residual [3] and a raw β, one sample of weight one."""
    one = constant(np.ones((1,)), x.dtype)
    beta = transient.uncertainty(BETA_MIN, one, jax.nn.softplus(x[3:]))
    loss = transient.photometric(
        x[None, :3], constant(np.zeros((1, 3)), x.dtype), beta[None], None
    )
    return loss[None]


def _uncertain_textbook(x):
    beta = BETA_MIN + jnp.log(1 + jnp.exp(x[3]))
    return (jnp.sum(x[:3] ** 2) / (2 * beta**2) + jnp.log(beta))[None]


def _exact_uncertain(x):
    beta = mpmath.mpf(BETA_MIN) + mpmath.log1p(mpmath.exp(x[3]))
    return [_exact_sq(x[:3]) / (2 * beta**2) + mpmath.log(beta)]


NERF_W = Case(
    name="NeRF-W's loss over its raw β",
    breaks="log(1 + exp(x)) is infinite from x = 89 on (709 in f64), with 0 / ∞ in "
    "its gradient.",
    formula="softplus is computed by logaddexp, β_min is added, and r / β is squared",
    axis="raw β",
    at=_RAW,
    points=np.concatenate([np.tile(_RESIDUAL, (len(_RAW), 1)), _RAW[:, None]], 1),
    stable=_uncertain,
    textbook=_uncertain_textbook,
    exact=_exact_uncertain,
    bounds={"float32": (1e-6, 2e-6, 7e-7), "float64": (2e-15, 5e-15, 2e-13)},
    floors=(1.0, 0.0, 0.0),
)

_LIGHT = np.array([0, 1e-30, 1e-6, *_sides(0.0031308), 0.2, 1, 100])


def _srgb_textbook(light):
    power = 1.055 * light ** (1 / 2.4) - 0.055
    return jnp.where(light <= 0.0031308, 12.92 * light, power)


def _exact_srgb(light):
    if light[0] <= mpmath.mpf(0.0031308):
        return [mpmath.mpf(12.92) * light[0]]
    return [1.055 * mpmath.power(light[0], mpmath.mpf(1 / 2.4)) - mpmath.mpf(0.055)]


SRGB = Case(
    name="sRGB at black",
    breaks="The gradient of the power is infinite at 0, and `where` multiplies it by "
    "0.",
    formula="The power is evaluated at 1 where the linear branch is selected",
    switch="switch at a linear value of 0.0031308",
    axis="linear light",
    at=_LIGHT,
    stable=texture.srgb,
    textbook=_srgb_textbook,
    exact=_exact_srgb,
    bounds={"float32": (1e-6, 1e-6, 2e-6), "float64": (2e-15, 2e-15, 2e-15)},
    timed=np.array([0.2]),
)

CASES = (GEMAN, CHARBONNIER, HUBER, PSNR, NERF_W, SRGB)
