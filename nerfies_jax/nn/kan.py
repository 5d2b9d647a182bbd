"""Kolmogorov-Arnold networks of Gaussian kernels (RBF-KAN) with explicit parameters.

`spec = KANSpec(in_features=3, hidden=(64,), out_features=3)`, `params = init(key,
spec)`, `y = apply(spec, params, x)` with any leading axes.

One layer is y_o = sum over inputs i of f_io(x_i) + bias_o, where each function of one
variable is a sum of Gaussians on a uniform grid and, beside it, a weighted SiLU:

    f_io(x) = sum_g C_gio exp(-((x - mu_g) / w)^2) + B_io silu(x)

Li 2024, "Kolmogorov-Arnold networks are radial basis function networks",
arXiv:2405.06721 (FastKAN), which is equation 5 of Sonata with w = sqrt(2) sigma. With
`basis="bspline"` the Gaussians are cubic B-splines instead (its equation 4; Liu et al.
2024, arXiv:2404.19756), as many, on the same grid.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from nerfies_jax.geometry.precision import at_least_float32, power_of_two
from nerfies_jax.nn import bsplines, mlp
from nerfies_jax.nn.mlp import HeadSpec
from nerfies_jax.runtime.contract import checked

BASES = ("rbf", "bspline")
OUTPUT = "output"  # name of the only head where a spec has `out_features`
DEGREE = 3  # of the B-splines, of which there are so many more than intervals
HEAD_INITIALIZERS = ("glorot", "small", "zero")
# Narrower kernels leave gaps between the centers, wider ones are so alike that their
# weights cannot be told apart: the Gram matrix of 16 kernels has condition 5.7 at
# sigma / h = 0.5, 58 at 0.707, 4.5e3 at 1 and 2e7 at 1.5.
WIDTH_RATIOS = (0.25, 1.5)
# Added to the variance of a hidden layer's features. Features that spread by less than
# 1e-3 are left small instead of being amplified to one.
NORM_VARIANCE = 1e-6
# Trained log-widths may leave their start by this much, a factor of 2e4 either way;
# 1 / width overflows float32 beyond 88.
LOG_WIDTH_RANGE = 10.0


@dataclasses.dataclass(frozen=True)
class KANSpec:
    """Settings of a KAN: layer widths, kernels and their grids.

    Layers lead from `in_features` through the `hidden` widths to `out_features`, or to
    several named `heads` in their place, which all read the last hidden layer.

    The centers of the first layer's `kernels` lie on `grid`, where raw inputs are
    expected. Those of the others lie on `hidden_grid`, in front of which `norm`
    standardizes the features of each point. The norm has no trained scale, which would
    be a trained width under another name, and the first layer has none: it would turn
    one or two coordinates into signs. `width_ratio` is sigma / h, the kernels' standard
    deviation over the distance of their centers. The grid resolves half a period per h
    in any case.

    `trainable_kernels` makes every input's centers and log-widths parameters (Sonata,
    equations 9 and 10). It requires `basis="rbf"`. The paper argues against it
    (appendix A.3): with one width and even spacing all Gaussians have one spectrum,
    exp(-sigma^2 w^2 / 2), and the weights alone shape that of the sum by their
    interference, sum_g C_g exp(-i w mu_g). Unequal widths and gaps break that up.
    """

    in_features: int
    hidden: tuple[int, ...] = ()
    out_features: int | None = None
    heads: tuple[tuple[str, HeadSpec], ...] = ()
    kernels: int = 8
    grid: tuple[float, float] = (-1.0, 1.0)
    hidden_grid: tuple[float, float] = (-2.0, 2.0)
    width_ratio: float = math.sqrt(0.5)
    base: bool = True  # the SiLU beside the kernels
    norm: bool = True
    trainable_kernels: bool = False
    basis: str = "rbf"

    def __post_init__(self):
        self._check_basis()
        if self.in_features < 1 or any(width < 1 for width in self.hidden):
            raise ValueError(
                "a KAN needs in_features >= 1 and hidden widths >= 1, got in_features="
                f"{self.in_features}, hidden={self.hidden}"
            )
        if (self.out_features is None) == (not self.heads):
            raise ValueError(
                "a KAN has either out_features or heads, got out_features="
                f"{self.out_features} and {len(self.heads)} heads; give one of them"
            )
        if self.out_features is not None and self.out_features < 1:
            raise ValueError(f"out_features={self.out_features} must be at least 1")
        if self.kernels < 2:
            raise ValueError(
                f"kernels={self.kernels}: a grid has at least two centers, one at each "
                "end"
            )
        for name in ("grid", "hidden_grid"):
            low, high = getattr(self, name)
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ValueError(f"{name} needs low < high, got {low} and {high}")
        if not WIDTH_RATIOS[0] <= self.width_ratio <= WIDTH_RATIOS[1]:
            raise ValueError(
                f"width_ratio={self.width_ratio} is not within {WIDTH_RATIOS}: "
                "narrower kernels leave gaps, wider ones cannot be told apart; 0.5 to "
                "0.75 is sound"
            )
        if self.norm and any(width < 3 for width in self.hidden):
            raise ValueError(
                f"hidden={self.hidden}: standardizing one feature leaves 0 and two "
                "leaves signs; take widths of at least 3, or norm=False"
            )
        names = [name for name, _ in self.heads]
        if len(set(names)) < len(names):
            raise ValueError(f"heads must have different names, got {names}")
        for name, head in self.heads:
            if head.init not in HEAD_INITIALIZERS:
                raise ValueError(
                    f"head {name!r}: unknown init {head.init!r}; choose from "
                    f"{HEAD_INITIALIZERS}"
                )

    def _check_basis(self):
        if self.basis not in BASES:
            raise ValueError(f"unknown basis {self.basis!r}; choose from {BASES}")
        if self.basis == "bspline" and self.kernels <= DEGREE:
            raise ValueError(
                f"kernels={self.kernels}: cubic B-splines on one interval are four; "
                f"take at least {DEGREE + 1}"
            )
        if self.basis == "bspline" and self.trainable_kernels:
            raise ValueError(
                "trainable_kernels move Gaussians; B-splines lie on an even grid"
            )

    @property
    def read_outs(self) -> tuple[tuple[str, HeadSpec], ...]:
        """The heads, or the one head that `out_features` stands for."""
        if self.out_features is None:
            return self.heads
        return ((OUTPUT, HeadSpec(self.out_features)),)

    def widths(self) -> tuple[int, ...]:
        """Return the number of inputs of each layer. The last are those of the heads.

        Returns:
          One integer for each layer.
        """
        return (self.in_features, *self.hidden)

    def grid_of(self, layer: int) -> tuple[float, float]:
        """Return the ends of the grid of a layer.

        Args:
          layer: Index of the layer, counted from 0.

        Returns:
          The lower and the upper end.
        """
        return self.hidden_grid if layer else self.grid


class KANLayer(NamedTuple):
    """Trained parameters of one layer."""

    kernel: Float[Array, "kernels inputs outputs"]  # C, a weight for each Gaussian
    base: Float[Array, "inputs outputs"] | None  # B, of the SiLU
    bias: Float[Array, " outputs"]


class Kernels(NamedTuple):
    """Centers and log(sqrt(2) sigma) of one layer's Gaussians, if they are trained."""

    center: Float[Array, "kernels inputs"]
    log_width: Float[Array, "kernels inputs"]


class KAN(NamedTuple):
    """Parameters of one network."""

    hidden: tuple[KANLayer, ...]
    heads: dict[str, KANLayer]  # all read the last hidden layer, through one basis
    kernels: tuple[Kernels, ...] | None  # one for each layer; None where fixed


def spacing(spec: KANSpec, layer: int) -> float:
    """Return the distance h between neighboring centers of a layer.

    Args:
      spec: The network's settings.
      layer: Index of the layer, counted from 0.

    Returns:
      The distance in units of the layer's inputs.
    """
    low, high = spec.grid_of(layer)
    gaps = spec.kernels - (DEGREE if spec.basis == "bspline" else 1)
    return (high - low) / gaps


def centers(spec: KANSpec, layer: int, dtype=jnp.float32) -> Float[Array, " kernels"]:
    """Return the fixed centers of a layer, or the initial ones if they are trained.

    B-splines begin and end one interval outside the grid, on which they then sum to
    one.

    Args:
      spec: The network's settings.
      layer: Index of the layer, counted from 0.
      dtype: Floating-point type of the result.

    Returns:
      Centers, [kernels].
    """
    low, high = spec.grid_of(layer)
    if spec.basis == "bspline":
        low, high = low - spacing(spec, layer), high + spacing(spec, layer)
    return jnp.linspace(low, high, spec.kernels, dtype=dtype)


def width(spec: KANSpec, layer: int) -> float:
    """Return the fixed width of a layer's kernels, or the initial one if it is trained.

    Args:
      spec: The network's settings.
      layer: Index of the layer, counted from 0.

    Returns:
      w = sqrt(2) sigma of Gaussians, the knot spacing of B-splines.
    """
    if spec.basis == "bspline":
        return spacing(spec, layer)
    return math.sqrt(2) * spec.width_ratio * spacing(spec, layer)


@checked
def init(key: Key[Array, ""], spec: KANSpec, dtype=jnp.float32) -> KAN:
    """Draw the parameters of a network.

    Hidden layers and `out_features` are drawn as "glorot": the weights of the Gaussians
    such that inputs spread over the grid give outputs of variance one. The initializers
    "zero" and "small" of a head hold for kernel and base weights alike. Biases are
    zero. All precisions draw the same numbers.

    Args:
      key: A typed key, `jax.random.key(seed)`.
      spec: The network's settings.
      dtype: Floating-point type of the parameters.

    Returns:
      The parameters, a pytree of arrays.
    """
    widths = spec.widths()
    keys = jax.random.split(key, len(spec.hidden) + len(spec.read_outs))
    hidden = tuple(
        _init_layer(spec, keys[layer], widths[layer], outputs, "glorot", dtype)
        for layer, outputs in enumerate(spec.hidden)
    )
    heads = {
        name: _init_layer(spec, head_key, widths[-1], head.width, head.init, dtype)
        for (name, head), head_key in zip(
            spec.read_outs, keys[len(spec.hidden) :], strict=True
        )
    }
    kernels = None
    if spec.trainable_kernels:
        kernels = tuple(
            Kernels(
                jnp.tile(centers(spec, layer, dtype)[:, None], (1, inputs)),
                jnp.full((spec.kernels, inputs), math.log(width(spec, layer)), dtype),
            )
            for layer, inputs in enumerate(widths)
        )
    return KAN(hidden, heads, kernels)


def _init_layer(spec, key, inputs, outputs, init, dtype):
    # Far from the ends, sum_g exp(-((x - mu_g) / w)^2)^2 is sqrt(pi) sigma / h on
    # average over x: 1.25 at the default. FastKAN draws 0.1 whatever the inputs.
    # The squares of cubic B-splines integrate to 151/315.
    each = math.sqrt(math.pi) * spec.width_ratio
    power = inputs * (151 / 315 if spec.basis == "bspline" else each)
    kernel_bound, base_bound = {
        "glorot": (math.sqrt(3 / power), math.sqrt(6 / (inputs + outputs))),
        "small": (mlp.SMALL, mlp.SMALL),
        "zero": (0.0, 0.0),
    }[init]
    shape = spec.kernels + 1, inputs, outputs
    drawn = jax.random.uniform(key, shape, jnp.float32, -1, 1).astype(dtype)
    base = base_bound * drawn[-1] if spec.base else None
    return KANLayer(kernel_bound * drawn[:-1], base, jnp.zeros(outputs, dtype))


@checked
def apply(
    spec: KANSpec, params: KAN, x: Float[Array, "*batch in_features"]
) -> Float[Array, "*batch out_features"]:
    """Evaluate a network that has `out_features`.

    Args:
      spec: The network's settings.
      params: Parameters from `init`, of the type of `x`.
      x: Inputs with any leading axes, [..., in_features]. The first layer expects them
        on `spec.grid`, and `hold` brings those outside near it.

    Returns:
      Outputs [..., out_features].

    Raises:
      ValueError: Where `x` has another number of features, or the spec has heads.
    """
    if spec.out_features is None:
        raise ValueError(
            "kan.apply: this KAN has heads and no out_features; use kan.apply_heads"
        )
    return apply_heads(spec, params, x)[OUTPUT]


@checked
def apply_heads(
    spec: KANSpec, params: KAN, x: Float[Array, "*batch inputs"]
) -> dict[str, Float[Array, "*batch outputs"]]:
    """Evaluate all heads of a network.

    Args:
      spec: The network's settings.
      params: Parameters from `init`, of the type of `x`.
      x: Inputs with any leading axes, [..., in_features].

    Returns:
      The output [..., width] of each head, by its name.

    Raises:
      ValueError: Where `x` has another number of features.
    """
    if x.shape[-1] != spec.in_features:
        raise ValueError(
            f"kan.apply: `x` has shape {list(x.shape)}, expected [..., "
            f"{spec.in_features}] for in_features={spec.in_features}"
        )
    kind = next(iter(params.heads.values())).kernel.dtype
    if x.dtype != kind:
        raise ValueError(
            f"kan.apply: `x` is {x.dtype} but the parameters are {kind}; "
            "cast one of them"
        )
    return after_first_layer(spec, params, first_layer_part(spec, params, x, 0))


@checked
def first_layer_part(
    spec: KANSpec, params: KAN, part: Float[Array, "*batch part"], start: int
) -> Float[Array, "*batch outputs"]:
    """Compute the contribution of some inputs to the first layer, without bias.

    A layer is a sum over its inputs, so parts that are equal for many evaluations (the
    time for all points, a point's code for all times) are evaluated once. Pass the sum
    of the parts to `after_first_layer`.

    Args:
      spec: The network's settings.
      params: Parameters from `init`.
      part: Consecutive inputs, [..., part].
      start: Index of the first of them among all inputs.

    Returns:
      Contributions to the first layer, [..., outputs].

    Raises:
      ValueError: If the inputs are not among those of the network.
    """
    stop = start + part.shape[-1]
    if not 0 <= start < stop <= spec.in_features:
        raise ValueError(
            f"inputs {start} .. {stop - 1} are not among the {spec.in_features} of "
            "this KAN"
        )
    layer, kernels = _layer(spec, params, 0)
    layer = layer._replace(
        kernel=layer.kernel[:, start:stop],
        base=None if layer.base is None else layer.base[start:stop],
    )
    if kernels is not None:
        kernels = jax.tree.map(lambda leaf: leaf[:, start:stop], kernels)
    return _sum_over_inputs(spec, 0, layer, kernels, part)


@checked
def after_first_layer(
    spec: KANSpec, params: KAN, first: Float[Array, "*batch features"]
) -> dict[str, Float[Array, "*batch outputs"]]:
    """Evaluate the heads from the sum of the first layer's parts.

    Args:
      spec: The network's settings.
      params: Parameters from `init`.
      first: Sum of the `first_layer_part`s of all inputs, [..., features].

    Returns:
      The output [..., width] of each head, by its name.
    """
    layer, _ = _layer(spec, params, 0)
    features = first + layer.bias
    for index in range(1, len(spec.hidden) + 1):
        layer, kernels = _layer(spec, params, index)
        if spec.norm:
            features = standardize(features)
        features = _sum_over_inputs(spec, index, layer, kernels, features) + layer.bias
    outputs, first_column = {}, 0
    for name, head in spec.read_outs:
        outputs[name] = features[..., first_column : first_column + head.width]
        first_column += head.width
    return outputs


@checked
@at_least_float32
def standardize(
    features: Float[Array, "*batch features"],
) -> Float[Array, "*batch features"]:
    """Scale each point's features to mean zero and a variance of at most one.

    Args:
      features: Features, [..., features].

    Returns:
      Features of the same shape. Their variance is one unless they spread by less than
      1e-3.
    """
    # Features of 1e20 have a variance that float32 cannot hold, and would all become 0.
    # A power of two changes no digit; below one, `NORM_VARIANCE` would overflow.
    largest = jnp.max(jnp.abs(features), axis=-1, keepdims=True)
    scale = jnp.maximum(power_of_two(jax.lax.stop_gradient(largest)), 1)
    scaled = features / scale
    centered = scaled - jnp.mean(scaled, axis=-1, keepdims=True)
    variance = jnp.mean(centered**2, axis=-1, keepdims=True)
    return centered * jax.lax.rsqrt(variance + NORM_VARIANCE / scale**2)


@checked
@at_least_float32
def hold(
    x: Float[Array, "*batch inputs"], grid: tuple[float, float], margin: float
) -> Float[Array, "*batch inputs"]:
    """Pull inputs outside the grid toward it, smoothly.

    Inside the grid `x` is unchanged. Outside the result tends to `margin` beyond the
    nearer end. The first two derivatives are continuous.

    A Gaussian is 5e-2 of its height a quarter of a grid beyond the grid's end and 1e-12
    three quarters beyond, so an input that strays there stops learning, and SiLU helps
    on one side only. Codes that start 50 grids away fit a signal of 1 to 0.81 without a
    remedy, to 0.65 with tanh and to 0.41 with this function, whose gradient falls from
    1 like 0.6 (margin / distance)^2.

    Args:
      x: Inputs, [..., inputs].
      grid: Lower and upper end of the grid.
      margin: Largest distance from the grid of the result, positive.

    Returns:
      Inputs of the same shape, inside `grid` or less than `margin` away.
    """
    low, high = grid
    middle, half = (low + high) / 2, (high - low) / 2
    offset = x - middle
    outside = jnp.abs(offset) > half
    distance = jnp.where(outside, jnp.abs(offset) - half, 0)
    # Its slope is (1 + 3 e) (1 + 2 e + 3 e^2)^(-3/2), which nothing cancels in; that of
    # e / sqrt(1 + e^2), a difference of equals, is noise in float32 from e = 3000. Far
    # out in 1 / e: the square of e would overflow, and the gradient be 0 from 1e15 on.
    far = distance > margin
    excess = jnp.where(far, 0, distance) / margin
    inverse = margin / jnp.where(far, distance, margin)
    left = jnp.where(
        far,
        inverse * jax.lax.rsqrt(3 + (2 + inverse) * inverse),
        jax.lax.rsqrt(1 + (2 + 3 * excess) * excess),
    )
    risen = 1 - left
    beyond = middle + jnp.sign(offset) * (half + margin * risen)
    return jnp.where(outside, beyond, x)


def _layer(spec, params, index):
    """Return one layer and its kernels. The heads, side by side, are the last layer."""
    kernels = None if params.kernels is None else params.kernels[index]
    if index < len(params.hidden):
        return params.hidden[index], kernels
    heads = [params.heads[name] for name, _ in spec.read_outs]
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=-1), *heads)
    return joined, kernels


def _sum_over_inputs(spec, index, layer, kernels, inputs):
    """A layer without its bias."""
    dtype = inputs.dtype
    # One standard deviation beyond the end the outermost Gaussian is steepest. The
    # last B-spline has its center one interval beyond: all gradients are there still.
    margin = width(spec, index)
    if spec.basis == "rbf":
        margin /= math.sqrt(2)
    held = hold(inputs, spec.grid_of(index), margin)
    if kernels is None:
        center = centers(spec, index, dtype)
        per_width = jnp.full_like(center, 1 / width(spec, index))
    else:
        center = kernels.center
        start = math.log(width(spec, index))
        bounds = start - LOG_WIDTH_RANGE, start + LOG_WIDTH_RANGE
        per_width = jnp.exp(-jnp.clip(kernels.log_width, *bounds))

    gaussian = spec.basis == "rbf"

    # One kernel's Gaussians are made, used and forgotten. Forward and backward of one
    # layer, 8192 x 64 -> 64, one core, ms for 8, 16, 32 kernels: einsum over a basis
    # [n, in, kernels] 96, 200, 396 (117 to 470 MB); the basis flat for one product 72,
    # 172, 356; kernel by kernel, kept for the backward pass, 24, 87, 196 (32 to
    # 152 MB); with a hand-written derivative 24, 86, 205; a scan 26, 50, 106 (6 MB).
    # With held inputs it is 32, 59, 115 (23 MB) where the einsum takes 113, 221, 421.
    # Three layers 64, 64, 64 -> 9 of 10k points: einsum 284, flat 251, kept 187, this
    # 92; in blocks of 512 that are recomputed 191, 126, 112, 112, so only memory asks
    # for blocks. Four kernels at a time save a quarter at narrow widths. No custom
    # derivative, so forward mode works.
    # The scan already keeps XLA from merging the two passes.
    @functools.partial(jax.checkpoint, prevent_cse=False)
    def add_kernel(total, kernel):
        center, per_width, weight = kernel
        distance = (held - center) * per_width
        value = jnp.exp(-(distance**2)) if gaussian else bsplines.cubic(distance)
        return total + value @ weight, None

    nothing = jnp.zeros((*inputs.shape[:-1], layer.bias.shape[0]), dtype)
    total, _ = jax.lax.scan(
        add_kernel, nothing, (center, per_width, layer.kernel), unroll=4
    )
    if layer.base is not None:
        total = total + jax.nn.silu(inputs) @ layer.base
    return total
