"""Losses on the spectrum of a frame, with gated weights.

Sonata, "learning frequency features in dual domains", equations 12 to 17: the high
bands of a wavelet pyramid, the amplitudes of the Fourier transform, and a learned gate
for each. Value and gradient at 270x480 take 4.5 and 4.0 ms on one core, compared with
10.5 ms for L1 and SSIM.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.splats import Params
from nerfies_jax.geometry.precision import widened
from nerfies_jax.runtime.contract import checked
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import PenaltyContext, Term, total
from nerfies_jax.training.step_counts import steps

NAME = "spectral"
GATES = ("learned", "floor", "fixed", "schedule")
LEARNED = ("learned", "floor")  # the gates that have parameters
# Lower bound of a learned gate. At the bound it has no gradient and stays. A gate can
# only close, so it would not open again anyway.
LEAST_OPENING = 1e-4


def _positive(what, **values):
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(
                f"the {what} {name} must be positive and finite, got {name}={value}; "
                "disable a loss with None"
            )


@dataclasses.dataclass(frozen=True)
class WaveletSpec:
    """Mean squared differences of the high bands of `levels` levels, finest first.

    Level l has the weight `level_factor`**l. Equation 13 has equal weights. Typical
    errors grow 2 to 10 times from level to level, so the coarsest level dominates. 1/4
    compensates the growth of orthonormal coefficients of a smooth error.
    """

    most: float = 0.1  # weight when the gate is fully open
    levels: int = 3
    level_factor: float = 1.0

    def __post_init__(self):
        _positive("wavelet", most=self.most, level_factor=self.level_factor)
        if self.levels < 1:
            raise ValueError(
                f"a wavelet loss needs levels >= 1, got levels={self.levels}; "
                "disable it with wavelet=None"
            )


@dataclasses.dataclass(frozen=True)
class FourierSpec:
    """Mean squared differences of Fourier amplitudes, with `dc_weight` for the mean."""

    most: float = 0.1  # weight when the gate is fully open
    dc_weight: float = 1.0

    def __post_init__(self):
        _positive("Fourier", most=self.most)
        if not (math.isfinite(self.dc_weight) and self.dc_weight >= 0):
            raise ValueError(
                f"dc_weight={self.dc_weight} must be finite and not negative; "
                "0 leaves the mean color to the other losses"
            )


@dataclasses.dataclass(frozen=True)
class SpectralSpec:
    """Settings of the losses and of the schedule of their weights.

    Weights begin at opening * most. `gate="learned"` is equation 16. The loss grows
    with the gate, so gradient descent can only close it. It is an annealing whose pace
    is `learning_rate`, whatever the losses are. With "floor" the weights stop at
    `floor` times `most`, with "fixed" they are constant, and with "schedule" they decay
    to zero with a half cosine. docs/results/frequency_gates.md compares the gates.
    """

    wavelet: WaveletSpec | None = WaveletSpec()
    fourier: FourierSpec | None = FourierSpec()
    gate: str = "learned"
    opening: float = 0.5  # equation 16 at g = 0
    learning_rate: float = 1e-2  # of the logits g
    floor: float = 0.05
    after: int = steps(0)  # steps without these losses

    def __post_init__(self):
        if self.gate not in GATES:
            raise ValueError(f"unknown gate {self.gate!r}; choose from {GATES}")
        if self.wavelet is None and self.fourier is None:
            raise ValueError(
                "wavelet and fourier are both None; enable one of them, or disable the "
                "spectral losses (spectral=None)"
            )
        if not LEAST_OPENING <= self.opening < 1:
            raise ValueError(f"opening={self.opening} must lie in [{LEAST_OPENING}, 1)")
        if self.gate == "floor" and not 0 <= self.floor < self.opening:
            raise ValueError(
                f"floor={self.floor} must lie in [0, opening={self.opening}), because "
                "a gate closes from its opening"
            )
        _positive("gates'", learning_rate=self.learning_rate)
        if self.after < 0:
            raise ValueError(f"after={self.after} must not be negative")

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the regularizer of a run of `run_steps`."""
        kind = LearnedBound if self.gate in LEARNED else Bound
        return kind(self, run_steps)


class Bands(NamedTuple):
    """High bands of one level. The first letter is the band along the width."""

    hl: Float[Array, "height width channels"]  # vertical edges
    lh: Float[Array, "height width channels"]  # horizontal edges
    hh: Float[Array, "height width channels"]  # diagonals


class Pyramid(NamedTuple):
    """An image in the orthonormal Haar basis."""

    high: tuple[Bands, ...]  # finest first
    low: Float[Array, "height width channels"]


class Gates(NamedTuple):
    """Logits or weights of the two losses. None for a disabled loss."""

    wavelet: Float[Array, ""] | None
    fourier: Float[Array, ""] | None


@checked
def haar_pyramid(image: Float[Array, "height width channels"], levels: int) -> Pyramid:
    """Decompose an image of any size by an orthonormal Haar transform.

    An odd last row or column is repeated (half-sample symmetric extension), so that a
    constant has no high bands. The energy is that of the extended image. Levels beyond
    a size of one pixel have zero bands.

    Args:
      image: The image.
      levels: Number of levels.

    Returns:
      Bands of each level, and the low band.
    """
    high, low = [], image
    for _ in range(levels):
        low, bands = _split(low)
        high.append(bands)
    return Pyramid(tuple(high), low)


def _split(image):
    height, width, channels = image.shape
    odd = ((0, height % 2), (0, width % 2), (0, 0))
    even = jnp.pad(image, odd, mode="edge")
    quads = even.reshape((height + 1) // 2, 2, (width + 1) // 2, 2, channels)
    a, b = quads[:, 0, :, 0], quads[:, 0, :, 1]
    c, d = quads[:, 1, :, 0], quads[:, 1, :, 1]
    # Differences first, so that they are exactly zero for a constant.
    bands = Bands(
        hl=((a - b) + (c - d)) / 2,
        lh=((a - c) + (b - d)) / 2,
        hh=((a - b) - (c - d)) / 2,
    )
    return ((a + b) + (c + d)) / 2, bands


def _fill_invalid(
    render: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
    valid: Bool[Array, "height width"] | None,
) -> tuple[
    Float[Array, "height width channels"], Float[Array, "height width channels"]
]:
    """Fill invalid pixels of the render with the truth, in at least float32.

    A spectrum needs a complete image. Invalid pixels then add no difference and have no
    gradient. Where the truth is not finite there, both images are black.
    """
    render, truth = widened(render), widened(truth)
    if valid is None:
        return render, truth
    is_valid = valid[..., None]
    truth = jnp.where(is_valid | jnp.isfinite(truth), truth, 0)
    return jnp.where(is_valid, render, truth), truth


@checked(images=("render", "truth"))
def wavelet_loss(
    spec: WaveletSpec,
    render: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
    valid: Bool[Array, "height width"] | None = None,
) -> Float[Array, ""]:
    """Compute the sum of the mean squares of all high bands, equations 12 and 13.

    Args:
      spec: Settings.
      render: Rendered image.
      truth: Reference image.
      valid: True for valid pixels. None: all are valid.

    Returns:
      The loss.
    """
    render, truth = _fill_invalid(render, truth, valid)
    # The transform is linear, so one pyramid of the difference is enough.
    pyramid = haar_pyramid(render - truth, spec.levels)
    factors = [spec.level_factor**level for level in range(spec.levels)]
    return total(
        factor * jnp.mean(jnp.square(band))
        for factor, bands in zip(factors, pyramid.high, strict=True)
        for band in bands
    )


@checked(images=("render", "truth"))
def fourier_loss(
    spec: FourierSpec,
    render: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
    valid: Bool[Array, "height width"] | None = None,
) -> Float[Array, ""]:
    """Compute the mean squared difference of all Fourier amplitudes.

    Equations 14 and 15, with an orthonormal transform. Without normalization the loss
    would be height * width times as large. Amplitudes do not depend on the phase, so an
    image that is shifted circularly has no loss. Never use this loss alone. An
    amplitude of the render that is exactly zero has no gradient, so of a constant image
    only the mean is trained.

    Args:
      spec: Settings.
      render: Rendered image.
      truth: Reference image.
      valid: True for valid pixels. None: all are valid.

    Returns:
      The loss.
    """
    render, truth = _fill_invalid(render, truth, valid)
    width = truth.shape[1]
    difference = amplitudes(render) - amplitudes(truth)
    multiplicity = _times_in_whole_spectrum(width, truth.dtype)
    squares = jnp.square(difference) * multiplicity[:, None]
    squares = squares.at[0, 0].multiply(spec.dc_weight)
    return jnp.sum(squares) / truth.size


@checked
def amplitudes(
    image: Float[Array, "height width channels"],
) -> Float[Array, "height half channels"]:
    """Compute the orthonormal Fourier amplitudes |F| of each channel.

    Args:
      image: The image.

    Returns:
      The first width // 2 + 1 columns of the spectrum. The gradient of an amplitude is
      zero where the amplitude is zero.
    """
    spectrum = jnp.fft.rfft2(widened(image), axes=(0, 1), norm="ortho")
    # abs has a zero gradient at zero, where a square root of squares has NaN.
    return jnp.abs(spectrum)


def _times_in_whole_spectrum(width, dtype):
    """Return how often columns of the half spectrum occur in the full one: 1 or 2."""
    columns = jnp.arange(width // 2 + 1)
    once = (columns == 0) | (2 * columns == width)
    return jnp.where(once, 1, 2).astype(dtype)


def init(spec: SpectralSpec, dtype: DTypeLike = jnp.float32) -> Gates:
    """Initialize the logits at the opening: g = 0 for one half, as in the paper.

    Args:
      spec: Settings of the losses.
      dtype: Type of the logits.

    Returns:
      The logits, None where a loss is absent.
    """
    opening = _start_of_sigmoid(spec)
    logit = jnp.asarray(math.log(opening) - math.log1p(-opening), dtype)
    return Gates(
        None if spec.wavelet is None else logit,
        None if spec.fourier is None else logit,
    )


def _start_of_sigmoid(spec):
    if spec.gate == "floor":
        return (spec.opening - spec.floor) / (1 - spec.floor)
    return spec.opening


def weights(
    spec: SpectralSpec, gates: Gates | None, step: Int[Array, ""], steps: int
) -> Gates:
    """Compute the weights of the losses at a step.

    Args:
      spec: Settings.
      gates: Logits of a learned gate (equation 16), None otherwise.
      step: Traced step.
      steps: Total number of steps.

    Returns:
      The weights.
    """
    gate = jnp.where(step < spec.after, 0.0, 1.0)

    def weight(most, logit):
        return gate * most * _opening(spec, logit, step, steps)

    return Gates(
        *(
            None if loss is None else weight(loss.most, logit)
            for loss, logit in zip(
                (spec.wavelet, spec.fourier), gates or (None, None), strict=True
            )
        )
    )


def _opening(spec, logit, step, steps):
    if spec.gate == "learned":
        return jnp.maximum(jax.nn.sigmoid(logit), LEAST_OPENING)
    if spec.gate == "floor":
        return spec.floor + (1 - spec.floor) * jax.nn.sigmoid(logit)
    if spec.gate == "schedule":
        fall = schedules.cosine(spec.opening, 0.0, steps - spec.after, after=spec.after)
        return fall(step)
    return spec.opening


def terms(
    spec: SpectralSpec,
    weight: Gates,
    render: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
    valid: Bool[Array, "height width"] | None = None,
) -> dict[str, Term]:
    """Compute the losses of equation 17, and their weights for logging.

    Args:
      spec: Settings.
      weight: Weights of the losses.
      render: Rendered image.
      truth: Reference image.
      valid: True for valid pixels. None: all are valid.

    Returns:
      The terms of the loss by name.
    """
    losses = {}
    if spec.wavelet is not None:
        loss = wavelet_loss(spec.wavelet, render, truth, valid)
        losses["wavelet"] = loss, weight.wavelet
    if spec.fourier is not None:
        loss = fourier_loss(spec.fourier, render, truth, valid)
        losses["fourier"] = loss, weight.fourier
    terms = {}
    for name, (loss, factor) in losses.items():
        assert factor is not None
        terms[name] = Term(loss, factor.astype(loss.dtype))
        terms[f"{name}_weight"] = Term(factor, None)
    return terms


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Regularizer` of a `SpectralSpec` without a learned gate."""

    spec: SpectralSpec
    steps: int

    name = NAME

    def __post_init__(self):
        if self.spec.after >= self.steps:
            raise ValueError(
                f"after={self.spec.after} leaves none of the {self.steps} steps of the "
                "run to the spectral losses; start them earlier or disable them"
            )

    def loss(self, params: Params, context: PenaltyContext) -> dict[str, Term]:
        """Compute the spectral losses of one frame."""
        observation = context.observation
        gates = self._gates(params)
        weight = weights(self.spec, gates, context.step, self.steps)
        assert observation is not None
        assert observation.rendering is not None
        return terms(
            self.spec,
            weight,
            observation.rendering.color,
            observation.truth,
            observation.valid,
        )

    def _gates(self, params):
        del params


@dataclasses.dataclass(frozen=True)
class LearnedBound(Bound):
    """The `Regularizer` of a `SpectralSpec` with a learned gate."""

    @property
    def learning_rate(self) -> float:
        """Learning rate of the gate."""
        return self.spec.learning_rate

    def init(self, key: Key[Array, ""]) -> Gates:
        """Initialize the gate."""
        return init(self.spec)

    def _gates(self, params):
        return params.nets[NAME]
