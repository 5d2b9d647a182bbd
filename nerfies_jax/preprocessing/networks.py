"""Depth and segmentation by networks that the user has downloaded as ONNX files.

    given = networks.depths(capture, "depth_anything_v2_vits.onnx")

A network runs on the training images as they were captured, in a child process with
limits of memory and time. The input size and the types are read from the file. How
images are normalized, and what the output is, is read from NAME.json next to NAME.onnx,
from the preprocessor_config.json of its folder or the folder above, from the metadata
of the file, or is the normalization of ImageNet.
"""

import contextlib
import dataclasses
import hashlib
import pathlib
import tempfile
from typing import NamedTuple

import cv2
import numpy as np

from nerfies_jax.capture import cache_files, decoder, extras
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.decoder import DecoderError
from nerfies_jax.preprocessing import network_settings
from nerfies_jax.preprocessing.network_settings import MOST_SIDE, NetworkSettings
from nerfies_jax.runtime import events

VERSION = 1  # of cached outputs
# Longest side of the input for networks that accept any size, as for Depth Anything.
LONGEST = 518
CPU_SECONDS = 900.0  # for an image
# Memory beyond that of any decoder, and per byte of the file.
MEMORY_BYTES, MEMORY_PER_BYTE = 2**33, 6
FOLDER = CACHE / "networks"


class Network(NamedTuple):
    """A network file, and how to run it."""

    path: pathlib.Path
    size: tuple[int, int] | None  # width and height of the input, None for any
    kind: str  # type of the input
    channels_last: bool
    settings: NetworkSettings


class Depths(NamedTuple):
    """Results of a depth network."""

    depth: np.ndarray  # [frames, height, width] of the capture, NaN if not computed
    inverse: bool | None  # True for inverse depth, None if it is not known


def depths(
    capture: Capture,
    path: pathlib.Path | str,
    settings: NetworkSettings | None = None,
    folder: pathlib.Path = FOLDER,
) -> Depths:
    """Compute depth of the training images by a network.

    Args:
      capture: The capture.
      path: ONNX file of a network with one output channel, such as Depth Anything or
        MiDaS.
      settings: How to run it. None to read it from the files.
      folder: Cache folder.

    Returns:
      Depth or inverse depth of any scale and offset.

    Raises:
      CaptureError: If the network cannot be run, or its output is no depth.
      MissingExtra: If ONNX Runtime is not installed.
    """
    network = _read_network(path, settings)
    result = np.full(capture.images.shape[:3], np.nan, np.float32)

    def depth_of(output, row):
        output = np.squeeze(np.asarray(output, np.float32))
        if output.ndim != 2:
            raise CaptureError(
                f"{path}: its output {network.settings.output} has shape "
                f"{output.shape}; expected one depth per pixel, so name another output"
            )
        if not np.isfinite(output).all() or np.ptp(output) == 0:
            problem = "the same everywhere" if np.ptp(output) == 0 else "not finite"
            raise CaptureError(
                f"{path}: its depth of frame {capture.ids[row]!r} is {problem}; check "
                "the normalization of its input in its settings"
            )
        # The offset is arbitrary, but aligned depth is expected to be positive.
        return output - min(0.0, float(output.min()))

    for row, depth in _read_or_compute(capture, network, depth_of, folder):
        result[row] = cv2.resize(depth, capture.size, interpolation=cv2.INTER_LINEAR)
    inverse = {"depth": False, "inverse depth": True}.get(network.settings.kind)
    return Depths(result, inverse)


def segments(
    capture: Capture,
    path: pathlib.Path | str,
    settings: NetworkSettings | None = None,
    folder: pathlib.Path = FOLDER,
) -> np.ndarray:
    """Segment what may move in the training images by a network.

    Args:
      capture: The capture.
      path: ONNX file of a network whose output is one channel (salient objects, such as
        U2-Net), two (background and foreground), or one for each class.
      settings: How to run it. None to read it from the files.
      folder: Cache folder.

    Returns:
      Booleans [frames, height, width] of the capture. False in frames for which it was
      not computed.

    Raises:
      CaptureError: If the network cannot be run, or its output is no segmentation.
      MissingExtra: If ONNX Runtime is not installed.
    """
    network = _read_network(path, settings)
    result = np.zeros(capture.images.shape[:3], bool)

    def share_of(output, _):
        return _share(output, network)

    for row, share in _read_or_compute(capture, network, share_of, folder):
        full_share = cv2.resize(share, capture.size, interpolation=cv2.INTER_LINEAR)
        result[row] = full_share > network.settings.threshold
    return result


def _share(output, network):
    """Probability [height, width] that a pixel may move."""
    settings, path = network.settings, network.path
    output = output[0] if output.ndim > 2 and len(output) == 1 else output
    labels = settings.kind == "labels" or output.dtype.kind in "iub"
    if output.ndim == 3 and labels and 1 in (output.shape[0], output.shape[2]):
        output = np.squeeze(output)
    if output.ndim == 2:
        output = output[None]
    if output.ndim != 3 or not np.isfinite(output).all():
        raise CaptureError(
            f"{path}: its output {settings.output} has shape {output.shape}; expected "
            "finite [channels, height, width], so name another output"
        )
    if network.channels_last and not labels:
        output = np.moveaxis(output, -1, 0) if len(output) > 2 else output
    if labels or len(output) > 2:
        if not settings.classes:
            raise CaptureError(
                f"{path}: it has {'labels' if labels else f'{len(output)} classes'}; "
                f"name those that move as classes in {path.with_suffix('.json').name}, "
                'for example {"classes": [15]}'
            )
        label = output[0] if labels else output.argmax(0)
        return np.isin(label, settings.classes).astype(np.float32)
    values = np.asarray(output, np.float32)
    if len(values) == 2:
        values = values[1:] - values[:1] if _logits(values, settings) else values[1:]
    if _logits(output, settings):
        values = 1 / (1 + np.exp(-np.clip(values, -50, 50)))
    return np.ascontiguousarray(values[0])


def _logits(values, settings):
    if settings.kind in ("logits", "probability"):
        return settings.kind == "logits"
    return bool(((values < 0) | (values > 1)).any())


def _read_network(
    path: pathlib.Path | str, settings: NetworkSettings | None = None
) -> Network:
    """Read how to run a network."""
    extras.check("onnxruntime", "onnx")
    path = pathlib.Path(path).absolute()
    if not path.is_file():
        raise CaptureError(f"{path}: no such file of a network; check the path")
    with _report_errors(path), decoder.session() as child:
        about = child.request(
            "network_header", CPU_SECONDS, _memory(path), path=str(path)
        ).about
    if settings is None:
        settings = network_settings.read(path, about["metadata"])
    inputs, outputs = about["inputs"], about["outputs"]
    if len(inputs) != 1 or len(inputs[0][2]) != 4:
        input_list = ", ".join(f"{name} {shape}" for name, _, shape in inputs)
        raise CaptureError(
            f"{path}: its inputs are {input_list or 'none'}; expected one image, "
            "[1, 3, height, width] or [1, height, width, 3]"
        )
    name, kind, shape = inputs[0]
    channels_last = shape[1] != 3 and shape[3] == 3
    types = ("tensor(float)", "tensor(float16)", "tensor(double)", "tensor(uint8)")
    batch_fits = not isinstance(shape[0], int) or shape[0] == 1
    if (shape[1] != 3 and not channels_last) or not batch_fits or kind not in types:
        raise CaptureError(
            f"{path}: its input {name} is {kind} {shape}; expected one color image, "
            "[1, 3, height, width] or [1, height, width, 3]"
        )
    sides = shape[1:3] if channels_last else shape[2:4]
    size = settings.size
    if all(isinstance(side, int) and side > 0 for side in sides):
        size = (sides[1], sides[0])
        if max(size) > MOST_SIDE:
            raise CaptureError(
                f"{path}: its input has {size[0]}x{size[1]} pixels; at most "
                f"{MOST_SIDE}x{MOST_SIDE} are supported"
            )
    names = [name for name, *_ in outputs]
    output = settings.output or names[0]
    if output not in names:
        raise CaptureError(f"{path}: no output {output!r}; it has {', '.join(names)}")
    settings = dataclasses.replace(settings, output=output)
    return Network(path, size, kind, channels_last, settings)


def _memory(path):
    return MEMORY_BYTES + MEMORY_PER_BYTE * path.stat().st_size


@contextlib.contextmanager
def _report_errors(path):
    """Report errors of the child with the path of the network."""
    try:
        yield
    except DecoderError as error:
        advice = "" if error.has_advice else "; export it again, or use another one"
        raise CaptureError(
            f"{path}: ONNX Runtime cannot use it ({str(error)[:400]}){advice}"
        ) from None


def _read_or_compute(capture, network, result_of, folder):
    """Yield training frames and their results, from a cache if they are there."""
    identity = f"network {VERSION} {_digest(capture, network)}"
    path = folder / f"{identity.rpartition(' ')[2]}.npz"
    arrays = cache_files.read(
        path, lambda file: cache_files.read_arrays(file, identity)
    )
    if arrays is None:
        arrays = {"result": np.stack([*_results(capture, network, result_of)])}
        with contextlib.suppress(
            OSError, CaptureError
        ):  # else computed again next time
            cache_files.write_arrays(path, arrays, identity)
    yield from zip(capture.train, arrays["result"], strict=True)


def _results(capture, network, result_of):
    small = _resize_images(capture, network)
    settings = network.settings
    normalization = {
        "scale": settings.scale,
        "mean": settings.mean,
        "std": settings.std,
        "bgr": settings.order == "bgr",
    }
    with (
        tempfile.TemporaryDirectory() as scratch,
        _report_errors(network.path),
        decoder.streaming() as child,
        events.stage(f"running {network.path.name}", len(small)) as stage,
    ):
        file = pathlib.Path(scratch) / "images.npy"
        np.save(file, small)
        answers = child.stream(
            "network",
            CPU_SECONDS,
            _memory(network.path),
            path=str(network.path),
            images=str(file),
            name=settings.output,
            kind=network.kind,
            channels_last=network.channels_last,
            settings=normalization,
        )
        for row, answer in zip(capture.train, answers, strict=True):
            yield result_of(answer.arrays["output"], row)
            stage.advance()


def _resize_images(capture, network):
    """Resize training images to the size of the input, as uint8."""
    width, height = capture.size
    size = network.size
    if size is None:
        part, multiple = LONGEST / max(width, height), network.settings.multiple
        size = tuple(
            max(1, round(side * part / multiple)) * multiple for side in capture.size
        )
    interpolation = cv2.INTER_AREA if size[0] < width else cv2.INTER_CUBIC
    return np.stack(
        [
            cv2.resize(capture.images[row], size, interpolation=interpolation)
            for row in capture.train
        ]
    )


def _digest(capture, network):
    checksum = hashlib.blake2b(digest_size=12)
    settings = sorted(dataclasses.asdict(network.settings).items())
    checksum.update(repr((settings, network.size, capture.images.shape)).encode())
    with network.path.open("rb") as file:
        while part := file.read(2**24):
            checksum.update(part)
    for other in sorted(network.path.parent.glob(f"{network.path.stem}*")):
        status = other.stat()  # weights outside of the file
        checksum.update(f"{other.name} {status.st_size} {status.st_mtime_ns}".encode())
    for row in capture.train:
        checksum.update(np.ascontiguousarray(capture.images[row]).data)
    return checksum.hexdigest()
