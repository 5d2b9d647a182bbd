"""LPIPS: distance of images in the features of a trained image classifier.

Zhang et al. 2018, arXiv:1801.03924, version 0.1 of their code. The layers are here, the
trained weights are not. Without weights `load` raises `WeightsMissing`, whose message
says where they come from.
"""

import dataclasses
import functools
import importlib.util
import operator
import os
import pathlib
from collections.abc import Iterable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry.precision import exact_einsum, widened
from nerfies_jax.metrics import weight_files

# The reference's ImageNet statistics, moved to images in [-1, 1].
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
# The reference adds 1e-10 to the length of a feature vector; a pixel where every
# channel is dead has length 0 and counts as equal to itself.
LENGTH_OFFSET = 1e-10

Scaling = Literal["standard", "unscaled"]


class Convolution(NamedTuple):
    """A convolution with bias, as `lax.conv_general_dilated` takes it (HWIO)."""

    kernel: Float[Array, "rows columns inputs outputs"]
    bias: Float[Array, " outputs"]


class LpipsParams(NamedTuple):
    """Trained weights: the classifier's convolutions and a head for each stage."""

    convolutions: tuple[Convolution, ...]
    heads: tuple[Float[Array, " channels"], ...]  # not negative in the released files


@dataclasses.dataclass(frozen=True)
class Stage:
    """Convolutions up to one of the compared feature maps, after optional pooling.

    Each convolution is (index in torchvision's `features`, kernel width, output
    channels, stride, padding) and is followed by a ReLU.
    """

    convolutions: tuple[tuple[int, int, int, int, int], ...]
    pool: int | None = None  # width of the max pooling in front, stride 2


@dataclasses.dataclass(frozen=True)
class Network:
    """A classifier's feature layers, cut into the five stages LPIPS compares."""

    name: str
    stages: tuple[Stage, ...]
    files: tuple[str, ...]  # what torchvision calls its weights in the torch hub cache
    smallest: int  # pixels on the shorter side, or a stage comes out empty

    @property
    def channels(self) -> tuple[int, ...]:
        """Number of channels of each compared feature map."""
        return tuple(stage.convolutions[-1][2] for stage in self.stages)


ALEX = Network(
    name="alex",
    stages=(
        Stage(((0, 11, 64, 4, 2),)),
        Stage(((3, 5, 192, 1, 2),), pool=3),
        Stage(((6, 3, 384, 1, 1),), pool=3),
        Stage(((8, 3, 256, 1, 1),)),
        Stage(((10, 3, 256, 1, 1),)),
    ),
    files=("alexnet-owt-7be5be79.pth", "alexnet-owt-4df8aa71.pth"),
    smallest=31,
)
VGG = Network(
    name="vgg",
    stages=(
        Stage(tuple((i, 3, 64, 1, 1) for i in (0, 2))),
        Stage(tuple((i, 3, 128, 1, 1) for i in (5, 7)), pool=2),
        Stage(tuple((i, 3, 256, 1, 1) for i in (10, 12, 14)), pool=2),
        Stage(tuple((i, 3, 512, 1, 1) for i in (17, 19, 21)), pool=2),
        Stage(tuple((i, 3, 512, 1, 1) for i in (24, 26, 28)), pool=2),
    ),
    files=("vgg16-397923af.pth",),
    smallest=16,
)


class WeightsMissing(ValueError):
    """LPIPS cannot be computed. The message is one line with the reason."""


def lpips(
    params: LpipsParams,
    network: Network,
    image: Float[Array, "height width 3"],
    truth: Float[Array, "height width 3"],
    scaling: Scaling = "standard",
) -> Float[Array, ""]:
    """Compute the learned perceptual distance of two images.

    Args:
      params: Trained weights.
      network: Their network.
      image: Rendered image in [0, 1], [height, width, 3].
      truth: Ground truth of the same shape.
      scaling: "standard" maps [0, 1] to [-1, 1], on which LPIPS was trained. "unscaled"
        passes [0, 1] unchanged, a mistake in the metrics of Deformable-3DGS, 4DGS and
        E-D3DGS, and is only for comparison with their tables.

    Returns:
      The distance, a scalar.

    Raises:
      ValueError: If the image is too small for the network.

    References:
      Zhang et al. 2018, arXiv:1801.03924, equation 1.
    """
    distances = _stage_distances(params, network, image, truth, scaling)
    return functools.reduce(operator.add, map(jnp.mean, distances))


def lpips_map(
    params: LpipsParams,
    network: Network,
    image: Float[Array, "height width 3"],
    truth: Float[Array, "height width 3"],
    scaling: Scaling = "standard",
) -> Float[Array, "height width"]:
    """Compute the LPIPS of each pixel: the stages' maps resized bilinearly and added.

    Args:
      params: Trained weights.
      network: Their network.
      image: Rendered image in [0, 1], [height, width, 3].
      truth: Ground truth of the same shape.
      scaling: As for `lpips`.

    Returns:
      Distances, [height, width].
    """
    distances = _stage_distances(params, network, image, truth, scaling)
    return sum(jax.image.resize(d, image.shape[:2], "bilinear") for d in distances)


def masked_lpips(
    params: LpipsParams,
    network: Network,
    image: Float[Array, "height width 3"],
    truth: Float[Array, "height width 3"],
    mask: Bool[Array, "height width"],
) -> Float[Array, ""]:
    """Compute the mLPIPS of DyCheck.

    Both images are black outside the mask, and the map is averaged inside it.

    Args:
      params: Trained weights.
      network: Their network.
      image: Rendered image in [0, 1], [height, width, 3].
      truth: Ground truth of the same shape.
      mask: True for the pixels to compare, [height, width].

    Returns:
      The distance, NaN for an empty mask.

    References:
      Gao et al. 2022 (DyCheck), arXiv:2210.13445.
    """
    image, truth = (jnp.where(mask[..., None], x, 0.0) for x in (image, truth))
    distance = lpips_map(params, network, image, truth)
    pixels = jnp.sum(mask).astype(distance.dtype)  # float16 counts to 65 504
    return jnp.sum(jnp.where(mask, distance, 0.0)) / pixels


def features(
    params: LpipsParams, network: Network, signed: Float[Array, "height width 3"]
) -> tuple[Float[Array, "rows columns channels"], ...]:
    """Compute the five compared feature maps of an image, after their ReLUs.

    Args:
      params: Trained weights.
      network: Their network.
      signed: Image in [-1, 1], [height, width, 3].

    Returns:
      Feature maps, [rows, columns, channels].

    Raises:
      ValueError: If the image is too small for the network.
    """
    if min(signed.shape[:2]) < network.smallest:
        raise ValueError(
            f"LPIPS with {network.name} needs {network.smallest} pixels on the shorter "
            f"side, got {signed.shape[1]}x{signed.shape[0]}"
        )
    shift, scale = (jnp.asarray(x, signed.dtype) for x in (SHIFT, SCALE))
    x = ((signed - shift) / scale)[None]
    convolutions = iter(params.convolutions)
    outputs = []
    for stage in network.stages:
        if stage.pool:
            x = lax.reduce_window(
                x,
                -jnp.inf,
                lax.max,
                (1, stage.pool, stage.pool, 1),
                (1, 2, 2, 1),
                "VALID",
            )
        for _, _, _, stride, padding in stage.convolutions:
            kernel, bias = next(convolutions)
            x = lax.conv_general_dilated(
                x,
                kernel,
                (stride, stride),
                ((padding, padding), (padding, padding)),
                dimension_numbers=("NHWC", "HWIO", "NHWC"),
                precision=lax.Precision.HIGHEST,  # TF32 moves LPIPS in its third digit
            )
            x = jax.nn.relu(x + bias)
        outputs.append(x[0])
    return tuple(outputs)


def _stage_distances(params, network, image, truth, scaling):
    if scaling not in ("standard", "unscaled"):
        raise ValueError(f'scaling must be "standard" or "unscaled", got {scaling!r}')
    image, truth = widened(image), widened(truth)
    if scaling == "standard":
        image, truth = 2.0 * image - 1.0, 2.0 * truth - 1.0
    pairs = zip(
        features(params, network, image), features(params, network, truth), strict=True
    )
    return [
        exact_einsum(
            "hwc,c->hw",
            (_unit(a) - _unit(b)) ** 2,
            head,
        )
        for (a, b), head in zip(pairs, params.heads, strict=True)
    ]


def _unit(x):
    length_sq = jnp.sum(x**2, axis=-1, keepdims=True)
    # sqrt has no gradient at 0, where every channel of a pixel is dead.
    alive = length_sq > 0
    length = jnp.where(alive, jnp.sqrt(jnp.where(alive, length_sq, 1.0)), 0.0)
    return x / (length + LENGTH_OFFSET)


def load(network: Network, files: Iterable[str | pathlib.Path] = ()) -> LpipsParams:
    """Load trained weights.

    Args:
      network: The network.
      files: Files (`.pth`, `.safetensors`, `.npz`) that together hold torchvision's
        classifier (`features.0.weight`) and the LPIPS heads (`lin0.model.1.weight`), or
        a saved `lpips.LPIPS` module with both. Missing parts are looked for in the
        torch hub cache (classifier) and in an installed `lpips` package (heads),
        neither of which is imported.

    Returns:
      The weights.

    Raises:
      WeightsMissing: If they cannot be found.
    """
    files, tensors = tuple(files), {}
    for path in files:
        tensors.update(weight_files.read_tensors(path))
    for part, names, fallback in (
        ("classifier", _classifier_names(network)[0], _cached_classifier(network)),
        ("heads", _head_names(0), _installed_heads(network)),
    ):
        if any(f"{name}.weight" in tensors for name in names):
            continue
        if fallback is None:
            raise WeightsMissing(_missing(network, part, files))
        tensors.update(weight_files.read_tensors(fallback))
    return _params(network, tensors)


def _missing(network, part, files):
    where = {
        "classifier": f"{network.files[0]} from https://download.pytorch.org/models/, "
        f"given or in {_hub_folder()}",
        "heads": f"v0.1/{network.name}.pth of the lpips package, given or installed",
    }[part]
    read = ", ".join(map(str, files)) or "no file was named"
    return f"no LPIPS {network.name} {part} weights ({read}); needed: {where}"


def _hub_folder():
    cache = os.environ.get("XDG_CACHE_HOME", pathlib.Path.home() / ".cache")
    home = os.environ.get("TORCH_HOME", pathlib.Path(cache) / "torch")
    return pathlib.Path(home) / "hub" / "checkpoints"


def _cached_classifier(network):
    paths = (_hub_folder() / name for name in network.files)
    return next((path for path in paths if path.is_file()), None)


def _installed_heads(network):
    spec = importlib.util.find_spec("lpips")
    if spec is None or spec.origin is None:
        return None
    path = pathlib.Path(spec.origin).parent / "weights" / "v0.1" / f"{network.name}.pth"
    return path if path.is_file() else None


def _classifier_names(network):
    """For each convolution, what torchvision and a saved LPIPS module call it."""
    return [
        (f"features.{index}", f"net.slice{number}.{index}")
        for number, stage in enumerate(network.stages, 1)
        for index, *_ in stage.convolutions
    ]


def _head_names(stage):
    return f"lin{stage}.model.1", f"lins.{stage}.model.1", f"lin{stage}.model.0"


def _params(network, tensors):
    def take(names, suffix, shape):
        names = [f"{name}.{suffix}" for name in names]
        name = next((name for name in names if name in tensors), None)
        if name is None:
            raise WeightsMissing(
                f"the LPIPS {network.name} weights lack {names[0]} (also looked for as "
                f"{', '.join(names[1:])}); is this another network's file?"
            )
        if tensors[name].shape != shape or not np.all(np.isfinite(tensors[name])):
            raise WeightsMissing(
                f"LPIPS {network.name} weight {name} should be finite and "
                f"{shape}, is {tensors[name].shape}; is this another network's file?"
            )
        return np.asarray(tensors[name], np.float32)

    convolutions, inputs = [], 3
    settings = (layer for stage in network.stages for layer in stage.convolutions)
    for names, (_, width, outputs, _, _) in zip(
        _classifier_names(network), settings, strict=True
    ):
        kernel = take(names, "weight", (outputs, inputs, width, width))
        bias = take(names, "bias", (outputs,))
        convolutions.append(
            Convolution(jnp.asarray(kernel.transpose(2, 3, 1, 0)), jnp.asarray(bias))
        )
        inputs = outputs
    heads = [
        jnp.asarray(take(_head_names(i), "weight", (1, channels, 1, 1)).reshape(-1))
        for i, channels in enumerate(network.channels)
    ]
    return LpipsParams(tuple(convolutions), tuple(heads))
