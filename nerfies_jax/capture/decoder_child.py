"""Child process of `decoder`, which decodes untrusted files with resource limits.

Requests arrive on stdin, one JSON object per line. Each answer on stdout is a line of
JSON followed by the bytes of the arrays that it lists. The last line of a request marks
its end.
"""

import contextlib
import functools
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


def _colmap(folder):
    from nerfies_jax.capture import colmap_tables

    yield colmap_tables.read(folder)


def _exr(path, header_only):
    from nerfies_jax.capture import exr_decoding

    yield exr_decoding.read(path, header_only)


def _image(path):
    from nerfies_jax.capture import images

    yield {}, {"pixels": images.decode(path)}


def _mask(path):
    from nerfies_jax.capture import masks

    pixels = masks.decode(path)
    arrays = {"value": pixels.value}
    if pixels.alpha is not None:
        arrays["alpha"] = pixels.alpha
    yield {"full": pixels.full, "colorful": pixels.colorful}, arrays


def _photograph(path, header_only):
    from nerfies_jax.capture import photographs

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


_VIDEO = "nerfies_jax.capture.video_decoding"


def _video(operation, **arguments):
    from nerfies_jax.capture import video_decoding

    yield from getattr(video_decoding, operation)(**arguments)


_NETWORK = "nerfies_jax.capture.network_decoding"


def _network(operation, **arguments):
    from nerfies_jax.capture import network_decoding

    yield from getattr(network_decoding, operation)(**arguments)


OPERATIONS: dict[str, tuple[Callable[..., Iterable], str]] = {
    "colmap": (_colmap, "nerfies_jax.capture.colmap_tables"),
    "exr": (_exr, "nerfies_jax.capture.exr_decoding"),
    "video": (functools.partial(_video, "frames"), _VIDEO),
    "video_length": (functools.partial(_video, "length"), _VIDEO),
    "video_notes": (functools.partial(_video, "notes"), _VIDEO),
    "video_transfer": (functools.partial(_video, "transfer"), _VIDEO),
    "network": (functools.partial(_network, "run"), _NETWORK),
    "network_header": (functools.partial(_network, "header"), _NETWORK),
    "image": (_image, "nerfies_jax.capture.images"),
    "mask": (_mask, "nerfies_jax.capture.masks"),
    "photograph": (_photograph, "nerfies_jax.capture.photographs"),
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
    import importlib

    children.end_with_parent()
    # Libraries that print must not write into the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    for line in sys.stdin.buffer:
        job = json.loads(line)
        operation, module = OPERATIONS[job["operation"]]
        # Imported first, since the limit of memory excludes libraries.
        importlib.import_module(module)
        try:
            start_time = time.process_time()
            _limit(job["cpu_seconds"], job["memory_bytes"])
            for about, arrays in operation(**job["arguments"]):
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
