"""Settings of networks in ONNX files: how to normalize images, and what comes out."""

import dataclasses
import json
import math
import pathlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal

import msgspec
import numpy as np

from nerfies_jax.capture import json_files
from nerfies_jax.capture.capture import CaptureError

MULTIPLE = 14  # pixels of the patches of Depth Anything
MOST_SIDE = 4096
MAX_TEXT = 2**20  # characters of a value in the metadata


@dataclasses.dataclass(frozen=True)
class NetworkSettings:
    """Input and output of a network, as far as its file does not describe them."""

    size: tuple[int, int] | None = None  # width and height of the input
    scale: float = 1 / 255  # factor on 8-bit values
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)  # after scaling
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)
    order: Literal["rgb", "bgr"] = "rgb"
    multiple: int = MULTIPLE  # divisor of the sides, where the network accepts any
    output: str = ""  # name of the output; empty for the first
    # Kind of depth, where empty is the one that fits the static points. Kind of
    # segmentation, where empty is logits if any value is outside of [0, 1].
    kind: Literal["", "depth", "inverse depth", "logits", "probability", "labels"] = ""
    classes: tuple[int, ...] = ()  # classes that may move, of more than two
    threshold: float = 0.5  # probability above which a pixel is segmented

    def __post_init__(self):
        for name in ("mean", "std"):
            values = getattr(self, name)
            _check(len(values) == 3 and np.isfinite(values).all(), name, values, "3")
        _check(min(self.std) > 0, "std", self.std, "positive")
        _check(0 < self.scale < math.inf, "scale", self.scale, "positive")
        _check(self.order in ("rgb", "bgr"), "order", self.order, "rgb or bgr")
        _check(0 < self.multiple <= MOST_SIDE, "multiple", self.multiple, "positive")
        _check(0 < self.threshold < 1, "threshold", self.threshold, "between 0 and 1")
        size = self.size
        fits = size is None or (len(size) == 2 and 0 < min(size) <= max(size))
        _check(
            fits and max(size or (1,)) <= MOST_SIDE, "size", size, "width and height"
        )
        kinds = ("", "depth", "inverse depth", "logits", "probability", "labels")
        _check(self.kind in kinds, "kind", self.kind, "one of " + ", ".join(kinds[1:]))


def _check(fits, name, value, requirement):
    if not fits:
        raise ValueError(f"{name}={value!r} of a network; it must be {requirement}")


def read(path: pathlib.Path, metadata: Mapping[str, str]) -> NetworkSettings:
    """Read the settings of a network from its files.

    Args:
      path: ONNX file. NAME.json next to it counts most, then preprocessor_config.json
        of its folder or the one above, and then its metadata.
      metadata: Metadata of the file. Values of the names of settings are JSON or text.

    Returns:
      The settings.

    Raises:
      CaptureError: If one is unknown, or has a wrong type or value.
    """
    settings_file = path.with_suffix(".json")
    fields: dict[str, Any] = {}
    for source, content in _sources(path, metadata):
        unknown = set(content) - {f.name for f in dataclasses.fields(NetworkSettings)}
        if source == settings_file and unknown:
            names = ", ".join(f.name for f in dataclasses.fields(NetworkSettings))
            raise CaptureError(
                f"{settings_file}: {min(unknown)!r} is no setting; there are {names}"
            )
        fields = {n: v for n, v in content.items() if n not in unknown} | fields
    try:
        return msgspec.convert(fields, NetworkSettings)
    except ValueError as error:
        raise CaptureError(
            f"{settings_file if settings_file.exists() else path}: {error}"
        ) from None


def _sources(path, metadata) -> Iterator[tuple[pathlib.Path, dict[str, Any]]]:
    """Settings by source, from the one that counts most."""
    settings_file = path.with_suffix(".json")
    if settings_file.exists():
        yield settings_file, _object(settings_file)
    for folder in (path.parent, path.parent.parent):
        file = folder / "preprocessor_config.json"
        if file.is_file():
            yield file, _of_preprocessor(_object(file))
            break
    yield path, dict(_of_metadata(metadata))


def _object(file):
    content = json_files.read_json(file, dict[str, Any])
    if not isinstance(content, dict):
        raise CaptureError(f"{file}: expected a JSON object of settings")
    return content


def _of_preprocessor(config):
    """Settings of the preprocessor_config.json of Hugging Face's transformers."""
    fields: dict[str, Any] = {}
    if config.get("do_rescale", True) and "rescale_factor" in config:
        fields["scale"] = config["rescale_factor"]
    if config.get("do_normalize", True) is False:
        fields |= {"mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
    for name, other in (("mean", "image_mean"), ("std", "image_std")):
        if name not in fields and isinstance(config.get(other), list):
            fields[name] = config[other]
    if isinstance(config.get("ensure_multiple_of"), int):
        fields["multiple"] = config["ensure_multiple_of"]
    return fields


def _of_metadata(metadata: Mapping[str, str]) -> Iterable[tuple[str, Any]]:
    for name, text in metadata.items():
        if len(text) > MAX_TEXT:
            continue
        try:
            yield name, json.loads(text)
        except ValueError:
            yield name, text
