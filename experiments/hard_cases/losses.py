"""Hard cases of losses and of measures: penalties, similarities, spectra."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from gaussians_jax.effects import depth, spectral
from nerfies_jax.capture.synthetic import texture
from nerfies_jax.effects import transient
from nerfies_jax.training import losses

AXIS = np.array([2.0, -1.0, 2.0]) / 3
WIDTH = 0.03125  # 2^-5: the same number in every precision
PENALTY = {"float32": (6e-7, 1e-6, 3e-6), "float64": (1e-15, 2e-15, 5e-15)}
NEAR = 1e-6  # how close to a switch its two sides are tried, as a share of it


def _sides(switch):
    return [switch * (1 - NEAR), switch * (1 + NEAR)]


def _along(lengths):
    lengths = np.array(lengths)
    return {"axis": "|r|", "at": lengths, "inputs": lengths[:, None] * AXIS}


def _geman_by_power(r):
    """Barron 2019, equation 8 with alpha = -2 and the width 2c, of a length."""
    length = jnp.sqrt(jnp.sum(r**2))
    return (2 - 2 * (jnp.square(length / WIDTH) / 4 + 1) ** -1)[None]


def _exact_sq(r):
    return sum(x**2 for x in r)


GEMAN = Case(
    name="Geman-McClure of a vector",
    breaks="a length has no slope at 0; 2 - 2/(1 + u) is 0 below u = 1e-8",
    formula="2u/(1 + u) of u = |r|²/4c², 1/(1 + 1/u) above; derivative 1/(1 + u)²",
    switch="u = 1",
    **_along([0, 1e-15, 1e-9, 1e-6, 1e-3, *_sides(2 * WIDTH), 1, 1e3, 1e6, 1e15]),
    stable=lambda r: losses.geman_mcclure(jnp.sum(r**2), WIDTH)[None],
    textbook=_geman_by_power,
    exact=lambda r: [2 * _exact_sq(r) / (_exact_sq(r) + 4 * mpmath.mpf(WIDTH) ** 2)],
    bounds=PENALTY | {"bfloat16": (2e-2, 3e-2)},
    floors=(0, 1e-30, 1e-20),
    caught=(
        ("float32", "value"),
        ("float64", "value"),
        ("float32", "slope"),
        ("float64", "curvature"),
    ),
    timed=0.01 * AXIS,
)


def _charbonnier_by_difference(r):
    return (jnp.sqrt(jnp.sum(r**2) + WIDTH**2) - WIDTH)[None]


def _exact_charbonnier(r):
    width = mpmath.mpf(WIDTH)
    return [mpmath.sqrt(_exact_sq(r) + width**2) - width]


CHARBONNIER = Case(
    name="Charbonnier of a vector",
    breaks="√(s + c²) - c is 0 below s = 1e-7 c², and its digits go before",
    formula="s / (√(s + c²) + c), from s = 8 c² on √(s + c²) - c",
    switch="s = 8 c²",
    **_along([0, 1e-15, 1e-9, 1e-6, 1e-3, WIDTH, 1, 1e3, 1e6, 1e15]),
    stable=lambda r: losses.charbonnier(jnp.sum(r**2), WIDTH)[None],
    textbook=_charbonnier_by_difference,
    exact=_exact_charbonnier,
    bounds={kind: bounds[:2] for kind, bounds in PENALTY.items()},
    caught=(("float32", "value"), ("float64", "value")),
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
    breaks="the length has no slope at 0",
    formula="s / 2 of the squared length; the root is taken of what is above",
    switch="|r| = c",
    **_along([0, 1e-15, 1e-9, 1e-3, *_sides(WIDTH), 1, 1e3, 1e6, 1e15]),
    stable=lambda r: losses.huber(jnp.sum(r**2), WIDTH)[None],
    textbook=_huber_of_length,
    exact=_exact_huber,
    bounds={kind: bounds[:2] for kind, bounds in PENALTY.items()},
    caught=(("float32", "slope"), ("float64", "slope")),
    timed=0.01 * AXIS,
)

_ERRORS = np.array([0, 1e-30, *_sides(1e-10), 1e-8, 1e-4, 0.1, 10, 1e6])


PSNR = Case(
    name="PSNR of equal pictures",
    breaks="log of 0; log(mse + 1e-10) reads 79.957 dB for 80, slope -4e10 at 0",
    formula="log of max(mse, 1e-10)",
    switch="mse = 1e-10",
    axis="mean squared error",
    at=_ERRORS,
    inputs=_ERRORS[:, None],
    stable=losses.psnr,
    textbook=lambda mse: -10 * jnp.log10(mse + 1e-10),
    exact=lambda mse: [-10 * mpmath.log10(max(mse[0], mpmath.mpf(losses.LEAST_MSE)))],
    bounds={"float32": (1e-6, 1e-6), "float64": (1e-15, 1e-15)},
    floors=(10.0, 0.0, 0.0),
    caught=(
        ("float32", "value"),
        ("float64", "value"),
        ("float32", "slope"),
        ("float64", "slope"),
    ),
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
    breaks="log(1 + exp(x)) is infinite from x = 89 (709), 0 / ∞ in its slope",
    formula="softplus by logaddexp, β_min added, r / β squared",
    axis="raw β",
    at=_RAW,
    inputs=np.concatenate([np.tile(_RESIDUAL, (len(_RAW), 1)), _RAW[:, None]], 1),
    stable=_uncertain,
    textbook=_uncertain_textbook,
    exact=_exact_uncertain,
    bounds={"float32": (1e-6, 2e-6), "float64": (2e-15, 5e-15)},
    floors=(1.0, 0.0, 0.0),
    caught=(("float32", "value"), ("float64", "value"), ("float32", "slope")),
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
    breaks="the slope of the power is infinite at 0, and `where` multiplies it by 0",
    formula="the power sees 1 where the line is taken",
    switch="light = 0.0031308",
    axis="linear light",
    at=_LIGHT,
    inputs=_LIGHT[:, None],
    stable=texture.srgb,
    textbook=_srgb_textbook,
    exact=_exact_srgb,
    bounds={"float32": (1e-6, 1e-6), "float64": (2e-15, 2e-15)},
    caught=(("float32", "slope"), ("float64", "slope")),
    timed=np.array([0.2]),
)


# Two rows of three pixels: every sum of them is exact enough to see only the amplitude.
_PATTERN = np.array([1.0, -0.25, 0.5, 0.125, 0.75, -0.5])
_CONTRAST = np.array([0, 1e-22, 1e-15, 1e-6, 1e-3, 1, 1e10])


def _transformed(pixels):
    return jnp.fft.rfft2(pixels.reshape(2, 3), norm="ortho").reshape(-1)


def _amplitudes_textbook(pixels):
    spectrum = _transformed(pixels)
    return jnp.sqrt(spectrum.real**2 + spectrum.imag**2)


def _exact_amplitudes(pixels):
    found = []
    for k in range(2):
        for j in range(2):
            turns = [
                mpmath.mpf(k * (n // 3)) / 2 + mpmath.mpf(j * (n % 3)) / 3
                for n in range(6)
            ]
            real = sum(
                p * mpmath.cospi(2 * t) for p, t in zip(pixels, turns, strict=True)
            )
            imag = sum(
                p * mpmath.sinpi(2 * t) for p, t in zip(pixels, turns, strict=True)
            )
            found.append(mpmath.sqrt((real**2 + imag**2) / 6))
    return found


AMPLITUDE = Case(
    name="Fourier amplitudes of an almost black picture",
    breaks="√(re² + im²) is 0 below 1e-19 (f32), its slope 0/0",
    formula="abs of the complex number; slope 0 where it vanishes",
    axis="contrast",
    at=_CONTRAST,
    inputs=_CONTRAST[:, None] * _PATTERN,
    stable=lambda x: spectral.amplitudes(x.reshape(2, 3, 1)).reshape(-1),
    textbook=_amplitudes_textbook,
    exact=_exact_amplitudes,
    bounds={"float32": (1e-6, 2e-6), "float64": (2e-15, 5e-15)},
    caught=(("float32", "value"), ("float32", "slope"), ("float64", "slope")),
    timed=_PATTERN,
)


# Dyadic numbers: level + offset + contrast * pattern is exact in float32, so all that
# is lost is lost by the similarity.
_PICTURE = np.random.default_rng(0).integers(-2, 3, (11, 11, 1)).astype(float)
_OTHER = np.random.default_rng(1).integers(-2, 3, (11, 11, 1)).astype(float)
_LEVELS = [
    (0.875, 0.0, 0.0),
    (0.875, 2.0**-12, 0.0),
    (0.875, 0.0, 2.0**-12),
    (0.875, 2.0**-6, 2.0**-6),
    (0.5, 0.125, 0.0625),
    (1000.0, 0.0, 0.0),
    (1000.0, 0.0, 0.5),
    (1000.0, 0.5, 0.5),
]


def _pair(x):
    level, offset, contrast = x
    image, target = (constant(p, x.dtype) for p in (_PICTURE, _OTHER))
    return level + offset + contrast * image, level + contrast * target


def _dssim_textbook(x):
    image, target = _pair(x)
    weight = constant(np.multiply.outer(losses.WINDOW, losses.WINDOW), x.dtype)
    a, b, aa, bb, ab = (
        jnp.sum(weight[..., None] * part)
        for part in (image, target, image**2, target**2, image * target)
    )
    structure = (2 * (ab - a * b) + losses.CONTRAST) / (
        aa - a * a + bb - b * b + losses.CONTRAST
    )
    luminance = (2 * a * b + losses.LUMINANCE) / (a * a + b * b + losses.LUMINANCE)
    return (1 - luminance * structure)[None]


def _exact_dssim(x):
    level, offset, contrast = x
    line = [mpmath.exp(-mpmath.mpf(k * k) / 4.5) for k in range(-5, 6)]
    total = sum(line)
    weight = [u * v / total**2 for u in line for v in line]
    image = [level + offset + contrast * p for p in _PICTURE.ravel().tolist()]
    target = [level + contrast * p for p in _OTHER.ravel().tolist()]

    def mean(values):
        return mpmath.fdot(weight, values)

    a, b = mean(image), mean(target)
    va = mean([(p - a) ** 2 for p in image])
    vb = mean([(p - b) ** 2 for p in target])
    vab = mean([(p - a) * (q - b) for p, q in zip(image, target, strict=True)])
    c1, c2 = mpmath.mpf(losses.LUMINANCE), mpmath.mpf(losses.CONTRAST)
    ssim = (2 * a * b + c1) / (a * a + b * b + c1) * (2 * vab + c2) / (va + vb + c2)
    return [1 - ssim]


DSSIM = Case(
    name="SSIM of pictures almost alike",
    breaks="E[xy] - E[x] E[y]: 4e-5 off at level 0.9, slope of noise where 0 is true",
    formula="a + b - ab from the window of image - target, about the target's mean",
    axis="row of level, offset, contrast",
    at=np.arange(len(_LEVELS), dtype=float),
    inputs=np.array(_LEVELS),
    stable=lambda x: losses.dssim_map(*_pair(x), padding="valid").reshape(1),
    textbook=_dssim_textbook,
    exact=_exact_dssim,
    bounds={"float32": (1e-6, 5e-4), "float64": (2e-15, 5e-13)},
    floors=(1e-3, 1e-3, 0.0),
    caught=(("float32", "value"), ("float32", "slope"), ("float64", "slope")),
)


# A picture of 2 x 2 about a bright level: the bands are differences of its pixels.
_SOFT = np.array([0, 1e-3, 0.01, 0.1, 1, 100])
_QUAD = np.array([3.1, -2.2, 5.3, 1.7])


def _bands(pixels):
    high = spectral.haar_pyramid(pixels.reshape(2, 2, 1), 1).high[0]
    return jnp.concatenate([band.reshape(-1) for band in high])


def _bands_textbook(pixels):
    a, b, c, d = pixels
    return jnp.stack([(a + c) - (b + d), (a + b) - (c + d), (a + d) - (b + c)]) / 2


HAAR = Case(
    name="wavelet bands of low contrast",
    breaks="sums of pixels round before they are subtracted",
    formula="differences of neighbours first",
    axis="contrast at level 1000.3",
    at=_SOFT,
    inputs=1000.3 + _SOFT[:, None] * _QUAD,
    stable=_bands,
    textbook=_bands_textbook,
    exact=lambda p: [
        (p[0] + p[2] - p[1] - p[3]) / 2,
        (p[0] + p[1] - p[2] - p[3]) / 2,
        (p[0] + p[3] - p[1] - p[2]) / 2,
    ],
    bounds={"float32": (2e-7, 2e-7), "float64": (4e-16, 4e-16)},
    caught=(("float32", "value"),),
)


_DEPTHS = np.array([2.0, 3.5, 2.5, 6.0, 4.25, 3.0])
_WRONG = np.array([0.5, -1.0, 0.25, 0.5, -0.75, 0.5])
_OFF = np.array([2.0**-14, 2.0**-11, 2.0**-8, 2.0**-4, 1.0])


def _truth_like(x):
    return constant(_DEPTHS, x.dtype)


def _pearson_textbook(x):
    truth = _truth_like(x)
    a, b = x - jnp.mean(x), truth - jnp.mean(truth)
    r = jnp.sum(a * b) / jnp.sqrt(jnp.sum(a * a) * jnp.sum(b * b))
    return (1 - r)[None]


def _exact_pearson(x):
    truth = [mpmath.mpf(float(t)) for t in _DEPTHS]
    a = [v - sum(x) / 6 for v in x]
    b = [v - sum(truth) / 6 for v in truth]
    length = mpmath.sqrt(mpmath.fdot(a, a) * mpmath.fdot(b, b))
    return [1 - mpmath.fdot(a, b) / length]


CORRELATION = Case(
    name="1 - correlation of depths that agree",
    breaks="1 - r is a few ulps of 1",
    formula="half the mean square of the difference of standardised depths",
    axis="departure from the truth",
    at=_OFF,
    inputs=_DEPTHS + _OFF[:, None] * _WRONG,
    stable=lambda x: depth.correlation(x, _truth_like(x), constant(np.ones(6), bool))[
        None
    ],
    textbook=_pearson_textbook,
    exact=_exact_pearson,
    bounds={"float32": (1e-3, 1e-3), "float64": (1e-11, 1e-11)},
    caught=(("float32", "value"),),
)

CASES = (
    GEMAN,
    CHARBONNIER,
    HUBER,
    PSNR,
    NERF_W,
    SRGB,
    AMPLITUDE,
    DSSIM,
    HAAR,
    CORRELATION,
)
