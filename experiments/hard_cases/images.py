"""Hard cases of measures of images: spectra, similarities, correlation."""

import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from gaussians_jax.losses import depth, spectral
from nerfies_jax.training import losses

# Two rows of three pixels: every sum of them is exact enough to see only the amplitude.
_PATTERN = np.array([1.0, -0.25, 0.5, 0.125, 0.75, -0.5])
_CONTRAST = np.array([0, 1e-22, 1e-15, 1e-6, 1e-3, 1, 1e10])


def _transform(pixels):
    return jnp.fft.rfft2(pixels.reshape(2, 3), norm="ortho").reshape(-1)


def _amplitudes_textbook(pixels):
    spectrum = _transform(pixels)
    return jnp.sqrt(spectrum.real**2 + spectrum.imag**2)


def _exact_amplitudes(pixels):
    amplitudes = []
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
            amplitudes.append(mpmath.sqrt((real**2 + imag**2) / 6))
    return amplitudes


AMPLITUDE = Case(
    name="Fourier amplitudes of an almost black image",
    breaks="√(re² + im²) is 0 below 1e-19 (f32), and its gradient is 0/0.",
    formula="abs of the complex number is used, with gradient 0 where it vanishes",
    axis="contrast",
    at=_CONTRAST,
    along=_PATTERN,
    stable=lambda x: spectral.amplitudes(x.reshape(2, 3, 1)).reshape(-1),
    textbook=_amplitudes_textbook,
    exact=_exact_amplitudes,
    bounds={"float32": (1e-6, 2e-6), "float64": (2e-15, 5e-15)},
    timed=_PATTERN,
)


# Dyadic numbers: level + offset + contrast * pattern is exact in float32, so all that
# is lost is lost by the similarity.
_IMAGE = np.random.default_rng(0).integers(-2, 3, (11, 11, 1)).astype(float)
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
    image, target = (constant(p, x.dtype) for p in (_IMAGE, _OTHER))
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
    image = [level + offset + contrast * p for p in _IMAGE.ravel().tolist()]
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
    name="SSIM of images almost alike",
    breaks="E[xy] - E[x] E[y] is off by 4e-5 at level 0.9, and its gradient is noise "
    "where it should be 0.",
    formula="a + b - ab is computed from the filtered image - target, about the mean "
    "of the target",
    axis="row of level, offset, contrast",
    at=np.arange(len(_LEVELS), dtype=float),
    points=np.array(_LEVELS),
    stable=lambda x: losses.dssim_map(*_pair(x), padding="valid").reshape(1),
    textbook=_dssim_textbook,
    exact=_exact_dssim,
    bounds={"float32": (1e-6, 5e-4), "float64": (2e-15, 5e-13)},
    floors=(1e-3, 1e-3, 0.0),
)


# An image of 2 x 2 about a bright level: the bands are differences of its pixels.
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
    breaks="Sums of pixels are rounded before they are subtracted.",
    formula="Differences of neighbors are computed first",
    axis="contrast at level 1000.3",
    at=_SOFT,
    points=1000.3 + _SOFT[:, None] * _QUAD,
    stable=_bands,
    textbook=_bands_textbook,
    exact=lambda p: [
        (p[0] + p[2] - p[1] - p[3]) / 2,
        (p[0] + p[1] - p[2] - p[3]) / 2,
        (p[0] + p[3] - p[1] - p[2]) / 2,
    ],
    bounds={"float32": (2e-7, 2e-7), "float64": (4e-16, 4e-16)},
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
    breaks="1 - r is a few ulps of 1.",
    formula="Half the mean square of the difference of standardized depths is used",
    axis="departure from the truth",
    at=_OFF,
    points=_DEPTHS + _OFF[:, None] * _WRONG,
    stable=lambda x: depth.correlation(x, _truth_like(x), constant(np.ones(6), bool))[
        None
    ],
    textbook=_pearson_textbook,
    exact=_exact_pearson,
    bounds={"float32": (1e-3, 1e-3, 8e-7), "float64": (1e-11, 1e-11, 2e-15)},
)

CASES = (AMPLITUDE, DSSIM, HAAR, CORRELATION)
