"""Running a network of an ONNX file on images, in the decoder's child process.

The file is untrusted data. It runs on the CPU with the operators of ONNX Runtime alone:
no library of custom operators is loaded, settings stored in the file are ignored, and
weights in other files must be in its folder, which ONNX Runtime checks.
"""

import os
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from nerfies_jax.capture.errors import FileError

# The first version that refuses weights outside of the folder of the model.
LEAST_VERSION = (1, 24)
MAX_FILE = 2**31  # bytes, the limit of the format
MAX_THREADS = 16
MAX_VALUES = 2**28  # of an output for one image
TYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}


def _session(path):
    os.environ.pop("ORT_LOAD_CONFIG_FROM_MODEL", None)
    import onnxruntime

    version = tuple(int(part) for part in onnxruntime.__version__.split(".")[:2])
    if version < LEAST_VERSION:
        raise FileError(
            f"onnxruntime {onnxruntime.__version__} is installed, which loads weights "
            f"from any folder; install {'.'.join(map(str, LEAST_VERSION))} or later"
        )
    size = pathlib.Path(path).stat().st_size
    if size > MAX_FILE:
        raise FileError(
            f"{size} bytes; at most {MAX_FILE} are read, so use a smaller one"
        )
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = min(MAX_THREADS, _cores())
    options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False
    options.add_session_config_entry("session.load_model_format", "ONNX")
    return onnxruntime.InferenceSession(
        path, options, providers=["CPUExecutionProvider"]
    )


def _cores():
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def header(path: str) -> Iterator[tuple[dict[str, Any], dict]]:
    """Read the inputs, outputs and metadata of a network.

    Args:
      path: The ONNX file.

    Yields:
      One dictionary: `inputs` and `outputs` as lists of name, type and shape, and
      `metadata`, which maps names to texts.
    """
    session = _session(path)

    def describe(nodes):
        return [(node.name, node.type, [*node.shape]) for node in nodes]

    metadata = session.get_modelmeta().custom_metadata_map
    yield (
        {
            "inputs": describe(session.get_inputs()),
            "outputs": describe(session.get_outputs()),
            "metadata": {**metadata},
        },
        {},
    )


def run(
    path: str, images: str, name: str, kind: str, channels_last: bool, settings: Mapping
) -> Iterator[tuple[dict, dict[str, np.ndarray]]]:
    """Run a network on images, one at a time.

    Args:
      path: The ONNX file.
      images: npy file of uint8 images, [images, height, width, 3].
      name: Name of the output.
      kind: Type of the input, of `TYPES`.
      channels_last: True if the input is [1, height, width, 3].
      settings: `scale`, `mean`, `std` and `bgr` of the normalization.

    Yields:
      The output of each image, as `output`.
    """
    session = _session(path)
    entry = session.get_inputs()[0].name
    for image in np.load(images, mmap_mode="r", allow_pickle=False):
        if settings["bgr"]:
            image = image[..., ::-1]
        value: Any = np.asarray(image)
        if kind != "tensor(uint8)":
            pixels = value * np.float64(settings["scale"])
            value = (pixels - np.array(settings["mean"])) / np.array(settings["std"])
        value = value if channels_last else np.moveaxis(value, -1, 0)
        tensor = np.ascontiguousarray(value[None], TYPES[kind])
        (output,) = session.run([name], {entry: tensor})
        if not isinstance(output, np.ndarray) or output.dtype.kind not in "fiub":
            raise FileError(
                f"its output {name} is not an array of numbers; name another"
            )
        if output.size > MAX_VALUES:
            raise FileError(
                f"its output {name} has shape {output.shape}; at most {MAX_VALUES} "
                "values are read, so use a smaller input size"
            )
        yield {}, {"output": output}
