"""Fourier features of positions and times, and their coarse-to-fine window."""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.geometry.fusion import materialised
from nerfies_jax.geometry.precision import at_least_float32

Scalar = Float[Array, ""]

# sin πr and cos πr on |r| <= 1/4 as polynomials in r²: these Taylor terms leave 7e-9
# (float32) and 2e-17 (float64).
_TERMS = {"float32": 5, "float64": 9}


@dataclasses.dataclass(frozen=True)
class EncodingSpec:
    """Sines and cosines of 2^k x (times π where `times_pi`), k = 0 .. bands-1.

    `times_pi` is Mildenhall et al. 2020, equation 4, for coordinates in [-1, 1]. The
    published code of NeRF and Nerfies leaves π out, and its captures fill a box of
    diagonal one. `identity` puts the coordinates themselves in front.
    """

    bands: int
    identity: bool = True
    times_pi: bool = False

    def __post_init__(self):
        # 2^24 and above would turn neighbouring float32 coordinates into noise
        if not 0 <= self.bands <= 24:
            raise ValueError(
                f"an encoding has 0 to 24 bands, got bands={self.bands}; ten resolve a "
                "thousandth of the scene"
            )
        if self.bands == 0 and not self.identity:
            raise ValueError(
                "an encoding with bands=0 and identity=False has no features; set one"
            )

    def width(self, dimensions: int) -> int:
        """Features made of a point with so many coordinates."""
        return dimensions * (2 * self.bands + self.identity)

    @property
    def shortest_wave(self) -> float:
        """Length of the last band's wave in the coordinates' units; inf without one."""
        if self.bands == 0:
            return math.inf
        return (2 if self.times_pi else 2 * math.pi) / 2 ** (self.bands - 1)


@at_least_float32
def encode(
    spec: EncodingSpec,
    point: Float[Array, " dim"],
    window: Float[Array, " bands"] | None,
) -> Float[Array, " features"]:
    """Features of one point: [x,] then for each band sin of all axes, cos of all axes.

    `window` weighs the bands (see `anneal`), never the identity; None leaves them all
    on. The layout is that of Nerfies, whose weights can therefore be read. Narrower
    coordinates than float32 are encoded in float32, and the features rounded.
    """
    if spec.bands == 0:
        return point
    powers = jnp.asarray([2.0**k for k in range(spec.bands)], point.dtype)
    scaled = powers[:, None] * point  # a power of two: exact; float16 would overflow
    # Half turns are reduced before π is rounded in: `sin(2^k π x)` in float32 is 1e-4
    # off at k = 9 and noise at |x| = 1e4. Measured with 8 bands, the polynomial takes
    # 0.55 of the time forward and 0.14 in the gradient. Without π the product is exact
    # and XLA's sine good to 3e-8 at any argument; reducing by π/2 would limit |x|.
    sine, cosine = sincospi(scaled) if spec.times_pi else sincos(scaled)
    waves = jnp.stack([sine, cosine], axis=1)
    if window is not None:
        waves = waves * window[:, None, None]
    features = waves.reshape(-1)
    return jnp.concatenate([point, features]) if spec.identity else features


@at_least_float32
def anneal(bands: int, alpha: Scalar) -> Float[Array, " bands"]:
    """Weights that open band k as `alpha` goes from k to k + 1; traced.

    Coarse to fine, Nerfies (Park et al. 2021): (1 - cos(π clip(α - k, 0, 1))) / 2, here
    as sin²: the difference is 20 % off where a band begins to open, in float32. At
    `alpha` = 0 every band is shut and only the identity passes; without identity the
    features are then all zero.
    """
    opened = jnp.clip(alpha - jnp.arange(bands, dtype=alpha.dtype), 0, 1)
    # The polynomial's ends are exact: a shut band is 0 and an open one is 1.
    return sincospi(opened / 2)[0] ** 2


@jax.custom_jvp
def sincos(
    angle: Float[Array, "*batch"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """sin x and cos x together, of any finite x, as exact as XLA has them.

    Each is computed once, where XLA:CPU would compute it in the features and again for
    their slopes: a step of `nerfies-small` takes 120 ms for 127, of `d-nerf-small` 114
    for 123 (least of 24, side by side in one process).
    """
    return materialised(jnp.sin(angle)), materialised(jnp.cos(angle))


@sincos.defjvp
def _sincos_jvp(primals, tangents):
    sine, cosine = sincos(*primals)
    return (sine, cosine), (cosine * tangents[0], -sine * tangents[0])


@jax.custom_jvp
@at_least_float32
def sincospi(
    half_turns: Float[Array, "*batch"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """sin πx and cos πx together, of any finite x, to an ulp or two of 1."""
    x = half_turns
    # Both steps are exact: x - 2 round(x/2) loses no bits, nor does taking off a
    # multiple of ½, so nothing is rounded before the multiplication by π.
    turn = x - 2 * jnp.round(x / 2)
    quarter = jnp.round(2 * turn)
    r = turn - quarter / 2
    r_sq = r * r
    terms = _TERMS[x.dtype.name]
    sine = r * _horner([_coefficient(2 * n + 1) for n in range(terms)], r_sq)
    cosine = _horner([_coefficient(2 * n) for n in range(terms + 1)], r_sq)
    swap = jnp.abs(quarter) == 1
    first = jnp.where(swap, cosine, sine)
    second = jnp.where(swap, sine, cosine)
    # quarter is -2 .. 2; the quadrants' signs
    sine = jnp.where((quarter < 0) | (quarter == 2), -first, first)
    cosine = jnp.where((quarter == 1) | (jnp.abs(quarter) == 2), -second, second)
    return materialised(sine), materialised(cosine)


@sincospi.defjvp
def _sincospi_jvp(primals, tangents):
    """π cos and -π sin: the polynomial's own derivative has one term less."""
    sine, cosine = sincospi(*primals)
    turned = math.pi * tangents[0]
    return (sine, cosine), (cosine * turned, -sine * turned)


def _coefficient(power):
    return (-1) ** (power // 2) * math.pi**power / math.factorial(power)


def _horner(coefficients, x):
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total
