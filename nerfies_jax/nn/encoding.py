"""Positional encoding of points and times, and its coarse-to-fine window."""

import dataclasses
import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.geometry.precision import at_least_float32
from nerfies_jax.nn.sines import sincos, sincospi
from nerfies_jax.runtime.contract import checked

Scalar = Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class EncodingSpec:
    """Settings of a positional encoding with frequencies 2^k, k = 0 .. bands-1.

    `times_pi` multiplies frequencies by π, as in Mildenhall et al. 2020, equation 4,
    for coordinates in [-1, 1]. The published code of NeRF and Nerfies omits π, and its
    scenes fill a box of diagonal one. `identity` prepends the coordinates.
    """

    bands: int
    identity: bool = True
    times_pi: bool = False

    def __post_init__(self):
        # From 2^24 on, neighboring float32 coordinates give unrelated features.
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
        """Return the number of features of a point.

        Args:
          dimensions: Number of coordinates of the point.

        Returns:
          The length of `encode`'s result.
        """
        return dimensions * (2 * self.bands + self.identity)

    @property
    def shortest_wave(self) -> float:
        """Wavelength of the last band in coordinate units, inf without bands."""
        if self.bands == 0:
            return math.inf
        return (2 if self.times_pi else 2 * math.pi) / 2 ** (self.bands - 1)


@checked(broadcast=True)
@at_least_float32
def encode(
    spec: EncodingSpec,
    point: Float[Array, " dim"],
    window: Float[Array, " bands"] | None,
) -> Float[Array, " features"]:
    """Encode one point as [x,] and, band by band, sines and cosines of all axes.

    The layout is that of Nerfies, so that its weights can be loaded. Coordinates in
    half precision are encoded in float32, and the features are rounded.

    Args:
      spec: Settings of the encoding.
      point: Coordinates, [dim].
      window: Weights of the bands (see `anneal`), [bands]. The coordinates are not
        weighted. None is a weight of one for all bands.

    Returns:
      Features, [spec.width(dim)].

    Raises:
      ValueError: If the window has another number of bands.
    """
    if spec.bands == 0:
        return point
    if window is not None and window.shape != (spec.bands,):
        raise ValueError(
            f"a window of {window.shape[0]} weights does not fit {spec.bands} bands; "
            "use the same number of bands for both"
        )
    powers = jnp.asarray([2.0**k for k in range(spec.bands)], point.dtype)
    phase = powers[:, None] * point  # exact; float16 would overflow
    # The argument is reduced before the multiplication by π. Computed as sin(2^k π x)
    # in float32, the error is 1e-4 at k = 9, and the result is noise at |x| = 1e4.
    # Without π the product is exact.
    sine, cosine = sincospi(phase) if spec.times_pi else sincos(phase)
    waves = jnp.stack([sine, cosine], axis=1)
    if window is not None:
        waves = waves * window[:, None, None]
    features = waves.reshape(-1)
    return jnp.concatenate([point, features]) if spec.identity else features


@checked(broadcast=True)
@at_least_float32
def anneal(bands: int, alpha: Scalar) -> Float[Array, " bands"]:
    """Compute the coarse-to-fine window (1 - cos(π clip(α - k, 0, 1))) / 2.

    It is computed as sin², because the difference has an error of 20 % in float32 where
    a band begins to open. At `alpha` = 0 all bands are zero. Only the coordinates
    remain then, if `identity` is set.

    Args:
      bands: Number of bands.
      alpha: Progress α, traced. Band k opens while it goes from k to k + 1.

    Returns:
      Weights in [0, 1], [bands].

    References:
      Park et al. 2021 (Nerfies), arXiv:2011.12948, equation 8.
    """
    fraction = jnp.clip(alpha - jnp.arange(bands, dtype=alpha.dtype), 0, 1)
    # The polynomial is exact at its ends: closed bands are 0 and open bands are 1.
    return sincospi(fraction / 2)[0] ** 2


@checked(broadcast=True)
def positional_encoding(
    points: Float[Array, "*batch dim"],
    num_frequencies: int,
    window: Float[Array, "*batch num_frequencies"] | None = None,
    *,
    include_input: bool = True,
    times_pi: bool = False,
) -> Float[Array, "*batch features"]:
    """Encode coordinates with sines and cosines of growing frequency.

    Args:
      points: Coordinates [..., dim]. Leading axes of `points` and `window` broadcast.
      num_frequencies: Number of frequency bands, 1, 2, 4, ... in that order, 0 to 24.
      window: Weight of each band, [..., num_frequencies], as `coarse_to_fine_window`
        makes them. None enables all bands. The coordinates are not weighted.
      include_input: True to put the coordinates themselves first.
      times_pi: True to multiply frequencies by pi, as in the paper of NeRF. The
        code of NeRF and Nerfies omits it.

    Returns:
      Features [..., dim * (2 * num_frequencies + include_input)]: the coordinates, then
      for each band the sines and then the cosines of all coordinates.

    Raises:
      ValueError: If the number of bands is out of range or does not fit the window.

    References:
      Mildenhall et al. 2020, arXiv:2003.08934, equation 4.
    """
    spec = EncodingSpec(num_frequencies, include_input, times_pi)
    return encode(spec, points, window)


@checked(broadcast=True)
def coarse_to_fine_window(
    num_frequencies: int, alpha: Float[Array, "*batch"] | float
) -> Float[Array, "*batch num_frequencies"]:
    """Compute the weights of an encoding's bands during coarse-to-fine training.

    Band k opens while `alpha` goes from k to k + 1. At 0 all bands are off, and at
    `num_frequencies` all are on.

    Args:
      num_frequencies: Number of frequency bands of the encoding.
      alpha: Progress [...], a number or an array. It may be traced.

    Returns:
      Weights in [0, 1], [..., num_frequencies].

    References:
      Park et al. 2021 (Nerfies), arXiv:2011.12948, equation 8.
    """
    if not isinstance(alpha, Array):
        alpha = jnp.asarray(float(alpha))
    return anneal(num_frequencies, alpha)
