"""State dicts of every kind come out as arrays; nothing in them is executed."""

import base64
import json
import pickle
import struct
import zlib

import numpy as np
import pytest

from nerfies_jax.measure import weight_files

# Saved by PyTorch 2.13, zlib-compressed: {a: arange(6)/4 as [2, 3], b: arange(4) in
# float16, t: a transposed view of a, p: a Parameter of ones, slice: arange(10)[3:7:2]}.
ZIP = """
eNqlVUlv00AUntiJkxroBqULUHYI0KaJ3TYJW5GFLCQjkRqBKg5EbuI2Fm7S50yKgEulkgI34IA4IQ6Iv8CBX8GB
C+KAxCZOXLnBjO2ktqM0ahlp8rLMt7zJe885hQ0jFIuhltWL+pFmFUrGij5R1LCWWL5jylI3uuVbq0yhUDFNvYCN
SrnKX7OKuqUXLxsFzAM6pUIoPhciZBowBVwhbIl8DRtmlc9b+nzNMIt5rJerFSu/IvDAxuNzUXK4Sk5qizqEHQgv
mxUNX3e+5CFiEyaBm2NJLCzXIKpwGGKzClIYhV2HLoVVQuvAPylRAzsw7FRhlw2ah+4SESk1iK9o5kKTt8c+koLe
UlQJY+ijfOE69CuhOux2uPZgGFBhr30Qw6DDVYqUuJJtYYhCWIVZh2ElRJ2MOLB9GParcMCGLcNom4tY1ixtSce6
xcPBBrMNEeAQ4WcwHLZTrMMRaumow30Mw3EVTjy2P5x8BHEVTs1F6CWaRkGH0758r1bKi818z9jkIowRch7D+Cy1
XocEfZlwyJMYUioItUROicbeLtys/SAQunNtq2YQDTSrJrFQsZY0nF/RrSqpDlnqCxQPWSlK/e735zVqhu721CMo
vUHt1kheM43F8pJexrIktrJ3XtOT1MDMXfjFEAlmUwN9aKZpYP4e1iu02GXp3HZ0G8s0MDZ16qF+4eswR1S4TT10
o4u+rpxIytLZ/zDgsK5eJC8zCF0ie5Xs1zPUkfr958Eh8sNQB0djfkcpWYqjLeifR5eQRPWen3z/iwrEOuid9+sJ
spRB289/1c6Z6j+d5T5uQ1/8P31nhdzIuJF1Y9iNETdyboy6sWGwy400jzff6rdz9P2mefQgsZlHs0MntpqIyFPF
D68Wb3Tun1EkbDSwfXVV3TJIB9/X6NMjbxRlKbFFA6lkOp2ZFtJCNp3NZqYmU9PCVDIrZLPplDiZFDOCmJkShakM
dflw399PceIjbrsM2Vfd8Omdbr0tzoPPwSDaO8AGfchpBrWbh0ES7xAa8ZE885K0TL4gj3eQ9Pl4+lnUOsCCcG/X
d/vgL1gUmD1BrLeD/dh4OIBNBbHe7vNjXwaxQhDrrXg/digSwIpBrLd2e3zYLx5sm//MW1KjPrDKoQ7FnlM4bqzR
Gux4E8kH4po7E/5wjRbn7O5/0LUxOnJKhHMwvH3eOfsPRQockQ==
"""
LEGACY = """
eNp1kttu00AQhn1K0i60lDPlWM7mFJzEoYmESIWqCmk51dz4Blmus9RGxvbYm0ogVcpNQuEZuOCSV+MRkLhg1nYq
GcJKntGuZ//v39kdK19J+Pvb1q+19z9erzbHyoufKsZ9kHR7RZKkJI157MWhs8fSLIgjkLHAXsI/YcB5yBwWDQM3
AuXAJrjIPybMyYJPLAN1HzTdruFi5scphxpVbBVnQcShTjVbExpxtAsNqo1GyPQQEzKPIyUjr9IhS9lwM/A4AemO
BbJuy7jDBcXjcer5TWfEgzAjTsp2RkE4dDiLsjh19toEVF23GwKMle4uA63YQrbC2OVvikUCNXsZa/rmer/X6/S7
fdMwDKjnHr1khLbqLzksbFOJKlSdwiJVqTwF8sUXdo5wOGrBUu5pB5Z9RPozzDM3fHdIOVal9DqPkLLi46FR/bhQ
1yZwgsoTOFkon+Jw2oIzuTKHs4WyP9fsOb8wuSpkVKpM4TyVhdcLhdRFDpcsuJxLJXDlP41L3NT9wDhLCaz9S1vv
dlrdbssw4SrSFKRdy1sygevC9I2CdJPDLQtuH+QT/TNgvFvcfRh4DO5V+vMcb/2wP/crqHbP6JomPEAUQVRzWxxr
Ag9FMApUi0Pbgo54MW/FK53jVJ6nqcy7CHVeWzXWVKTZGA/ER6TqkMs8q1PLrJW5VuZ6mRtlXijz4l/1OB5LG9LT
eoUyfoIB+RuDwsf3wR/tRtdj
"""


@pytest.fixture(params=["zip", "legacy"])
def saved(request, tmp_path):
    path = tmp_path / "state.pth"
    encoded = {"zip": ZIP, "legacy": LEGACY}[request.param]
    path.write_bytes(zlib.decompress(base64.b64decode(encoded)))
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


def test_unknown_kinds_and_missing_files_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"w\.onnx: weights come as \.npz"):
        weight_files.read_tensors(tmp_path / "w.onnx")
    with pytest.raises(ValueError, match=r"w\.npz: no such file"):
        weight_files.read_tensors(tmp_path / "w.npz")
