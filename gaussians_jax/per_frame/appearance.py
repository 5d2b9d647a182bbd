"""Appearance of photographs in different light: a code changes the color of Gaussians.

The color `c` of a Gaussian becomes `c + (gain c + offset) + (A c + b)`. The matrix `A`
and the vector `b` are linear in the code of a photograph and the same for all
Gaussians, as an exposure. The gain and offset of each channel are the output of a small
network that reads a feature of the Gaussian, its color and the code, as in
WildGaussians (Kulhanek et al. 2024, arXiv:2407.08447) and Splatfacto-W (Xu et al. 2024,
arXiv:2407.12306). The sky changes by `A` and `b` as well.

Differences: the affine change of all colors is our choice, and its entries are the
first twelve of a code in the beginning. Codes are relative to their mean, and a code of
zero changes no color. The colors of the Gaussians themselves, which files and viewers
show, therefore are those of the mean photograph. To this end, the last hidden layer is
multiplied by a linear function of the code.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Splats
from gaussians_jax.per_frame import exposure, id_tables, sky
from gaussians_jax.per_frame.id_tables import Places
from gaussians_jax.per_frame.sky import Sky, SkySpec
from nerfies_jax.nn import dense, mlp
from nerfies_jax.nn.mlp import Layer, MLPSpec
from nerfies_jax.training import schedules

NAME = "appearance"
AFFINE = 12  # entries of A and b
OUTPUTS = 6  # of the network: gain and offset of three channels
# Quantile of the distances of the Gaussians from their median, along the largest axis,
# which features take for the size of the scene (WildGaussians, its code).
INNER = 0.97


@dataclasses.dataclass(frozen=True)
class ColorNetworkSpec:
    """Settings of the network that changes the color of each Gaussian.

    Attributes:
      bands: Octaves of the Fourier features of its position that the feature of a
        Gaussian begins with. It has six entries for each.
      depth: Number of hidden layers.
      width: Width of the hidden layers.
      feature_rate: Learning rate of the features, which falls like that of the network.
    """

    bands: int = 4
    depth: int = 2
    width: int = 128
    feature_rate: float = 5e-3

    def __post_init__(self):
        for name in ("bands", "depth", "width"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        if not 0 < self.feature_rate < math.inf:
            raise ValueError(
                f"feature_rate={self.feature_rate} must be positive and finite"
            )


@dataclasses.dataclass(frozen=True)
class AppearanceSpec:
    """Settings of an appearance model.

    Attributes:
      code: Length of the code of a photograph.
      network: Network that reads code and Gaussian. None for one affine change of all
        colors in a photograph.
      sky: Background of each photograph. None for that of the capture.
      code_rate: Learning rate of the codes. Each is updated by its own photograph only.
      learning_rate: Learning rate of network, affine change and sky.
      final: Ratio of the last to the first learning rates.
    """

    code: int = 32
    network: ColorNetworkSpec | None = ColorNetworkSpec()
    sky: SkySpec | None = None
    code_rate: float = 1e-2
    learning_rate: float = 1e-3
    final: float = 0.1

    def __post_init__(self):
        if self.code < 1:
            raise ValueError(f"code={self.code} must be at least 1")
        if not 0 < self.final <= 1:
            raise ValueError(f"final={self.final} must lie in (0, 1]")
        for name in ("code_rate", "learning_rate"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name}={getattr(self, name)} must be positive and finite"
                )

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the appearance model for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.exposures)


class ColorNetwork(NamedTuple):
    """Parameters of the network."""

    hidden: tuple[Layer, ...]
    gate: Float[Array, "code width"]  # factors of the last hidden layer, for each code
    out: Float[Array, "width 6"]


class Shared(NamedTuple):
    """Shared parameters of an appearance model, None for disabled parts."""

    codes: Float[Array, "ids code"]
    affine: Float[Array, "code 12"]
    network: ColorNetwork | None
    sky: Sky | None


def fourier_features(mean: np.ndarray, bands: int) -> np.ndarray:
    """Compute the initial features of Gaussians, on the host.

    Args:
      mean: Positions [gaussians, 3] in scene units.
      bands: Number of octaves. The longest wave is four times the size of the scene.

    Returns:
      Sines and cosines of the positions, [gaussians, 6 bands] float32.
    """
    mean = np.asarray(mean, np.float64)
    offset = mean - np.median(mean, axis=0)
    size = float(np.quantile(np.abs(offset).max(axis=1), INNER))
    place = offset / size if size > 0 else np.zeros_like(offset)
    angle = 0.5 * np.pi * place[:, None] * 2.0 ** np.arange(bands)[:, None]
    angle = angle.reshape(len(mean), 3 * bands)
    return np.concatenate([np.sin(angle), np.cos(angle)], axis=1).astype(np.float32)


def _hidden_spec(spec: ColorNetworkSpec, code: int) -> MLPSpec:
    inputs = 6 * spec.bands + 3 + code
    return MLPSpec(inputs, spec.depth, spec.width, (), (), "relu", "he")


def init_network(
    key: Key[Array, ""],
    spec: ColorNetworkSpec,
    code: int,
    dtype: DTypeLike = jnp.float32,
) -> ColorNetwork:
    """Initialize the network.

    Args:
      key: PRNG key.
      spec: Settings.
      code: Length of a code.
      dtype: Floating-point type.

    Returns:
      The parameters.
    """
    hidden_key, gate_key, out_key = jax.random.split(key, 3)
    return ColorNetwork(
        mlp.init(_hidden_spec(spec, code), hidden_key, dtype).hidden,
        mlp.init_layer(gate_key, code, spec.width, "glorot", dtype).weight,
        mlp.init_layer(out_key, spec.width, OUTPUTS, "glorot", dtype).weight,
    )


def network_change(
    spec: ColorNetworkSpec,
    params: ColorNetwork,
    features: Float[Array, "gaussians features"],
    colors: Float[Array, "gaussians 3"],
    code: Float[Array, " code"],
) -> Float[Array, "gaussians 6"]:
    """Evaluate gain and offset of each Gaussian. They are zero for a code of zero.

    Args:
      spec: Settings.
      params: Parameters of the network.
      features: Features of the Gaussians.
      colors: Their colors.
      code: Code of the photograph.

    Returns:
      Gains and offsets of the channels.
    """
    hidden_spec = _hidden_spec(spec, code.shape[0])
    layers = mlp.with_known(hidden_spec, mlp.MLP(params.hidden, {}), code)
    inputs = jnp.concatenate([features, colors], axis=1)
    reduced_spec = dataclasses.replace(hidden_spec, inputs=inputs.shape[1])
    activations = mlp.hidden_features(reduced_spec, layers, inputs)
    weight = dense.product(code, params.gate)[:, None] * params.out
    return dense.product(activations, weight)


def recolor(
    spec: AppearanceSpec,
    shared: Shared,
    features: Float[Array, "gaussians features"] | None,
    colors: Float[Array, "gaussians 3"],
    code: Float[Array, " code"],
) -> Float[Array, "gaussians 3"]:
    """Change the colors of Gaussians to those in one photograph.

    Args:
      spec: Settings.
      shared: Shared parameters.
      features: Features of the Gaussians. None without a network.
      colors: Colors of the Gaussians.
      code: Code of the photograph.

    Returns:
      Changed colors, not clipped.
    """
    exposed_colors = exposed(shared, colors, code)
    if spec.network is None:
        return exposed_colors
    assert shared.network is not None
    assert features is not None
    change = network_change(spec.network, shared.network, features, colors, code)
    return exposed_colors + change[:, :3] * colors + change[:, 3:]


def exposed(
    shared: Shared, colors: Float[Array, "*any 3"], code: Float[Array, " code"]
) -> Float[Array, "*any 3"]:
    """Apply the affine change that all colors of a photograph have in common.

    Args:
      shared: Shared parameters.
      colors: Colors of Gaussians or of the sky.
      code: Code of the photograph.

    Returns:
      Changed colors, not clipped.
    """
    change = dense.product(code, shared.affine).reshape(3, 4)
    return exposure.apply_exposure(colors, change)


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `GaussianAppearance` of an `AppearanceSpec` in a run of `steps`."""

    spec: AppearanceSpec
    steps: int
    places: Places

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of features, codes and networks."""
        spec = self.spec

        def falling(rate):
            return schedules.log_linear(rate, spec.final * rate, self.steps)(step)

        network = falling(spec.learning_rate)
        shared_rates = Shared(
            falling(spec.code_rate),
            network,
            None if spec.network is None else network,
            None if spec.sky is None else network,
        )
        features = None if spec.network is None else falling(spec.network.feature_rate)
        return MotionParams(features, shared_rates)

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize codes of zero, which change no color."""
        spec, code = self.spec, self.spec.code
        network_key, sky_key = jax.random.split(key)
        features = network = None
        if spec.network is not None:
            fourier = fourier_features(np.asarray(gaussians.mean), spec.network.bands)
            features = jnp.asarray(fourier)
            network = init_network(network_key, spec.network, code)
        shared_params = Shared(
            jnp.zeros((id_tables.rows_of(self.places), code), jnp.float32),
            jnp.eye(code, AFFINE, dtype=jnp.float32),
            network,
            None if spec.sky is None else sky.init(sky_key, spec.sky, code),
        )
        return MotionParams(features, shared_params)

    def code(
        self, params: MotionParams, appearance: Int[Array, ""]
    ) -> Float[Array, " code"]:
        """Return the code of an appearance id, relative to the mean code."""
        return id_tables.deviation(params.shared.codes, self.places, appearance)

    def apply(
        self,
        params: MotionParams,
        colors: Float[Array, "gaussians 3"],
        code: Float[Array, " code"],
    ) -> Float[Array, "gaussians 3"]:
        """Return the colors of the Gaussians for a code."""
        return recolor(self.spec, params.shared, params.per_gaussian, colors, code)

    @property
    def background(self):
        """Function that evaluates the sky, or None without one."""
        return None if self.spec.sky is None else self._sky

    def _sky(self, params, direction, code):
        color = sky.color(self.spec.sky, params.shared.sky, direction, code)
        return exposed(params.shared, color, code)
