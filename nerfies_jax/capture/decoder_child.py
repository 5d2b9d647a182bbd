"""Child process of `decoder`, which decodes untrusted files with resource limits.

Requests arrive on stdin, one JSON object per line. Each answer on stdout is a line of
JSON followed by the bytes of the arrays that it lists. The last line of a request marks
its end.
"""

import contextlib
import functools
import importlib
import json
import os
import pathlib
import sys
import time
from collections.abc import Callable, Iterable

from nerfies_jax.capture.errors import FileError
from nerfies_jax.runtime import children

try:
    import resource
except ImportError:  # Windows has no such module
    resource = None  # type: ignore[assignment]


def _limit(cpu_seconds, memory_bytes):
    """Bound the further processor time and memory of this process."""
    if resource is None:
        return
    cpu_time = time.process_time()
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_time + cpu_seconds) + 1, hard))
    with contextlib.suppress(ValueError, OSError):
        with open("/proc/self/statm") as file:
            size_bytes = int(file.read().split()[0]) * resource.getpagesize()
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (size_bytes + int(memory_bytes), hard))


def _table(module, **arguments):
    yield module.read(**arguments)


def _image(images, path):
    yield {}, {"pixels": images.decode(path)}


def _mask(masks, path):
    pixels = masks.decode(path)
    arrays = {"value": pixels.value}
    if pixels.alpha is not None:
        arrays["alpha"] = pixels.alpha
    yield {"full": pixels.full, "colorful": pixels.colorful}, arrays


def _photograph(photographs, path, header_only):
    photographs.heic_is_read()
    file = pathlib.Path(path)
    try:
        if header_only:
            yield photographs.decode_header(file)._asdict(), {}
        else:
            yield {}, {"pixels": photographs.decode_upright(file)}
    # Which of the two it is decides whether a folder is read without the file.
    except (photographs.Unreadable, photographs.TooLarge) as error:
        yield {"refused": type(error).__name__, "message": str(error)}, {}


# The module that decodes, and the name of its function, or a function above that takes
# the module and the arguments.
OPERATIONS: dict[str, tuple[str, Callable[..., Iterable] | str]] = {
    "colmap": ("colmap_tables", _table),
    "exr": ("exr_decoding", _table),
    "video": ("video_decoding", "frames"),
    "video_length": ("video_decoding", "length"),
    "video_notes": ("video_decoding", "notes"),
    "video_transfer": ("video_decoding", "transfer"),
    "network": ("network_decoding", "run"),
    "network_header": ("network_decoding", "header"),
    "image": ("images", _image),
    "mask": ("masks", _mask),
    "photograph": ("photographs", _photograph),
}


def _answer(stream, about, arrays):
    import numpy as np

    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    rows = [(name, each.dtype.str, each.shape) for name, each in arrays.items()]
    stream.write(json.dumps({"about": about, "arrays": rows}).encode() + b"\n")
    for array in arrays.values():
        stream.write(array.reshape(-1).view(np.uint8).data)
    stream.flush()


def _say(stream, about):
    stream.write(json.dumps(about).encode() + b"\n")
    stream.flush()


def main() -> None:
    """Answer requests until stdin ends."""
    children.end_with_parent()
    # Libraries that print must not write into the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    for line in sys.stdin.buffer:
        job = json.loads(line)
        name, operation = OPERATIONS[job["operation"]]
        # Imported first, since the limit of memory excludes libraries.
        module = importlib.import_module(f"nerfies_jax.capture.{name}")
        if isinstance(operation, str):
            decode = getattr(module, operation)
        else:
            decode = functools.partial(operation, module)
        try:
            start_time = time.process_time()
            _limit(job["cpu_seconds"], job["memory_bytes"])
            for about, arrays in decode(**job["arguments"]):
                _answer(answers, about, arrays)
                if time.process_time() - start_time > 1.0:  # the limit holds per answer
                    start_time = time.process_time()
                    _limit(job["cpu_seconds"], job["memory_bytes"])
            _say(answers, {"end": True})
        # Decoders may raise anything. The parent adds the path.
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            if isinstance(error, MemoryError):
                reason = "it takes more memory than such a file should"
            advice = isinstance(error, FileError)
            _say(answers, {"error": reason[:1000], "has_advice": advice})


if __name__ == "__main__":
    main()
