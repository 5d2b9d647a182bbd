"""Template network, from an encoded point to density and color."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.nn import dense, encoding, grids, mlp, planes, voxels
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.grids import HashGridSpec
from nerfies_jax.nn.mlp import HeadSpec, MLPSpec
from nerfies_jax.nn.planes import PlanesSpec
from nerfies_jax.nn.voxels import VoxelGridSpec
from nerfies_jax.training import schedules
from nerfies_jax.training.step_counts import steps

# Log density above which the exponential is continued by its tangent, so that values
# and gradients are finite.
LARGEST_LOG = 15.0


def exponential(raw: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Compute exp(raw), continued by its tangent above raw = 15.

    Args:
      raw: Log densities, [...].

    Returns:
      Densities per unit of the field, [...].

    References:
      Müller et al. 2022, arXiv:2201.05989, whose code clips the gradient instead.
    """
    beyond = jnp.maximum(raw - LARGEST_LOG, 0)
    return jnp.exp(jnp.minimum(raw, LARGEST_LOG)) * (1 + beyond)


PyTree = Any
# Modules of the encodings that have tables of parameters.
GRIDS = {HashGridSpec: grids, VoxelGridSpec: voxels, PlanesSpec: planes}
DENSITIES = {"softplus": jax.nn.softplus, "relu": jax.nn.relu, "exp": exponential}


@dataclasses.dataclass(frozen=True)
class TemplateSpec:
    """Size and activations of the network. The defaults are those of NeRF.

    `direction` is None if color does not depend on the view. `density` is the
    activation of the density. "relu" is that of the NeRF paper. With it a ray without
    any positive density has no gradient, and with an interval at infinity the gradient
    is 1e10, while that of "softplus" is at most 6e-3. "exp" becomes opaque in the
    fewest steps and suits feature grids. `anneal_steps` is the number of steps over
    which the bands of the position, or the levels of its tables, are opened one by one,
    as for the warp of Nerfies. None opens all from the start.

    The position may be encoded by a grid or by planes, which span the cube [-1, 1]^3 of
    the field and, contracted, all space around it. Planes with `timestamps` also read
    the time. They are for the medium of a scene flow and not for templates.
    """

    position: EncodingSpec | HashGridSpec | VoxelGridSpec | PlanesSpec = EncodingSpec(
        10
    )
    direction: EncodingSpec | None = EncodingSpec(4)
    depth: int = 8
    width: int = 256
    skips: tuple[int, ...] = (5,)  # layers that also read the input, counted from 0
    color_width: int = 128
    density: str = "softplus"
    density_bias: float = 0.0  # added before the activation; negative for less density
    anneal_steps: int | None = steps(None)

    def __post_init__(self):
        if self.density not in DENSITIES:
            raise ValueError(
                f"unknown density activation {self.density!r}; choose from "
                f"{sorted(DENSITIES)}"
            )
        if not math.isfinite(self.density_bias):
            raise ValueError(
                f"density_bias={self.density_bias} must be finite; 0 starts as the "
                "network does, less starts emptier"
            )
        if self.depth < 1:
            raise ValueError(
                f"depth={self.depth} must be at least 1: media and surfaces read the "
                "last layer"
            )
        for name in ("width", "color_width"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        if self.anneal_steps is not None and self.anneal_steps < 1:
            raise ValueError(
                f"anneal_steps={self.anneal_steps} must be at least 1; None opens all "
                "from the first step"
            )

    @property
    def reads_time(self) -> bool:
        """True if its tables depend on time."""
        return isinstance(self.position, PlanesSpec) and bool(self.position.timestamps)

    @property
    def encoded_width(self) -> int:
        """Number of features of a point, and of the time if it is encoded too."""
        return self.position.width(4 if self.reads_time else 3)


class Template(NamedTuple):
    """Parameters."""

    trunk: mlp.MLP  # heads "density" and "bottleneck"
    color: mlp.MLP  # reads [bottleneck, condition]; head "color"
    # Tables of a grid or of planes, if there are any.
    tables: PyTree = None


class Radiance(NamedTuple):
    """Density and color of the field at one point."""

    density: Float[Array, ""]  # per unit of the field, not negative
    color: Float[Array, "3"]  # sRGB in (0, 1)
    features: Float[Array, " width"]  # the trunk's last layer, for other media


def trunk_spec(spec: TemplateSpec, inputs: int) -> MLPSpec:
    """Return the settings of the trunk.

    Args:
      spec: Settings of the template.
      inputs: Number of features of a point.

    Returns:
      Settings of an MLP with the heads "density" and "bottleneck".
    """
    heads = (("density", HeadSpec(1)), ("bottleneck", HeadSpec(spec.width)))
    return MLPSpec(inputs, spec.depth, spec.width, heads, spec.skips)


def _color_spec(spec: TemplateSpec, condition: int) -> MLPSpec:
    """Return the settings of the color branch."""
    inputs = spec.width + condition
    return MLPSpec(inputs, 1, spec.color_width, (("color", HeadSpec(3)),))


def init(
    spec: TemplateSpec,
    key: Key[Array, ""],
    inputs: int,
    condition: int,
    dtype: DTypeLike = jnp.float32,
) -> Template:
    """Initialize the parameters with Glorot weights.

    Args:
      spec: Settings of the template.
      key: PRNG key.
      inputs: Number of features that `apply` will get.
      condition: Number of features of a ray that `apply` will get.
      dtype: Floating-point type of the parameters.

    Returns:
      The parameters.
    """
    trunk_key, color_key = jax.random.split(key)
    tables, grid = None, GRIDS.get(type(spec.position))
    if grid is not None:
        # A separate key, so that the other parameters do not depend on it.
        tables_key = jax.random.fold_in(key, 2)
        tables = grid.init(spec.position, tables_key, dtype)
    return Template(
        mlp.init(trunk_spec(spec, inputs), trunk_key, dtype),
        mlp.init(_color_spec(spec, condition), color_key, dtype),
        tables,
    )


def encode(
    spec: TemplateSpec,
    params: Template,
    point: Float[Array, "3"],
    step: Int[Array, ""] | None,
    time: Float[Array, ""] | None = None,
) -> Float[Array, " features"]:
    """Encode a point for the trunk.

    Args:
      spec: Settings of the template.
      params: Parameters.
      point: Point in units of the field, [3].
      step: Training step, which determines the window of the bands or levels. None to
        open all.
      time: Time in [0, 1], required if `spec.reads_time`.

    Returns:
      Features, [spec.encoded_width].

    Raises:
      ValueError: If a time is needed but missing.
    """
    position = spec.position
    parts = position.bands if isinstance(position, EncodingSpec) else position.levels
    window = None
    if spec.anneal_steps is not None and step is not None and parts:
        window = schedules.band_window(parts, spec.anneal_steps, step, point.dtype)
    if isinstance(position, EncodingSpec):
        return encoding.encode(position, point, window)
    grid = GRIDS[type(position)]
    if not isinstance(position, PlanesSpec):
        return grid.encode(position, params.tables, point, window)
    place = (grids.contract(point) + 2) / 4
    if spec.reads_time and time is not None:
        place = jnp.concatenate([place, time[None]])
    features = grid.encode(position, params.tables, place)
    if window is not None:
        features = features * jnp.repeat(window, position.features)
    return features


def raw_density(
    spec: TemplateSpec, params: Template, features: Float[Array, " inputs"]
) -> tuple[Float[Array, ""], Float[Array, " width"]]:
    """Evaluate the trunk.

    Args:
      spec: Settings of the template.
      params: Parameters.
      features: Encoded point, [inputs].

    Returns:
      The density before its activation, and the trunk's last layer [width].
    """
    trunk = trunk_spec(spec, features.shape[-1])
    hidden = mlp.hidden_features(trunk, params.trunk, features)
    raw = mlp.affine(params.trunk.heads["density"], hidden)[0] + spec.density_bias
    return raw, hidden


def apply(
    spec: TemplateSpec,
    params: Template,
    features: Float[Array, " inputs"],
    condition: Float[Array, " condition"],
    density_noise: Float[Array, ""] | None = None,
) -> Radiance:
    """Evaluate density and color at one point.

    The density never depends on `condition`.

    Args:
      spec: Settings of the template.
      params: Parameters.
      features: Encoding of the point and the features that effects add to it, [inputs].
      condition: Encoded view direction and codes, the same along a ray, [condition].
      density_noise: Noise added before the activation of the density, or None.

    Returns:
      The density per unit of the field and the color.

    Raises:
      ValueError: If the color branch reads another number of features of the ray.

    References:
      Mildenhall et al. 2020, arXiv:2003.08934, figure 7.
    """
    read = len(params.color.hidden[0].weight) - spec.width
    if len(condition) != read:
        raise ValueError(
            f"the color branch reads {read} features of the ray, and condition has "
            f"{len(condition)}; give `init` that many"
        )
    raw, hidden = raw_density(spec, params, features)
    if density_noise is not None:
        raw = raw + density_noise
    return add_color(spec, params, raw, hidden, color_offset(spec, params, condition))


def color_offset(
    spec: TemplateSpec, params: Template, condition: Float[Array, " condition"]
) -> Float[Array, " color_width"]:
    """Compute the contribution of a ray to the first color layer, including its bias.

    It is the same for all samples of a ray.

    Args:
      spec: Settings of the template.
      params: Parameters.
      condition: Features of the ray, [condition].

    Returns:
      The contribution, [color_width].
    """
    bottleneck, first = params.trunk.heads["bottleneck"], params.color.hidden[0]
    ours, other_weights = jnp.split(first.weight, [spec.width])
    return condition @ other_weights[: len(condition)] + (
        bottleneck.bias @ ours + first.bias
    )


def add_color(
    spec: TemplateSpec,
    params: Template,
    raw: Float[Array, ""],
    hidden: Float[Array, " width"],
    offset: Float[Array, " color_width"],
    more: Float[Array, " more"] | None = None,
) -> Radiance:
    """Add color to the result of `raw_density`.

    Args:
      spec: Settings of the template.
      params: Parameters.
      raw: Density before its activation.
      hidden: The trunk's last layer, [width].
      offset: `color_offset` of the ray.
      more: Further features of the sample, which are read after those of the ray, or
        None.

    Returns:
      The density per unit of the field and the color.
    """
    bottleneck, first = params.trunk.heads["bottleneck"], params.color.hidden[0]
    # There is no activation between the bottleneck and this layer, so their matrices
    # are multiplied once instead of computing the bottleneck for every sample.
    branch = dense.product(hidden, bottleneck.weight @ first.weight[: spec.width])
    if more is not None:
        branch = branch + dense.product(more, first.weight[-len(more) :])
    branch = branch + offset
    color = mlp.affine(params.color.heads["color"], jax.nn.relu(branch))
    activation = DENSITIES[spec.density]
    return Radiance(activation(raw), jax.nn.sigmoid(color), hidden)
