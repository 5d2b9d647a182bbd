"""State dicts of every kind come out as arrays; nothing in them is executed."""

import json
import pathlib
import pickle
import struct

import numpy as np
import pytest

from nerfies_jax.metrics import weight_files

# state_*.pth are saved by PyTorch 2.13: {a: arange(6)/4 as [2, 3], b: arange(4) in
# float16, t: a transposed view of a, p: a Parameter of ones, slice: arange(10)[3:7:2]}.


@pytest.fixture(params=["zip", "legacy"])
def saved(request, tmp_path):
    name = f"state_{request.param}.pth"
    path = tmp_path / "state.pth"
    path.write_bytes(pathlib.Path(__file__).with_name(name).read_bytes())
    return path


def test_pytorch_files_read_without_pytorch(saved):
    tensors = weight_files.read_tensors(saved)
    quarters = np.arange(6, dtype=np.float32).reshape(2, 3) / 4
    expected = {
        "a": quarters,
        "b": np.arange(4, dtype=np.float16),
        "t": quarters.T,
        "p": np.ones(2, np.float32),
        "slice": np.array([3, 5]),
    }
    assert tensors.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(tensors[name], value)
        assert tensors[name].dtype == value.dtype


def test_a_truncated_file_is_named(saved):
    saved.write_bytes(saved.read_bytes()[:-300])
    with pytest.raises(ValueError, match=r"state\.pth: not a readable \.pth"):
        weight_files.read_tensors(saved)


def test_a_pickle_that_would_run_code_is_refused_and_does_not_run(tmp_path):
    marker = tmp_path / "ran"

    class Payload:
        def __reduce__(self):
            return open, (str(marker), "w")

    path = tmp_path / "evil.pth"
    path.write_bytes(pickle.dumps({"weight": Payload()}, protocol=2))
    with pytest.raises(ValueError, match=r"evil\.pth.*asks for .*open"):
        weight_files.read_tensors(path)
    assert not marker.exists()


def test_a_pickle_of_arrays_reads_without_running_it(tmp_path, rng):
    path = tmp_path / "w.ckpt"
    kernel = np.asfortranarray(rng.normal(size=(2, 3)).astype(np.float32))
    bias = np.arange(3, dtype=">f8")
    path.write_bytes(pickle.dumps({"Conv_0": {"kernel": kernel, "bias": bias}}, 4))
    tensors = weight_files.read_tensors(path)
    assert tensors.keys() == {"Conv_0.kernel", "Conv_0.bias"}
    np.testing.assert_array_equal(tensors["Conv_0.kernel"], kernel)
    np.testing.assert_array_equal(tensors["Conv_0.bias"], bias)
    for bad in ({"a": print}, {"a": np.array([{}], object)}, {"a": 3}):
        path.write_bytes(pickle.dumps(bad))
        with pytest.raises(ValueError, match=r"w\.ckpt: not a readable \.ckpt"):
            weight_files.read_tensors(path)
    # An array that claims to be larger than its bytes allocates nothing.
    content = pickle.dumps({"a": np.zeros(7, np.float32)})
    path.write_bytes(content.replace(b"K\x07", b"K\xff"))
    with pytest.raises(ValueError, match="cannot reshape"):
        weight_files.read_tensors(path)


def test_npz_reads_numbers_and_refuses_objects(tmp_path, rng):
    path = tmp_path / "w.npz"
    value = rng.normal(size=(2, 3))
    np.savez(path, weight=value)
    np.testing.assert_array_equal(weight_files.read_tensors(path)["weight"], value)
    np.savez(path, weight=np.array([{}], object))
    with pytest.raises(ValueError, match=r"w\.npz"):
        weight_files.read_tensors(path)


def safetensors(entries, body):
    header = json.dumps(entries).encode()
    return struct.pack("<Q", len(header)) + header + body


def test_safetensors_read_by_their_offsets(tmp_path):
    path = tmp_path / "w.safetensors"
    entries = {
        "__metadata__": {"format": "pt"},
        "half": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]},
        "full": {"dtype": "F32", "shape": [1, 2], "data_offsets": [4, 12]},
    }
    body = struct.pack("<HHff", 0x3F80, 0xC000, 1.5, -2.0)
    path.write_bytes(safetensors(entries, body))
    tensors = weight_files.read_tensors(path)
    np.testing.assert_array_equal(tensors["half"].astype(np.float32), [1.0, -2.0])
    np.testing.assert_array_equal(tensors["full"], [[1.5, -2.0]])


@pytest.mark.parametrize(
    "data",
    [
        b"",
        struct.pack("<Q", 2**60) + b"{}",
        safetensors(
            {"w": {"dtype": "F32", "shape": [2], "data_offsets": [0, 99]}}, b"12"
        ),
        safetensors(
            {"w": {"dtype": "F32", "shape": [9], "data_offsets": [0, 4]}}, b"1234"
        ),
        safetensors(
            {"w": {"dtype": "X9", "shape": [1], "data_offsets": [0, 4]}}, b"1234"
        ),
    ],
    ids=["empty", "huge header", "offset past the end", "wrong shape", "unknown type"],
)
def test_damaged_safetensors_are_named(data, tmp_path):
    path = tmp_path / "w.safetensors"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"w\.safetensors: not a readable"):
        weight_files.read_tensors(path)


def test_an_archive_with_any_byte_changed_is_read_or_named(tmp_path):
    path = tmp_path / "w.npz"
    np.savez_compressed(path, w=np.arange(300.0))
    whole, refused = path.read_bytes(), []
    for place in range(0, len(whole), 3):
        damaged = bytearray(whole)
        damaged[place] ^= 255
        path.write_bytes(damaged)
        try:
            weight_files.read_tensors(path)
        except ValueError as error:
            refused.append(str(error))
    assert len(refused) > len(whole) / 6
    assert all("w.npz: not a readable" in words for words in refused)


def test_unknown_kinds_and_missing_files_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"w\.onnx: weights must be a \.npz"):
        weight_files.read_tensors(tmp_path / "w.onnx")
    with pytest.raises(ValueError, match=r"w\.npz: No such file"):
        weight_files.read_tensors(tmp_path / "w.npz")
