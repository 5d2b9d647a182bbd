"""Gaussians in the formats and axes of other programs."""

import json
import math
import re
import struct

import jax
import numpy as np
import plyfile
import pytest

from gaussians_jax.core.splats import SH_DC
from gaussians_jax.io import files, gltf, turned
from gaussians_jax.splatting import harmonics
from tests.gaussians.shared import rotations
from tests.gaussians.test_files import opacities, same_rotation, some_splats


def unpacked(word, bits):
    """Numbers in [0, 1] of a packed word, the first in the highest bits."""
    columns = []
    for size in reversed(bits):
        columns.insert(0, (word & (2**size - 1)) / (2**size - 1))
        word = word >> size
    return np.stack(columns, axis=-1)


def decompressed(path):
    """A compressed PLY as splat-transform 3.7 reads it, to which this was compared."""
    ply = plyfile.PlyData.read(path)
    vertex, chunk = ply["vertex"].data, ply["chunk"].data
    row = np.arange(len(vertex)) // 256

    def between(kind, axes, values):
        low, high = (
            np.stack([chunk[f"{bound}_{kind}{axis}"] for axis in axes], -1)[row]
            for bound in ("min", "max")
        )
        return low + (high - low) * values

    color = unpacked(vertex["packed_color"], (8, 8, 8, 8))
    word = vertex["packed_rotation"]
    three = (unpacked(word & 0x3FFFFFFF, (10, 10, 10)) - 0.5) * 2**0.5
    largest = np.sqrt(1 - (three**2).sum(-1))
    quaternion = np.stack(
        [np.insert(a, n, b) for a, n, b in zip(three, word >> 30, largest, strict=True)]
    )
    rest = np.stack([ply["sh"][f"f_rest_{i}"] for i in range(45)], -1)
    return {
        "mean": between("", "xyz", unpacked(vertex["packed_position"], (11, 10, 11))),
        "log_scale": between(
            "scale_", "xyz", unpacked(vertex["packed_scale"], (11, 10, 11))
        ),
        "color": between("", "rgb", color[:, :3]),
        "opacity": color[:, 3],
        "quaternion": quaternion,
        "sh_rest": (((rest + 0.5) / 256 - 0.5) * 8).reshape(-1, 3, 15).swapaxes(1, 2),
    }


def test_a_compressed_ply_holds_the_gaussians_within_its_steps(tmp_path):
    rows = some_splats(count=700)
    assert files.save(tmp_path / "a.compressed.ply", rows) == 700
    read = decompressed(tmp_path / "a.compressed.ply")
    assert len(read["mean"]) == 700  # of which the last chunk has 188
    distance = np.linalg.norm(read["mean"][:, None] - np.asarray(rows.mean), axis=-1)
    order = distance.argmin(axis=1)
    assert len(set(order)) == 700
    rows = jax.tree.map(lambda leaf: np.asarray(leaf, float)[order], rows)
    steps = {"mean": 6 / 1023, "log_scale": 7 / 1023, "sh_rest": 8 / 256}
    for name, step in steps.items():  # of the coarsest axis, over the whole range
        np.testing.assert_allclose(read[name], getattr(rows, name), atol=0.51 * step)
    color = 0.5 + SH_DC * rows.sh_dc[:, 0]
    np.testing.assert_allclose(read["color"], color, atol=0.51 * np.ptp(color) / 255)
    np.testing.assert_allclose(read["opacity"], *opacities(rows), atol=0.51 / 255)
    assert same_rotation(read["quaternion"], rows.quaternion).max() < 3e-6
    # Neighbors share a chunk, which keeps the steps of positions small.
    apart = read["mean"] - read["mean"][np.random.default_rng(0).permutation(700)]
    along = np.linalg.norm(np.diff(read["mean"], axis=0), axis=1)
    assert along.mean() < 0.4 * np.linalg.norm(apart, axis=1).mean()


@pytest.mark.parametrize("degree", [0, 3])
def test_a_usd_stage_holds_linear_values(degree, tmp_path):
    rows = some_splats(degree=degree)
    files.save(tmp_path / "a.usda", rows, usd_up="Z")
    text = (tmp_path / "a.usda").read_text()
    assert text.startswith("#usda 1.0\n")
    assert 'upAxis = "Z"' in text

    def array(name, width):
        words = re.search(rf" {name} = \[(.*)\]", text)[1]
        return np.array(re.findall(r"[-+.\de]+", words), float).reshape(-1, width)

    names = ("positions", "orientations", "scales", "opacities")
    mean, turn, scale, opacity = map(array, names, (3, 4, 3, 1))
    np.testing.assert_allclose(mean, rows.mean, rtol=1e-6)
    np.testing.assert_allclose(scale, np.exp(rows.log_scale), rtol=1e-5)
    np.testing.assert_allclose(opacity[:, 0], *opacities(rows), rtol=1e-5)
    assert same_rotation(turn, rows.quaternion).max() < 1e-12
    colors = array("radiance:sphericalHarmonicsCoefficients", 3)
    ours = np.concatenate([rows.sh_dc, rows.sh_rest], axis=1).reshape(-1, 3)
    np.testing.assert_allclose(colors, ours, rtol=1e-6)
    assert f"sphericalHarmonicsDegree = {degree}\n" in text


def glb_attributes(path):
    """The vertex attributes of a .glb, by the text of glTF 2.0."""
    data = path.read_bytes()
    magic, version, total = struct.unpack("<4sII", data[:12])
    assert (magic, version, total) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    document, rest = json.loads(data[20 : 20 + size]), data[20 + size :]
    assert kind == b"JSON"
    assert struct.unpack("<I4s", rest[:8]) == (len(rest) - 8, b"BIN\0")
    assert size % 4 == 0 == len(rest) % 4
    assert document["buffers"] == [{"byteLength": len(rest) - 8}]
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    assert primitive["mode"] == 0
    assert (
        document["extensionsUsed"]
        == ["KHR_gaussian_splatting"]
        == list(primitive["extensions"])
    )
    read, at = {}, 8
    for name, number in primitive["attributes"].items():
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        values = np.frombuffer(rest, dtype, accessor["count"] * width, at)
        assert view["byteOffset"] == at - 8
        assert view["byteLength"] == values.nbytes
        at += values.nbytes
        read[name] = values.reshape(-1, width)
        if name == "POSITION":
            assert accessor["min"] == read[name].min(axis=0).tolist()
            assert accessor["max"] == read[name].max(axis=0).tolist()
    return read


@pytest.mark.parametrize("degree", [0, 3])
def test_a_glb_holds_linear_values(degree, tmp_path):
    """Ratified KHR_gaussian_splatting, which splat-transform 3.7 writes equally."""
    rows = some_splats(degree=degree)
    assert files.save(tmp_path / "a.glb", rows) == 20
    rows = jax.tree.map(np.asarray, rows)
    read = glb_attributes(tmp_path / "a.glb")
    opacity = opacities(rows)[0]
    kinds = {name.removeprefix("KHR_gaussian_splatting:"): read[name] for name in read}
    np.testing.assert_array_equal(kinds.pop("POSITION"), rows.mean)
    np.testing.assert_allclose(kinds.pop("SCALE"), np.exp(rows.log_scale), rtol=1e-6)
    np.testing.assert_allclose(kinds.pop("OPACITY")[:, 0], opacity, rtol=1e-6)
    wxyz = np.roll(kinds.pop("ROTATION"), 1, axis=1)
    assert same_rotation(wxyz, rows.quaternion).max() < 1e-12
    color = np.clip(0.5 + SH_DC * rows.sh_dc[:, 0], 0, 1)
    fallback = np.column_stack([color, opacity])
    np.testing.assert_allclose(kinds.pop("COLOR_0") / 255, fallback, atol=0.51 / 255)
    ours = np.concatenate([rows.sh_dc, rows.sh_rest], axis=1)
    for row, values in enumerate(ours.swapaxes(0, 1)):
        band = math.isqrt(row)
        name = f"SH_DEGREE_{band}_COEF_{row - band**2}"
        np.testing.assert_array_equal(kinds.pop(name), values)
    assert not kinds


def test_too_many_gaussians_for_a_glb_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(gltf, "MOST_BYTES", 4000)
    with pytest.raises(ValueError, match="at most 4000: write fewer"):
        files.save(tmp_path / "a.glb", some_splats())
    assert not list(tmp_path.iterdir())


def test_turned_gaussians_look_the_same_from_a_turned_camera():
    rows = some_splats()
    rotation = rotations(np.array([0.3, -0.5, 0.7, 0.4])).as_matrix()
    after = turned.turned(rows, rotation)
    np.testing.assert_allclose(after.mean, rows.mean @ rotation.T, atol=1e-5)

    def covariance(rows):
        axes = rotations(rows.quaternion).as_matrix()
        return axes @ (np.exp(rows.log_scale)[:, :, None] ** 2 * axes.swapaxes(1, 2))

    turn = rotation @ covariance(rows) @ rotation.T
    np.testing.assert_allclose(covariance(after), turn, rtol=1e-4, atol=1e-6)
    direction = np.random.default_rng(1).normal(size=(20, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    basis = jax.jit(lambda direction: harmonics.basis(direction, 3))

    def rest(rows, direction):
        values = np.stack(basis(np.float32(direction)))[1:]
        return np.einsum("in,nic->nc", values, rows.sh_rest)

    seen = rest(after, direction @ rotation.T)
    np.testing.assert_allclose(seen, rest(rows, direction), atol=1e-5)
